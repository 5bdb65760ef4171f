"""``minimize``: search with torch's Adam until a measurement confirms the goal."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

import torch
from tqdm import tqdm

from ..attr import Ranked, SceneAttribution, VanillaSceneGradient, own_texels, range_lengths, summarize
from ..errors import SceneCaptumError, whole_number
from ..estimation import (
    DEFAULT_REPLICATES,
    Budget,
    Denoise,
    Metric,
    Stream,
    Target,
    TargetedMetric,
    TransformSelector,
    at_values,
    check_renderer_and_metric,
    derived_seeds,
    gradients_enabled,
    input_values,
    jackknife,
    render_images,
    require_memory,
    value_by_definition,
    with_image_transform,
)
from ..protocols import Capabilities, Renderer
from ..visualization import first_few, jump_notes
from ._adam import BoundedAdam, Offsets
from ._bounds import Limit, brought_inside, chosen_limits, construction, first_of_each_light, lamps
from ._result import Measured, Moved, Optimization, Whole, changed_fraction

BISECTIONS = 3  # of the last step
CLEAR = 2.0  # standard errors beyond which an effect is clear of the noise
KEPT_CONE = "belongs to the construction of a spot, which a design does not change."
NOISE_ONLY = (
    "the errors are of noise only: rate the design again at twice the resolution, with four times the samples"
)


@dataclass(frozen=True)
class SearchOptions:
    """How far and how long ``minimize`` searches; the fields are its parameters."""

    top: int = 5
    change: float = 0.5
    limits: Mapping[str, tuple[Limit, Limit]] | None = None
    steps: int = 60

    def __post_init__(self) -> None:
        if not 0 < self.change <= 1:
            raise SceneCaptumError(
                f"change must be a fraction of a range, above 0 and at most 1, not {self.change!r}."
            )
        whole_number("top", self.top)
        whole_number("steps", self.steps)


def minimize(  # noqa: PLR0913 -- options shared by all methods, plus its own
    renderer: Renderer,
    metric: Metric,
    below: float,
    *,
    inputs: Mapping[str, torch.Tensor] | None = None,
    target: Target = None,
    top: int = SearchOptions.top,
    change: float = SearchOptions.change,
    limits: Mapping[str, tuple[Limit, Limit]] | None = None,
    steps: int = SearchOptions.steps,
    seed: int = 0,
    spp: int | None = None,
    denoise: Denoise = "auto",
    show_progress: bool = False,
) -> Optimization:
    """Lower a metric below a goal with torch's Adam, changing only the most salient parameters.

    Parameters are ranked by their effects over their ranges. All but the top ones are kept constant, and so
    are those whose effects are within two standard errors, and the cones of spots. A lamp or a sky that is
    off stays off unless ``limits`` names it. A colour changes per channel, a texture by one offset per
    channel for all texels; a lamp or a sky is dimmed, and keeps its colour; no reflectance is raised above
    0.85, that of white paint, and no value moves closer to a physical bound than 1 % of its range. Every step
    renders with a new seed. The goal counts as reached once a measurement with independent samples confirms
    it; the last step is then shortened as far as the goal allows. A search that misses the goal returns the
    best of its steps, or the start if none is lower. A scene that is below the goal already, and within its
    limits, is kept.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics, optimize
    >>> renderer = SceneRenderer("cornell-box", inputs="reflectance", resolution=(16, 16), spp=256)
    >>> found = optimize.minimize(renderer, metrics.MeanLuminance(), below=27, top=2)  # cd/m²
    >>> found.reached, len(found.moved)
    (True, 2)

    Parameters
    ----------
    renderer, metric
        As for ``VanillaSceneGradient``; the renderer must have ``bounds``. To increase a metric, minimize its
        negative.
    below
        The goal, in the metric's unit. If more is better for the metric, as for an illuminance, a warning says so.
    inputs
        The values to start from; by default the scene's own.
    target
        Index of the metric's output, if that is a vector.
    top
        Number of parameters to change.
    change
        Maximum change of each parameter, as a fraction of its physical range, or of its value if the range is
        infinite.
    limits
        Intervals ``(low, high)`` of values by name or glob, in place of ``change``; numbers, or one for each
        channel, within which a lamp may also change its colour:
        ``{"desk.pose.translation": ((-0.3, -0.5, 0), (0.3, 0, 0))}`` keeps a desk on the floor. Objects are not
        moved into others whose bounds they did not overlap before. A value outside its limits begins at the
        nearest one inside, whether or not it is among the top ones, and in a scene below the goal as well; that is
        part of its change.
    steps
        Maximum number of steps.
    seed, show_progress
        As for ``VanillaSceneGradient``.
    spp
        Samples per pixel of each step and each measurement; the renderer's by default.
    denoise
        As for ``VanillaSceneGradient``; decided once, for the original scene.

    Returns
    -------
    Optimization
        Its ``reached`` is True if the goal was reached.

    Raises
    ------
    SceneCaptumError
        If an option is invalid, no parameter affects the metric, or an object starts inside another.

    References
    ----------
    Kingma and Ba, "Adam: A Method for Stochastic Optimization", 2015.
    """
    options = SearchOptions(top, change, limits, steps)
    warn_if_more_is_better(metric, target, below)
    search = Search(renderer, metric, inputs=inputs, target=target, seed=seed, spp=spp, denoise=denoise)
    return search.to(below, options, show_progress=show_progress)


def warn_if_more_is_better(metric: Metric, target: Target, below: float) -> None:
    """Warn of a goal below a value if more is better for the metric; before anything is rendered.

    It is no error: too much light, which dazzles, is a reason for such a goal.
    """
    measure = TargetedMetric(metric, target).measure
    if measure is None or measure.describe().get("better") != "higher":
        return
    warnings.warn(
        f"More is better for {measure.describe()['name']}, and below={below:g} asks for less: a value of at least "
        f"{below:g} counts as missed. `explain` without below= renders the changes that raise it.",
        stacklevel=3,
    )


class Search:
    """The start of a search: a scene whose metric is measured, and whose parameters are ranked when needed.

    The parameters are those of ``minimize``; ``ranked`` is an attribution of this scene, if there is one already.
    """

    def __init__(
        self,
        renderer: Renderer,
        metric: Metric,
        *,
        inputs: Mapping[str, torch.Tensor] | None = None,
        target: Target = None,
        seed: int = 0,
        spp: int | None = None,
        denoise: Denoise = "auto",
        ranked: SceneAttribution | None = None,
    ) -> None:
        check_renderer_and_metric(renderer, metric)
        self._renderer, self._metric, self._denoise = renderer, metric, denoise
        self._values = input_values(renderer, inputs)
        self._fixed = construction(renderer)
        self._spp = Capabilities(renderer).spp if spp is None else whole_number("spp", spp)
        self._seed, self._given = seed, ranked
        self._ranking_seed, measurement_seed = derived_seeds(seed, Stream.OPTIMIZATION, 2)
        budget = Budget.split(self._spp, DEFAULT_REPLICATES, measurement_seed)
        self._seeds, self._spp_of_replicate = budget.seeds[0], budget.spp[0]
        require_memory(renderer, budget.spp, len(self._seeds))
        self._targeted = TargetedMetric(metric, target)
        selector = TransformSelector(denoise, renderer, self._values, smoothed=self._targeted.is_smoothed)
        images = self._render(self._values)
        (self._transformed,) = with_image_transform([self._targeted], images, selector)
        self._before = self._measured(self._values, images)

    @gradients_enabled()
    def to(self, below: float, options: SearchOptions, *, show_progress: bool = False) -> Optimization:
        """Search until the metric is below a goal; at once where it is already, within the limits."""
        limits = self._limits(options.limits or {})
        brought = brought_inside(self._values, limits)
        measure = {} if self._targeted.measure is None else self._targeted.measure.describe()
        name = str(measure.get("symbol") or self._targeted.label)
        unit = str(measure.get("unit") or "")
        if self._before.is_below(below) and not brought:
            return Optimization(dict(self._values), (), self._before, self._before, (), below, name, unit)
        rows = self._movable(options.top, limits)
        if not rows:
            raise SceneCaptumError(self._nothing_moves(name))
        inside = self._values | brought
        start = {row.name: inside[row.name] for row in rows}
        within = {name: limits[name] for name in start if name in limits}
        optimizer = BoundedAdam(self._renderer, start, options.change, within)

        def optimized() -> dict[str, torch.Tensor]:
            return inside | {name: value.detach() for name, value in optimizer.values().items()}

        history: list[float] = []
        after = None
        unmoved = lowest = optimizer.offsets()
        _, _, *seeds = derived_seeds(self._seed, Stream.OPTIMIZATION, 2 + options.steps)
        for seed in tqdm(seeds, disable=not show_progress, desc=name, unit="step"):
            current = {**inside, **optimizer.values()}
            image = self._renderer(current, seed=seed, spp=self._spp)
            metric = at_values(self._transformed, self._renderer, current)
            value, adjoint = metric.value_and_adjoint(image)
            history.append(value)
            lowest = optimizer.offsets() if value == min(history) else lowest
            # A step's value is biased low, since the optimizer fits its noise: check with independent samples.
            exact = metric.by_definition()
            seems_below = value < below and (exact is None or exact.value(image.detach()) < below)
            if seems_below and (confirmed := self._measure(optimized())).is_below(below):
                after = _shortened(optimizer, lambda: self._measure(optimized()), confirmed, below)
                break
            optimizer.step(image, adjoint)
        if after is None:
            first = self._measure(inside) if brought else self._before
            after = _best(optimizer, lambda: self._measure(optimized()), (first, unmoved), lowest)
        rates_picture = self._ranked.surfaces is not None and measure.get("limits")
        labels = {row.name: row.label for row in rows}
        note = NOISE_ONLY if rates_picture and after.is_below(below) else ""
        if not after.is_below(below) and (stopped := optimizer.at_limits()):
            note = f"at the limit of their change or range: {', '.join(labels[one] for one in stopped)}"
        return Optimization(
            values=optimized(),
            moved=self._moved(optimized(), {**start, **brought}),
            before=self._before,
            after=after,
            history=tuple(history),
            below=below,
            metric=name,
            unit=unit,
            note=note,
            shows_a_view=Capabilities(self._renderer).shows_a_view is not False,
        )

    def _moved(self, values: Mapping[str, torch.Tensor], names: Iterable[str]) -> tuple[Moved, ...]:
        """Return the initial and final value of each of these that has moved: others were at a bound."""
        initial = {
            name: self._values[name] for name in names if not torch.equal(self._values[name], values[name])
        }
        before, after = (
            summarize(own_texels(self._renderer, one))
            for one in (initial, {name: values[name] for name in initial})
        )
        lengths, lights = range_lengths(self._renderer, initial), lamps(self._renderer)
        ranges = Capabilities(self._renderer).ranges or Capabilities(self._renderer).bounds or {}
        labels = self._ranked.labels

        def moved(name: str) -> Moved:
            low, high = ranges.get(name, (-math.inf, math.inf))
            whole: Whole = "light" if name in lights else "range" if math.isfinite(high - low) else "value"
            # Not of the offsets, which go on where a value or a texel has reached its bound.
            fraction = changed_fraction(before[name], after[name], lengths[name], whole)
            return Moved(name, labels.get(name, name), before[name], after[name], fraction, whole)

        return tuple(map(moved, initial))

    @cached_property
    def _ranked(self) -> SceneAttribution:
        if self._given is not None:
            return self._given
        ranked: SceneAttribution = VanillaSceneGradient(self._renderer, self._metric).attribute(
            self._values,
            target=self._targeted.target,
            seed=self._ranking_seed,
            spp=self._spp,
            denoise=self._denoise,
        )
        return ranked

    def _limits(
        self, limits: Mapping[str, tuple[Limit, Limit]]
    ) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
        """Return the limits of the parameters that a design may change."""
        if named := self._fixed.intersection(limits):
            raise SceneCaptumError(f"limits names {min(named)!r}, which {KEPT_CONE}")
        chosen = chosen_limits(self._values, limits)
        return {name: limit for name, limit in chosen.items() if name not in self._fixed}

    def _movable(self, count: int, limits: Collection[str]) -> list[Ranked]:
        """Return the parameters with the largest effects that may be changed."""
        # A design for the evening must not need the sky: only limits say that a light may be switched on.
        kept = self._fixed | (self._off() - set(limits))
        movable = [row for row in self._ranked.ranking() if any(row.total) and row.name not in kept]
        # Those in the noise would move in either direction; they only count where nothing is clear of it.
        clear = [row for row in movable if abs(row.effect) > CLEAR * (row.effect_error or 0.0)]
        return first_of_each_light(clear or movable)[:count]

    def _off(self) -> set[str]:
        """Return the lights that are off."""
        return {name for name in lamps(self._renderer) & self._values.keys() if not self._values[name].any()}

    def _nothing_moves(self, metric: str) -> str:
        kept = [row.label for row in self._ranked.ranking() if any(row.total)]
        if off := [row.name for row in self._ranked.ranking() if any(row.total) and row.name in self._off()]:
            return (
                f"All lights here that affect {metric} are off, and a search keeps them off: {first_few(off)}. "
                "Start with them on, add other inputs, or name them in limits= of minimize."
            )
        if not kept and (jumps := jump_notes(self._ranked)):
            return f"No parameter has a derivative: {first_few([note.lstrip('– ') for note in jumps], '; ')}."
        if not kept:
            return f"No parameter affects {metric}: all its gradients are 0."
        return f"{kept[0]} {KEPT_CONE} Add other inputs."

    def _render(self, values: Mapping[str, torch.Tensor]) -> list[torch.Tensor]:
        return render_images(self._renderer, values, self._seeds, self._spp_of_replicate)

    def _measure(self, values: Mapping[str, torch.Tensor]) -> Measured:
        return self._measured(values, self._render(values))

    def _measured(self, values: Mapping[str, torch.Tensor], images: list[torch.Tensor]) -> Measured:
        metric, pictures = at_values(self._transformed, self._renderer, values), torch.stack(images)
        estimate, stated = jackknife(metric, images), value_by_definition(metric, pictures)
        value, error = estimate.value, estimate.standard_error or 0.0
        if stated is None:
            return Measured(value, error, pictures.mean(0))
        exact, exact_error = stated
        return Measured(exact, exact_error or 0.0, pictures.mean(0), value, error)


def _best(
    optimizer: BoundedAdam, measure: Callable[[], Measured], start: tuple[Measured, Offsets], lowest: Offsets
) -> Measured:
    """Go to the best of the start, the step with the lowest value and the last one; return what it measures.

    All three are measured with the same samples, which are not those that the step has its low value from.
    """
    designs = [start]
    for offsets in (lowest, optimizer.offsets()):
        optimizer.go_to(offsets)
        designs.append((measure(), offsets))
    best, offsets = min(designs, key=lambda design: design[0].order)
    optimizer.go_to(offsets)
    return best


def _shortened(
    optimizer: BoundedAdam, measure: Callable[[], Measured], reached: Measured, below: float
) -> Measured:
    """Shorten the last step as far as the goal allows, by bisection, and return what was measured there."""
    enough, too_short = 1.0, 0.0
    for _ in range(BISECTIONS):
        fraction = (enough + too_short) / 2
        optimizer.shorten_last_step(fraction)
        measured = measure()
        if measured.is_below(below) and not optimizer.colliding():
            enough, reached = fraction, measured
        else:
            too_short = fraction
    optimizer.shorten_last_step(enough)
    return reached
