"""Parameter space → image space: each pixel gets the saliency of what it shows.

``heatmap`` paints an attribution on the picture, ``shared_maximum`` finds one scale for several maps, and
``export`` writes maps to files.
"""

from __future__ import annotations

import io
import math
import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

from ._writing import whole_file
from .errors import SceneCaptumError, near_misses

if TYPE_CHECKING:
    from .attr import SceneAttribution
    from .scene import SurfaceMap, TexelMap

Names: TypeAlias = "str | Sequence[str] | None"
Scale: TypeAlias = Literal["linear", "log"]

IMAGE = 3  # axes of a texture


def heatmap(
    attribution: SceneAttribution,
    *,
    parameter: Names = None,
    signed: bool = False,
    scale: Scale = "linear",
    decades: float = 3.0,
    maximum: float | None = None,
    texels: bool = False,
    surfaces: SurfaceMap | None = None,
) -> torch.Tensor:
    """Paint each pixel with the saliency of the objects it shows, weighted by how much of it they cover.

    Example
    -------
    >>> heatmap(attribution, parameter="*.reflectance.*", signed=True)  # doctest: +SKIP
    >>> top = shared_maximum([before, after])  # doctest: +SKIP
    >>> heatmap(before, maximum=top), heatmap(after, maximum=top)  # doctest: +SKIP

    An object's saliency is the ℓ2 norm over all its parameters; where several materials, lights and media meet
    in one object, over all of theirs; and where the attribution is to groups, over those that have any of them.
    The scale is set by the most salient object, parameter or group, seen or not, so a map never exceeds 1, and its
    brightest pixel stays below 1 where what matters most is out of sight.

    Parameters
    ----------
    attribution
        What to paint.
    parameter
        A name or glob of the attribution's parameters (or groups), or a list of these: only they are painted, and
        set the scale. By default all.
    signed
        Whether to give an object's saliency the sign of the sum of all its channels and parameters: it tells
        whether raising all of them alike would raise the metric. Objects of either sign cancel in a pixel that
        shows both.
    scale
        ``"linear"``, or ``"log"``: 1 at the maximum, and 0 at and below the maximum divided by 10 to the power
        of ``decades``; the sign is kept.
    decades
        How many powers of ten a logarithmic map shows.
    maximum
        The saliency that is painted as 1, and with it all above: see ``shared_maximum``. Where it is 0 the map is
        black.
    texels
        Whether to paint bitmaps and environment maps texel by texel, where the surface's own coordinates put
        them, and meshes by their vertices or faces, instead of all over their objects alike. A pixel then has the
        norm of the mean gradient per unit of texture of the texels that it shows: where that is even it equals the
        saliency of the whole texture, and a part that matters ten times as much for its size is ten times as
        bright. Gradients of single texels are noisy, and the brightest sets the scale; more samples, or
        ``maximum``, help.
    surfaces
        What the pixels show, if not what is seen directly: ``renderer.see_through()``.

    Returns
    -------
    Tensor
        ``(H, W)`` in [0, 1], or in [-1, 1] where it is signed.

    Raises
    ------
    SceneCaptumError
        Where the attribution does not know what its pixels show, a name matches nothing, there are no texels to
        paint, or a scale is none.
    """
    if scale not in ("linear", "log"):
        raise SceneCaptumError(f'scale must be "linear" or "log", not {scale!r}.')
    if not decades > 0:
        raise SceneCaptumError(f"decades must be positive, not {decades!r}.")
    shown = _surfaces_of(attribution, surfaces)
    magnitude, sign, brightest = _entries(attribution, shown, parameter, texels)
    if maximum is not None:
        if not 0 <= maximum < math.inf:
            raise SceneCaptumError(f"maximum must be finite and not negative, not {maximum!r}.")
        brightest = maximum

    height, width = shown.shape
    painted = torch.zeros(height * width)
    if brightest > 0:
        strength = sign * magnitude if signed else magnitude
        painted.index_add_(
            0,
            torch.from_numpy(shown.pixel).long(),
            torch.from_numpy(shown.fraction) * torch.from_numpy(strength).float() / brightest,
        )
    # Fractions of a pixel sum to 1 up to rounding.
    painted = painted.clamp(-1, 1).reshape(height, width)
    return _logarithmic(painted, decades) if scale == "log" else painted


def shared_maximum(
    attributions: Iterable[SceneAttribution],
    *,
    parameter: Names = None,
    texels: bool = False,
    surfaces: SurfaceMap | None = None,
) -> float:
    """Return the ``maximum`` for heatmaps that are to be compared: the largest of their own.

    Parameters
    ----------
    attributions
        What the heatmaps paint, in the same unit.
    parameter, texels, surfaces
        As for ``heatmap``.

    Returns
    -------
    float
        0 where all attributions are.

    Raises
    ------
    SceneCaptumError
        As ``heatmap``.
    """
    return max(
        (_entries(one, _surfaces_of(one, surfaces), parameter, texels)[2] for one in attributions),
        default=0.0,
    )


def export(
    what: SceneAttribution | torch.Tensor,
    path: str | os.PathLike[str],
    *,
    colours: str | None = None,
    limits: tuple[float, float] | None = None,
    **options: Any,
) -> None:
    """Write a map to a file: ``.png``, ``.exr`` or ``.npy``.

    - ``.png``: 8 bits, grey or in colours.
    - ``.exr``: 32-bit floats. For an attribution the picture is in R, G and B, the map in ``saliency``, and the
      objects are a Cryptomatte, by which compositing programs select them; for a map, all is in Y.
    - ``.npy``: the numbers, for ``numpy.load``.

    Parameters
    ----------
    what
        An attribution, of which the heatmap is written; or a map ``(H, W)`` or a picture ``(H, W, 3)``, such as
        ``renderer.derivative_image`` returns.
    path
        Where to; its ending chooses the format.
    colours
        The name of a matplotlib colour map for a PNG, if it is not to be grey.
    limits
        What a PNG shows as black and as white, or as the ends of the colour map. By default 0 and 1, or -1 and 1
        where there is a sign.
    **options
        Those of ``heatmap``, where ``what`` is an attribution.

    Raises
    ------
    SceneCaptumError
        Where the format or a colour map is unknown, the shape is none of a picture, or the file cannot be written.
    """
    from .attr import SceneAttribution

    if isinstance(what, SceneAttribution):
        values = heatmap(what, **options).numpy(force=True)
    elif options:
        raise SceneCaptumError(f"{', '.join(options)}: only for an attribution; a map is written as it is.")
    else:
        values = _picture(what)
    path = Path(path)
    if path.suffix not in (".npy", ".png", ".exr"):
        raise SceneCaptumError(f"{path} must end in .png, .exr or .npy.")
    with whole_file(path) as partial:
        if path.suffix == ".npy":
            # numpy does not say why a file of its own cannot be written.
            content = io.BytesIO()
            np.save(content, values)
            partial.write_bytes(content.getbuffer())
        elif path.suffix == ".png":
            signed = options.get("signed", values.min() < 0)
            _write_png(values, partial, colours, limits or ((-1.0, 1.0) if signed else (0.0, 1.0)))
        else:
            attribution = what if isinstance(what, SceneAttribution) else None
            partial.write_bytes(_exr(values, attribution, options.get("surfaces")))


def _picture(values: torch.Tensor) -> NDArray[np.float32]:
    if (
        not isinstance(values, torch.Tensor)
        or values.ndim not in (2, IMAGE)
        or values.shape[2:] not in ((), (3,))
    ):
        came = tuple(values.shape) if isinstance(values, torch.Tensor) else type(values).__name__
        raise SceneCaptumError(
            f"Only an attribution, a map (H, W) or a picture (H, W, 3) is written, not {came}."
        )
    return values.float().numpy(force=True)


def _write_png(
    values: NDArray[np.float32], path: Path, colours: str | None, limits: tuple[float, float]
) -> None:
    from matplotlib import colormaps
    from PIL import Image

    low, high = limits
    if not low < high:
        raise SceneCaptumError(f"limits must be two numbers, the lower first, not {limits!r}.")
    shown = np.clip((values - low) / (high - low), 0, 1)
    if colours is not None:
        if colours not in colormaps or values.ndim == IMAGE:
            raise SceneCaptumError(
                f"colours must name a matplotlib colour map, and be for a map (H, W), not {colours!r} for "
                f"{values.shape}.{near_misses(str(colours), colormaps)}"
            )
        shown = colormaps[colours](shown)[..., :3]
    Image.fromarray(np.round(shown * 255).astype(np.uint8)).save(path)


def _exr(
    values: NDArray[np.float32], attribution: SceneAttribution | None, surfaces: SurfaceMap | None
) -> bytes:
    from ._cryptomatte import layers
    from .backend import exclusively

    if attribution is None:
        with exclusively() as mi:
            return _exr_bytes(mi, mi.Bitmap(np.ascontiguousarray(values)))
    channels, metadata = layers(_surfaces_of(attribution, surfaces))
    channels = {"saliency": values, **channels}
    if attribution.image is not None:
        picture = attribution.image.numpy(force=True)
        channels = {**dict(zip("RGB", np.moveaxis(picture, -1, 0), strict=True)), **channels}
    stack = np.stack([one.astype(np.float32) for one in channels.values()], axis=-1)
    with exclusively() as mi:
        bitmap = mi.Bitmap(stack, channel_names=list(channels))
        for key, value in metadata.items():
            bitmap.metadata()[key] = value
        return _exr_bytes(mi, bitmap)


def _exr_bytes(mi: Any, bitmap: Any) -> bytes:
    # Into memory: Mitsuba does not say everything that goes wrong with a file.
    stream = mi.MemoryStream()
    bitmap.write(stream, mi.Bitmap.FileFormat.OpenEXR)
    return bytes(stream.raw_buffer())


def _surfaces_of(attribution: SceneAttribution, given: SurfaceMap | None) -> SurfaceMap:
    surfaces = attribution.surfaces if given is None else given
    if surfaces is None:
        raise SceneCaptumError(
            "This attribution does not know which object each pixel shows: only a SceneRenderer does."
        )
    return surfaces


def _entries(
    attribution: SceneAttribution, surfaces: SurfaceMap, parameter: Names, texels: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return each entry's saliency and sign, and the saliency at which the scale of a map of its own ends."""
    chosen = _chosen(attribution, parameter)
    saliency = {name: value for name, value in attribution.saliency().items() if name in chosen}
    total = {name: attribution[name].double().sum().item() for name in chosen}
    worn = _worn(attribution, surfaces, saliency)
    textures = _textures(attribution, surfaces, chosen) if texels else {}

    objects = [math.hypot(*(saliency[name] for name in one)) for one in worn]
    brightest = max([*objects, *saliency.values()], default=0.0)
    if textures:
        worn = [one - textures.keys() for one in worn]
        objects = [math.hypot(*(saliency[name] for name in one)) for one in worn]
    magnitude = np.array(objects)[surfaces.object_index]
    effect = np.array([math.fsum(total[name] for name in one) for one in worn])[surfaces.object_index]
    for name, shown in textures.items():
        density = shown.density(attribution[name].numpy(force=True), len(surfaces.pixel))
        magnitude = np.hypot(magnitude, np.linalg.norm(density, axis=-1))
        effect += density.sum(-1)
        brightest = max(brightest, float(magnitude.max(initial=0.0)))
    return magnitude, np.sign(effect), brightest


def _textures(
    attribution: SceneAttribution, surfaces: SurfaceMap, chosen: Collection[str]
) -> dict[str, TexelMap]:
    """Return what the map tells of the chosen textures' texels; groups have none."""
    known = {name: surfaces.texels[name] for name in chosen if name in surfaces.texels}
    if not known and any(attribution[name].ndim in (2, IMAGE) for name in chosen):
        raise SceneCaptumError(
            "Which texels the pixels show is not known: attribute with a SceneRenderer of one camera, or give "
            "surfaces=renderer.surfaces_with_texels(...)."
        )
    return known


def _chosen(attribution: SceneAttribution, parameter: Names) -> list[str]:
    if parameter is None:
        return list(attribution)
    wanted = [parameter] if isinstance(parameter, str) else list(parameter)
    chosen: dict[str, None] = {}
    for one in wanted:
        # A name is matched as it stands first: it may hold brackets.
        matched = [one] if one in attribution else [name for name in attribution if fnmatchcase(name, one)]
        if not matched:
            raise SceneCaptumError(
                f"parameter={one!r} matches none of the {len(attribution)} parameters of the attribution."
                f"{near_misses(one, attribution)}"
            )
        chosen |= dict.fromkeys(matched)
    return list(chosen)


def _worn(
    attribution: SceneAttribution, surfaces: SurfaceMap, saliency: Mapping[str, float]
) -> list[set[str]]:
    """Return for each object the parameters, or the groups of parameters, that it shows."""
    groups = attribution.info.get("groups") or {name: [name] for name in saliency}
    group_of = {name: group for group, members in groups.items() for name in members if group in saliency}
    return [{group_of[name] for name in below if name in group_of} for below in surfaces.parameters]


def _logarithmic(painted: torch.Tensor, decades: float) -> torch.Tensor:
    strength = (1 + painted.abs().log10() / decades).clamp(0, 1)
    return strength * painted.sign()
