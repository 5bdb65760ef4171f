"""The results of infidelity and sensitivity-n, with their tables and figures."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from ..estimation import delete_one_jackknife, mean_and_error
from ..student import clear_from
from ..visualization import (
    RAISES,
    UNCLEAR,
    add_footnotes,
    axes_or_new,
    figure_of,
    format_with_error,
    grid,
    rounded,
    shorten,
    style_axes,
    wrapped_lines,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Statistic = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]

_NAME_WIDTH = 36
_FOOTNOTE_WIDTH = 60
IN_NOISE = "too noisy to tell, since the changes are within the noise of rendering; use more samples"
NOISY_GRADIENTS = (
    "too noisy to tell, since the changes are within the noise of the gradients; use more samples for the "
    "attribution"
)
BOTH_NOISY = (
    "too noisy to tell, since the changes are within the noise of rendering and of the gradients; use more "
    "samples for both"
)
NO_CHANGE = "not defined, since the metric did not change"


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
    replicates
        ``(n, replicates)``: what each replicate of the attribution predicts; None without error bars. Of a
        texture it is not known, since results have the noise of its total only: it counts as infidelity.
    """

    predicted: torch.Tensor
    measured: torch.Tensor
    metric: str
    method: str
    replicates: torch.Tensor | None = None

    @property
    def value(self) -> float:
        """The infidelity: mean square of prediction minus measurement, corrected for the noise of both."""
        return self._with_error(_mean_square_error)[0]

    @property
    def standard_error(self) -> float:
        """Standard error of ``value``, from the choice of perturbations and the noise of renders and gradients."""
        return self._with_error(_mean_square_error)[1]

    @property
    def normalized(self) -> float:
        """``value`` over the mean square change: 0 for a perfect prediction, 1 for one of no change at all.

        NaN where the mean square change is not clear of the noise of rendering, or less than the noise of the
        predictions: the ratio would be of noise.
        """
        return math.nan if self._why_no_ratio() else self._with_error(_normalized_error)[0]

    @property
    def normalized_error(self) -> float:
        """Standard error of ``normalized``; NaN where that is."""
        return math.nan if self._why_no_ratio() else self._with_error(_normalized_error)[1]

    def _why_no_ratio(self) -> str:
        """Return why ``value`` cannot be compared with the mean square change; empty if it can.

        The mean square change must be clear of the noise of rendering without any one perturbation, too: the error
        of the ratio is from such means. The choice of perturbations alone cannot make it 0.
        """
        if not self.measured.any():
            return NO_CHANGE
        whole = torch.arange(len(self.measured))
        subsets = [whole, *(whole[whole != left_out] for left_out in whole)]
        is_noise = not all(_has_clear_changes(self.measured[kept]) for kept in subsets)
        if self._noise_of_predictions() > _mean_square(self.measured).clamp(min=0):
            return BOTH_NOISY if is_noise else NOISY_GRADIENTS
        return IN_NOISE if is_noise else ""

    def _noise_of_predictions(self) -> torch.Tensor:
        """Return the mean square error of the predictions, from the noise of the gradients; 0 if unknown."""
        rows = _rows(self.predicted, self.replicates)
        # Relative to the first: the mean of equal numbers may be rounded, which would be spurious noise.
        return (rows - rows[:, :1]).var(1).mean() / rows.shape[1]

    def _ratio(self, unit: str = "") -> str:
        """Return ``normalized`` with its error, in ``"%"`` if that is the unit, or why there is none."""
        if why := self._why_no_ratio():
            return why
        scale = 100 if unit else 1
        written = format_with_error(scale * self.normalized, scale * self.normalized_error)
        return f"{written} {unit}".rstrip()

    def _with_error(self, statistic: Statistic) -> tuple[float, float]:
        """Return a statistic of predictions and measurements, and its error with that of the gradients."""
        rows, measured = _rows(self.predicted, self.replicates), self.measured
        value, error = statistic_with_error(statistic, rows, measured)
        if (count := rows.shape[1]) > 2:
            of_gradients = delete_one_jackknife(lambda kept: statistic(rows[:, kept], measured), count)[1]
            error = math.hypot(error, of_gradients.item())
        return value, error

    def plot(self, *, ax: Axes | None = None) -> Figure:
        """Plot the measured against the predicted change of every perturbation, into ``ax`` if given.

        The bars are standard errors: of the renders and, where they are known, of the gradients.
        """
        ax = axes_or_new(ax, 4.2, 4.2)
        ax.axline((0, 0), slope=1, color="0.75", linewidth=1, zorder=0)
        means, errors = zip(*map(mean_and_error, self.measured), strict=True)
        style: dict[str, Any] = {"fmt": "o", "markersize": 3, "elinewidth": 0.8, "alpha": 0.8}
        of_predictions = (
            None if self.replicates is None else [mean_and_error(row)[1] for row in self.replicates]
        )
        ax.errorbar(self.predicted.tolist(), means, errors, of_predictions, color=RAISES, **style)
        style_axes(
            ax,
            f"Infidelity {format_with_error(self.value, self.standard_error)}",
            x="predicted change: perturbation × attribution",
            y=f"measured change of {shorten([self.metric], _NAME_WIDTH)[0]}",
        )
        note = f"relative to the mean square change: {self._ratio('%')}"
        lines = [*wrapped_lines(note, _FOOTNOTE_WIDTH), "error bars: ± 1 standard error"]
        add_footnotes(ax, lines, below=34)
        return figure_of(ax)

    def __str__(self) -> str:
        count, replicates = self.measured.shape
        size = self.predicted.square().mean().sqrt().item()
        noise = self._noise_of_predictions().sqrt().item()
        of_noise = [("their error from the noise of the gradients", rounded(noise, 4))] if noise else []
        lines = grid(
            (f"infidelity of {self.method}", format_with_error(self.value, self.standard_error)),
            [
                ("relative to the mean square change", self._ratio()),
                ("root mean square of the predicted changes", rounded(size, 4)),
                *of_noise,
            ],
        )
        header = f"{self.metric} under {count} perturbations, each in {replicates} replicates"
        return "\n".join([header, "", *lines])

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

    def plot(self, *, ax: Axes | None = None) -> Figure:
        """Plot the correlation over the number of parameters deleted together, into ``ax`` if given."""
        ax = axes_or_new(ax, 4.6, 3.3)
        for level in (0, 1):
            ax.axhline(level, color="0.75", linewidth=1, zorder=0)
        style: dict[str, Any] = {"marker": "o", "markersize": 4, "capsize": 3}
        ax.errorbar(
            self.sizes, self.correlations, self.standard_errors, color=RAISES, ecolor=UNCLEAR, **style
        )
        lowest = min((value for value in self.correlations if not math.isnan(value)), default=0.0)
        ax.set_ylim(-1.05 if lowest < 0 else -0.05, 1.08)
        ax.set_xticks(self.sizes)
        y = "Pearson correlation of\nsums and changes"
        style_axes(ax, "Sensitivity-n", x="parameters deleted together", y=y)
        add_footnotes(ax, wrapped_lines(f"{self.method} for {self.metric}", _FOOTNOTE_WIDTH), below=34)
        return figure_of(ax)

    def __str__(self) -> str:
        written = [
            "-" if math.isnan(value) else format_with_error(value, error)
            for value, error in zip(self.correlations, self.standard_errors, strict=True)
        ]
        counts = [str(len(sums)) for sums in self.predicted]
        rows = list(zip(map(str, self.sizes), counts, written, strict=True))
        header = f"sensitivity-n of {self.method} for {self.metric}"
        return "\n".join([header, "", *grid(("n", "subsets", "correlation"), rows)])

    __repr__ = __str__


def statistic_with_error(
    statistic: Statistic, predicted: torch.Tensor, measured: torch.Tensor, *, drawn: bool = True
) -> tuple[float, float]:
    """Return a statistic of ``(n, …)`` predictions and ``(n, replicates)`` measurements, and its standard error.

    The error is that of the delete-one jackknife over the replicates and, if the ``n`` cases were drawn at random
    (``drawn``), over these too.
    """
    count, replicates = measured.shape
    value, error = delete_one_jackknife(lambda kept: statistic(predicted, measured[:, kept]), replicates)
    if drawn:
        drawing = delete_one_jackknife(lambda kept: statistic(predicted[kept], measured[kept]), count)
        error = torch.hypot(error, drawing[1])
    return value.item(), error.item()


def _rows(predicted: torch.Tensor, replicates: torch.Tensor | None) -> torch.Tensor:
    """Return ``(n, replicates)`` predictions; without replicates two that are equal, which have no noise."""
    return predicted[:, None].expand(-1, 2) if replicates is None else replicates


def _mean_square_error(predicted: torch.Tensor, measured: torch.Tensor) -> torch.Tensor:
    """Return an unbiased mean square difference of ``(n, R)`` predictions and ``(n, R')`` measurements."""
    product = (predicted.mean(1) * measured.mean(1)).mean()
    return _mean_square(predicted) + _mean_square(measured) - 2 * product


def _normalized_error(predicted: torch.Tensor, measured: torch.Tensor) -> torch.Tensor:
    mean_square = _mean_square(measured)
    return torch.where(mean_square == 0, math.nan, _mean_square_error(predicted, measured) / mean_square)


def _has_clear_changes(measured: torch.Tensor) -> bool:
    """Whether the mean square of ``(n, R)`` replicated changes is clear of the noise of rendering."""
    replicates = measured.shape[1]
    change, error = delete_one_jackknife(lambda kept: _mean_square(measured[:, kept]), replicates)
    return bool(change > clear_from({"replicates": replicates}) * error)


def _mean_square(replicates: torch.Tensor) -> torch.Tensor:
    """Return an unbiased mean square of ``(n, R)`` replicated measurements: the mean product of two replicates."""
    count = replicates.shape[1]
    products = replicates.sum(1).square() - replicates.square().sum(1)
    return products.mean() / (count * (count - 1))


def _pearson(predicted: torch.Tensor, measured: torch.Tensor) -> torch.Tensor:
    both = torch.stack([predicted, measured.mean(1)])
    constant = (both.std(1) <= 1e-6 * both.abs().amax(1)).any()  # up to rounding
    return torch.where(constant, math.nan, torch.corrcoef(both)[0, 1])
