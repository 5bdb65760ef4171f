"""Matrices in Radiance's format."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def write_matrix(path: Path, values: np.ndarray, form: str = "float", big_endian: bool = False) -> None:
    """Write ``(rows, columns, 3)`` values."""
    rows, columns, channels = values.shape
    order = ">" if big_endian else "<"
    lines = ["#?RADIANCE", "written by a test", f"NROWS={rows}", f"NCOLS={columns}", f"NCOMP={channels}"]
    if form != "ascii":
        lines.append(f"BigEndian={int(big_endian)}")
    head = "\n".join([*lines, f"FORMAT={form}", "", ""])
    body = (
        "\n".join("\t".join(map(repr, row.ravel().tolist())) for row in values).encode()
        if form == "ascii"
        else values.astype(order + {"float": "f4", "double": "f8"}[form]).tobytes()
    )
    path.write_bytes(head.encode() + body)
