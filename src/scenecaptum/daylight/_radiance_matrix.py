"""Matrices in Radiance's file format."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import torch

from ..errors import SceneCaptumError

_TYPES = {"float": "f4", "double": "f8"}
_CHANNELS = 3


def read_matrix(path: str | os.PathLike[str]) -> torch.Tensor:
    """Read a matrix of RGB values with a Radiance header, ``(rows, columns, 3)`` float32."""
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise SceneCaptumError(
            f"{path} cannot be read: {error.strerror or error}. Give a matrix of gendaymtx."
        ) from error
    return parse_matrix(data, str(path))


def parse_matrix(data: bytes, name: str) -> torch.Tensor:
    """Return the matrix in the content of a file, ``(rows, columns, 3)`` float32.

    Raises
    ------
    SceneCaptumError
        If the header is missing or incomplete, the values have other than three components, or their number is
        not what the header says.
    """
    head, separator, body = data.partition(b"\n\n")
    if not head.startswith(b"#?RADIANCE") or not separator:
        raise SceneCaptumError(f"{name} has no Radiance header: write it with gendaymtx, without -h.")
    fields = dict(
        [part.strip() for part in line.split("=", 1)]
        for line in head.decode("utf-8", errors="replace").splitlines()
        if "=" in line and not line.startswith((" ", "\t"))
    )
    rows, columns, channels = (_size(fields, key, name) for key in ("NROWS", "NCOLS", "NCOMP"))
    if channels != _CHANNELS:
        raise SceneCaptumError(f"{name} has NCOMP={channels}, expected {_CHANNELS}: red, green and blue.")
    values = _values(body, fields, name)
    if values.size != rows * columns * channels:
        raise SceneCaptumError(
            f"{name} has {values.size} values, expected {rows} × {columns} × {channels} as in its header."
        )
    return torch.from_numpy(values.reshape(rows, columns, channels).astype(np.float32))


def _size(fields: dict[str, str], key: str, name: str) -> int:
    text = fields.get(key, "")
    if not text.isdigit() or int(text) == 0:
        raise SceneCaptumError(f"{name} needs a line {key}= with a whole number in its header, not {text!r}.")
    return int(text)


def _values(body: bytes, fields: dict[str, str], name: str) -> np.ndarray:
    form = fields.get("FORMAT", "")
    if form in _TYPES:
        order = ">" if fields.get("BigEndian") == "1" else "<"
        width = int(_TYPES[form][1])
        return np.frombuffer(body[: len(body) // width * width], dtype=order + _TYPES[form])
    if form != "ascii":
        raise SceneCaptumError(f"{name} has FORMAT={form}, expected ascii, float or double.")
    try:
        return np.array(body.split(), dtype=np.float64)
    except ValueError as error:
        raise SceneCaptumError(f"{name} is not a matrix of numbers: {error}.") from error
