"""Reads photometric files of the IES: ANSI/IES LM-63 of 1986, 1991, 1995, 2002 and 2019."""

from __future__ import annotations

import math
import os
import re
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import torch

from ...errors import SceneCaptumError
from .._files import check_kind, is_file
from ._photometry import Photometry

METRES = {1.0: 0.3048, 2.0: 1.0}  # by the file's number for its unit
TYPES = {1.0: "C", 2.0: "B", 3.0: "A"}
# Later files have a number in place of the ballast–lamp photometric factor that is not a factor.
LAST_WITH_PHOTOMETRIC_FACTOR = 1991

_VERSION = re.compile(r"\s*IES(?:NA)?[\s:]*(?:LM-63-)?(\d{4}|\d{2})\b", re.IGNORECASE)
_TILT = re.compile(r"^[ \t]*TILT[ \t]*=[ \t]*(.*?)[ \t]*$", re.IGNORECASE | re.MULTILINE)


def read_ies(path: str | os.PathLike[str]) -> Photometry:
    """Return the photometry in an IES LM-63 file.

    The candelas are those of the file times its multiplier and ballast factors, over the full turn where the file
    leaves out what symmetry repeats.

    Example
    -------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "downlight.ies"
    >>> _ = path.write_text('''IES:LM-63-2019
    ... TILT=NONE
    ... 1 -1 1 3 1 1 2 0 0 0 1 1 10
    ... 0 45 90
    ... 0
    ... 300 240 0''')
    >>> round(read_ies(path).lumens)
    983

    Raises
    ------
    SceneCaptumError
        If the file is missing or damaged, is of photometric type A or B, or has a TILT table with effect.
    """
    path = Path(path)
    try:
        return _parse(_text(path))
    except _FormatError as fault:
        if path.suffix.lower() == ".ldt":
            raise SceneCaptumError(
                f"{path} is an EULUMDAT file, which is not read: export the lamp as IES (LM-63)."
            ) from None
        raise SceneCaptumError(f"{path} cannot be read as an IES file: {fault}.") from None


class _FormatError(Exception):
    """What is wrong with a file, without its name."""


def _text(path: Path) -> str:
    check_kind(path)
    if not is_file(path):
        raise SceneCaptumError(f"There is no IES file {str(path)!r}. Check the path.")
    # Old files have labels in any encoding.
    return path.read_text(encoding="utf-8-sig", errors="replace")


class _Header(NamedTuple):
    """The numbers before the angles, in the order of the file."""

    lamps: float
    lumens_per_lamp: float
    multiplier: float
    verticals: float
    horizontals: float
    type: float
    unit: float
    width: float
    length: float
    height: float
    ballast_factor: float
    photometric_factor: float
    watts: float


def _parse(text: str) -> Photometry:
    tilt = _TILT.search(text)
    if tilt is None:
        raise _FormatError("it has no TILT= line")
    numbers = _Numbers(text[tilt.end() :])
    _check_tilt(tilt[1], numbers)
    header = _Header(*numbers.take(len(_Header._fields), "header"))
    _check_header(header)
    verticals, horizontals = int(header.verticals), int(header.horizontals)
    vertical = numbers.take(verticals, "vertical angle")
    horizontal = numbers.take(horizontals, "horizontal angle")
    candela = numbers.take(verticals * horizontals, "candela")
    numbers.check_end()
    _check_ascending("vertical", vertical)
    _check_ascending("horizontal", horizontal)
    if vertical[0] not in (0, 90) or vertical[-1] not in (90, 180):
        raise _FormatError(f"its vertical angles must span 0–90, 90–180 or 0–180°, not {_span(vertical)}")
    if min(candela) < 0 or not any(candela):
        raise _FormatError("its candelas must not be negative, and not all 0")
    angles, table = _full_turn(
        torch.tensor(horizontal, dtype=torch.float64),
        torch.tensor(candela, dtype=torch.float64).reshape(horizontals, verticals),
    )
    return Photometry(
        vertical=torch.tensor(vertical, dtype=torch.float64),
        horizontal=angles,
        table=table * _factor(header, text),
        rated_lumens=header.lamps * header.lumens_per_lamp if header.lumens_per_lamp > 0 else None,
        size=_size(header),
        watts=header.watts,
    )


class _Numbers:
    """The numbers of a file, one after the other; lines mean nothing."""

    def __init__(self, text: str) -> None:
        self._words = text.replace(",", " ").replace("\x1a", " ").split()
        self._next = 0

    def take(self, count: int, name: str) -> list[float]:
        """Return the next numbers; raise if there are fewer, or if a word is not a finite number."""
        words = self._words[self._next : self._next + count]
        found = [_number(word, name) for word in words]
        if len(found) < count:
            raise _FormatError(f"it ends after {len(found)} of {count} {name} values")
        self._next += count
        return found

    def check_end(self) -> None:
        """Raise if numbers are left: then a count in the header is wrong."""
        rest = self._words[self._next :]
        if rest:
            raise _FormatError(f"{rest[0]!r} follows its last candela: check its numbers of angles")


def _number(word: str, name: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise _FormatError(f"its {name} values contain {word!r}, which is not a finite number")
    return value


def _check_tilt(tilt: str, numbers: _Numbers) -> None:
    """Read the table of a lamp that gives less light when tilted; raise unless it has no effect."""
    if tilt.upper() == "NONE":
        return
    if tilt.upper() == "INCLUDE":
        _, pairs = numbers.take(2, "TILT")
        count = _count("TILT angles", pairs)
        numbers.take(count, "TILT angle")
        if all(factor == 1 for factor in numbers.take(count, "TILT factor")):
            return
    raise _FormatError(
        f"TILT={tilt} makes its light depend on how it is mounted, which is not supported; write TILT=NONE, "
        "without its table, for the candelas as measured"
    )


def _check_header(header: _Header) -> None:
    kind = TYPES.get(header.type)
    if kind != "C":
        found = f"type {kind}" if kind else f"number {header.type:g}"
        raise _FormatError(f"its photometry must be of type C (number 1), not {found}; convert the file")
    if header.unit not in METRES:
        raise _FormatError(f"its unit must be 1 (feet) or 2 (metres), not {header.unit:g}")
    _count("lamps", header.lamps)
    if _count("vertical angles", header.verticals) < 2:
        raise _FormatError("it must have at least 2 vertical angles")
    _count("horizontal angles", header.horizontals)
    if header.lumens_per_lamp <= 0 and header.lumens_per_lamp != -1:
        raise _FormatError(
            f"its lumens per lamp must be positive, or -1 for absolute photometry, not {header.lumens_per_lamp:g}"
        )
    for name in ("multiplier", "ballast_factor"):
        if getattr(header, name) <= 0:
            raise _FormatError(
                f"its {name.replace('_', ' ')} must be positive, not {getattr(header, name):g}"
            )


def _count(name: str, value: float) -> int:
    if value < 1 or not value.is_integer():
        raise _FormatError(f"its number of {name} must be a whole number of at least 1, not {value:g}")
    return int(value)


def _check_ascending(name: str, angles: list[float]) -> None:
    for before, after in pairwise(angles):
        if after <= before:
            raise _FormatError(f"its {name} angles must ascend, but {after:g} follows {before:g}")


def _span(angles: list[float]) -> str:
    return f"{angles[0]:g}–{angles[-1]:g}°"


def _factor(header: _Header, text: str) -> float:
    """Return the factor by which the file's candelas are multiplied."""
    version = _VERSION.match(text)
    year = int(version[1]) if version else 1986  # the first edition has no line with a version
    factor = header.multiplier * header.ballast_factor
    if year + 1900 * (year < 100) > LAST_WITH_PHOTOMETRIC_FACTOR:
        return factor
    if header.photometric_factor <= 0:
        raise _FormatError(f"its photometric factor must be positive, not {header.photometric_factor:g}")
    return factor * header.photometric_factor


def _size(header: _Header) -> tuple[float, float, float]:
    metres = METRES[header.unit]
    return metres * header.width, metres * header.length, metres * header.height


def _full_turn(horizontal: torch.Tensor, table: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the angles and candelas over 360°, from those that the file gives for its symmetry (LM-63)."""
    match horizontal[0].item(), horizontal[-1].item():
        case 0.0, 0.0:  # the same in all planes
            return torch.tensor([0.0, 360.0], dtype=torch.float64), table.expand(2, -1)
        case 0.0, 360.0:
            return horizontal, table
        case 0.0, 90.0:  # the same in all quadrants
            return _mirror(*_mirror(horizontal, table))
        case (0.0, 180.0) | (90.0, 270.0):  # the same on both sides of a plane
            return _mirror(horizontal, table)
    found = _span(horizontal.tolist())
    raise _FormatError(f"its horizontal angles must be 0, or span 0–90, 0–180, 90–270 or 0–360°, not {found}")


def _mirror(horizontal: torch.Tensor, table: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Append the planes mirrored about the last one."""
    mirrored = 2 * horizontal[-1] - horizontal[:-1].flip(0)
    return torch.cat([horizontal, mirrored]), torch.cat([table, table[:-1].flip(0)])
