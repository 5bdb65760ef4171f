"""Checks before Mitsuba reads a file, for faults that make it crash, hang or read out of bounds.

Mitsuba detects and reports most damage. These are the cases that it does not, found by the fuzzer.
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

MAX_DEPTH = 200  # of nested tags or dicts; Mitsuba parses recursively and overflows its stack
MAX_DEFAULT_LENGTH = 100_000  # characters of a <default>, which can double with each reference to another
MAX_RLE_RATIO = 64  # decoded bytes of a Radiance image per byte of its file
MAX_DENSITY = 2.0**24  # above it the mean free path is below float32 resolution in a scene of size 1

_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
_TAG = re.compile(r"</|/>|<(?=\w)")
_DEFAULT = re.compile(r'<default\s+name="([^"]*)"\s+value="([^"]*)"')
_PLACEHOLDER = re.compile(r"(?<!\\)\$(\w+)")
_FILE_NAME = re.compile(r'filename="([^"]*)"')


def check_xml(path: Path, values: Mapping[str, str]) -> None:
    """Raise if a scene file, or one that it includes, is nested too deeply or has exponentially growing defaults.

    ``values`` are those of its ``$name`` placeholders.
    """
    for file, text in _texts(path, values):
        depth = deepest = 0
        for tag in _TAG.finditer(text):
            depth += 1 if tag.group() == "<" else -1
            deepest = max(deepest, depth)
        if deepest > MAX_DEPTH:
            raise SceneCaptumError(
                f"{file} cannot be loaded: its tags are nested {deepest} levels deep; the maximum is {MAX_DEPTH}. "
                "Check that each tag is closed, or remove unnecessary nesting."
            )
        _check_defaults(file, text)


def _texts(
    path: Path, values: Mapping[str, str], seen: frozenset[Path] = frozenset()
) -> Iterator[tuple[Path, str]]:
    """Yield the path and text of a scene file and of those that it includes, without comments."""
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
    """The ``$name`` placeholders of a scene file and its includes: all, and those with a ``<default>``."""

    used: frozenset[str]
    defaults: frozenset[str]

    @classmethod
    def find(cls, path: Path, values: Mapping[str, str]) -> Placeholders:
        """Find them in a file; ``values`` are as for ``check_xml``."""
        texts = [text for _, text in _texts(path, values)]
        used = (name for text in texts for name in _PLACEHOLDER.findall(text))
        defaults = (name for text in texts for name, _ in _DEFAULT.findall(text))
        return cls(frozenset(used), frozenset(defaults))


def _check_defaults(path: Path, text: str) -> None:
    known: dict[str, str] = {}
    for name, value in _DEFAULT.findall(text):
        known[name] = re.sub(r"\$(\w+)", lambda found: known.get(found.group(1), ""), value)
        if len(known[name]) > MAX_DEFAULT_LENGTH:
            raise SceneCaptumError(
                f"{path} cannot be loaded: <default name={name!r}> grows beyond {MAX_DEFAULT_LENGTH} characters "
                "by referencing other defaults. Write out its value."
            )


def check_dict(config: Mapping[str, Any]) -> None:
    """Raise if a scene dict is nested too deeply, or contains a value or key that crashes Mitsuba."""
    pending: list[tuple[Any, tuple[Any, ...]]] = [(config, ())]
    while pending:
        current, parents = pending.pop()
        if len(parents) > MAX_DEPTH:
            raise SceneCaptumError(
                f"The scene dict is nested more than {MAX_DEPTH} levels deep, or contains itself. Reference a "
                'shared object with {"type": "ref", "id": …} instead.'
            )
        for key, value in current.items():
            key_path = ".".join(map(str, (*parents, key)))
            if not isinstance(key, str):
                raise SceneCaptumError(f"The scene dict has a key that is not a string: {key_path}.")
            if value is None:
                raise SceneCaptumError(f"The scene dict has None at {key_path!r}. Leave the key out.")
            if isinstance(value, dict):
                pending.append((value, (*parents, key)))


def is_file(path: Path) -> bool:
    """Whether a file exists; False for invalid file names."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def check_file(path: Path) -> None:
    """Raise if an image, mesh or volume would make Mitsuba corrupt memory or hang."""
    check_kind(path)
    if not is_file(path):
        return
    with path.open("rb") as file:
        start = file.read(10)
    for magic, check in _CHECKS.items():
        if start.startswith(magic):
            check(path)


def check_kind(path: Path) -> None:
    """Raise if a path is a folder or a device, which may be endless."""
    if not is_file(path) and os.path.exists(path):
        raise SceneCaptumError(
            f"{path} is {'a folder' if path.is_dir() else 'a device'}, not a regular file."
        )


def _check_hdr(path: Path) -> None:
    """Check a Radiance image's run-length encoding: after a scanline without it, Mitsuba writes out of bounds."""
    data = path.read_bytes()
    size = re.search(rb"\n-Y (\d+) \+X (\d+)\n", data)
    if size is None:
        raise _damaged(path, "its header has no line with its size, such as -Y 512 +X 1024")
    height, width = map(int, size.groups())
    if not 0 < 4 * height * width <= MAX_RLE_RATIO * len(data):
        raise _damaged(path, f"{width}×{height} pixels do not fit in {len(data)} bytes")
    offset = size.end()
    if not 8 <= width < 0x8000 or not _is_run_length_encoded(data, offset):
        return  # flat from the first scanline on, which Mitsuba reads correctly
    for line in range(height):
        if offset >= len(data):
            return  # truncated, which Mitsuba reports
        if not _is_run_length_encoded(data, offset):
            raise _damaged(path, f"line {line + 1} of {height} is not run-length encoded, unlike the first")
        offset = _end_of_runs(data, offset + 4, 4 * width)


def _is_run_length_encoded(data: bytes, offset: int) -> bool:
    return data[offset : offset + 2] == b"\2\2" and data[offset + 2 : offset + 3] < b"\x80"


def _end_of_runs(data: bytes, offset: int, count: int) -> int:
    """Return the offset behind the runs that decode to ``count`` bytes."""
    while count > 0:
        length = data[offset] if offset < len(data) else 1
        run = length - 128 if length > 128 else length
        offset += 2 if length > 128 else 1 + length
        count -= max(run, 1)
    return offset


def _check_volume(path: Path) -> None:
    """Check a grid's size and values: Mitsuba accepts negative sizes and infinite densities."""
    data = path.read_bytes()
    if len(data) < 48:
        raise _damaged(path, f"{len(data)} bytes are too few for a grid")
    kind, *size = struct.unpack("<5i", data[4:24])
    count = int(np.prod(size, dtype=object))
    if kind != 1 or min(size) < 1 or len(data) - 48 != 4 * count:
        raise _damaged(path, f"a grid of {'×'.join(map(str, size))} numbers does not match {len(data)} bytes")
    values = np.frombuffer(data, "<f4", offset=24)
    if not np.isfinite(values).all() or np.abs(values).max() > MAX_DENSITY:
        raise _damaged(path, f"it contains numbers that are not finite or exceed {MAX_DENSITY:.0f}")


def _check_serialized(path: Path) -> None:
    """Check ``.serialized`` meshes: Mitsuba follows mesh offsets and vertex indices without a bounds check."""
    data = path.read_bytes()
    (version,) = struct.unpack_from("<H", data, 2) if len(data) > 4 else (0,)
    size, letter = (8, "Q") if version >= 4 else (4, "I")
    (count,) = struct.unpack("<I", data[-4:])
    start = len(data) - 4 - size * count
    if version not in (3, 4) or not count or start < 4:
        raise _damaged(path, f"{count} meshes do not fit in {len(data)} bytes")
    offsets = struct.unpack_from(f"<{count}{letter}", data, start)
    for number, (offset, end) in enumerate(zip(offsets, [*offsets[1:], start], strict=True)):
        try:
            fault = _find_mesh_fault(zlib.decompress(data[offset + 4 : end]), version)
        except (zlib.error, struct.error, ValueError) as error:
            fault = str(error)
        if fault:
            raise _damaged(path, f"mesh {number}: {fault}")


def _find_mesh_fault(data: bytes, version: int) -> str | None:
    """Check the counts, sizes and indices of a decompressed mesh."""
    (flags,) = struct.unpack_from("<I", data)
    offset = 4 if version == 3 else data.index(b"\0", 4) + 1
    vertices, faces = struct.unpack_from("<QQ", data, offset)
    floats = 3 + 3 * bool(flags & 1) + 2 * bool(flags & 2) + 3 * bool(flags & 8)
    indices_offset = offset + 16 + vertices * floats * (8 if flags & 0x2000 else 4)
    if indices_offset + 12 * faces != len(data):
        return f"{vertices} vertices and {faces} faces do not match {len(data)} bytes"
    indices = np.frombuffer(data, "<u4", offset=indices_offset)
    return "a face has a vertex that does not exist" if faces and indices.max() >= vertices else None


def _check_ply(path: Path) -> None:
    """Check vertex indices: Mitsuba builds its acceleration structure from out-of-bounds memory."""
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
            indices = faces["indices"][faces["count"] == 3]
        else:
            words = body.split()[counts["vertex"] * len(rows["vertex"]) :]
            width = len(words) // counts["face"]
            indices = np.array(words[: width * counts["face"]], float).reshape(-1, width)[:, 1:4]
    except (KeyError, ValueError, TypeError, IndexError, ArithmeticError):
        return  # no triangles in a form that Mitsuba accepts, which it reports
    if indices.size and indices.max() >= counts["vertex"]:
        raise _damaged(path, f"a face has vertex {indices.max():.0f} of {counts['vertex']}")


def _ply_format(lines: list[list[str]]) -> str:
    return next((line[1] for line in lines if line[:1] == ["format"] and len(line) > 1), "")


def _ply_rows(lines: list[list[str]], order: str) -> tuple[dict[str, int], dict[str, list[Any]]]:
    """Return the number of rows of each element, and the fields of a row; lists are read as triangles."""
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
                ("indices", order + _PLY_TYPES[words[2]], 3),
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
    return SceneCaptumError(f"{path} is damaged: {fault}. Save it again, or use an intact copy.")


def check_referenced_files(resolve: Callable[[str], Any], nodes: Iterable[Any]) -> None:
    """Check every file that the parsed nodes of a scene reference."""
    for node in nodes:
        props = node.props
        sources = _IMAGE_SOURCES.get(props.plugin_name(), ())
        if sources and not any(key in props for key in sources):
            raise SceneCaptumError(
                f"A {props.plugin_name()} of the scene has no image. Give it one of: {', '.join(sources)}."
            )
        name = props.get("filename", "") if "filename" in props else ""
        if isinstance(name, str) and name:
            check_file(Path(str(resolve(name))))


# Properties that define the image of a plugin, which crashes without any of them.
_IMAGE_SOURCES = {"bitmap": ("filename", "bitmap", "data"), "envmap": ("filename", "bitmap")}
