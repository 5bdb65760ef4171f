"""The results of infidelity and sensitivity-n, with their tables and figures."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from ..estimation import delete_one_jackknife
from ..visualization import RAISES, TEXT, UNCLEAR, add_footnotes, figure_of, new_figure, shorten
from ._drawing import means_and_errors, style_axes, table_lines, value_with_error

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Statistic = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]

_NAME_WIDTH = 36


@dataclass(frozen=True, repr=False)
class Infidelity:
    """Mean squared error of the changes that gradients predict for random perturbations; prints as a table.

    Attributes
    ----------
    predicted
        ``(n,)``: the sum of perturbation × attribution.
    measured
        ``(n, replicates)``: the metric of the original scene minus that of the perturbed one.
    metric, method
        Names of the metric and of the attribution method.
    """

    predicted: torch.Tensor
    measured: torch.Tensor
    metric: str
    method: str

    @property
    def value(self) -> float:
        """The infidelity: mean square of prediction minus measurement, corrected for the noise of rendering."""
        return self._with_error(_mean_square_error)[0]

    @property
    def standard_error(self) -> float:
        """Standard error of ``value``, from the choice of perturbations and the noise of rendering."""
        return self._with_error(_mean_square_error)[1]

    @property
    def normalized(self) -> float:
        """``value`` over the mean square change: 0 for a perfect prediction, 1 for one of no change at all."""
        return self._with_error(_normalized_error)[0]

    @property
    def normalized_error(self) -> float:
        """Standard error of ``normalized``."""
        return self._with_error(_normalized_error)[1]

    def _with_error(self, statistic: Statistic) -> tuple[float, float]:
        return statistic_with_error(statistic, self.predicted, self.measured)

    def plot(self, ax: Axes | None = None) -> Figure:
        """Plot the measured against the predicted change of every perturbation, with the identity line.

        Parameters
        ----------
        ax
            Axes to draw into; by default those of a new figure.
        """
        return _draw_infidelity(self, ax)

    def __str__(self) -> str:
        return _infidelity_text(self)

    __repr__ = __str__


@dataclass(frozen=True, repr=False)
class SensitivityN:
    """Correlation of the effect of deleting n parameters with the sum of their attributions; prints as a table.

    Attributes
    ----------
    parameters
        Number of parameters.
    sizes
        Numbers of parameters deleted together.
    predicted
        For each size ``(subsets,)``: the sums of the attributions.
    measured
        For each size ``(subsets, replicates)``: the metric of the original scene minus that without the subset.
    metric, method
        Names of the metric and of the attribution method.
    """

    parameters: int
    sizes: tuple[int, ...]
    predicted: tuple[torch.Tensor, ...]
    measured: tuple[torch.Tensor, ...]
    metric: str
    method: str

    @property
    def correlations(self) -> tuple[float, ...]:
        """Pearson correlation for each size; NaN where predictions or measurements are constant."""
        return tuple(value for value, _ in self._with_errors())

    @property
    def standard_errors(self) -> tuple[float, ...]:
        """Standard errors of the correlations, from the noise of rendering and the choice of subsets."""
        return tuple(error for _, error in self._with_errors())

    def _with_errors(self) -> list[tuple[float, float]]:
        return [
            statistic_with_error(_pearson, *pair, drawn=len(pair[0]) < math.comb(self.parameters, size))
            for size, *pair in zip(self.sizes, self.predicted, self.measured, strict=True)
        ]

    def plot(self, ax: Axes | None = None) -> Figure:
        """Plot the correlation over the number of parameters deleted together.

        Parameters
        ----------
        ax
            Axes to draw into; by default those of a new figure.
        """
        return _draw_sensitivity_n(self, ax)

    def __str__(self) -> str:
        return _sensitivity_n_text(self)

    __repr__ = __str__


def statistic_with_error(
    statistic: Statistic, predicted: torch.Tensor, measured: torch.Tensor, *, drawn: bool = True
) -> tuple[float, float]:
    """Return a statistic of ``(n,)`` predictions and ``(n, replicates)`` measurements, and its standard error.

    The error is that of the delete-one jackknife over the replicates and, if the ``n`` cases were drawn at random
    (``drawn``), over these too.
    """
    count, replicates = measured.shape
    value, error = delete_one_jackknife(lambda kept: statistic(predicted, measured[:, kept]), replicates)
    if drawn:
        _, drawing_error = delete_one_jackknife(
            lambda kept: statistic(predicted[kept], measured[kept]), count
        )
        error = torch.hypot(error, drawing_error)
    return value.item(), error.item()


def _mean_square_error(predicted: torch.Tensor, measured: torch.Tensor) -> torch.Tensor:
    return _mean_square(predicted[:, None] - measured)


def _normalized_error(predicted: torch.Tensor, measured: torch.Tensor) -> torch.Tensor:
    mean_square = _mean_square(measured)
    return torch.where(mean_square == 0, math.nan, _mean_square_error(predicted, measured) / mean_square)


def _mean_square(replicates: torch.Tensor) -> torch.Tensor:
    """Return an unbiased mean square of ``(n, R)`` replicated measurements: the mean product of two replicates."""
    count = replicates.shape[1]
    products = replicates.sum(1).square() - replicates.square().sum(1)
    return products.mean() / (count * (count - 1))


def _pearson(predicted: torch.Tensor, measured: torch.Tensor) -> torch.Tensor:
    both = torch.stack([predicted, measured.mean(1)])
    constant = (both.std(1) <= 1e-6 * both.abs().amax(1)).any()  # up to rounding
    return torch.where(constant, math.nan, torch.corrcoef(both)[0, 1])


def _infidelity_text(found: Infidelity) -> str:
    count, replicates = found.measured.shape
    root_mean_square = found.predicted.square().mean().sqrt().item()
    grid = [
        (f"infidelity of {found.method}", value_with_error(found.value, found.standard_error)),
        ("relative to the mean square change", value_with_error(found.normalized, found.normalized_error)),
        ("root mean square of the predicted changes", f"{root_mean_square:.4g}"),
    ]
    header = f"{found.metric} under {count} perturbations, each in {replicates} replicates"
    return "\n".join([header, "", *table_lines(grid)])


def _draw_infidelity(found: Infidelity, ax: Axes | None) -> Figure:
    if ax is None:
        ax = new_figure(4.2, 4.2).add_subplot()
    means, errors = zip(*means_and_errors(found.measured), strict=True)
    predicted = found.predicted.tolist()
    ax.axline((0, 0), slope=1, color="0.75", linewidth=1, zorder=0)
    ax.errorbar(predicted, means, errors, fmt="o", markersize=3, color=RAISES, elinewidth=0.8, alpha=0.8)
    ax.set_xlabel("predicted change: perturbation × attribution", fontsize=TEXT)
    metric = shorten([found.metric], _NAME_WIDTH)[0]
    ax.set_ylabel(f"measured change of {metric}", fontsize=TEXT, parse_math=False)
    style_axes(ax, f"Infidelity {value_with_error(found.value, found.standard_error)}")
    relative = value_with_error(100 * found.normalized, 100 * found.normalized_error)
    note = f"relative to the mean square change: {relative} %"
    add_footnotes(ax, [note], below=34)
    return figure_of(ax)


def _sensitivity_n_text(found: SensitivityN) -> str:
    rows = zip(found.sizes, found.predicted, found.correlations, found.standard_errors, strict=True)
    grid = [
        ("n", "subsets", "correlation"),
        *((str(size), str(len(sums)), _correlation(*pair)) for size, sums, *pair in rows),
    ]
    header = f"sensitivity-n of {found.method} for {found.metric}"
    return "\n".join([header, "", *table_lines(grid)])


def _draw_sensitivity_n(found: SensitivityN, ax: Axes | None) -> Figure:
    if ax is None:
        ax = new_figure(4.6, 3.3).add_subplot()
    ax.axhline(1, color="0.75", linewidth=1, zorder=0)
    ax.axhline(0, color="0.75", linewidth=1, zorder=0)
    ax.errorbar(
        found.sizes,
        found.correlations,
        found.standard_errors,
        marker="o",
        markersize=4,
        capsize=3,
        color=RAISES,
        ecolor=UNCLEAR,
    )
    lowest = min((value for value in found.correlations if not math.isnan(value)), default=0.0)
    ax.set_ylim(-1.05 if lowest < 0 else -0.05, 1.08)
    ax.set_xticks(found.sizes)
    ax.set_xlabel("parameters deleted together", fontsize=TEXT)
    ax.set_ylabel("Pearson correlation of\nsums and changes", fontsize=TEXT)
    style_axes(ax, "Sensitivity-n")
    note = f"{found.method} for {found.metric}"
    add_footnotes(ax, textwrap.wrap(note, 60), below=34)
    return figure_of(ax)


def _correlation(value: float, error: float) -> str:
    return "-" if math.isnan(value) else value_with_error(value, error)
