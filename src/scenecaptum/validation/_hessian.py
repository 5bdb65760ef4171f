"""Hessian-vector products of a metric, from finite differences of gradients."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import torch

from ..attr import SceneAttribution, VanillaSceneGradient, range_lengths
from ..checkpoint import Folder, with_checkpoint
from ..denoising import Guides, guides_of
from ..errors import SceneCaptumError, near_misses
from ..estimation import DEFAULT_REPLICATES, Metric, Target, TargetedMetric, mean_and_error
from ..protocols import Capabilities, Renderer, accepted_keywords
from ._scenes import MAX_STEP, MIN_STEP, Scenes, distances_to_bounds

# Reduce a stencil until the truncation error of its lower-order formula is at most this fraction of the slope.
MAX_TRUNCATION_ERROR, STEP_REDUCTION, MAX_STEP_REDUCTIONS = 0.02, 2.0, 8

Direction = Mapping[str, torch.Tensor]


@dataclass(frozen=True)
class Stencil:
    """A finite-difference stencil for the slope of a function along a direction, at 0.

    The difference from the slope by a formula of lower order estimates the truncation error.
    """

    offsets: tuple[float, ...]  # where the function is evaluated, in units of the direction
    weights: tuple[float, ...]  # of these values in the slope
    lower_order: tuple[float, ...]  # weights of the formula of lower order

    @property
    def length(self) -> float:
        """The largest offset."""
        return max(map(abs, self.offsets))

    def scaled(self, step: float) -> Stencil:
        """Return the stencil scaled by ``step``; a negative step mirrors it."""
        return Stencil(
            tuple(step * offset for offset in self.offsets),
            tuple(weight / step for weight in self.weights),
            tuple(weight / step for weight in self.lower_order),
        )


# Both have length 1; their truncation errors are of fourth and third order.
CENTRAL = Stencil((-1, -1 / 2, 1 / 2, 1), (1 / 6, -4 / 3, 4 / 3, -1 / 6), (0, -1, 1, 0))
ONE_SIDED = Stencil((0, 1 / 3, 2 / 3, 1), (-11 / 2, 9, -9 / 2, 1), (-9 / 2, 6, -3 / 2, 0))


def hessian_vector_product(
    renderer: Renderer,
    metric: Metric,
    direction: Direction,
    target: Target = None,
    *,
    seed: int = 0,
    spp: int | None = None,
    replicates: int = DEFAULT_REPLICATES,
    checkpoint: Folder = None,
) -> SceneAttribution:
    """Return ``H v``: the derivative of every parameter's gradient along a direction ``v``.

    Computed as the gradient of the metric's slope along ``v``, a finite difference of four scenes that are
    rendered with common random numbers. The steps are at most a tenth of each parameter's physical range and half
    the distance to its bounds, shorter where the metric is strongly non-linear, and one-sided at a bound.

    Example
    -------
    Luminance is linear in a lamp's radiance ``L``, so ``L`` times the derivative of its gradients with respect to
    ``L`` is these gradients themselves:

    >>> from scenecaptum import SceneRenderer, VanillaSceneGradient, metrics
    >>> renderer = SceneRenderer("cornell-box", ["reflectance", "emitters"], resolution=(16, 16), spp=16)
    >>> lamp, floor = "light.emitter.radiance.value", "floor.reflectance.value"
    >>> metric = metrics.MeanLuminance()
    >>> product = hessian_vector_product(renderer, metric, {lamp: renderer.inputs[lamp]})
    >>> gradient = VanillaSceneGradient(renderer, metric).attribute()
    >>> torch.allclose(product[floor], gradient[floor], rtol=1e-3)
    True

    Parameters
    ----------
    renderer, metric, target
        As for ``VanillaSceneGradient``; the renderer must have ``bounds``.
    direction
        A tensor for each parameter that moves, broadcastable to its shape.
    seed, spp, replicates, checkpoint
        As for ``ablation_test``; ``spp`` is that of each of the four scenes.

    Returns
    -------
    SceneAttribution
        By parameter name, with standard errors. ``metric_value`` is the slope of the metric, and ``info["step"]``
        the largest step, in units of the direction.

    Raises
    ------
    SceneCaptumError
        If the direction names no parameter, is 0 or not finite, or leads out of the bounds both ways.

    Notes
    -----
    If the parameter affects the sampling of paths (a roughness, or Russian roulette), less of the noise cancels.
    """
    options: dict[str, Any] = {"seed": seed, "spp": spp, "replicates": replicates}
    scenes = Scenes(with_checkpoint(renderer, checkpoint), metric, target, **options)
    return product_of(scenes, direction, scenes.values, **options)


def product_of(
    scenes: Scenes, direction: Direction, names: Iterable[str], **options: Any
) -> SceneAttribution:
    """Return the elements of ``H v`` for the named parameters; options as for ``VanillaSceneGradient``."""
    direction = _check_direction(direction, scenes.values)
    stencil = choose_stencil(scenes, direction)
    slope = _Slope(scenes.metric, stencil)
    renderer = _StencilRenderer(scenes, direction, stencil.offsets)
    values = {name: scenes.values[name] for name in names}
    product: SceneAttribution = VanillaSceneGradient(renderer, slope).attribute(
        values, target=scenes.metric.target, **options, denoise=scenes.metric.transform.denoises
    )
    assert product.image is not None
    return dataclasses.replace(
        product,
        image=product.image.mean(0),
        surfaces=Capabilities(scenes.renderer).surfaces,
        info={**product.info, "method": "hessian_vector_product", "step": stencil.length},
    )


class _StencilRenderer:
    """Renders the scenes of a stencil as one stack of images."""

    def __init__(self, scenes: Scenes, direction: Direction, offsets: tuple[float, ...]) -> None:
        self.renderer = renderer = scenes.renderer
        self.values = scenes.values
        self.direction = direction
        self.offsets = offsets
        offered = Capabilities(renderer)
        self.spp = offered.spp
        self.labels = offered.labels or {}
        self.info = offered.info or {}
        self.accepted_keywords = accepted_keywords(renderer)

    def __call__(self, inputs: Mapping[str, torch.Tensor], **options: Any) -> torch.Tensor:
        return torch.stack([self.renderer(scene, **options) for scene in self._scenes(inputs)])

    def guides_of(self, inputs: Mapping[str, torch.Tensor]) -> Guides | None:
        """Return the guides of each scene of the stencil, as one stack; None if the renderer has none."""
        guides = [found for scene in self._scenes(inputs) if (found := guides_of(self.renderer, scene))]
        return Guides.stacked(guides) if guides else None

    def _scenes(self, inputs: Mapping[str, torch.Tensor]) -> list[dict[str, torch.Tensor]]:
        values = {**self.values, **inputs}
        return [{**values, **_moved(values, self.direction, offset)} for offset in self.offsets]


class _Slope:
    """The slope of a metric as a metric of its own, of the stack of images of a stencil.

    Draws of noise are the same for all of its images, and are split among the replicates as those of the metric.
    """

    def __init__(self, metric: TargetedMetric, stencil: Stencil) -> None:
        self.metric = metric
        self.stencil = stencil
        self.__name__ = f"slope of {TargetedMetric(metric.metric).name}"

    def __call__(self, images: torch.Tensor) -> torch.Tensor:
        pairs = zip(self.stencil.weights, images, strict=True)
        return torch.stack([weight * self.metric.metric(image) for weight, image in pairs]).sum(0)

    @property
    def n_draws(self) -> int:
        return self.metric.n_draws

    def with_draws(self, draws: Mapping[int, int]) -> _Slope:
        return _Slope(self.metric.with_draws(draws), self.stencil)


def choose_stencil(scenes: Scenes, direction: Direction) -> Stencil:
    """Return a stencil within the bounds whose truncation error is small."""
    up, down = max_steps(scenes, direction)
    if max(up, down) == 0:
        raise SceneCaptumError(
            f"The direction leads out of the physical bounds either way: {', '.join(direction)} cannot move along "
            "it. Move fewer elements, or others."
        )
    if min(up, down) >= MIN_STEP / MAX_STEP * max(up, down):
        kind, step = CENTRAL, min(up, down)
    else:
        kind, step = ONE_SIDED, up if up > down else -down
    known: dict[float, torch.Tensor] = {0.0: scenes.unmodified}
    for _ in range(MAX_STEP_REDUCTIONS):
        stencil = kind.scaled(step)
        for offset in stencil.offsets:
            if offset not in known:
                known[offset] = scenes.measure(_moved(scenes.values, direction, offset))
        measured = torch.stack([known[offset] for offset in stencil.offsets])
        slope, lower_order = (
            measured.new_tensor(weights) @ measured for weights in (stencil.weights, stencil.lower_order)
        )
        truncation, error = mean_and_error(slope - lower_order)
        # Single precision; pseudo-values multiply its error by their number.
        size = scenes.unmodified.mean().abs().item() * len(scenes.seeds)
        rounding = size * torch.finfo(torch.float32).eps * sum(map(abs, stencil.weights))
        if abs(truncation) <= max(MAX_TRUNCATION_ERROR * abs(slope.mean().item()), 2 * error, rounding):
            break
        step /= STEP_REDUCTION
    return stencil


def max_steps(scenes: Scenes, direction: Direction) -> tuple[float, float]:
    """Return the longest steps along and against a direction; 0 if a parameter is at its bound.

    A step is a tenth of the smallest range, at most half the distance to a bound, which may be unphysical.
    """
    lengths = range_lengths(scenes.renderer, {name: scenes.values[name] for name in direction})
    bounds = Capabilities(scenes.renderer).bounds or {}
    longest = {1: math.inf, -1: math.inf}
    for name, tangent in direction.items():
        low, high = bounds.get(name, (-math.inf, math.inf))
        length = MAX_STEP * lengths[name].item() / tangent.abs().max().item()
        for sign, step in longest.items():
            distance = distances_to_bounds(scenes.values[name], sign * tangent, low, high).min().item()
            longest[sign] = min(step, length, max(0.0, 0.5 * distance))
    return longest[1], longest[-1]


def _moved(
    values: Mapping[str, torch.Tensor], direction: Direction, offset: float
) -> dict[str, torch.Tensor]:
    return {name: values[name] + offset * tangent for name, tangent in direction.items()}


def _check_direction(direction: Direction, values: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    checked = {}
    for name, given in direction.items():
        if name not in values:
            raise SceneCaptumError(
                f"direction names {name!r}, which is not an input.{near_misses(name, values)}"
            )
        tensor = torch.as_tensor(given).detach().to(values[name])
        try:
            tensor.broadcast_to(values[name].shape)
        except RuntimeError:
            raise SceneCaptumError(
                f"The direction of {name!r} has shape {tuple(tensor.shape)}, which does not broadcast to the "
                f"parameter's {tuple(values[name].shape)}."
            ) from None
        if not torch.isfinite(tensor).all():
            raise SceneCaptumError(f"The direction of {name!r} contains a value that is not finite.")
        if tensor.any():
            checked[name] = tensor
    if not checked:
        raise SceneCaptumError("direction is 0: at least one element must be non-zero.")
    return checked
