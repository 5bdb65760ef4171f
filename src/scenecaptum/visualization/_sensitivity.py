"""Tables and figure of global sensitivity: gradients compared with Morris's and Sobol's methods."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ._figures import RAISES, SMALL, TEXT, TITLE, UNCLEAR, WIDTH, figure_of, new_figure
from ._numbers import align_decimals, columns, pad, shorten, with_error
from ._text import pluralize

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..validation import DGSM, SensitivityComparison, SensitivityIndex

_NAME_WIDTH = 34
_MAX_BARS = 15
_AXIS_WORDS = {
    "gradient × range": "change of the metric",
    "DGSM bound": "fraction of its variance",
    "Morris μ*": "change of the metric",
    "Sobol total": "fraction of its variance",
}


def dgsm_text(found: DGSM, top: int | None = 40) -> str:
    """Format the intervals, derivatives and bounds in ``found`` for a terminal; ``top`` limits the rows."""
    rows = found.rows[:top]
    names = shorten([row.label for row in rows], _NAME_WIDTH)
    table = [
        ("parameter", *names),
        ("from", *(f"{row.low:.3g}" for row in rows)),
        ("to", *(f"{row.high:.3g}" for row in rows)),
        ("ν, per unit squared", *_values_with_errors([(row.nu, row.nu_error) for row in rows])),
        ("Sobol total at most", *_values_with_errors([(row.bound, row.bound_error) for row in rows])),
    ]
    variance = " ± ".join(with_error(found.variance, found.variance_error))
    summary = (
        f"{found.metric}: variance {variance} over the intervals, from gradients at {found.points} points "
        f"({found.renders:g} renders and backward passes)"
    )
    hidden = len(found.rows) - len(rows)
    more = [f"… and {pluralize(hidden, 'parameter')} more"] if hidden else []
    return "\n".join([*_format_columns(table), *more, "", summary])


def sensitivity_text(found: SensitivityComparison, top: int | None = 40) -> str:
    """Format the sensitivities and costs in ``found`` for a terminal; ``top`` limits the rows."""
    shown = found.parameters[:top]
    names = [scalar.name for scalar in shown]
    hidden = len(found.parameters) - len(shown)
    more = [f"… and {pluralize(hidden, 'parameter')} more"] if hidden else []
    size = len(found.sobol.top)
    labels = [
        *more,
        "",
        f"Kendall's τ with {found.sobol.method}",
        f"ranks {size} and {size + 1} resolved",
        f"renders until the top {size} is stable",
        "renders in total",
        "seconds",
    ]
    table = [("parameter", *shorten([scalar.label for scalar in shown], _NAME_WIDTH), *labels)]
    for method in found.methods:
        values = _values_with_errors([(method.values[name], method.errors[name]) for name in names])
        marked = [
            f"{value}{' *' if name in method.top else '  '}"
            for name, value in zip(names, values, strict=True)
        ]
        table.append((method.method, *marked, *([""] * len(more)), "", *_cost(found, method)))
    note = f"{found.metric}; * the top {size} of each method; a backward pass counts as a render"
    return "\n".join([*_format_columns(table), "", note])


def plot_sensitivity(found: SensitivityComparison, top: int | None = _MAX_BARS, figure: Any = None) -> Figure:
    """Plot the sensitivity of every parameter with two standard errors, one panel per method.

    The bars of each method's most sensitive parameters are blue.

    Parameters
    ----------
    found
        The result to plot.
    top
        Number of parameters, by total Sobol index; None for all.
    figure
        A matplotlib ``Figure`` or ``SubFigure`` to draw into; by default a new one.
    """
    shown = found.parameters[:top]
    if figure is None:
        figure = new_figure(WIDTH + 1.4, 1.3 + 0.2 * len(shown))
    axes = figure.subplots(1, len(found.methods), sharey=True)
    for ax, method in zip(axes, found.methods, strict=True):
        _draw_index(ax, method, [scalar.name for scalar in shown])
    axes[0].set_yticks(
        range(len(shown)), shorten([scalar.label for scalar in shown], _NAME_WIDTH), fontsize=SMALL
    )
    for label in axes[0].get_yticklabels():
        label.set_parse_math(False)
    axes[0].invert_yaxis()
    title = f"Sensitivity of {found.metric}, the top {len(found.sobol.top)} of each method in blue"
    figure.suptitle(title, fontsize=TITLE, parse_math=False)
    return figure_of(axes[0])


def _draw_index(ax: Axes, method: SensitivityIndex, names: Sequence[str]) -> None:
    values = [method.values[name] for name in names]
    colors = [RAISES if name in method.top else UNCLEAR for name in names]
    errors = [2 * method.errors[name] for name in names]
    ax.barh(range(len(names)), values, height=0.7, color=colors)
    ax.errorbar(values, range(len(names)), xerr=errors, fmt="none", ecolor="black", elinewidth=0.8)
    ax.set_xlim(0, 1.08 * max(value + error for value, error in zip(values, errors, strict=True)) or 1)
    ax.spines[["top", "right"]].set_visible(False)
    ax.tick_params(axis="y", length=0)
    ax.tick_params(axis="x", labelsize=SMALL)
    ax.locator_params(axis="x", nbins=3)
    ax.set_title(method.method, fontsize=TEXT, loc="left")
    stable = f"top {len(method.top)} stable after" if method.stable else "not stable after"
    renders = (
        f"{method.renders_until_stable:.3g} renders" if method.stable else f"{method.renders:.4g} renders"
    )
    ax.set_xlabel(f"{_AXIS_WORDS[method.method]}\n\n{stable}\n{renders}", fontsize=SMALL)


def _cost(found: SensitivityComparison, method: SensitivityIndex) -> list[str]:
    tau = found.agreement.get((method.method, found.sobol.method))
    return [
        "" if tau is None else f"{tau:.2f}".replace("-", "−"),
        "yes" if method.resolved else "tied",
        f"{method.renders_until_stable:.4g}" if method.stable else f"> {method.renders:.4g}",
        f"{method.renders:.5g}",
        f"{method.seconds:.3g}",
    ]


def _values_with_errors(numbers: Sequence[tuple[float, float]]) -> list[str]:
    written = [with_error(value, error) for value, error in numbers]
    values, errors = (align_decimals(column) for column in zip(*written, strict=True))
    return [f"{value} ± {error}" for value, error in zip(values, errors, strict=True)]


def _format_columns(table: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table that is given by columns."""
    padded = [[pad(cell, max(map(columns, column))) for cell in column] for column in table]
    return ["  ".join(row).rstrip() for row in zip(*padded, strict=True)]
