"""Command-line options of the examples."""

from __future__ import annotations

import argparse
from pathlib import Path


def parser(
    doc: str | None, *, resolution: str | None = None, spp: int, out: str | None = None
) -> argparse.ArgumentParser:
    """Return a parser of ``--spp``, of ``--resolution`` for a view, and of ``--out`` where files are written."""
    result = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    if resolution is not None:
        result.add_argument("--resolution", type=size, default=size(resolution), metavar="WIDTHxHEIGHT")
    result.add_argument("--spp", type=int, default=spp, help="samples per pixel")
    if out is not None:
        result.add_argument("--out", type=Path, default=Path(out), help="output folder")
    return result


def size(text: str) -> tuple[int, int]:
    """Return width and height of ``"160x90"``."""
    width, height = text.split("x")
    return int(width), int(height)
