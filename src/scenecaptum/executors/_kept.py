"""The renderers that a worker keeps for its next tasks."""

from __future__ import annotations

import os
import pickle
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..backend import trim_heap

MAX_RENDERERS = 4
LARGEST_SHARE = 0.5  # of the machine's memory that a worker may take with more than one renderer

_kept: OrderedDict[bytes, Any] = OrderedDict()  # the last used one at the end


def made(recipe: Callable[[], Any]) -> Any:
    """Return the renderer of a recipe: kept from an earlier task of this process, or a new one."""
    key = pickle.dumps(recipe)
    renderer = _kept.pop(key, None)
    if renderer is None:
        _make_room()
        renderer = recipe()
    _kept[key] = renderer
    return renderer


def _make_room() -> None:
    """Drop the renderers that were used least recently: all but a few, more if the process has grown large."""
    while len(_kept) >= MAX_RENDERERS or (_kept and _memory_share() > LARGEST_SHARE):
        _kept.popitem(last=False)
        trim_heap()


def _memory_share() -> float:
    """Return the share of the machine's memory that this process occupies, or 0 where that is unknown."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages / os.sysconf("SC_PHYS_PAGES")
    except (OSError, ValueError):
        return 0.0
