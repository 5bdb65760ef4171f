"""What is looked at before Mitsuba reads a file: faults at which it would end the process, hang or read anything.

Mitsuba recognises most damage and says so. Here is the rest, each as the fuzzer found it.
"""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import SceneCaptumError

DEEPEST = 200  # nested tags or dicts; Mitsuba descends by recursion, and overflows its stack
LONGEST = 100_000  # characters of a <default>; each may double what the one before it holds
LONGEST_RUN = 64  # bytes of a Radiance picture that one of its file may stand for
DENSEST = 2.0**24  # beyond it a mean free path is shorter than float32 can step through a scene of size 1

_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
_TAG = re.compile(r"</|/>|<(?=\w)")
_DEFAULT = re.compile(r'<default\s+name="([^"]*)"\s+value="([^"]*)"')
_PLACEHOLDER = re.compile(r"(?<!\\)\$(\w+)")
_FILE_NAME = re.compile(r'filename="([^"]*)"')


def check_xml(path: Path, values: Mapping[str, str]) -> None:
    """Raise where a scene file, or one that it includes, is nested too deep or grows without end.

    Parameters
    ----------
    path
        Of the file.
    values
        Those of its ``$names``.

    Raises
    ------
    SceneCaptumError
        With the file and its fault.
    """
    for file, text in _texts(path, values):
        depth = deepest = 0
        for tag in _TAG.finditer(text):
            depth += 1 if tag.group() == "<" else -1
            deepest = max(deepest, depth)
        if deepest > DEEPEST:
            raise SceneCaptumError(
                f"{file} cannot be loaded: its tags are nested {deepest} deep; {DEEPEST} is the most that is "
                "read. Close each tag, or take out what holds only one thing."
            )
        _check_defaults(file, text)


def _texts(
    path: Path, values: Mapping[str, str], seen: frozenset[Path] = frozenset()
) -> Iterator[tuple[Path, str]]:
    """Read a scene file and those that it includes, without their comments."""
    text = _COMMENT.sub("", path.read_text(encoding="utf-8", errors="replace"))
    yield path, text
    values = {**dict(_DEFAULT.findall(text)), **values}
    for name in _FILE_NAME.findall(text):
        other = path.parent / _PLACEHOLDER.sub(lambda found: values.get(found[1], found[0]), name)
        check_kind(other)
        if other.suffix == ".xml" and is_file(other) and other.resolve() not in seen:
            yield from _texts(other, values, seen | {path.resolve()})


@dataclass(frozen=True)
class Placeholders:
    """The ``$names`` of a scene file and of those that it includes: all, and those with a ``<default>``."""

    used: frozenset[str]
    defaults: frozenset[str]

    @classmethod
    def of(cls, path: Path, values: Mapping[str, str]) -> Placeholders:
        """Look for them, where some have got values."""
        texts = [text for _, text in _texts(path, values)]
        used = (name for text in texts for name in _PLACEHOLDER.findall(text))
        defaults = (name for text in texts for name, _ in _DEFAULT.findall(text))
        return cls(frozenset(used), frozenset(defaults))


def _check_defaults(path: Path, text: str) -> None:
    known: dict[str, str] = {}
    for name, value in _DEFAULT.findall(text):
        known[name] = re.sub(r"\$(\w+)", lambda found: known.get(found.group(1), ""), value)
        if len(known[name]) > LONGEST:
            raise SceneCaptumError(
                f"{path} cannot be loaded: <default name={name!r}> grows beyond {LONGEST} characters by naming "
                "others. Write its value out."
            )


def check_dict(config: Mapping[str, Any]) -> None:
    """Raise where a scene dict is nested too deep, or has a value or key at which Mitsuba ends the process."""
    pending: list[tuple[Any, tuple[Any, ...]]] = [(config, ())]
    while pending:
        one, trail = pending.pop()
        if len(trail) > DEEPEST:
            raise SceneCaptumError(
                f"The scene dict is nested more than {DEEPEST} deep, or holds itself. Name a shared object with "
                '{"type": "ref", "id": …} instead.'
            )
        for key, value in one.items():
            place = ".".join(map(str, (*trail, key)))
            if not isinstance(key, str):
                raise SceneCaptumError(f"The scene dict has a key that is no string: {place}.")
            if value is None:
                raise SceneCaptumError(f"The scene dict has None at {place!r}. Leave the key out.")
            if isinstance(value, dict):
                pending.append((value, (*trail, key)))


def is_file(path: Path) -> bool:
    """Whether there is such a file; there is none of a name that no file can have."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def check_file(path: Path) -> None:
    """Raise where a picture, mesh or volume would make Mitsuba corrupt its memory or never end."""
    check_kind(path)
    if not is_file(path):
        return
    with path.open("rb") as file:
        start = file.read(10)
    for magic, check in _CHECKS.items():
        if start.startswith(magic):
            check(path)


def check_kind(path: Path) -> None:
    """Raise where a path leads to a folder or a device, which has no end to read to."""
    if not is_file(path) and os.path.exists(path):
        raise SceneCaptumError(
            f"{path} is {'a folder' if path.is_dir() else 'a device'}, not a file to read."
        )


def _check_hdr(path: Path) -> None:
    """Follow a Radiance picture's run lengths: after a line without them, Mitsuba writes beyond the picture."""
    data = path.read_bytes()
    size = re.search(rb"\n-Y (\d+) \+X (\d+)\n", data)
    if size is None:
        raise _damaged(path, "its header has no line with its size, such as -Y 512 +X 1024")
    height, width = map(int, size.groups())
    if not 0 < 4 * height * width <= LONGEST_RUN * len(data):
        raise _damaged(path, f"{width}×{height} pixels are not in {len(data)} bytes")
    at = size.end()
    if not 8 <= width < 0x8000 or not _is_coded(data, at):
        return  # flat from the first line on, which Mitsuba reads rightly
    for line in range(height):
        if at >= len(data):
            return  # cut off, and Mitsuba says so
        if not _is_coded(data, at):
            raise _damaged(path, f"line {line + 1} of {height} has no run lengths, unlike the first")
        at = _after_runs(data, at + 4, 4 * width)


def _is_coded(data: bytes, at: int) -> bool:
    return data[at : at + 2] == b"\2\2" and data[at + 2 : at + 3] < b"\x80"


def _after_runs(data: bytes, at: int, count: int) -> int:
    """Return where the run lengths of ``count`` bytes end."""
    while count > 0:
        length = data[at] if at < len(data) else 1
        run = length - 128 if length > 128 else length
        at += 2 if length > 128 else 1 + length
        count -= max(run, 1)
    return at


def _check_volume(path: Path) -> None:
    """Compare a grid's size with its file's; Mitsuba takes negative sizes and endless densities as they come."""
    data = path.read_bytes()
    if len(data) < 48:
        raise _damaged(path, f"{len(data)} bytes hold no grid")
    kind, *size = struct.unpack("<5i", data[4:24])
    count = int(np.prod(size, dtype=object))
    if kind != 1 or min(size) < 1 or len(data) - 48 != 4 * count:
        raise _damaged(path, f"a grid of {'×'.join(map(str, size))} numbers is not in {len(data)} bytes")
    values = np.frombuffer(data, "<f4", offset=24)
    if not np.isfinite(values).all() or np.abs(values).max() > DENSEST:
        raise _damaged(path, f"it holds numbers that are not finite or beyond {DENSEST:.0f}")


def _check_serialized(path: Path) -> None:
    """Unpack ``.serialized`` meshes: Mitsuba goes wherever the dictionary at the end and the faces point."""
    data = path.read_bytes()
    (version,) = struct.unpack_from("<H", data, 2) if len(data) > 4 else (0,)
    size, letter = (8, "Q") if version >= 4 else (4, "I")
    (count,) = struct.unpack("<I", data[-4:])
    start = len(data) - 4 - size * count
    if version not in (3, 4) or not count or start < 4:
        raise _damaged(path, f"there is no room for {count} meshes in {len(data)} bytes")
    offsets = struct.unpack_from(f"<{count}{letter}", data, start)
    for number, (offset, end) in enumerate(zip(offsets, [*offsets[1:], start], strict=True)):
        try:
            fault = _fault_of_mesh(zlib.decompress(data[offset + 4 : end]), version)
        except (zlib.error, struct.error, ValueError) as error:
            fault = str(error)
        if fault:
            raise _damaged(path, f"mesh {number}: {fault}")


def _fault_of_mesh(data: bytes, version: int) -> str | None:
    """Compare the counts, sizes and indices of an unpacked mesh."""
    (flags,) = struct.unpack_from("<I", data)
    at = 4 if version == 3 else data.index(b"\0", 4) + 1
    vertices, faces = struct.unpack_from("<QQ", data, at)
    floats = 3 + 3 * bool(flags & 1) + 2 * bool(flags & 2) + 3 * bool(flags & 8)
    places = at + 16 + vertices * floats * (8 if flags & 0x2000 else 4)
    if places + 12 * faces != len(data):
        return f"{vertices} vertices and {faces} faces are not in {len(data)} bytes"
    corners = np.frombuffer(data, "<u4", offset=places)
    return "a face has a vertex that is not there" if faces and corners.max() >= vertices else None


def _check_ply(path: Path) -> None:
    """Look for faces with vertices that are not there: Mitsuba builds its tree of what lies beyond."""
    data = path.read_bytes()
    end = re.search(rb"end_header\r?\n", data)
    if end is None:
        return
    head, body = data[: end.start()], data[end.end() :]
    lines = [line.split() for line in head.decode(errors="replace").splitlines() if line.strip()]
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(_ply_format(lines), "")
    try:
        counts, rows = _ply_rows(lines, order or "<")
        if list(counts)[:2] != ["vertex", "face"]:
            return
        if order:
            vertices = counts["vertex"] * np.dtype(rows["vertex"]).itemsize
            faces = np.frombuffer(body, rows["face"], counts["face"], vertices)
            corners = faces["corners"][faces["count"] == 3]
        else:
            words = body.split()[counts["vertex"] * len(rows["vertex"]) :]
            width = len(words) // counts["face"]
            corners = np.array(words[: width * counts["face"]], float).reshape(-1, width)[:, 1:4]
    except (KeyError, ValueError, TypeError, IndexError, ArithmeticError):
        return  # no triangles as Mitsuba reads them, and it says so
    if corners.size and corners.max() >= counts["vertex"]:
        raise _damaged(path, f"a face has vertex {corners.max():.0f} of {counts['vertex']}")


def _ply_format(lines: list[list[str]]) -> str:
    return next((line[1] for line in lines if line[:1] == ["format"] and len(line) > 1), "")


def _ply_rows(lines: list[list[str]], order: str) -> tuple[dict[str, int], dict[str, list[Any]]]:
    """Return how many rows each element has, and the fields of a row; a list is that of a triangle."""
    counts: dict[str, int] = {}
    rows: dict[str, list[Any]] = {}
    name = ""
    for kind, *words in lines:
        if kind == "element":
            name = words[0]
            counts[name], rows[name] = int(words[1]), []
        elif kind == "property" and words[0] == "list":
            rows[name] += [
                ("count", order + _PLY_TYPES[words[1]]),
                ("corners", order + _PLY_TYPES[words[2]], 3),
            ]
        elif kind == "property":
            rows[name].append((words[1], order + _PLY_TYPES[words[0]]))
    return counts, rows


_PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2"},
    **{"int": "i4", "uint": "u4", "float": "f4", "double": "f8"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"},
}

_CHECKS: dict[bytes, Callable[[Path], None]] = {
    b"#?": _check_hdr,
    b"VOL": _check_volume,
    b"ply": _check_ply,
    b"\x1c\x04": _check_serialized,
}


def _damaged(path: Path, fault: str) -> SceneCaptumError:
    return SceneCaptumError(f"{path} is damaged: {fault}. Save it again, or take a copy that is whole.")


def check_named(resolve: Callable[[str], Any], nodes: Iterable[Any]) -> None:
    """Look at every file that the parsed nodes of a scene name."""
    for node in nodes:
        props = node.props
        pictures = _PICTURES.get(props.plugin_name(), ())
        if pictures and not any(key in props for key in pictures):
            raise SceneCaptumError(
                f"A {props.plugin_name()} of the scene has no picture. Give it one of: {', '.join(pictures)}."
            )
        name = props.get("filename", "") if "filename" in props else ""
        if isinstance(name, str) and name:
            check_file(Path(str(resolve(name))))


# What these take their pictures from; with none of it they end the process.
_PICTURES = {"bitmap": ("filename", "bitmap", "data"), "envmap": ("filename", "bitmap")}
