"""IES files for tests: texts with the wanted angles and candelas, and one without any symmetry."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

VERTICAL = [0, 15, 40, 60, 90, 120, 180]
HORIZONTAL = [0, 45, 90, 135, 180, 270, 360]


def ies_text(
    vertical: Sequence[float],
    horizontal: Sequence[float],
    candela: npt.ArrayLike,
    *,
    version: str | None = "IESNA:LM-63-2002",
    tilt: str = "TILT=NONE",
    **header: Any,
) -> str:
    """Return a file's text; ``candela`` is ``(H, V)``, ``header`` replaces numbers of the header by name."""
    numbers = {
        **{"lamps": 1, "lumens": -1, "multiplier": 1, "V": len(vertical), "H": len(horizontal), "type": 1},
        **{"unit": 2, "width": 0, "length": 0, "height": 0, "ballast": 1, "future": 1, "watts": 10},
    } | header
    words = [str(number) for number in numbers.values()]
    rows = np.broadcast_to(candela, (len(horizontal), len(vertical)))
    lines = [
        *([version] if version else []),
        "[TEST] synthetic",
        tilt,
        " ".join(words[:10]),
        " ".join(words[10:]),
        *(" ".join(f"{x:.12g}" for x in row) for row in (vertical, horizontal, *rows)),
    ]
    return "\n".join(lines) + "\n"


def write_ies(path: Path, *arguments: Any, **header: Any) -> Path:
    """Write ``ies_text`` to a file."""
    path.write_text(ies_text(*arguments, **header), encoding="utf-8")
    return path


def write_asymmetric(path: Path, seed: int) -> Path:
    """Write a file whose light differs in all directions."""
    rng = np.random.default_rng(seed)
    candela = rng.uniform(100, 1000, (len(HORIZONTAL), len(VERTICAL)))
    candela[:, 0], candela[:, -1], candela[-1] = 500, 100, candela[0]
    candela[-1, [0, -1]] = 500, 100
    return write_ies(path, VERTICAL, HORIZONTAL, candela)
