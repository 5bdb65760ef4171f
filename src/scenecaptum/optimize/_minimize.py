"""``minimize``: search with torch's Adam until a measurement confirms the goal."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from tqdm import tqdm

from ..attr import VanillaSceneGradient
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
    derived_seeds,
    input_values,
    jackknife,
    render_images,
    with_image_transform,
)
from ..protocols import Capabilities, Renderer
from ..visualization import metric_symbol, metric_unit
from ._adam import BoundedAdam
from ._bounds import Limit, chosen_limits, construction, first_of_each_light
from ._result import Measured, Optimization

BISECTIONS = 3  # of the last step
CLEAR = 2.0  # standard errors beyond which an effect is clear of the noise
NOISE_ONLY = "the errors are of noise only: rate the design again at twice the resolution"


def minimize(  # noqa: PLR0913 -- options shared by all methods, plus its own
    renderer: Renderer,
    metric: Metric,
    below: float,
    *,
    inputs: Mapping[str, torch.Tensor] | None = None,
    target: Target = None,
    top: int = 5,
    change: float = 0.5,
    limits: Mapping[str, tuple[Limit, Limit]] | None = None,
    steps: int = 60,
    seed: int = 0,
    spp: int | None = None,
    denoise: Denoise = "auto",
    show_progress: bool = False,
) -> Optimization:
    """Lower a metric below a goal with torch's Adam, changing only the most salient parameters.

    Parameters are ranked by their effects over their ranges. All but the top ones are kept constant, and so are
    those whose effects are within two standard errors, and the cones of spots. A colour changes per channel, a
    texture by one offset per channel for all texels; a lamp or a sky is dimmed, and keeps its colour; no
    reflectance is raised above 0.85, that of white paint. Every step renders with a new seed. The goal counts as
    reached once a measurement with independent samples confirms it; the last step is then shortened as far as the
    goal allows. A scene that is below the goal already is kept.

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
        The goal, in the metric's unit.
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
        moved into others whose bounds they did not overlap before.
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
    if not 0 < change <= 1:
        raise SceneCaptumError(
            f"change must be a fraction of a range, above 0 and at most 1, not {change!r}."
        )
    values = input_values(renderer, inputs)
    spp = Capabilities(renderer).spp if spp is None else whole_number("spp", spp)
    count = whole_number("steps", steps)
    ranking_seed, measurement_seed, *step_seeds = derived_seeds(seed, Stream.OPTIMIZATION, 2 + count)
    ranked = VanillaSceneGradient(renderer, metric).attribute(
        values, target=target, seed=ranking_seed, spp=spp, denoise=denoise
    )
    name = metric_symbol(ranked)
    most = whole_number("top", top)
    budget = Budget.split(spp, DEFAULT_REPLICATES, measurement_seed)

    def render(changed: Mapping[str, torch.Tensor]) -> list[torch.Tensor]:
        return render_images(renderer, changed, budget.seeds[0], budget.spp[0])

    targeted = TargetedMetric(metric, target)
    selector = TransformSelector(denoise, renderer, values, smoothed=targeted.is_smoothed)
    (transformed,) = with_image_transform([targeted], render(values), selector)

    def measure(changed: Mapping[str, torch.Tensor]) -> Measured:
        images = render(changed)
        estimate = jackknife(at_values(transformed, renderer, changed), images)
        return Measured(estimate.value, estimate.standard_error or 0.0, torch.stack(images).mean(0))

    before = after = measure(values)
    if before.is_below(below):
        return Optimization(dict(values), (), before, before, (), below, name, metric_unit(ranked))
    fixed = construction(renderer)
    movable = [row for row in ranked.ranking() if any(row.total) and row.name not in fixed]
    # Those in the noise would move in either direction; they only count where nothing is clear of it.
    clear = [row for row in movable if abs(row.effect) > CLEAR * (row.effect_error or 0.0)]
    top_rows = first_of_each_light(clear or movable)[:most]
    if not top_rows:
        raise SceneCaptumError(f"No parameter affects {name}: all its gradients are 0.")
    start = {row.name: values[row.name] for row in top_rows}
    optimizer = BoundedAdam(renderer, start, change, chosen_limits(values, start, limits or {}))

    def optimized() -> dict[str, torch.Tensor]:
        return values | {name: value.detach() for name, value in optimizer.values().items()}

    history: list[float] = []
    for step_seed in tqdm(step_seeds, disable=not show_progress, desc=name, unit="step"):
        current = {**values, **optimizer.values()}
        image = renderer(current, seed=step_seed, spp=spp)
        value, adjoint = at_values(transformed, renderer, current).value_and_adjoint(image)
        history.append(value)
        # The value of a step is biased low, since the optimizer fits its noise: check with independent samples.
        if value < below:
            after = measure(optimized())
            if after.is_below(below):
                after = _shortened(optimizer, lambda: measure(optimized()), after, below)
                break
        optimizer.step(image, adjoint)
    else:
        after = measure(optimized())
    rates_picture = ranked.surfaces is not None and (ranked.info.get("measure") or {}).get("limits")
    return Optimization(
        values=optimized(),
        moved=optimizer.summary({row.name: row.label for row in top_rows}),
        before=before,
        after=after,
        history=tuple(history),
        below=below,
        metric=name,
        unit=metric_unit(ranked),
        note=NOISE_ONLY if rates_picture and after.is_below(below) else "",
    )


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
