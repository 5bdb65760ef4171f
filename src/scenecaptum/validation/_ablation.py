"""The ablation test: move single parameters along their gradients and compare the metric with the prediction."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch
from tqdm import tqdm

from ..attr import Ranked, SceneAttribution, VanillaSceneGradient
from ..checkpoint import Folder, with_checkpoint
from ..errors import SceneCaptumError, whole_number
from ..estimation import DEFAULT_REPLICATES, Metric, Target, channel_totals, corrected_and_error, student_t
from ..protocols import Capabilities, Renderer
from ..ranks import kendall_tau_of_pairs
from ..student import DISAGREEMENT_LEVEL
from ..visualization import (
    LOWERS,
    RAISES,
    TEXT,
    UNCLEAR,
    WIDTH,
    add_footnotes,
    axes_or_new,
    caution_marks,
    characters_per_line,
    figure_of,
    first_few,
    format_with_error,
    grid,
    group_by_text,
    log_axis,
    metric_name,
    minus,
    name_rows,
    rounded,
    shorten,
    style_axes,
    wrapped_lines,
    write_header,
)
from ._scenes import (
    MAX_STEP,
    MIN_STEP,
    Scenes,
    distances_to_bounds,
    is_plain_gradient,
    scenes_of,
    unit_gradient,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Reduce a step until the second-order term is at most this fraction of the slope.
MAX_NONLINEARITY, STEP_REDUCTION, MAX_STEP_REDUCTIONS = 0.2, 4.0, 6
FIXED_STEP = 0.01  # of the gradient: the step of Beresna and Fiume
ROUNDING = 2.0**-14  # of the metric: smaller changes are mostly those of single precision
MAX_BOUND_FRACTION = 0.99  # of the distance to a bound, since the bound itself may be unphysical
AGREEMENT_TOLERANCE = 0.1  # relative difference that counts as agreement even where the errors are smaller
SIGNIFICANCE_LEVEL = 0.95  # confidence that two predictions or measurements differ
MIN_KENDALL_TAU = 0.95
_NAME_WIDTH, _NOTE_WIDTH = 36, 90
_OUTCOMES = {
    RAISES: "measured: as predicted",
    LOWERS: "measured: not as predicted",
    UNCLEAR: "measured: below the noise",
}


def ablation_test(  # noqa: PLR0913 -- the options of every long job, and its own
    renderer: Renderer,
    metric: Metric,
    attribution: SceneAttribution | None = None,
    target: Target = None,
    *,
    inputs: Mapping[str, torch.Tensor] | None = None,
    top: int = 10,
    seed: int = 0,
    spp: int | None = None,
    replicates: int = DEFAULT_REPLICATES,
    checkpoint: Folder = None,
    show_progress: bool = False,
) -> AblationTest:
    """Move each of the most salient parameters along its gradient and compare the metric with the prediction.

    Each step is a fraction of the parameter's physical range, down the gradient unless a bound is near. It is
    shortened until the metric is nearly linear over it, and renders at half the step remove the remaining
    second-order term. All renders of a parameter use common random numbers. All texels of a texture move together,
    except those that would leave their bounds; the measured change is then divided by the share of the gradient
    that belongs to the moving texels.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", inputs="reflectance", resolution=(16, 16), spp=64)
    >>> test = ablation_test(renderer, metrics.MeanLuminance(), top=2)
    >>> [row.agrees for row in test.rows]
    [True, True]

    Parameters
    ----------
    renderer, metric, target
        As for ``VanillaSceneGradient``; the renderer must have ``bounds``.
    attribution
        The plain gradients to test, at the values for which they were made; computed by default.
    inputs
        The values at which to test; by default the scene's own, or those of the attribution.
    top
        Number of parameters to test.
    seed
        Base seed; all other seeds are derived from it.
    spp
        Samples per pixel of each scene, over all replicates; the renderer's by default.
    replicates
        Number of independent renders of each scene; the standard errors come from their spread.
    checkpoint
        Folder that stores every finished replicate. A killed job resumes from it when it is started again with
        the same arguments.
    show_progress
        Whether to show a progress bar.

    Returns
    -------
    AblationTest
        One row per parameter with non-zero saliency, with a summary in ``is_confirmed`` and ``verdict``.

    Raises
    ------
    SceneCaptumError
        If the attribution is not one of plain gradients, has no error bars, or was made for another texture than
        that of the renderer.

    References
    ----------
    Beresna and Fiume, "Scene Parameter Saliency via Differentiable Light Transport": ablation with a step of one
    hundredth of each gradient, reported here as ``fixed``.
    """
    renderer = with_checkpoint(renderer, checkpoint)
    if attribution is None:
        attribution = VanillaSceneGradient(renderer, metric).attribute(
            inputs, target=target, seed=seed, spp=spp, show_progress=show_progress
        )
    if is_plain_gradient(attribution) and attribution.info.get("spp") == 1:
        raise SceneCaptumError("ablation_test needs at least 2 samples per pixel for error bars: raise spp.")
    if not is_plain_gradient(attribution) or attribution.covariance is None:
        raise SceneCaptumError(
            "ablation_test needs plain gradients with error bars: VanillaSceneGradient(...).attribute()."
        )
    options: dict[str, Any] = {"seed": seed, "spp": spp, "replicates": replicates, "values": inputs}
    scenes = scenes_of(attribution, renderer, metric, target, **options)
    slopes, errors = attribution.saliency("unit"), attribution.saliency_error("unit") or {}
    rows = [row for row in attribution.ranking(whole_number("top", top)) if slopes[row.name] > 0]
    cautions = attribution.info.get("cautions") or {}
    jumps, left_out = (attribution.info.get(key, {}) for key in ("jumps", "left_out_directions"))
    tested = {row.name for row in rows}

    def ablated(row: Ranked) -> Ablated:
        gradient = attribution.with_derivative(row.name)
        result = _ablate(scenes, row, gradient, slopes[row.name], errors[row.name])
        return dataclasses.replace(result, caution=cautions.get(row.name, ""))

    with tqdm(rows, disable=not show_progress, desc="ablation", unit="parameter") as bar:
        return AblationTest(
            rows=tuple(map(ablated, bar)),
            metric=metric_name(attribution),
            jumps={attribution.labels.get(name, name): reason for name, reason in jumps.items()},
            left_out={
                attribution.labels.get(name, name): reason
                for name, reason in left_out.items()
                if name in tested
            },
        )


@dataclass(frozen=True)
class _Step:
    """A step of a parameter along its gradient."""

    direction: torch.Tensor  # of unit length over the channels; 0 for elements that stay
    length: float  # negative down the gradient
    share: float = 1.0  # of the saliency that belongs to the moving elements


def _choose_step(value: torch.Tensor, gradient: torch.Tensor, low: float, high: float) -> _Step:
    """Step down the gradient, or up if a bound is near; near both, move only the elements that have space."""
    uphill = unit_gradient(gradient, value).expand_as(value)
    # Without a finite range use the mean: in an environment map the sun dominates the maximum.
    size = high - low if math.isfinite(high - low) else value.abs().mean().item() or 1.0
    distances = {sign: distances_to_bounds(value, sign * uphill, low, high) for sign in (-1, 1)}
    for sign, distance in distances.items():
        # Only half the distance, since the bound itself may be unphysical.
        length = min(MAX_STEP * size, 0.5 * distance.min().item())
        if length >= MIN_STEP * size:
            return _Step(uphill, sign * length)
    total = channel_totals(gradient).double().norm()
    steps = []
    for sign, distance in distances.items():
        direction = torch.where(distance >= MAX_STEP * size, uphill, 0.0)
        steps.append(_Step(direction, sign * MAX_STEP * size, ((gradient * direction).sum() / total).item()))
    return max(steps, key=lambda step: step.share)


def _ablate(
    scenes: Scenes, row: Any, gradient: torch.Tensor, predicted: float, predicted_error: float
) -> Ablated:
    offered = Capabilities(scenes.renderer)
    value, (low, high) = scenes.values[row.name], (offered.bounds or {})[row.name]
    chosen = _choose_step(value, gradient, low, high)
    if row.name in (offered.rendered_separately or ()) and offered.ranges is not None:
        # A pose has no bounds, and its gradient is the mean over its range.
        start, end = offered.ranges[row.name]
        chosen = _Step(unit_gradient(gradient, value).expand_as(value), (start - end) / 2)

    count = len(scenes.seeds)

    def slope(length: float) -> torch.Tensor:
        changes = scenes.half_differences({row.name: value + length * chosen.direction})
        return changes / (length * chosen.share)

    step = chosen.length
    for _ in range(MAX_STEP_REDUCTIONS):
        half, full = slope(step / 2), slope(step)
        measured, error = corrected_and_error(2 * half - full, count)
        second_order, second_order_error = corrected_and_error(2 * (full - half), count)
        # A shorter step would only amplify a second-order term that is within the noise.
        if abs(second_order) - 2 * second_order_error <= MAX_NONLINEARITY * abs(measured):
            break
        step /= STEP_REDUCTION
    distance = distances_to_bounds(value, -chosen.direction, low, high).min().item()
    fixed_step = min(FIXED_STEP * predicted, MAX_BOUND_FRACTION * distance)
    if math.isinf(distance) and abs(chosen.length) < fixed_step:
        fixed_step = 0.0  # beyond what a pose is judged by
    if predicted * fixed_step < ROUNDING * abs(scenes.unmodified.mean().item()):
        fixed_step = 0.0  # too short for single precision
    fixed, fixed_error = corrected_and_error(slope(-fixed_step), count) if fixed_step > 0 else (None, None)
    return Ablated(
        name=row.name,
        label=row.label,
        predicted=predicted,
        predicted_error=predicted_error,
        measured=measured,
        measured_error=error,
        step=step,
        curvature=2 * second_order / step,
        degrees_of_freedom=count - 1,
        fixed=fixed,
        fixed_error=fixed_error,
    )


@dataclass(frozen=True)
class Ablated:
    """The effect of moving one parameter along its gradient.

    Attributes
    ----------
    name, label
        The parameter's name in the scene, and a readable one.
    predicted, predicted_error
        The saliency ``‖g‖``: the predicted slope of the metric along the gradient.
    measured, measured_error
        The measured slope, from renders at 0, half a step and a full step, with the second-order term removed.
    step
        Signed length of the step, negative down the gradient; in the parameter's unit, over its channels.
    curvature
        Second derivative along the gradient.
    degrees_of_freedom
        Of the standard errors.
    fixed, fixed_error
        Slope measured with the step of the paper, one hundredth of the gradient, down the gradient and inside the
        bounds, including the second-order term; None where the parameter is at its bound, and where the metric
        would change by no more than the rounding of single precision.
    caution
        Why the derivative is known to be wrong; empty if it is not.
    """

    name: str
    label: str
    predicted: float
    predicted_error: float
    measured: float
    measured_error: float
    step: float
    curvature: float
    degrees_of_freedom: int
    fixed: float | None = None
    fixed_error: float | None = None
    caution: str = ""

    @property
    def noise(self) -> float:
        """Half-width of the 99.7 % confidence interval of the difference of prediction and measurement."""
        return self._half_width(DISAGREEMENT_LEVEL)

    def _half_width(self, level: float) -> float:
        error = math.hypot(self.predicted_error, self.measured_error)
        return student_t(level, self.degrees_of_freedom) * error

    @property
    def above_noise(self) -> bool:
        """Whether the larger of prediction and measurement exceeds the noise: only then is agreement a finding."""
        return max(self.predicted, abs(self.measured)) > self.noise

    @property
    def agrees(self) -> bool:
        """Whether prediction and measurement agree within 10 % or within the noise."""
        allowed = max(AGREEMENT_TOLERANCE * self.predicted, self.noise)
        return abs(self.measured - self.predicted) <= allowed

    @property
    def is_clear(self) -> bool:
        """Whether the prediction exceeds its own noise: a measurement below the noise then leaves it in doubt."""
        return self.predicted > student_t(DISAGREEMENT_LEVEL, self.degrees_of_freedom) * self.predicted_error

    @property
    def is_doubtful(self) -> bool:
        """Whether the measurement is below the noise, but at 95 % differs from a prediction that is clear."""
        differs = abs(self.measured - self.predicted) > self._half_width(SIGNIFICANCE_LEVEL)
        return not self.above_noise and self.is_clear and differs


@dataclass(frozen=True, repr=False)
class AblationTest:
    """Result of ``ablation_test``; prints as a table.

    Attributes
    ----------
    rows
        One per parameter, in order of decreasing saliency.
    metric
        Name of the metric.
    jumps
        The reasons why poses have no derivative to test, by their labels.
    left_out
        The same of poses that are tested in their other directions.
    """

    rows: tuple[Ablated, ...]
    metric: str
    jumps: Mapping[str, str] = field(default_factory=dict)
    left_out: Mapping[str, str] = field(default_factory=dict)

    @property
    def kendall_tau(self) -> float | None:
        """Rank correlation of predictions and measurements, from −1 to 1; None if no pair is resolved.

        Only rows above the noise count, and of these only pairs whose predictions and measurements both differ
        significantly.
        """
        rows = [row for row in self.rows if row.above_noise]
        pairs = torch.zeros(len(rows), len(rows), dtype=torch.bool)
        for a, b in itertools.combinations(range(len(rows)), 2):
            pairs[a, b] = all(_is_resolved(rows[a], rows[b], which) for which in ("measured", "predicted"))
        predicted, measured = [row.predicted for row in rows], [row.measured for row in rows]
        tau = kendall_tau_of_pairs(predicted, measured, pairs)
        return None if math.isnan(tau) else tau

    @property
    def is_confirmed(self) -> bool:
        """Whether there are rows above the noise, and all agree with their predictions, in size and in order."""
        tau, measurable = self.kendall_tau, [row for row in self.rows if row.above_noise]
        ordered = tau is None or tau >= MIN_KENDALL_TAU
        return bool(measurable) and ordered and all(row.agrees for row in measurable)

    @property
    def verdict(self) -> str:
        """The result in one sentence."""
        measurable = [row for row in self.rows if row.above_noise]
        if not self.rows and self.jumps:
            reasons = [f"{label} has no derivative: {reason}" for label, reason in self.jumps.items()]
            return f"Nothing to test: {first_few(reasons, '; ')}"
        if not self.rows:
            return f"Nothing to test: {self.metric} depends on none of these parameters"
        if not measurable:
            return (
                f"Too noisy to tell: no change of {self.metric} exceeds the noise of its measurement; use more "
                "samples"
            )
        agreeing = sum(row.agrees for row in measurable)
        tau = self.kendall_tau
        order = "no resolved pair to rank" if tau is None else f"Kendall's τ {minus(f'{tau:.2f}')}"
        doubtful = sum(row.is_doubtful for row in self.rows)
        in_doubt = f", {doubtful} of them unlike predicted at 95 %" if doubtful else ""
        return (
            f"{'Confirmed' if self.is_confirmed else 'Not confirmed'}: "
            f"{agreeing} of {len(measurable)} parameters above the noise change {self.metric} as predicted; "
            f"{order}; {len(self.rows) - len(measurable)} below the noise{in_doubt}"
        )

    def _untested(self) -> list[str]:
        """Return why poses are not tested, or not in all directions; what the verdict says is left out."""
        jumps = self.jumps.items() if self.rows else ()
        return [
            *(f"–  {label} is not tested: {reason}; no derivative" for label, reason in jumps),
            *(
                f"–  {label}: {reason}; this direction is not tested"
                for label, reason in self.left_out.items()
            ),
        ]

    def _cautions(self) -> dict[str, str]:
        """Return the mark of each reason why derivatives are known to be wrong."""
        return caution_marks(group_by_text((row.name, row.caution) for row in self.rows))

    def plot(self, *, ax: Axes | None = None) -> Figure:
        """Plot the predicted and the measured slope of the metric for each parameter, into ``ax`` if given.

        Parameters are in order of decreasing saliency. Grey bars show the noise, the half-width of the 99.7 %
        confidence interval of their difference; crosses show the slope measured with the step of the paper, 0.01
        of each gradient.
        """
        ax = axes_or_new(ax, WIDTH, 1.7 + 0.24 * len(self.rows))
        label = f"change of {self.metric} per unit of the parameter, along its gradient"
        lines = wrapped_lines(label, characters_per_line(0.67 * WIDTH, TEXT))
        style_axes(ax, x="\n".join(lines))
        if self.rows:
            _draw(ax, self.rows)
        else:
            ax.set_xticks([])  # the verdict says why there is nothing to draw
        marks, names = self._cautions(), shorten([row.label for row in self.rows], _NAME_WIDTH)
        name_rows(
            ax,
            [f"{marks.get(row.caution, '')} {n}".strip() for row, n in zip(self.rows, names, strict=True)],
        )
        write_header(ax, "Ablation test", columns=2)
        notes = [self.verdict, *(f"{mark} {text}" for text, mark in marks.items()), *self._untested()]
        footnotes = [line for note in notes for line in wrapped_lines(note, _NOTE_WIDTH)]
        add_footnotes(ax, footnotes, below=34 + 13 * (len(lines) - 1))
        return figure_of(ax)

    def __str__(self) -> str:
        marks, names = self._cautions(), shorten([row.label for row in self.rows], _NAME_WIDTH)
        cells = [
            (
                f"{name} {marks.get(row.caution, '')}".rstrip(),
                format_with_error(row.predicted, row.predicted_error),
                format_with_error(row.measured, row.measured_error),
                rounded(row.step, 2),
            )
            for name, row in zip(names, self.rows, strict=True)
        ]
        lines = grid(
            ("moved along its gradient", "predicted slope", "measured slope", "step"), cells, right=True
        )
        remarks = ["", *(_remark(row) for row in self.rows)]
        notes = [*(f"{mark} {text}" for text, mark in marks.items()), *self._untested()]
        return "\n".join([*map(str.__add__, lines, remarks), *notes, "", self.verdict])

    __repr__ = __str__


def _is_resolved(a: Ablated, b: Ablated, which: str) -> bool:
    """Return whether a field of two rows, ``which``, differs significantly."""
    error = math.hypot(getattr(a, f"{which}_error"), getattr(b, f"{which}_error"))
    degrees = min(a.degrees_of_freedom, b.degrees_of_freedom)
    return bool(abs(getattr(a, which) - getattr(b, which)) > student_t(SIGNIFICANCE_LEVEL, degrees) * error)


def _draw(ax: Axes, rows: tuple[Ablated, ...]) -> None:
    # Bars on a logarithmic axis start at its lower limit, so the limit is set first.
    lower = 0.5 * min(
        value
        for row in rows
        for value in (
            row.predicted,
            row.noise or row.predicted,
            row.fixed if row.fixed and row.fixed > 0 else row.predicted,
        )
    )
    upper = 2 * max(max(row.predicted, abs(row.measured), row.fixed or 0) for row in rows)
    log_axis(ax, "x", lower, upper)
    positions = range(len(rows))
    lengths = [max(row.noise - lower, 0) for row in rows]
    ax.barh(positions, lengths, left=lower, height=0.7, color="0.88", label="noise")
    style: dict[str, Any] = {"marker": "D", "s": 34, "facecolors": "none", "edgecolors": "black", "zorder": 3}
    ax.scatter([row.predicted for row in rows], positions, label="predicted: the saliency", **style)
    # A negative one is within its noise, or contradicts the prediction, as the table says.
    fixed = [
        (y, row.fixed, row.fixed_error or 0.0)
        for y, row in enumerate(rows)
        if row.fixed is not None and row.fixed > 0
    ]
    if fixed:
        y, x, xerr = zip(*fixed, strict=True)
        style = {"fmt": "x", "markersize": 6.5, "markeredgewidth": 1.3, "color": "0.45", "elinewidth": 1}
        label = "measured with a step of 0.01 of the gradient"
        ax.errorbar(x, y, xerr=xerr, label=label, zorder=2, **style)  # seen behind a dot
    style = {"fmt": "o", "markersize": 4, "elinewidth": 1.2, "capsize": 3, "zorder": 4}
    for color, label in _OUTCOMES.items():
        shown = {y: row for y, row in enumerate(rows) if _color(row) == color and row.measured >= 0}
        _draw_measured(ax, shown, color=color, label=label, **style)
    # A logarithmic axis has no place for a negative one: it is at its magnitude, without a fill.
    label = "measured: opposite sign"
    for position, row in enumerate(rows):
        if row.measured < 0:
            _draw_measured(
                ax, {position: row}, color=_color(row), label=label, markerfacecolor="none", **style
            )
            label = "_opposite"  # in the legend once


def _draw_measured(ax: Axes, rows: Mapping[int, Ablated], **style: Any) -> None:
    if rows:
        values = [abs(row.measured) for row in rows.values()]
        ax.errorbar(values, list(rows), xerr=[row.measured_error for row in rows.values()], **style)


def _color(row: Ablated) -> str:
    if not row.above_noise:
        return UNCLEAR
    return RAISES if row.agrees else LOWERS


def _remark(row: Ablated) -> str:
    if row.is_doubtful:
        return "  below the noise, but unlike predicted"
    if not row.above_noise:
        return f"  below the noise{': prediction not confirmed' if row.is_clear else ''}"
    return "" if row.agrees else "  not as predicted"
