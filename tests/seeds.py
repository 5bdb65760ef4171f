"""The seeds of all tests, which ``SCENECAPTUM_TEST_SEED=1`` shifts to others.

A claim about random numbers has to hold, within its own standard error, under every offset.
"""

from __future__ import annotations

import importlib
import inspect
import os
import re
import sys
from collections.abc import Callable, Iterator
from typing import Any

OFFSET = int(os.environ.get("SCENECAPTUM_TEST_SEED", "0"))

# Farther apart than the seeds that one test draws, so that no two offsets have any in common.
_APART = 1_000_003


def shifted(seed: int = 0) -> int:
    """Return the seed that stands for a number under this run's offset."""
    return seed + _APART * OFFSET


def seeds(*bounds: int) -> list[int]:
    """Return the seeds that stand for ``range(*bounds)``."""
    return [shifted(number) for number in range(*bounds)]


def shift_text(code: str) -> str:
    """Return an example with its seeds shifted."""
    return re.sub(
        r"\b(seed=|seed_grad=|manual_seed\()(\d+)\b",
        lambda found: f"{found[1]}{shifted(int(found[2]))}",
        code,
    )


def shift_defaults() -> None:
    """Shift the default seeds of the library's functions."""
    for package in (
        "scenecaptum",
        *(f"scenecaptum.{name}" for name in ("optimize", "tradeoff", "validation")),
    ):
        importlib.import_module(package)
    for name, module in list(sys.modules.items()):
        for function in _functions(module) if name.startswith("scenecaptum.") else ():
            defaults = function.__kwdefaults__ or {}
            if function.__module__ == name and defaults.get("seed") == 0:
                defaults["seed"] = shifted()


def _functions(owner: Any) -> Iterator[Callable[..., Any]]:
    for one in vars(owner).values():
        if inspect.isclass(one) and one.__module__ == getattr(owner, "__name__", None):
            yield from _functions(one)
        elif inspect.isfunction(inspect.unwrap(getattr(one, "__func__", one))):
            yield inspect.unwrap(getattr(one, "__func__", one))
