"""Projection from parameters to pixels: each pixel gets the saliency of the objects it shows.

``heatmap`` maps an attribution to pixels, and ``shared_maximum`` returns a common scale for several maps.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from fnmatch import fnmatchcase
from typing import Literal, TypeAlias, get_args

import numpy as np
import torch
from numpy.typing import NDArray

from ..errors import SceneCaptumError, near_misses
from ..protocols import Attribution, RankedParameter, Scale
from ..student import clear_from
from ._light_maps import TEXTURE_NDIM, light_maps_left_out
from ._surfaces import SurfaceMap, TexelMap

Names: TypeAlias = "str | Sequence[str] | None"
MapNorm: TypeAlias = Literal["sqrt", "linear", "log"]

# Saliencies span orders of magnitude: on a linear scale all but a few lamps are nearly black.
DEFAULT_NORM: MapNorm = "sqrt"
DECADES = 3.0  # of a logarithmic map

IMAGE = 3  # number of axes


def heatmap(
    attribution: Attribution,
    *,
    parameter: Names = None,
    signed: bool = False,
    scale: Scale | None = None,
    norm: MapNorm = DEFAULT_NORM,
    decades: float = DECADES,
    maximum: float | None = None,
    texels: bool = False,
    surfaces: SurfaceMap | None = None,
) -> torch.Tensor:
    """Return the metric saliency map: the saliency of the objects in each pixel, weighted by coverage.

    Example
    -------
    >>> heatmap(attribution, parameter="*.reflectance.*", signed=True)  # doctest: +SKIP
    >>> top = shared_maximum([before, after])  # doctest: +SKIP
    >>> heatmap(before, maximum=top), heatmap(after, maximum=top)  # doctest: +SKIP

    The saliency of an object is the ℓ2 norm, the root of the sum of squares, over the parameters of all its
    materials, emitters and media; for an attribution to groups, over the groups that contain any of these. A map
    of light is left out beside its ``scale``, whose effect is that of all its light. The heatmap
    is normalized by the largest saliency of any object, parameter or group, visible or not. It never exceeds 1,
    and its maximum is below 1 if the most salient object is not visible. Parameters that rank last
    (``ranked_last``) have no colour. Figures, ``export`` and the report show this heatmap, on the same default
    scale.

    Parameters
    ----------
    attribution
        The attribution to map.
    parameter
        A name or glob of the attribution's parameters (or groups), or a list of these: only they are mapped and
        determine the scale. By default all.
    signed
        Whether to give an object's saliency the sign of the sum of its parameters' effects, or 0 where this sum is
        less than two standard errors from 0, or more if these have fewer than 7 degrees of freedom. Objects of
        opposite sign cancel within a pixel.
    scale
        What is compared, as for ``SceneAttribution.ranking``: by default effects over the parameters' ranges.
    norm
        ``"sqrt"``: the square root, which keeps faint objects visible. ``"linear"``: in proportion to saliency.
        ``"log"``: in proportion to its logarithm, with 0 at and below the maximum divided by 10 to the power of
        ``decades``. The sign is kept.
    decades
        Number of powers of ten that a logarithmic map covers.
    maximum
        Saliency that maps to 1; larger values are clipped. See ``shared_maximum``. If it is 0, the map is 0.
    texels
        Whether to map bitmaps and environment maps per texel, and mesh attributes per vertex or face, instead of
        uniformly over their objects. A pixel then gets the mean effect per unit of texture over its texels: for a
        uniform gradient this is the saliency of the whole texture. Gradients of single texels are noisy, and the
        largest determines the maximum; use more samples or set ``maximum``.
    surfaces
        The surface map to use instead of the directly visible objects: ``renderer.see_through()``.

    Returns
    -------
    Tensor
        ``(H, W)`` in [0, 1], or in [-1, 1] if signed.

    Raises
    ------
    SceneCaptumError
        If the attribution has no surface map, a name matches nothing, no texels are available, or an option is
        invalid.
    """
    surfaces = surfaces_of(attribution, surfaces)
    magnitude, sign, largest = _entries(attribution, surfaces, parameter, texels, scale)
    if maximum is not None:
        if not 0 <= maximum < math.inf:
            raise SceneCaptumError(f"maximum must be finite and not negative, not {maximum!r}.")
        largest = maximum

    height, width = surfaces.shape
    result = torch.zeros(height * width)
    if largest > 0:
        values = sign * magnitude if signed else magnitude
        result.index_add_(
            0,
            torch.from_numpy(surfaces.pixel).long(),
            torch.from_numpy(surfaces.fraction) * torch.from_numpy(values).float() / largest,
        )
    # The fractions of a pixel sum to 1 up to rounding.
    return normalized(result.clamp(-1, 1).reshape(height, width), norm, decades)


def normalized(values: torch.Tensor, norm: MapNorm = DEFAULT_NORM, decades: float = DECADES) -> torch.Tensor:
    """Return relative saliencies from -1 to 1 as they are shown; ``norm`` and ``decades`` as for ``heatmap``."""
    if norm not in get_args(MapNorm):
        raise SceneCaptumError(
            f"norm must be one of {', '.join(map(repr, get_args(MapNorm)))}, not {norm!r}."
        )
    if not decades > 0:
        raise SceneCaptumError(f"decades must be positive, not {decades!r}.")
    if norm == "linear":
        return values
    magnitude = values.abs()
    along = magnitude.sqrt() if norm == "sqrt" else (1 + magnitude.log10() / decades).clamp(0, 1)
    return along * values.sign()


def shared_maximum(
    attributions: Iterable[Attribution],
    *,
    parameter: Names = None,
    scale: Scale | None = None,
    texels: bool = False,
    surfaces: SurfaceMap | None = None,
) -> float:
    """Return a common ``maximum`` for heatmaps that are to be compared: the largest of their own, 0 if all are 0.

    The ``attributions`` have the same unit; ``parameter``, ``scale``, ``texels``, ``surfaces`` and the errors are
    as for ``heatmap``.
    """
    return max(
        (_entries(a, surfaces_of(a, surfaces), parameter, texels, scale)[2] for a in attributions),
        default=0.0,
    )


def objects_of_unclear_sign(
    attribution: Attribution,
    *,
    parameter: Names = None,
    scale: Scale | None = None,
    texels: bool = False,
    surfaces: SurfaceMap | None = None,
) -> list[str]:
    """Return the visible objects whose effect, the sum over their parameters, is not clear of its noise.

    A signed map is 0 there. Objects without an effect are not counted; the options are those of ``heatmap``.
    """
    surfaces = surfaces_of(attribution, surfaces)
    selected = set(mapped_parameters(attribution, parameter, scale))
    rows = {row.name: row for row in attribution.ranking(scale=scale) if row.name in selected}
    visible = np.unique(surfaces.object_index[surfaces.fraction > 0])
    used = used_by_objects(attribution, surfaces, rows)
    unclear = []
    for index in visible:
        # Texels have signs of their own.
        own = [rows[name] for name in used[index] if not (texels and name in surfaces.texels)]
        if any(row.saliency for row in own) and not clear_sum(attribution, own):
            unclear.append(surfaces.objects[index])
    return unclear


def clear_sum(attribution: Attribution, rows: Sequence[RankedParameter]) -> float:
    """Return the sum of the effects of some parameters, 0 if it is not clear of its noise."""
    total, error = (
        math.fsum(row.effect for row in rows),
        math.hypot(*(row.effect_error or 0.0 for row in rows)),
    )
    return total if abs(total) > clear_from(attribution.info) * error else 0.0


def surfaces_of(attribution: Attribution, given: SurfaceMap | None) -> SurfaceMap:
    surfaces = attribution.surfaces if given is None else given
    if surfaces is None:
        why = (
            views_without_map(attribution)
            or "does not know which object each pixel shows: only a SceneRenderer does."
        )
        raise SceneCaptumError(f"This attribution {why}")
    return surfaces


def views_without_map(attribution: Attribution) -> str:
    """Return why an attribution of several sensors has no map from pixels to objects; empty for others."""
    if attribution.image is None or attribution.image.ndim != 4:
        return ""
    return (
        f"is of the pictures of {len(attribution.image)} sensors, and a map is of one: attribute each with a "
        "renderer of its own, such as SceneRenderer(…, sensor=0)."
    )


def _entries(
    attribution: Attribution, surfaces: SurfaceMap, parameter: Names, texels: bool, scale: Scale | None
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return the saliency and sign of each entry of the surface map, and the largest saliency."""
    mapped = mapped_parameters(attribution, parameter, scale)
    saliency = {name: value for name, value in attribution.saliency(scale).items() if name in mapped}
    rows, factors = {row.name: row for row in attribution.ranking(scale=scale)}, attribution.factors(scale)
    is_norm = attribution.ranks_by_norm(scale)
    params_by_object = used_by_objects(attribution, surfaces, saliency)
    # Those of a map of light that is left out beside its scale, too.
    textures = _texel_maps(attribution, surfaces, _colored(attribution, parameter, scale)) if texels else {}

    objects = [math.hypot(*(saliency[name] for name in names)) for names in params_by_object]
    largest = max([*objects, *saliency.values()], default=0.0)
    if textures:
        params_by_object = [names - textures.keys() for names in params_by_object]
        objects = [math.hypot(*(saliency[name] for name in names)) for names in params_by_object]
    magnitude = np.array(objects)[surfaces.object_index]
    sums = np.array([clear_sum(attribution, [rows[name] for name in names]) for names in params_by_object])
    effect = sums[surfaces.object_index]
    for name, texel_map in textures.items():
        density = texel_map.density(attribution[name].numpy(force=True), len(surfaces.pixel))
        density = density * factors[name].numpy(force=True)
        total = density.sum(-1)
        magnitude = np.hypot(magnitude, np.linalg.norm(density, axis=-1) if is_norm else total)
        effect += total
        largest = max(largest, float(magnitude.max(initial=0.0)))
    return magnitude, np.sign(effect), largest


def _texel_maps(
    attribution: Attribution, surfaces: SurfaceMap, selected: Collection[str]
) -> dict[str, TexelMap]:
    """Return the texel maps of the selected textures; groups have none."""
    texel_maps = {name: surfaces.texels[name] for name in selected if name in surfaces.texels}
    if not texel_maps and any(attribution[name].ndim in (2, TEXTURE_NDIM) for name in selected):
        raise SceneCaptumError(
            "It is not known which texels the pixels show: attribute with a SceneRenderer of one camera, or give "
            "surfaces=renderer.surfaces_with_texels(...)."
        )
    return texel_maps


def mapped_parameters(
    attribution: Attribution, parameter: Names = None, scale: Scale | None = None
) -> list[str]:
    """Return the selected parameters that make up the saliency of objects, without maps of light counted twice."""
    colored = _colored(attribution, parameter, scale)
    kind = attribution.kind.in_scale(attribution.scale_or_default(scale))
    left_out = light_maps_left_out(kind, {name: attribution[name] for name in colored})
    return [name for name in colored if name not in left_out]


def _colored(attribution: Attribution, parameter: Names, scale: Scale | None) -> list[str]:
    """Return the selected parameters that have a colour, without poses that jump and what ranks last.

    A map of nothing else shows this.
    """
    jumps, last = attribution.info.get("jumps", {}), attribution.ranked_last(scale)
    selected = [name for name in _select(attribution, parameter) if name not in jumps]
    return [name for name in selected if name not in last] or selected


def _select(attribution: Attribution, parameter: Names) -> list[str]:
    if parameter is None:
        return list(attribution)
    patterns = [parameter] if isinstance(parameter, str) else list(parameter)
    selected: dict[str, None] = {}
    for pattern in patterns:
        # Exact names first: a name may contain brackets.
        exact = pattern in attribution
        matched = [pattern] if exact else [name for name in attribution if fnmatchcase(name, pattern)]
        if not matched:
            raise SceneCaptumError(
                f"parameter={pattern!r} matches none of the {len(attribution)} parameters of the attribution."
                f"{near_misses(pattern, attribution, instead=' list(attribution) gives all names.')}"
            )
        selected |= dict.fromkeys(matched)
    return list(selected)


def used_by_objects(attribution: Attribution, surfaces: SurfaceMap, names: Collection[str]) -> list[set[str]]:
    """Return, for each object, which of these parameters or groups its appearance depends on."""
    groups = attribution.info.get("groups") or {name: [name] for name in names}
    group_of = {name: group for group, members in groups.items() for name in members if group in names}
    return [{group_of[name] for name in used if name in group_of} for used in surfaces.parameters]
