"""The ablation test: move single parameters along their gradients and compare the metric with the prediction."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from tqdm import tqdm

from ..attr import SceneAttribution, VanillaSceneGradient
from ..checkpoint import Folder, with_checkpoint
from ..errors import SceneCaptumError, whole_number
from ..estimation import DEFAULT_REPLICATES, Metric, Target, channel_totals
from ..protocols import Capabilities, Renderer
from ._ablation_result import Ablated, AblationTest
from ._scenes import (
    MAX_STEP,
    MIN_STEP,
    Scenes,
    denoise_of,
    distances_to_bounds,
    mean_and_error,
    unit_gradient,
)

# Reduce a step until the second-order term is at most this fraction of the slope.
MAX_NONLINEARITY, STEP_REDUCTION, MAX_STEP_REDUCTIONS = 0.2, 4.0, 6

FIXED_STEP = 0.01  # of the gradient: the step of Beresna and Fiume
MAX_BOUND_FRACTION = 0.99  # of the distance to a bound, since the bound itself may be unphysical


def ablation_test(  # noqa: PLR0913 -- the options of every long job, and its own
    renderer: Renderer,
    metric: Metric,
    attribution: SceneAttribution | None = None,
    target: Target = None,
    *,
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
        The plain gradients to test; computed by default.
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
        If the attribution is not one of plain gradients, or has no error bars.

    References
    ----------
    Beresna and Fiume, "Scene Parameter Saliency via Differentiable Light Transport": ablation with a step of one
    hundredth of each gradient, reported here as ``fixed``.
    """
    renderer = with_checkpoint(renderer, checkpoint)
    if attribution is None:
        attribution = VanillaSceneGradient(renderer, metric).attribute(
            target=target, seed=seed, spp=spp, show_progress=show_progress
        )
    if attribution.info.get("scale") != "unit" or attribution.covariance is None:
        raise SceneCaptumError(
            "ablation_test needs plain gradients with error bars: VanillaSceneGradient(...).attribute()."
        )
    options: dict[str, Any] = {"seed": seed, "spp": spp, "replicates": replicates}
    scenes = Scenes(renderer, metric, target, **options, denoise=denoise_of(attribution))
    rows = [row for row in attribution.ranking(whole_number("top", top)) if row.saliency > 0]
    with tqdm(rows, disable=not show_progress, desc="ablation", unit="parameter") as bar:
        return AblationTest(
            rows=tuple(_ablate(scenes, row, attribution[row.name]) for row in bar),
            metric=str(attribution.info["metric"]),
        )


@dataclass(frozen=True)
class _Step:
    """A step of a parameter along its gradient.

    Attributes
    ----------
    direction
        Gradient direction, of unit length over the channels; 0 for elements that stay.
    length
        Signed length, negative down the gradient.
    share
        Fraction of the saliency that belongs to the moving elements.
    """

    direction: torch.Tensor
    length: float
    share: float = 1.0


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


def _ablate(scenes: Scenes, row: Any, gradient: torch.Tensor) -> Ablated:
    value, (low, high) = scenes.values[row.name], (Capabilities(scenes.renderer).bounds or {})[row.name]
    chosen = _choose_step(value, gradient, low, high)

    def slope(length: float) -> torch.Tensor:
        change = scenes.measure({row.name: value + length * chosen.direction}) - scenes.unmodified
        return change / (length * chosen.share)

    step = chosen.length
    for _ in range(MAX_STEP_REDUCTIONS):
        half, full = slope(step / 2), slope(step)
        measured, error = mean_and_error(2 * half - full)
        second_order, second_order_error = mean_and_error(2 * (full - half))
        # A shorter step would only amplify a second-order term that is within the noise.
        if abs(second_order) - 2 * second_order_error <= MAX_NONLINEARITY * abs(measured):
            break
        step /= STEP_REDUCTION
    distance = distances_to_bounds(value, -chosen.direction, low, high).min().item()
    fixed_step = min(FIXED_STEP * row.saliency, MAX_BOUND_FRACTION * distance)
    fixed, fixed_error = mean_and_error(slope(-fixed_step)) if fixed_step > 0 else (None, None)
    return Ablated(
        name=row.name,
        label=row.label,
        predicted=row.saliency,
        predicted_error=row.saliency_error,
        measured=measured,
        measured_error=error,
        step=step,
        curvature=2 * second_order / step,
        degrees_of_freedom=len(scenes.seeds) - 1,
        fixed=fixed,
        fixed_error=fixed_error,
    )
