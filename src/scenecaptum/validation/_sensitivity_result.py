"""The comparison of gradients with Morris's and Sobol's methods, with its table and figure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any

from ..ranks import kendall_tau
from ..visualization import (
    DEFAULT_TOP,
    RAISES,
    SMALL,
    TEXT,
    TITLE,
    UNCLEAR,
    WIDTH,
    align_with_errors,
    figure_of,
    first,
    grid,
    minus,
    name_rows,
    new_figure,
    pluralize,
    rounded,
    shorten,
    style_axes,
)
from ._scalars import INTERVAL_NOTE, Scalar

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

_NAME_WIDTH, _MAX_ROWS = 34, 40
_CHANGE = "change of the metric"
_AXIS_WORDS = {
    "gradient × range": _CHANGE,
    "DGSM bound": "fraction of its variance",
    "Morris μ*": _CHANGE,
    "Sobol total": "fraction of its variance",
}


@dataclass(frozen=True)
class SensitivityIndex:
    """The sensitivity of every parameter by one method, and its cost.

    Attributes
    ----------
    method
        Name of the method.
    values, errors
        Sensitivities and standard errors by parameter name.
    renders
        Number of renders and backward passes, in units of ``spp`` samples per pixel.
    renders_until_stable
        Number of renders after which the set of the ``top`` parameters did not change any more.
    stable
        Whether that was before the last sample; if not, the set may change again.
    top
        The most sensitive parameters, the largest first.
    resolved
        Whether the last parameter in ``top`` differs from the next one by more than two standard errors; if not,
        they are tied, and the set depends on chance.
    seconds
        Wall-clock time.
    """

    method: str
    values: Mapping[str, float]
    errors: Mapping[str, float]
    renders: float
    renders_until_stable: float
    stable: bool
    top: tuple[str, ...]
    resolved: bool
    seconds: float


@dataclass(frozen=True, repr=False)
class SensitivityComparison:
    """Sensitivities of the same parameters over the same intervals by four methods; prints as a table.

    Attributes
    ----------
    parameters
        The parameters with their intervals, in order of decreasing total Sobol index.
    local
        Plain gradient at the current values, scaled to the interval: ``|∂M/∂θ| (high − low)``. Of a colour, θ
        is its largest channel and the hue stays, so this is not the effect over the range of an attribution.
    dgsm
        Upper bound of the total Sobol index from gradients at points over the intervals, relative to the variance
        of the metric in Sobol's samples.
    morris
        ``μ*``, Morris's mean absolute elementary effect, scaled to the interval.
    sobol
        The total Sobol index.
    metric
        Name of the metric.
    unit
        That of a change of the metric; empty if it has none.
    """

    parameters: tuple[Scalar, ...]
    local: SensitivityIndex
    dgsm: SensitivityIndex
    morris: SensitivityIndex
    sobol: SensitivityIndex
    metric: str
    unit: str = ""

    @property
    def methods(self) -> tuple[SensitivityIndex, ...]:
        """All four methods."""
        return self.local, self.dgsm, self.morris, self.sobol

    @property
    def agreement(self) -> dict[tuple[str, str], float]:
        """Kendall's τ-b of every pair of methods: 1 for the same order, 0 for unrelated ones."""
        return {
            (a.method, b.method): kendall_tau(*([m.values[n] for n in a.values] for m in (a, b)))
            for a, b in combinations(self.methods, 2)
        }

    def plot(self, top: int | None = DEFAULT_TOP, *, figure: Figure | SubFigure | None = None) -> Figure:
        """Plot the sensitivity of every parameter with two standard errors, one panel per method, and the costs.

        The bars of each method's most sensitive parameters are blue.

        Parameters
        ----------
        top
            Number of parameters, by total Sobol index; None for all.
        figure
            Figure or subfigure to draw into; by default a new one.
        """
        shown = first(self.parameters, top)
        part: Any = figure or new_figure(WIDTH + 1.4, 1.3 + 0.2 * len(shown))
        axes = part.subplots(1, len(self.methods), sharey=True)
        for ax, method in zip(axes, self.methods, strict=True):
            _draw_index(ax, method, [scalar.name for scalar in shown], self.unit)
        name_rows(axes[0], shorten([scalar.label for scalar in shown], _NAME_WIDTH), SMALL)
        title = f"Sensitivity of {self.metric}, the top {len(self.sobol.top)} of each method in blue"
        part.suptitle(title, fontsize=TITLE, parse_math=False)
        return figure_of(part)

    def text(self, top: int | None = _MAX_ROWS) -> str:
        """Return the table that ``print`` shows, of the first ``top`` parameters; None for all."""
        shown, size = self.parameters[:top], len(self.sobol.top)
        hidden = len(self.parameters) - len(shown)
        more = [f"… and {pluralize(hidden, 'parameter')} more"] if hidden else []
        costs = [
            f"Kendall's τ with {self.sobol.method}",
            f"ranks {size} and {size + 1} resolved",
            f"renders until the top {size} is stable",
            "renders in total",
            "seconds",
        ]
        columns = [
            ("parameter", *shorten([scalar.label for scalar in shown], _NAME_WIDTH), *more, "", *costs)
        ]
        for method in self.methods:
            values = align_with_errors([(method.values[s.name], method.errors[s.name]) for s in shown])
            marks = (" *" if scalar.name in method.top else "  " for scalar in shown)
            marked = map(str.__add__, values, marks)
            columns.append((method.method, *marked, *([""] * len(more)), "", *self._cost(method)))
        headers, *rows = zip(*columns, strict=True)
        notes = [
            f"{self.metric}; * the top {size} of each method{self._units()}",
            "a render has spp samples per pixel, and fewer are a part of one; a backward pass counts as a render",
            INTERVAL_NOTE,
        ]
        return "\n".join([*grid(headers, rows), "", *notes])

    def _units(self) -> str:
        return f"; {self.local.method} and {self.morris.method} in {self.unit}" if self.unit else ""

    def _cost(self, method: SensitivityIndex) -> list[str]:
        tau = self.agreement.get((method.method, self.sobol.method))
        return [
            "" if tau is None else minus(f"{tau:.2f}"),
            "yes" if method.resolved else "tied",
            rounded(method.renders_until_stable, 4) if method.stable else f"> {rounded(method.renders, 4)}",
            rounded(method.renders, 5),
            rounded(method.seconds),
        ]

    def __str__(self) -> str:
        return self.text()

    __repr__ = __str__


def _draw_index(ax: Axes, method: SensitivityIndex, names: list[str], unit: str) -> None:
    values = [method.values[name] for name in names]
    errors = [2 * method.errors[name] for name in names]
    colors = [RAISES if name in method.top else UNCLEAR for name in names]
    ax.barh(range(len(names)), values, height=0.7, color=colors)
    ax.errorbar(values, range(len(names)), xerr=errors, fmt="none", ecolor="black", elinewidth=0.8)
    ax.set_xlim(0, 1.08 * max(value + error for value, error in zip(values, errors, strict=True)) or 1)
    ax.locator_params(axis="x", nbins=3)
    stable = f"top {len(method.top)} stable after" if method.stable else "not stable after"
    renders = rounded(method.renders_until_stable) if method.stable else rounded(method.renders, 4)
    style_axes(ax, method.method, size=TEXT)
    words = _AXIS_WORDS[method.method]
    in_unit = f"in {unit}\n" if unit and words == _CHANGE else "\n"
    ax.set_xlabel(f"{words}\n{in_unit}{stable}\n{renders} renders", fontsize=SMALL)
    ax.tick_params(axis="y", length=0)
