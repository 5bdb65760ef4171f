"""Interactions of parameters: the Hessian of a metric between the most salient parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from ..attr import SceneAttribution, VanillaSceneGradient, ranges
from ..checkpoint import Folder, with_checkpoint
from ..errors import SceneCaptumError, whole_number
from ..estimation import DEFAULT_REPLICATES, Metric, Target, channel_totals
from ..protocols import Renderer
from ._hessian import max_steps, product_of
from ._interactions_result import HessianScale, Interactions
from ._scenes import Scenes, denoise_of, unit_gradient


def interactions(  # noqa: PLR0913 -- the options of every check, and its own
    renderer: Renderer,
    metric: Metric,
    attribution: SceneAttribution | None = None,
    target: Target = None,
    *,
    top: int = 6,
    scale: HessianScale = "unit",
    seed: int = 0,
    spp: int | None = None,
    replicates: int = DEFAULT_REPLICATES,
    checkpoint: Folder = None,
) -> Interactions:
    """Return the second derivatives between the most salient parameters, from finite differences of gradients.

    Each parameter moves along its unit gradient ``u``, along which the slope is its saliency; all texels of a
    texture move together. Element ``(p, q)`` is ``u_p · H u_q``, the derivative of the slope along ``q`` with
    respect to a step along ``p``. (In a sum over the channels of a colour opposite effects would cancel, and one
    row per channel would make the matrix three times as large.) Both orders are measured independently, ``p``
    moved and ``q`` differentiated and vice versa, so the symmetry of the matrix checks the steps and the
    derivatives.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", ["reflectance", "emitters"], resolution=(16, 16), spp=16)
    >>> found = interactions(renderer, metrics.MeanLuminance(), top=2)
    >>> found.matrix.shape, found.is_symmetric
    (torch.Size([2, 2]), True)

    Parameters
    ----------
    renderer, metric, target
        As for ``VanillaSceneGradient``; the renderer must have ``bounds``.
    attribution
        The plain gradients that give the ranking and the directions; computed by default.
    top
        Number of parameters. Each costs the gradients of four scenes.
    scale
        ``"unit"``: per unit of both parameters. ``"range"``: times the physical ranges of both, which makes an
        albedo and a radiance comparable; an infinite range is replaced by the parameter's largest value.
    seed
        Base seed; all other seeds are derived from it. All scenes are rendered with common random numbers.
    spp
        Samples per pixel of each scene, over all replicates; the renderer's by default.
    replicates
        Minimum number of independent replicates; their spread gives the standard errors.
    checkpoint
        Folder that stores every finished replicate. A killed job resumes from it when it is started again with
        the same arguments.

    Returns
    -------
    Interactions
        The matrix ``(P, P)`` in the metric's unit per unit of both parameters, or in the metric's unit for
        ``scale="range"``, with standard errors and a symmetry test.

    Raises
    ------
    SceneCaptumError
        If the attribution is not one of plain gradients, or all gradients are 0.
    """
    renderer = with_checkpoint(renderer, checkpoint)
    if scale not in ("unit", "range"):
        raise SceneCaptumError(f'scale must be "unit" or "range", not {scale!r}.')
    options: dict[str, Any] = {"seed": seed, "spp": spp, "replicates": replicates}
    if attribution is None:
        attribution = VanillaSceneGradient(renderer, metric).attribute(target=target, **options)
    if attribution.info.get("scale") != "unit":
        raise SceneCaptumError("interactions needs plain gradients: VanillaSceneGradient(...).attribute().")
    scenes = Scenes.split(renderer, metric, target, **options, denoise=denoise_of(attribution))
    rows = [row for row in attribution.ranking(whole_number("top", top)) if row.saliency > 0]
    uphill = {row.name: unit_gradient(attribution[row.name], scenes.values[row.name]) for row in rows}
    directions = {name: u for name, u in uphill.items() if max(max_steps(scenes, {name: u})) > 0}
    if not directions:
        raise SceneCaptumError("All gradients are 0 or lead out of bounds: there is no direction to move in.")
    products = [product_of(scenes, {name: u}, directions, **options) for name, u in directions.items()]
    lengths = ranges(renderer, {name: scenes.values[name] for name in directions})
    factors = torch.tensor([lengths[name].item() if scale == "range" else 1.0 for name in directions])
    both = torch.outer(factors, factors).double()
    return Interactions(
        names=tuple(directions),
        labels=tuple(row.label for row in rows if row.name in directions),
        replicates=both * torch.stack([_slopes(product.replicates, directions) for product in products], 1),
        shared_error=both * torch.stack([_shared_error(p, attribution, directions) for p in products]),
        steps=tuple(product.info["step"] for product in products),
        metric=str(attribution.info["metric"]),
        scale=scale,
        left_out=tuple(row.label for row in rows if row.name not in directions),
    )


def _slopes(totals: Mapping[str, torch.Tensor], directions: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """Return the slopes along every direction, ``(replicates, P)``, from channel totals ``(replicates, C)``."""
    slopes = [totals[name].double() @ u.reshape(-1).double() for name, u in directions.items()]
    return torch.stack(slopes, -1)


def _shared_error(
    product: SceneAttribution, gradient: SceneAttribution, directions: Mapping[str, torch.Tensor]
) -> torch.Tensor:
    """Return the error that all replicates share: of the bias correction, and of rounding over a short step."""
    relative = torch.finfo(torch.float32).eps / product.info["step"]
    rounding = torch.tensor(
        [relative * channel_totals(gradient[name]).norm() for name in directions]
    ).double()
    if product.bias is None:
        return rounding
    bias = _slopes({name: channel_totals(product.bias[name])[None] for name in directions}, directions)[0]
    return torch.hypot(bias, rounding)
