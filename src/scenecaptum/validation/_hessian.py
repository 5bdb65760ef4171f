"""Hessian-vector products of a metric, from differences of gradients."""

from __future__ import annotations

import dataclasses
import inspect
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import torch

from ..attr import SceneAttribution, VanillaSceneGradient
from ..attr._metric import Metric, Target, TargetedMetric
from ..attr._passes import DEFAULT_PASSES
from ..attr._ranges import ranges
from ..checkpoint import Folder, with_checkpoint
from ..denoising import Guides
from ..errors import SceneCaptumError, near_misses
from ._scenes import CRAMPED, LONGEST, Scenes, mean_and_error, room

# A stencil is short enough where dropping its last order takes less than this part of the slope.
BENT, SHORTER, SHORTEST = 0.02, 2.0, 8

Direction = Mapping[str, torch.Tensor]


@dataclass(frozen=True)
class Stencil:
    """Where along a direction a function is looked at, and how its values there add up to its slope at 0.

    Attributes
    ----------
    places
        In units of the direction.
    weights
        Of the values there.
    lower
        The same for a formula of lower order: their difference tells how much the function bends.
    """

    places: tuple[float, ...]
    weights: tuple[float, ...]
    lower: tuple[float, ...]

    def times(self, step: float) -> Stencil:
        """Return the same stencil, so much as long; a negative one looks the other way."""
        return Stencil(
            tuple(step * place for place in self.places),
            tuple(weight / step for weight in self.weights),
            tuple(weight / step for weight in self.lower),
        )


# Both reach to a distance of 1; their errors are of fourth and third order.
CENTRAL = Stencil((-1, -1 / 2, 1 / 2, 1), (1 / 6, -4 / 3, 4 / 3, -1 / 6), (0, -1, 1, 0))
ONE_SIDED = Stencil((0, 1 / 3, 2 / 3, 1), (-11 / 2, 9, -9 / 2, 1), (-9 / 2, 6, -3 / 2, 0))


def hessian_vector_product(
    renderer: Any,
    metric: Metric,
    direction: Direction,
    target: Target = None,
    *,
    seed: int = 0,
    spp: int | None = None,
    replicates: int = DEFAULT_PASSES,
    checkpoint: Folder = None,
) -> SceneAttribution:
    """Return ``H v``: how every parameter's gradient changes per unit of a step along a direction.

    It is the gradient of the metric's slope along ``v``, the slope being a difference of four scenes that share
    all their seeds, so that most of their noise cancels. They lie within a tenth of each parameter's physical
    range and half of the way to its bounds, closer where the metric bends, and on one side of a bound.

    Example
    -------
    The light of a lamp comes through all reflectances, so that along its radiance, and per relative change of it,
    the gradients of luminance by the reflectances grow by themselves:

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
        As for ``VanillaSceneGradient``; the renderer must tell its ``bounds``.
    direction
        A tensor for each parameter that moves, which broadcasts to it.
    seed
        Seed from which all others are drawn.
    spp
        Samples per pixel of each of the four scenes, in all their passes; the renderer's by default.
    replicates
        Least number of independent passes; their spread gives the standard errors.
    checkpoint
        A folder that keeps every finished pass: a job that was killed goes on from there when it is started again
        with the same arguments.

    Returns
    -------
    SceneAttribution
        By parameter name, with standard errors; ``metric_value`` is the slope, ``info["reach"]`` how far the
        farthest scene is, in units of the direction.

    Raises
    ------
    SceneCaptumError
        Where the direction names no parameter, is 0 or not finite, or leads nowhere within the bounds.

    Notes
    -----
    Where paths are chosen by the parameter (a roughness, or Russian roulette) less of the noise cancels, and the
    errors are larger.
    """
    renderer = with_checkpoint(renderer, checkpoint)
    scenes = Scenes.split(renderer, metric, target, seed=seed, spp=spp, replicates=replicates)
    options = {"seed": seed, "spp": spp, "replicates": replicates}
    return product_of(scenes, direction, scenes.values, **options)


def product_of(
    scenes: Scenes, direction: Direction, names: Iterable[str], **options: Any
) -> SceneAttribution:
    """Return the part of ``H v`` that some parameters have, with the options of ``VanillaSceneGradient``."""
    direction = _checked(direction, scenes.values)
    stencil = stencil_along(scenes, direction)
    slope = _Slope(scenes.metric, stencil)
    moved = _Moved(scenes, direction, stencil.places)
    values = {name: scenes.values[name] for name in names}
    found: SceneAttribution = VanillaSceneGradient(moved, slope).attribute(
        values, scenes.metric.target, **options, denoise=scenes.metric.view.denoises
    )
    assert found.image is not None
    info = {key: value for key, value in found.info.items() if key != "scale"}
    reach = max(map(abs, stencil.places))
    return dataclasses.replace(
        found,
        image=found.image.mean(0),
        surfaces=getattr(scenes.renderer, "surfaces", None),
        info={**info, "method": "hessian_vector_product", "reach": reach},
    )


class _Moved:
    """A renderer of several scenes along a direction, as one stack of images."""

    def __init__(self, scenes: Scenes, direction: Direction, places: tuple[float, ...]) -> None:
        self.renderer = renderer = scenes.renderer
        self.values = scenes.values
        self.direction = direction
        self.places = places
        self.spp = getattr(renderer, "spp", None)
        self.labels = getattr(renderer, "labels", {})
        self.info = getattr(renderer, "info", {})
        self.guides = _stacked(getattr(renderer, "guides", None), len(places))
        # By it a method tells whether the backward pass takes a seed of its own.
        self.__signature__ = inspect.signature(getattr(renderer, "forward", renderer))

    def __call__(self, inputs: Mapping[str, torch.Tensor], **options: Any) -> torch.Tensor:
        return torch.stack([self.renderer(self._at(place, inputs), **options) for place in self.places])

    def _at(self, place: float, inputs: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        whole = {**self.values, **inputs}
        return {**whole, **{name: whole[name] + place * one for name, one in self.direction.items()}}


def _stacked(guides: Guides | None, count: int) -> Guides | None:
    """Return guides for a stack of pictures of one camera."""
    if guides is None:
        return None
    return Guides(*(one.expand(count, *one.shape) for one in (guides.albedo, guides.normal)))


class _Slope:
    """The slope of a metric, from the images of a stencil."""

    def __init__(self, metric: TargetedMetric, stencil: Stencil) -> None:
        self.metric = metric.metric
        self.weights = stencil.weights
        self.__name__ = f"slope of {TargetedMetric(metric.metric).name}"

    def __call__(self, images: torch.Tensor) -> torch.Tensor:
        values = [weight * self.metric(image) for weight, image in zip(self.weights, images, strict=True)]
        return torch.stack(values).sum(0)


def stencil_along(scenes: Scenes, direction: Direction) -> Stencil:
    """Return a stencil that stays within the bounds, and on which the metric bends little."""
    up, down = reaches(scenes, direction)
    if max(up, down) == 0:
        raise SceneCaptumError(
            f"The direction leads out of the physical bounds either way: {', '.join(direction)} cannot move along "
            "it. Let fewer elements move, or others."
        )
    if min(up, down) >= CRAMPED / LONGEST * max(up, down):
        kind, step = CENTRAL, min(up, down)
    else:
        kind, step = ONE_SIDED, up if up > down else -down
    for _ in range(SHORTEST):
        stencil = kind.times(step)
        seen = torch.stack([scenes.measure(_changes(scenes, direction, place)) for place in stencil.places])
        slope, lower = (seen.new_tensor(row) @ seen for row in (stencil.weights, stencil.lower))
        bending, error = mean_and_error(slope - lower)
        if abs(bending) <= max(BENT * abs(slope.mean().item()), 2 * error, _rounding(scenes, stencil)):
            break
        step /= SHORTER
    return stencil


def reaches(scenes: Scenes, direction: Direction) -> tuple[float, float]:
    """Return how far to go along a direction and against it, 0 where a bound is met at once."""
    return _reach(scenes, direction, 1), _reach(scenes, direction, -1)


def _rounding(scenes: Scenes, stencil: Stencil) -> float:
    """Return what single precision may do to a slope: pseudo-values multiply it by their number."""
    size = scenes.still.mean().abs().item() * len(scenes.seeds)
    return size * torch.finfo(torch.float32).eps * sum(map(abs, stencil.weights))


def _changes(scenes: Scenes, direction: Direction, place: float) -> dict[str, torch.Tensor]:
    return {name: scenes.values[name] + place * one for name, one in direction.items()}


def _reach(scenes: Scenes, direction: Direction, sign: int) -> float:
    """Return how far to go: part of every range, and of every way to a bound, which may be unphysical itself."""
    lengths = ranges(scenes.renderer, {name: scenes.values[name] for name in direction})
    bounds = getattr(scenes.renderer, "bounds", {})
    reaches = [
        min(
            LONGEST * lengths[name].item() / one.abs().max().item(),
            0.5 * room(scenes.values[name], sign * one, *bounds.get(name, (-math.inf, math.inf))),
        )
        for name, one in direction.items()
    ]
    return max(0.0, min(reaches))


def _checked(direction: Direction, values: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    checked = {}
    for name, one in direction.items():
        if name not in values:
            raise SceneCaptumError(f"direction names {name!r}, which is no input.{near_misses(name, values)}")
        tensor = torch.as_tensor(one).detach().to(values[name])
        try:
            tensor.broadcast_to(values[name].shape)
        except RuntimeError:
            raise SceneCaptumError(
                f"The direction of {name!r} has shape {tuple(tensor.shape)}, which does not broadcast to the "
                f"parameter's {tuple(values[name].shape)}."
            ) from None
        if not torch.isfinite(tensor).all():
            raise SceneCaptumError(f"The direction of {name!r} holds a value that is not finite.")
        if tensor.any():
            checked[name] = tensor
    if not checked:
        raise SceneCaptumError("direction is 0: give at least one parameter an element to move along.")
    return checked
