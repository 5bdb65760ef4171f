"""The result of ``measure``: cost and accuracy of settings, with their table, figure and recommendation."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ..errors import SceneCaptumError
from ..files import atomic_write
from ..visualization import (
    SMALL,
    WIDTH,
    Label,
    add_footnotes,
    axes_or_new,
    figure_of,
    grid,
    log_axis,
    pack,
    rounded,
    rounded_up,
    style_axes,
    write_clear,
    write_header,
)
from ._settings import Setting
from ._statistics import Bias, Estimate

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.transforms import Bbox

TOP = 5
TOLERANCE = 0.05
_NOTE_WIDTH = 96
_MARKER, _STAR = 5.5, 11.0  # sizes in points
_HEIGHTS = (-3, 9, -15, 17, -23)  # of values beside a point, in points, where the preferred place is taken
_NOISY_REFERENCE = 0.5  # of its own norm: its direction is hardly known
_FAR = 3  # from this many times the noise, an error looks like a bias

# Label, marker and colour (dark enough for text on white) of each varied option in the figure, and the preferred
# offset of its annotations in points, beside the point, whose error bar is vertical.
_STYLES = {
    "spp": ("spp", "o", "#0072B2", (6, 4)),
    "primal_spp": ("spp of the primal", "^", "#2F7399", (-6, 4)),
    "gradient_spp": ("spp of the gradient", "v", "#00735A", (6, -9)),
    "max_depth": ("depth", "s", "#A84A00", (6, -9)),
    "resolution": ("resolution", "D", "#9A3D73", (-6, -10)),
    "replicates": ("replicates", "P", "#7A5600", (-6, -10)),
    "integrator": ("integrator", "X", "#000000", (-6, 5)),
    "smoothing": ("smoothing", "h", "#6A3D9A", (6, 5)),
}


@dataclass(frozen=True)
class Measured:
    """Cost and accuracy of one setting.

    Attributes
    ----------
    varied
        The option that differs from the renderer's own setting; empty for the own setting.
    setting
        The complete setting.
    seconds
        Median time of one attribution.
    relative_error
        Root mean square over the runs of ``‖g − g_ref‖ / ‖g_ref‖``.
    spread
        Standard deviation over the runs, ``√(E ‖g − mean(g)‖²) / ‖g_ref‖``.
    bias
        ``‖mean(g) − g_ref‖ / ‖g_ref‖``, corrected for the noise of both.
    spearman, kendall
        Mean rank correlation with the reference over all parameters; Kendall's is τ-b.
    kendall_resolved
        Kendall's τ over the pairs that differ by more than two standard errors in the reference; NaN if none does.
    top
        Fraction of the reference's top five parameters that are among the top five.
    """

    varied: str
    setting: Setting
    seconds: float
    relative_error: Estimate
    spread: float
    bias: Bias
    spearman: Estimate
    kendall: Estimate
    kendall_resolved: Estimate
    top: Estimate

    @property
    def value_text(self) -> str:
        """The value of the varied option; for the own setting, the setting."""
        if not self.varied:
            return str(self.setting)
        value: Any = self.setting.primal_spp if self.varied == "spp" else getattr(self.setting, self.varied)
        if self.varied == "max_depth" and value == -1:
            return "unlimited"
        return "×".join(map(str, value)) if self.varied == "resolution" else str(value)


@dataclass(frozen=True)
class Reference:
    """Cost and accuracy of the reference.

    Attributes
    ----------
    setting
        Its setting.
    seconds
        Its time.
    relative_error
        Its standard error, relative to ``‖g_ref‖``.
    kendall_of_halves
        Kendall's τ-b between the rankings of the two halves of its replicates: higher correlations are not
        meaningful.
    """

    setting: Setting
    seconds: float
    relative_error: float
    kendall_of_halves: float


@dataclass(frozen=True, repr=False)
class Tradeoff:
    """Cost and accuracy of several settings; prints as a table.

    Attributes
    ----------
    rows
        One per setting, the renderer's own first.
    reference
        The reference that they are compared with.
    runs
        Number of runs of each setting.
    parameters
        Number of parameters.
    metric, scene
        Names of the metric and the scene.
    """

    rows: tuple[Measured, ...]
    reference: Reference
    runs: int
    parameters: int
    metric: str
    scene: str

    @property
    def is_comparable(self) -> bool:
        """Whether the reference is accurate enough to tell the settings apart.

        It is not if its error is more than half of its norm, or most of every setting's error and larger than the
        differences between them.
        """
        errors = [row.relative_error.value for row in self.rows]
        noise = self.reference.relative_error
        hides_differences = len(errors) > 1 and noise > max(max(errors) - min(errors), min(errors) / 2)
        return noise <= _NOISY_REFERENCE and not hides_differences

    @property
    def front(self) -> list[Measured]:
        """The Pareto front of time and error, the fastest setting first; empty if they are not comparable."""
        front: list[Measured] = []
        if not self.is_comparable:
            return front
        for row in sorted(self.rows, key=lambda row: (row.seconds, row.relative_error.value)):
            if not front or row.relative_error.value < front[-1].relative_error.value:
                front.append(row)
        return front

    def cheapest(self, tolerance: float = TOLERANCE) -> Measured | None:
        """Return the fastest setting whose relative error plus its standard error is at most ``tolerance``.

        Raises
        ------
        SceneCaptumError
            If ``tolerance`` is not a positive number.
        """
        if not tolerance > 0:
            raise SceneCaptumError(
                f"tolerance must be a relative error above 0, such as 0.05, not {tolerance!r}."
            )
        accurate = [row for row in self.rows if sum(row.relative_error) <= tolerance]
        return min(accurate, key=lambda row: row.seconds, default=None)

    def recommendation(self, tolerance: float = TOLERANCE) -> str:
        """Return the recommended setting for a relative error of ``tolerance``, or why there is none."""
        best = self.cheapest(tolerance)
        if best is not None:
            caution = " (1 replicate: no error bars)" if best.setting.used_replicates == 1 else ""
            return (
                f"For an error of {_percent_of(tolerance)}: {best.setting} ({rounded(best.seconds, 2)} s), "
                f"error {_percent(*best.relative_error)}, {100 * best.top.value:.0f} % of the top five correct"
                f"{caution}."
            )
        if not self.is_comparable:
            return self._too_noisy()
        closest = min(self.rows, key=lambda row: sum(row.relative_error))
        limit, bias = sum(closest.relative_error), closest.bias.value if closest.bias.significant else 0.0
        if bias >= tolerance:
            return (
                f"No setting is within {_percent_of(tolerance)}: the best, {closest.setting}, has a bias of "
                f"{_percent_of(bias)}, which more samples do not reduce."
            )
        return (
            f"No setting is certainly within {_percent_of(tolerance)}: the best, {closest.setting}, has an error "
            f"of {_percent(*closest.relative_error)}, so its upper limit, of one standard error, is "
            f"{rounded_up(100 * limit, 2)} %; {self._remedy(closest, tolerance, bias)}."
        )

    def _too_noisy(self) -> str:
        return (
            f"The reference is too noisy to compare these settings: its error is "
            f"{_percent_of(self.reference.relative_error)}. Give it more samples: reference_spp= in Python, "
            "--reference-spp on the command line."
        )

    def _remedy(self, closest: Measured, tolerance: float, bias: float) -> str:
        """Return what brings the upper limit of the best setting below a tolerance: samples, or runs."""
        more_runs = f"measure with more than {self.runs} runs"
        if closest.relative_error.value <= tolerance:
            return f"{more_runs}, which bring it closer to the error"
        # The error without bias is proportional to 1/√spp.
        factor = (sum(closest.relative_error) ** 2 - bias**2) / (tolerance**2 - bias**2)
        spp = math.ceil(factor * max(closest.setting.primal_spp, closest.setting.gradient_spp))
        # No row is within the tolerance, so none with as many samples is either.
        tried = max(
            min(row.setting.primal_spp, row.setting.gradient_spp)
            for row in self.rows
            if row.setting.changed("spp", spp) == closest.setting.changed("spp", spp)
        )
        if tried >= spp:
            return f"about {rounded_up(spp, 2)} spp should suffice, but {tried} spp did not: {more_runs}"
        return f"about {rounded_up(spp, 2)} spp should suffice"

    def plot(self, *, ax: Axes | None = None) -> Figure:
        """Plot the relative error over the time, into ``ax`` if given, with one marker style per varied option.

        The grey line is the Pareto front, if it has more than one setting; the dashed line is the error of the
        reference itself.
        """
        ax = axes_or_new(ax, WIDTH, 4.6)
        _draw(ax, self.rows, self.front, self.reference)
        write_header(ax, f"Cost and accuracy: {self.metric}", columns=5)
        notes = [
            *(
                ["grey line: Pareto front" if len(self.front) > 1 else "Pareto front: one setting"]
                if self.front
                else ["the reference is too noisy to compare these settings"]
            ),
            f"dashed: error of the reference ({self.reference.setting})",
            f"error bars: one standard error, from {self.runs} runs",
        ]
        add_footnotes(ax, pack(notes, _NOTE_WIDTH), below=34)
        _label_points(ax, self.rows)
        return figure_of(ax)

    def to_csv(self, path: str | os.PathLike[str]) -> None:
        """Write one line per setting to a file, atomically."""
        rows = list(self.records())
        with atomic_write(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)

    def records(self) -> Iterator[dict[str, Any]]:
        """Return one flat dict per setting."""
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
                "smoothing": setting.smoothing,
                "runs": self.runs,
                "seconds": row.seconds,
                **_value_and_error("relative_error", row.relative_error),
                "spread": row.spread,
                **_value_and_error("bias", row.bias),
                "bias_z": row.bias.z,
                **_value_and_error("spearman", row.spearman),
                **_value_and_error("kendall", row.kendall),
                **_value_and_error("kendall_resolved", row.kendall_resolved),
                **_value_and_error("top5", row.top),
                "on_front": row in front,
                "reference_relative_error": self.reference.relative_error,
            }

    def text(self, tolerance: float = TOLERANCE) -> str:
        """Return the table, and the recommendation for a relative error of ``tolerance``."""
        cells = [
            (
                f"  {row.varied.replace('_', ' ')} {row.value_text}" if row.varied else row.value_text,
                rounded(row.seconds),
                _percent(*row.relative_error),
                _percent_of(row.spread),
                _percent(row.bias.value, row.bias.error)
                if row.bias.significant
                else f"≤ {rounded_up(100 * row.bias.upper_limit, 2)} %",
                _correlation(row.spearman.value),
                _correlation(row.kendall.value),
                f"{100 * row.top.value:.0f} %",
            )
            for row in self.rows
        ]
        lines = grid(
            ("", "seconds", "error", "spread", "bias", "Spearman", "Kendall", "top 5"), cells, right=True
        )
        front = self.front
        marks = ["", *("  *" if row in front else "" for row in self.rows)]
        reference = self.reference
        return "\n".join(
            [
                *([] if self.is_comparable else [self._too_noisy(), ""]),
                f"{self.scene}, {self.metric}: {self.parameters} parameters, {self.runs} runs of each setting",
                "",
                *map(str.__add__, lines, marks),
                "",
                f"{'* on the Pareto front of time and error;  ' if front else ''}bias: ≤ upper limit where not "
                "significant",
                *self._doubts(),
                f"reference: {reference.setting}, relative error {_percent_of(reference.relative_error)}; "
                f"rankings of its halves have Kendall's τ {_correlation(reference.kendall_of_halves)}",
                *([self.recommendation(tolerance)] if self.is_comparable or self.cheapest(tolerance) else []),
            ]
        )

    def _doubts(self) -> Iterator[str]:
        """Say why an error far above its noise is not called a bias."""
        unclear = [
            row
            for row in self.rows
            if not row.bias.significant
            and row.relative_error.value > _FAR * math.hypot(row.spread, self.reference.relative_error)
        ]
        if unclear:
            yield (
                f"an error of more than {_FAR} times the noise is not significant with {self.runs} runs, "
                "which hardly tell the spread: measure more"
            )

    def __str__(self) -> str:
        return self.text()

    __repr__ = __str__


def _value_and_error(name: str, estimate: Estimate | Bias) -> dict[str, float]:
    return {name: estimate.value, f"{name}_error": estimate.error}


def _draw(ax: Axes, rows: Sequence[Measured], front: Sequence[Measured], reference: Reference) -> None:
    """Draw the error over the time: a star for the first row, a marker for every other, and the Pareto front."""
    ax.set_xscale("log")
    ax.set_yscale("log")
    style: dict[str, Any] = {"color": "0.7", "linewidth": 1.2, "drawstyle": "steps-post", "zorder": 1}
    ax.plot([row.seconds for row in front], [row.relative_error.value for row in front], **style)
    _draw_points(ax, rows[:1], "*", "0.35", f"own: {rows[0].setting}", size=_STAR)
    for key, (name, marker, color, _) in _STYLES.items():
        varied = [row for row in rows if row.varied == key]
        if varied:
            _draw_points(ax, varied, marker, color, name)
    if reference.relative_error > 0:
        ax.axhline(reference.relative_error, color="0.5", linewidth=0.9, linestyle=(0, (4, 3)))
    low, high = min(row.seconds for row in rows), max(row.seconds for row in rows)
    margin = max((high / low) ** 0.12, 1.2)  # times of all settings may be the same
    log_axis(ax, "x", low / margin, high * margin)
    ax.margins(y=0.1)
    log_axis(ax, "y", *ax.get_ylim(), lambda error: f"{rounded(100 * error)} %")
    style_axes(ax, x="seconds", y="relative error of the gradient")


def _draw_points(
    ax: Axes, rows: Sequence[Measured], marker: str, color: str, name: str, *, size: float = _MARKER
) -> None:
    values, errors = zip(*(row.relative_error for row in rows), strict=True)
    lengths = [min(error, 0.9 * value) for value, error in zip(values, errors, strict=True)]
    style: dict[str, Any] = {"fmt": marker, "markersize": size, "color": color, "elinewidth": 1, "zorder": 3}
    ax.errorbar([row.seconds for row in rows], values, yerr=lengths, label=name, **style)


def _label_points(ax: Axes, rows: Sequence[Measured]) -> None:
    """Write the value of each varied setting beside its point, clear of points, error bars and other values.

    Times decide where the points are, so the places of the values cannot be chosen beforehand.
    """
    figure_of(ax).draw_without_rendering()
    occupied = [_extent(ax, row) for row in rows]
    for row in rows:
        if row.varied:
            _, _, color, (x, y) = _STYLES[row.varied]
            offsets = [(side * x, up) for side in (1, -1) for up in (y, *_HEIGHTS)]
            style = {"fontsize": SMALL - 0.5, "color": color, "zorder": 4}
            write_clear(
                ax, Label(row.value_text, (row.seconds, row.relative_error.value), offsets, style), occupied
            )


def _extent(ax: Axes, row: Measured) -> Bbox:
    """Return the box of a point and its error bar in pixels."""
    from matplotlib.transforms import Bbox

    value, error = row.relative_error
    ends = ax.transData.transform(
        [(row.seconds, value - min(error, 0.9 * value)), (row.seconds, value + error)]
    )
    half = 0.5 * (_MARKER if row.varied else _STAR) * figure_of(ax).dpi / 72
    middle = ax.transData.transform((row.seconds, value))[1]
    low, high = min(ends[0, 1], middle - half), max(ends[1, 1], middle + half)
    return Bbox.from_extents(ends[0, 0] - half, low, ends[0, 0] + half, high)


def _percent(value: float, error: float) -> str:
    """``'4.1 ± 0.3 %'``, with one digit of the error."""
    value, error = 100 * value, 100 * error
    if error == 0 or not math.isfinite(error):
        return f"{rounded(value)} %"
    places = min(max(-math.floor(math.log10(error)), 0), 4)
    return f"{value:.{places}f} ± {error:.{places}f} %"


def _percent_of(value: float) -> str:
    return f"{rounded(100 * value, 2)} %"


def _correlation(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.3f}"
