"""Minimize a metric by changing the few most salient parameters within their bounds."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from tqdm import tqdm

from ..attr import VanillaSceneGradient, ranges, summarize
from ..errors import SceneCaptumError, check_seed, whole_number
from ..estimation import (
    DEFAULT_REPLICATES,
    Budget,
    Denoise,
    Metric,
    TargetedMetric,
    TransformSelector,
    channel_totals,
    input_values,
    jackknife,
    render_images,
    with_image_transform,
)
from ..protocols import Capabilities, Renderer
from ._result import Measured, Moved, Optimization

LEARNING_RATE = 0.05  # of Adam: approximate step size as a fraction of a parameter's range
BOUND_MARGIN = 0.01  # distance from a physical bound, which may be degenerate, as a fraction of the range


def minimize(  # noqa: PLR0913 -- options shared by all methods, plus its own
    renderer: Renderer,
    metric: Metric,
    below: float,
    *,
    top: int = 5,
    change: float = 0.5,
    steps: int = 60,
    seed: int = 0,
    spp: int | None = None,
    denoise: Denoise = "auto",
    show_progress: bool = False,
) -> Optimization:
    """Lower a metric below a goal with torch's Adam, changing only the most salient parameters.

    Parameters are ranked by gradient × range; all but the top ones are kept constant. A colour changes per
    channel, a texture by one offset per channel for all texels. Every step renders with a new seed. The goal
    counts as reached once a measurement with independent samples confirms it.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics, optimize
    >>> renderer = SceneRenderer("cornell-box", inputs="reflectance", resolution=(16, 16), spp=256)
    >>> found = optimize.minimize(renderer, metrics.MeanLuminance(), below=0.15, top=2)
    >>> found.reached, len(found.moved)
    (True, 2)

    Parameters
    ----------
    renderer, metric
        As for ``VanillaSceneGradient``; the metric must return a scalar, and the renderer must have ``bounds``.
        To increase a metric, minimize its negative.
    below
        The goal, in the metric's unit.
    top
        Number of parameters to change.
    change
        Maximum change of each parameter, as a fraction of its physical range, or of its value if the range is
        infinite.
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
        If an option is invalid, or no parameter affects the metric.

    References
    ----------
    Kingma and Ba, "Adam: A Method for Stochastic Optimization", 2015.
    """
    if not 0 < change <= 1:
        raise SceneCaptumError(
            f"change must be a fraction of a range, above 0 and at most 1, not {change!r}."
        )
    values = input_values(renderer, None)
    spp = Capabilities(renderer).spp if spp is None else whole_number("spp", spp)
    count = whole_number("steps", steps)
    ranking_seed, measurement_seed, *step_seeds = (
        np.random.SeedSequence([check_seed("seed", seed), 6]).generate_state(2 + count).tolist()
    )
    ranked = VanillaSceneGradient(renderer, metric).attribute(
        scale="range", seed=ranking_seed, spp=spp, denoise=denoise
    )
    metric_name = str(ranked.info["metric"])
    top_rows = [row for row in ranked.ranking(whole_number("top", top)) if row.saliency > 0]
    if not top_rows:
        raise SceneCaptumError(f"No parameter affects {metric_name}: all its gradients are 0.")
    budget = Budget.split(spp, DEFAULT_REPLICATES, measurement_seed)

    def render(changed: Mapping[str, torch.Tensor]) -> list[torch.Tensor]:
        return render_images(renderer, changed, budget.seeds[0], budget.spp[0])

    (transformed,) = with_image_transform(
        [TargetedMetric(metric)], render(values), TransformSelector(denoise, renderer)
    )

    def measure(changed: Mapping[str, torch.Tensor]) -> Measured:
        images = render(changed)
        estimate = jackknife(transformed, images)
        return Measured(estimate.value, estimate.standard_error or 0.0, torch.stack(images).mean(0))

    optimizer = _BoundedAdam(renderer, {row.name: values[row.name] for row in top_rows}, change)
    history: list[float] = []
    before = after = measure(values)
    for step_seed in tqdm(step_seeds, disable=not show_progress, desc=metric_name, unit="step"):
        image = renderer({**values, **optimizer.values()}, seed=step_seed, spp=spp)
        value, adjoint = transformed.value_and_adjoint(image)
        history.append(value)
        # The value of a step is biased low, since the optimizer fits its noise: check with independent samples.
        if value < below:
            after = measure(values | _detached(optimizer.values()))
            if after.is_below(below):
                break
        optimizer.step(image, adjoint)
    else:
        after = measure(values | _detached(optimizer.values()))
    return Optimization(
        values=values | _detached(optimizer.values()),
        moved=optimizer.summary({row.name: row.label for row in top_rows}),
        before=before,
        after=after,
        history=tuple(history),
        below=below,
        metric=metric_name,
    )


class _BoundedAdam:
    """Adam on offsets from ``start`` by channel, in units of the ranges, up to ``change`` and within bounds."""

    def __init__(self, renderer: Renderer, start: Mapping[str, torch.Tensor], change: float) -> None:
        self.start = start
        self.change = change
        self._ranges = {name: length.item() for name, length in ranges(renderer, start).items()}
        bounds = Capabilities(renderer).bounds or {}
        self._bounds = {name: bounds[name] for name in start}
        self._offsets = {
            name: value.new_zeros(channel_totals(value).shape).requires_grad_()
            for name, value in start.items()
        }
        self._adam = torch.optim.Adam(self._offsets.values(), lr=LEARNING_RATE)

    def values(self) -> dict[str, torch.Tensor]:
        """Return the current values as functions of the offsets."""
        current = {}
        for name, value in self.start.items():
            offset = self._offsets[name].reshape(value.shape if value.ndim < 2 else (-1,))
            low, high = self._bounds[name]
            margin = BOUND_MARGIN * self._ranges[name]
            # A value that starts within the margin may stay there.
            lowest, highest = value.clamp(max=low + margin), value.clamp(min=high - margin)
            current[name] = torch.minimum(torch.maximum(value + self._ranges[name] * offset, lowest), highest)
        return current

    def step(self, image: torch.Tensor, adjoint: torch.Tensor) -> None:
        """Take one descent step, given the gradient of the metric with respect to the image."""
        self._adam.zero_grad()
        image.backward(adjoint)
        self._adam.step()
        with torch.no_grad():
            for offset in self._offsets.values():
                offset.clamp_(-self.change, self.change)

    def summary(self, labels: Mapping[str, str]) -> tuple[Moved, ...]:
        """Return the initial and current value of every parameter."""
        before, after = summarize(self.start), summarize(self.values())
        return tuple(
            Moved(name, labels[name], before[name], after[name], self._offsets[name].abs().max().item())
            for name in self.start
        )


def _detached(values: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {name: value.detach() for name, value in values.items()}
