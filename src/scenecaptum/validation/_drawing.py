"""What the tables and figures of several checks share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch

from ..visualization import SMALL, TITLE, align_decimals, columns, pad, with_error

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def table_lines(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table with its columns padded to equal widths."""
    widths = [max(map(columns, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(map(pad, row, widths)).rstrip() for row in rows]


def value_with_error(value: float, error: float) -> str:
    """Return ``'0.98 ± 0.02'``; the value alone if the error is 0."""
    return " ± ".join(filter(None, with_error(value, error or None)))


def aligned_with_errors(numbers: Sequence[tuple[float, float]]) -> list[str]:
    """Return ``'0.98 ± 0.02'`` for each value and its error, with the decimal points of both aligned."""
    written = [with_error(value, error) for value, error in numbers]
    values, errors = (align_decimals(column) for column in zip(*written, strict=True))
    return [f"{value} ± {error}" for value, error in zip(values, errors, strict=True)]


def means_and_errors(curve: torch.Tensor) -> list[tuple[float, float]]:
    """Return the means and standard errors of ``(points, replicates)``."""
    errors = curve.std(1) / math.sqrt(curve.shape[1])
    return list(zip(curve.mean(1).tolist(), errors.tolist(), strict=True))


def style_axes(ax: Axes, title: str) -> None:
    """Set the title, the size of the numbers, and remove two sides of the frame."""
    ax.set_title(title, loc="left", fontsize=TITLE)
    ax.tick_params(labelsize=SMALL)
    ax.spines[["top", "right"]].set_visible(False)
