"""Occlusion: the effect of patches of a texture or environment map."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import partial
from typing import Any, TypeAlias

import torch

from ..checkpoint import Folder
from ..errors import SceneCaptumError, near_misses, whole_number
from ..estimation import DEFAULT_REPLICATES, Denoise, covariance_of_mean, input_values
from ..protocols import ResultKind
from ._baseline_words import DEFAULT_OF_OCCLUSION, describe_baselines
from ._baselines import Baselines, Values, resolve_baselines
from ._method import Result, Settings, Targets
from ._perturbation import Arm, Effect, Effects, Perturbation, measured_drops

Extent: TypeAlias = "int | tuple[int, ...]"
Extents: TypeAlias = "Extent | Mapping[str, Extent] | None"
Window: TypeAlias = "tuple[slice, ...]"

_DEFAULT_PATCHES = 64  # 8 × 8 on a texture, 4 × 4 × 4 in a grid


class OcclusionScene(Perturbation):
    """The effect of replacing each patch of a texture or environment map by the mean of the whole texture or map.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("office", inputs="textures", resolution=(16, 16), spp=8)
    >>> occlusion = OcclusionScene(renderer, metrics.MeanLuminance())
    >>> attribution = occlusion.attribute(sliding_window_shapes=(32, 44), replicates=2, seed=0)
    >>> attribution["floor.reflectance.data"].shape
    torch.Size([64, 64, 3])

    A window slides over the texels of one parameter at a time. Each texel gets the metric of the scene minus the
    metric with the window at its baseline, averaged over the windows that cover it, and equal in all channels. As
    in Captum this is not divided by the size of the window. The effect of a texture, by which rankings compare it,
    adds up the patches that cover it: the sum over the texels and channels, divided by those of a window.

    Parameters
    ----------
    renderer, metric
        As for ``FeatureAblationScene``.

    References
    ----------
    Zeiler and Fergus, "Visualizing and Understanding Convolutional Networks", ECCV 2014.
    """

    def attribute(  # noqa: PLR0913 -- those of every method, and some of its own
        self,
        inputs: Mapping[str, torch.Tensor] | None = None,
        *,
        target: Targets = None,
        sliding_window_shapes: Extents = None,
        strides: Extents = None,
        baselines: Baselines = None,
        seed: int = 0,
        spp: int | None = None,
        replicates: int = DEFAULT_REPLICATES,
        denoise: Denoise = "auto",
        checkpoint: Folder = None,
        executor: Executor | None = None,
        show_progress: bool = False,
    ) -> Result:
        """Attribute the metric to patches of textures.

        Parameters
        ----------
        inputs
            Textures ``(H, W, C)`` and grids ``(D, H, W, C)`` by parameter name; by default those of the renderer.
            The result has only the names that are given.
        sliding_window_shapes
            Window size ``(h, w)`` in texels, ``(d, h, w)`` for a grid, one number for all dimensions, or a mapping
            from names or globs to these. By default 8 × 8 windows cover a texture, 4 × 4 × 4 a grid.
        strides
            Strides of the window, in the same format; by default the window size, without overlap.
        baselines
            Values of occluded patches, as for ``FeatureAblationScene``; by default each channel's mean, also of
            textures that a mapping does not name.
        target, seed, spp, replicates, denoise, checkpoint, executor, show_progress
            As for ``FeatureAblationScene``.

        Returns
        -------
        SceneAttribution
            Signed effects in units of the metric, shaped like the parameters.

        Raises
        ------
        SceneCaptumError
            If an input is not a texture, a window or stride does not fit, the baselines equal the textures, or the
            metric is not a finite scalar.
        AttributionInterrupted
            On Ctrl-C after all patches of at least one texture, with the result for these.
        """
        values = input_values(self.renderer, inputs)
        textures = _textures(values, explicit=inputs is not None)
        means = {n: t.reshape(-1, t.shape[-1]).mean(0).expand_as(t) for n, t in textures.items()}
        occluded = resolve_baselines(self.renderer, textures, baselines, default=means)
        windows = _all_windows(textures, sliding_window_shapes, strides)
        patches = [
            _Patch(name, index, window)
            for name, own_windows in windows.items()
            for index, window in enumerate(own_windows)
            if not torch.equal(textures[name][window], occluded[name][window])
        ]
        if not patches:
            raise SceneCaptumError(
                f"There is nothing to occlude: {', '.join(textures)} are already at their baselines. Give other "
                "baselines=, such as a number or a mapping by name."
            )
        arms = [Arm("the unchanged scene", lambda: values)]
        arms += [Arm(patch.description, partial(_occlude, patch, values, occluded)) for patch in patches]
        settings = Settings(
            seed, spp, replicates, show_progress, checkpoint=checkpoint, denoise=denoise, executor=executor
        )
        measured = self._measure(arms, target, settings)

        parts = [(patch.name, patch.index) for patch in patches]
        sizes = {name: len(own_windows) for name, own_windows in windows.items()}

        def effects_of(per_replicate: torch.Tensor) -> tuple[Effects, None]:
            drops = measured_drops(per_replicate, parts, sizes)
            return {name: _effect(own, windows[name], textures[name]) for name, own in drops.items()}, None

        info = describe_baselines(self.renderer, textures, baselines, occluded, default=DEFAULT_OF_OCCLUSION)
        # All but those at the end of a texture have the size of the first.
        info["patch_texels"] = {name: _texels(own_windows[0]) for name, own_windows in windows.items()}
        return self._results(measured, target, effects_of, quantity=ResultKind.OCCLUSION, **info)


@dataclass(frozen=True)
class _Patch:
    """A window of a texture and its index."""

    name: str
    index: int
    window: Window

    @property
    def description(self) -> str:
        texels = ", ".join(f"{extent.start}:{extent.stop}" for extent in self.window)
        return f"the scene with {self.name!r}[{texels}] at its baseline"


def _textures(values: Values, *, explicit: bool) -> dict[str, torch.Tensor]:
    others = [name for name, value in values.items() if value.ndim < 3]
    if explicit and others:
        raise SceneCaptumError(
            f"{others[0]!r} has shape {tuple(values[others[0]].shape)}; occlusion slides a window over textures, "
            "(H, W, C). Leave it out, or use FeatureAblationScene."
        )
    textures = {name: value for name, value in values.items() if name not in others}
    if not textures:
        raise SceneCaptumError(
            f"None of the {len(values)} inputs is a texture or an environment map, (H, W, C). "
            'Select some with SceneRenderer(…, inputs="textures"), or use '
            "FeatureAblationScene."
        )
    return textures


def _all_windows(textures: Values, shapes: Extents, strides: Extents) -> dict[str, list[Window]]:
    shape_of = _extents("sliding_window_shapes", shapes, textures)
    stride_of = _extents("strides", strides, textures)
    return {
        name: _windows(name, texture.shape[:-1], shape_of.get(name), stride_of.get(name))
        for name, texture in textures.items()
    }


def _extents(setting: str, given: Extents, textures: Values) -> dict[str, tuple[int, ...]]:
    """Return the extents that a setting gives for each texture."""
    if given is None:
        return {}
    extents = given if isinstance(given, Mapping) else {"*": given}
    by_name: dict[str, tuple[int, ...]] = {}
    for key, extent in extents.items():
        names = [key] if key in textures else [name for name in textures if fnmatchcase(name, key)]
        if not names:
            raise SceneCaptumError(
                f"{setting} names {key!r}, which is none of the textures: {', '.join(textures)}."
                f"{near_misses(key, textures)}"
            )
        # Names take precedence over globs, and earlier globs over later ones.
        matched = {name: _extent(setting, name, extent, textures[name].ndim - 1) for name in names}
        by_name = {**by_name, **matched} if key in textures else {**matched, **by_name}
    return by_name


def _extent(setting: str, name: str, extent: Any, dimensions: int) -> tuple[int, ...]:
    numbers = tuple(extent) if isinstance(extent, Sequence) and not isinstance(extent, str) else None
    numbers = (extent,) * dimensions if numbers is None else numbers
    if len(numbers) != dimensions:
        raise SceneCaptumError(
            f"{setting} for {name!r} must have {dimensions} numbers of texels, without the channels; it has "
            f"{len(numbers)}."
        )
    return tuple(whole_number(f"{setting} for {name!r}", number) for number in numbers)


def _windows(
    name: str, size: Sequence[int], shape: tuple[int, ...] | None, stride: tuple[int, ...] | None
) -> list[Window]:
    """Return the positions of the window; the last along a dimension is clipped at the end of the texture."""
    if shape is None:
        per_side = round(_DEFAULT_PATCHES ** (1 / len(size)))
        shape = tuple(math.ceil(texels / per_side) for texels in size)
    stride = shape if stride is None else stride
    if any(window > texels for window, texels in zip(shape, size, strict=True)):
        raise SceneCaptumError(
            f"sliding_window_shapes for {name!r} is {shape}, larger than the texture's {tuple(size)} texels."
        )
    extents = []
    for texels, window, step in zip(size, shape, stride, strict=True):
        if step > window < texels:
            raise SceneCaptumError(
                f"strides for {name!r} is {stride}, larger than the window's {shape} texels, which would leave "
                "gaps. Give strides no larger than the window."
            )
        count = 1 + math.ceil((texels - window) / step)
        extents.append([slice(i * step, min(i * step + window, texels)) for i in range(count)])
    return list(itertools.product(*extents))


def _texels(window: Window) -> int:
    return math.prod(extent.stop - extent.start for extent in window)


def _occlude(patch: _Patch, values: Values, occluded: Values) -> dict[str, torch.Tensor]:
    changed = values[patch.name].clone()
    changed[patch.window] = occluded[patch.name][patch.window]
    return {**values, patch.name: changed}


def _effect(drops: torch.Tensor, windows: list[Window], texture: torch.Tensor) -> Effect:
    """Map the ``(replicates, windows)`` drops of the metric to the texels."""
    count, size = len(drops), texture.shape[:-1]
    mean = _mean_over_windows(drops.mean(0), windows, size)
    squares, sums = torch.zeros_like(mean), []
    for replicate in drops:
        texels = _mean_over_windows(replicate, windows, size)
        squares += (texels - mean).square()
        sums.append(texels.sum())

    def shaped(texels: torch.Tensor) -> torch.Tensor:
        return texels.to(texture)[..., None].expand(texture.shape).clone()

    totals = torch.stack(sums)[:, None].expand(count, texture.shape[-1])
    if count == 1:
        return Effect(shaped(mean), None, totals, None)
    error = (squares / (count * (count - 1))).sqrt()
    return Effect(shaped(mean), shaped(error), totals, covariance_of_mean(totals))


def _mean_over_windows(drops: torch.Tensor, windows: list[Window], size: Sequence[int]) -> torch.Tensor:
    """Return for each texel the mean over the windows that cover it."""
    total, count = drops.new_zeros(size), drops.new_zeros(size)
    for drop, window in zip(drops, windows, strict=True):
        total[window] += drop
        count[window] += 1
    return total / count
