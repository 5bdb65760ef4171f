"""Writing numbers with as many digits as their errors support, and names that fit."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

# Plain decimals compare best down a column, but not when most of them are zeros.
_MOST_DECIMALS = 6
_LEAST_SCIENTIFIC = 1e6
_LEAST_OBJECT = 9  # columns that are left to the object's name in a label
_MOST_DIGITS = 8  # all that single precision has


class Format(NamedTuple):
    """How the numbers of one row are written: to which decimal place, and with which common power of ten.

    Attributes
    ----------
    place
        The last digit's place, counted to the right of the decimal point.
    exponent
        The power of ten that is taken out; 0 for plain decimals.
    """

    place: int
    exponent: int

    @classmethod
    def of(cls, value: float, error: float | None, *, digits: int | None = None) -> Format:
        """Choose the format of a value with an error, or four significant digits where there is none.

        Parameters
        ----------
        digits
            Significant digits of the error; by default one or two, as the Particle Data Group rounds: two
            where they begin with less than 355, so that rounding changes no error by more than a sixth.
        """
        error = error if error is not None and math.isfinite(error) else 0.0
        size = max(abs(value) if math.isfinite(value) else 0.0, error)
        if size == 0:
            return cls(0, 0)
        place = _last_place(error, digits) if error else 3 - _exponent(size)
        place = min(place, _MOST_DIGITS - 1 - _exponent(size))
        plain = place <= _MOST_DECIMALS and size < _LEAST_SCIENTIFIC
        return cls(place, 0 if plain else _exponent(size))

    def at_most(self, digits: int, size: float) -> Format:
        """Keep no more than so many significant digits of a number of this size."""
        if size == 0 or not math.isfinite(size):
            return self
        return self._replace(place=min(self.place, digits - 1 - _exponent(size)))

    def write(self, number: float) -> str:
        """Write a number; zero has neither digits nor a sign."""
        if number == 0 or not math.isfinite(number):
            return f"{number + 0.0:g}"
        decimals = self.place + self.exponent
        scaled = round(number / 10.0**self.exponent, decimals) + 0.0  # adding zero takes the sign off −0.0
        text = f"{scaled:.{max(decimals, 0)}f}"
        return f"{text}e{self.exponent}" if self.exponent else text

    def write_signed(self, number: float) -> str:
        """Write a number with its sign, which what rounds to zero has not."""
        text = self.write(number)
        positive = number > 0 and re.search("[1-9]", text.partition("e")[0])
        return f"+{text}" if positive else text


def with_error(value: float, error: float | None, *, digits: int | None = None) -> tuple[str, str]:
    """Write a value and its error to the same decimal place, ``('0.0978', '0.0008')``.

    The error is an empty string where there is none. ``digits`` is that of ``Format.of``.
    """
    style = Format.of(value, error, digits=digits)
    return style.write(value), "" if error is None else style.write(error)


def align_decimals(numbers: Sequence[str]) -> list[str]:
    """Pad numbers so that their decimal points stand in one column."""
    heads = [re.split(r"[.e]", number, maxsplit=1)[0] for number in numbers]
    tails = [number[len(head) :] for number, head in zip(numbers, heads, strict=True)]
    left, right = max(map(len, heads), default=0), max(map(len, tails), default=0)
    return [head.rjust(left) + tail.ljust(right) for head, tail in zip(heads, tails, strict=True)]


def shorten(names: Sequence[str], width: int) -> list[str]:
    """Shorten names in the middle, where they say least, and replace what cannot be printed.

    Of a label, ``object: property``, both are kept: it is the object's name that loses its middle, as long as a
    few columns are left to it. Where two different names would then read alike, they are cut elsewhere.

    Example
    -------
    >>> shorten(["mat-Wall White painted.001: diffuse reflectance", "lamp: radiance"], 36)
    ['mat-Wal…ted.001: diffuse reflectance', 'lamp: radiance']
    """
    names = ["".join(c if c.isprintable() else "�" for c in name) for name in names]
    middle = max(width - 1, 0) // 2
    shortened = [_cut_label(name, width, 0) for name in names]
    # Off the middle of the object's name, nearest first; as the last resort, off the middle of all.
    shifts = sorted(range(-middle, middle + 1), key=abs)
    cuts = [partial(_cut_label, width=width, shift=shift) for shift in shifts]
    cuts += [partial(cut, width=width, tail=middle + shift) for shift in shifts]
    for cut_elsewhere in cuts:
        doubtful = _alike(names, shortened)
        if not doubtful:
            return shortened
        shortened = [
            cut_elsewhere(name) if short in doubtful else short
            for name, short in zip(names, shortened, strict=True)
        ]
    return shortened


def _alike(names: Sequence[str], shortened: Sequence[str]) -> set[str]:
    """Return what stands for several different names."""
    meant: dict[str, set[str]] = {}
    for name, short in zip(names, shortened, strict=True):
        meant.setdefault(short, set()).add(name)
    return {short for short, candidates in meant.items() if len(candidates) > 1}


def _cut_label(label: str, width: int, shift: int) -> str:
    """Cut a label to a width, so many columns off the middle of the object's name, and its property if it must."""
    if columns(label) <= width:
        return label
    thing, separator, what = label.rpartition(": ")
    if separator:
        left = width - len(separator) - min(columns(thing), _LEAST_OBJECT, width // 2)
        what = separator + cut(what, left, left // 2) if left > 0 else ""
    else:
        thing, what = label, ""
    room = width - columns(what)
    return cut(thing, room, min(max((room - 1) // 2 + shift, 0), max(room - 1, 0))) + what


def cut(name: str, width: int, tail: int) -> str:
    """Leave out what precedes the last ``tail`` columns, so that at most ``width`` remain."""
    if columns(name) <= width:
        return name
    end = _first(name[::-1], min(tail, width - 1))[::-1]
    return f"{_first(name, width - 1 - tail)}…{end}" if width > 0 else ""


def _first(text: str, width: int) -> str:
    """Return as much of the beginning as fits in so many columns."""
    taken = 0
    for index, character in enumerate(text):
        taken += columns(character)
        if taken > width:
            return text[:index]
    return text


def columns(text: str) -> int:
    """Return how many columns of a terminal a text takes: two for a Chinese letter, none for an accent on one."""
    if text.isascii():
        return len(text)
    return sum(
        0 if unicodedata.combining(c) else 2 if unicodedata.east_asian_width(c) in "WF" else 1 for c in text
    )


def pad(text: str, width: int) -> str:
    """Add spaces on the right, up to so many columns."""
    return text + " " * (width - columns(text))


def _exponent(number: float) -> int:
    """Return the power of ten that a number has once it is rounded: 0.99999 counts as 1."""
    return int(f"{number:.3e}".partition("e")[2])


def _last_place(error: float, digits: int | None) -> int:
    exponent = _exponent(error)
    if digits is None:
        digits = 2 if error < 3.55 * 10.0**exponent else 1
    return digits - 1 - exponent
