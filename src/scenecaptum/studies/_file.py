"""Studies described in TOML or JSON."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

from ..designs import read_table
from ..errors import SceneCaptumError, near_misses


def read_study(path: Path, known: Collection[str]) -> dict[str, Any]:
    """Return the arguments of a ``Study`` from a file, with paths that do not depend on where it is run.

    ``known`` are the names of the arguments.
    """
    given = dict(read_table(path, "study"))
    for name in given:
        if name not in known:
            raise SceneCaptumError(
                f"{path} has {name!r}, which a study does not.{near_misses(name, known)} It has "
                f"{', '.join(known)}."
            )
    if "scenes" not in given:
        raise SceneCaptumError(f"{path} needs scenes: a list, or a table by name.")
    folder = path.resolve().parent
    for axis in ("scenes", "metrics"):
        if axis in given:
            given[axis] = _located(given[axis], folder)
    if "resolution" in given:
        given["resolution"] = tuple(given["resolution"])
    return given


def _located(value: Any, folder: Path) -> Any:
    """Return an axis with the paths of existing files, of scenes and ``FILE.py:NAME``, relative to a folder."""
    if isinstance(value, dict):
        return {key: _located(item, folder) for key, item in value.items()}
    if isinstance(value, list):
        return [_located(item, folder) for item in value]
    if not isinstance(value, str):
        return value
    file, colon, name = value.rpartition(":") if ".py:" in value else (value, "", "")
    return f"{folder / file}{colon}{name}" if (folder / file).is_file() else value
