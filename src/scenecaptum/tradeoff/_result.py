"""``Tradeoff``: what a measurement returns."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from .._writing import whole_file
from ..errors import SceneCaptumError
from ._settings import Setting
from ._statistics import Bias, Estimate

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TOP = 5
TOLERANCE = 0.05


@dataclass(frozen=True)
class Measured:
    """What one setting costs and how good it is.

    Attributes
    ----------
    varied
        What distinguishes it from the renderer's own setting; empty for that itself.
    setting
        All of it.
    seconds
        Median over the runs of the time of one attribution.
    relative_error
        Root mean square over the runs of ``‖g − g_ref‖ / ‖g_ref‖``.
    bias
        ``‖mean(g) − g_ref‖ / ‖g_ref‖`` with the noise of both taken out.
    spearman, kendall
        Rank correlation with the reference's order of all parameters, means over the runs; Kendall's is τ-b.
    kendall_resolved
        Kendall's τ over the pairs that the reference tells apart by two standard errors; NaN where it tells none.
    top
        Which part of the reference's first five is among the first five.
    """

    varied: str
    setting: Setting
    seconds: float
    relative_error: Estimate
    bias: Bias
    spearman: Estimate
    kendall: Estimate
    kendall_resolved: Estimate
    top: Estimate


@dataclass(frozen=True)
class Reference:
    """What the settings are compared with.

    Attributes
    ----------
    setting
        How it was computed.
    seconds
        How long that took.
    relative_error
        Its own standard error, relative to ``‖g_ref‖``.
    kendall_of_halves
        Kendall's τ-b between the rankings by either half of its passes: beyond that it cannot judge an order.
    """

    setting: Setting
    seconds: float
    relative_error: float
    kendall_of_halves: float


@dataclass(frozen=True, repr=False)
class Tradeoff:
    """The settings and what they are worth, the renderer's own first; prints as a table.

    Attributes
    ----------
    rows
        One for each setting.
    reference
        What they are compared with.
    runs
        How often each was run.
    parameters
        How many parameters were ranked.
    metric, scene
        Their names.
    """

    rows: tuple[Measured, ...]
    reference: Reference
    runs: int
    parameters: int
    metric: str
    scene: str

    @property
    def front(self) -> list[Measured]:
        """The settings that no other beats in both time and error, the fastest first."""
        found: list[Measured] = []
        for row in sorted(self.rows, key=lambda row: (row.seconds, row.relative_error.value)):
            if not found or row.relative_error.value < found[-1].relative_error.value:
                found.append(row)
        return found

    def cheapest(self, tolerance: float = TOLERANCE) -> Measured | None:
        """Return the fastest setting whose relative error, with its standard error, is at most ``tolerance``.

        Raises
        ------
        SceneCaptumError
            Where ``tolerance`` is not a positive number.
        """
        if not tolerance > 0:
            raise SceneCaptumError(
                f"tolerance must be a relative error above 0, such as 0.05, not {tolerance!r}."
            )
        good = [row for row in self.rows if sum(row.relative_error) <= tolerance]
        return min(good, key=lambda row: row.seconds, default=None)

    def recommendation(self, tolerance: float = TOLERANCE) -> str:
        """Return one line: what to use for a relative error of ``tolerance``, or what keeps it out of reach."""
        from ..visualization import recommendation_text

        return recommendation_text(self, tolerance)

    def plot(self, ax: Axes | None = None) -> Figure:
        """Draw relative error against seconds."""
        from ..visualization import plot_tradeoff

        return plot_tradeoff(self, ax=ax)

    def to_csv(self, path: str | os.PathLike[str]) -> None:
        """Write a line for each setting, to a file that appears whole or not at all."""
        rows = list(self.records())
        with whole_file(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)

    def records(self) -> Iterator[dict[str, Any]]:
        """Return a flat dict for each setting."""
        front = self.front
        for row in self.rows:
            setting = row.setting
            yield {
                "varied": row.varied or "own",
                "primal_spp": setting.primal_spp,
                "gradient_spp": setting.gradient_spp,
                "max_depth": setting.max_depth,
                "resolution": "x".join(map(str, setting.resolution or ())),
                "replicates": setting.replicates,
                "integrator": setting.integrator,
                "runs": self.runs,
                "seconds": row.seconds,
                **_pair("relative_error", row.relative_error),
                "bias": row.bias.value,
                "bias_error": row.bias.error,
                "bias_z": row.bias.z,
                **_pair("spearman", row.spearman),
                **_pair("kendall", row.kendall),
                **_pair("kendall_resolved", row.kendall_resolved),
                **_pair("top5", row.top),
                "on_front": row in front,
                "reference_relative_error": self.reference.relative_error,
            }

    def text(self, tolerance: float = TOLERANCE) -> str:
        """Return the table, and the recommendation for a relative error of ``tolerance``."""
        from ..visualization import tradeoff_text

        return tradeoff_text(self, tolerance)

    def __str__(self) -> str:
        return self.text()

    __repr__ = __str__


def _pair(name: str, estimate: Estimate) -> dict[str, float]:
    return {name: estimate.value, f"{name}_error": estimate.error}
