"""What is looked at before Mitsuba reads a file: faults at which it would end the process, hang or read anything.

Mitsuba recognises most damage and says so. Here is the rest, each as the fuzzer found it.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Callable, Iterable, Mapping
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
_FILE_NAME = re.compile(r'filename="([^"]*)"')


def check_xml(path: Path, seen: frozenset[Path] = frozenset()) -> None:
    """Raise where a scene file, or one that it includes, is nested too deep or grows without end.

    Raises
    ------
    SceneCaptumError
        With the file and its fault.
    """
    text = _COMMENT.sub("", path.read_text(encoding="utf-8", errors="replace"))
    depth = deepest = 0
    for tag in _TAG.finditer(text):
        depth += 1 if tag.group() == "<" else -1
        deepest = max(deepest, depth)
    if deepest > DEEPEST:
        raise SceneCaptumError(
            f"{path} cannot be loaded: its tags are nested {deepest} deep; {DEEPEST} is the most that is read. "
            "Close each tag, or take out what holds only one thing."
        )
    _check_defaults(path, text)
    for name in _FILE_NAME.findall(text):
        other = path.parent / name
        check_kind(other)
        if other.suffix == ".xml" and is_file(other) and other.resolve() not in seen:
            check_xml(other, seen | {path.resolve()})


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
    """Follow the dictionary at the end of a ``.serialized`` mesh: Mitsuba jumps to wherever it points."""
    data = path.read_bytes()
    (version,) = struct.unpack_from("<H", data, 2) if len(data) > 4 else (0,)
    size, letter = (8, "Q") if version >= 4 else (4, "I")
    (count,) = struct.unpack("<I", data[-4:])
    start = len(data) - 4 - size * count
    if version not in (3, 4) or not count or start < 4:
        raise _damaged(path, f"there is no room for {count} meshes in {len(data)} bytes")
    if any(offset >= start for offset in struct.unpack_from(f"<{count}{letter}", data, start)):
        raise _damaged(path, "a mesh is said to begin beyond its end")


_CHECKS: dict[bytes, Callable[[Path], None]] = {
    b"#?": _check_hdr,
    b"VOL": _check_volume,
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
