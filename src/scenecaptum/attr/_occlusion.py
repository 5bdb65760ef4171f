"""Occlusion: which patch of a texture or an environment map matters."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import partial
from typing import Any, TypeAlias

import torch

from ..checkpoint import Folder
from ..errors import SceneCaptumError, near_misses, whole_number
from ._baselines import Baselines, Values, resolve_baselines
from ._gradients import input_values
from ._method import Result, Settings, Targets
from ._passes import DEFAULT_PASSES, covariance_of_mean
from ._perturbation import Arm, Effect, Effects, Perturbation
from ._view import Denoise

Extent: TypeAlias = "int | tuple[int, ...]"
Extents: TypeAlias = "Extent | Mapping[str, Extent] | None"
Window: TypeAlias = "tuple[slice, ...]"

_DEFAULT_PATCHES = 64  # 8 × 8 on a texture, 4 × 4 × 4 in a grid


class OcclusionScene(Perturbation):
    """The effect of hiding each patch of a texture or environment map behind its mean.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("office", inputs="textures", resolution=(16, 16), spp=8)
    >>> occlusion = OcclusionScene(renderer, metrics.MeanLuminance())
    >>> attribution = occlusion.attribute(sliding_window_shapes=(32, 44), replicates=2, seed=0)
    >>> attribution["floor.reflectance.data"].shape
    torch.Size([64, 64, 3])

    A window slides over the texels of one parameter at a time. Each texel gets the metric of the scene minus
    that of the scene with the window at its baseline, averaged over the windows that cover it, and the same in
    all channels. As in Captum the effect is not divided by the window's size, so a texel shows what hiding its
    surroundings does, and the sum over the texels is no effect of anything: to weigh textures against each
    other use ``FeatureAblationScene``.

    Parameters
    ----------
    renderer
        A ``SceneRenderer``, or any callable ``renderer(inputs, *, seed, spp)`` that returns an image.
    metric
        A torch function from the image to a scalar, or to a vector of which ``target`` names elements; it need not
        be differentiable.

    References
    ----------
    Zeiler and Fergus, "Visualizing and Understanding Convolutional Networks", ECCV 2014.
    """

    def attribute(  # noqa: PLR0913 -- those of every method, and some of its own
        self,
        inputs: Mapping[str, torch.Tensor] | None = None,
        target: Targets = None,
        *,
        sliding_window_shapes: Extents = None,
        strides: Extents = None,
        baselines: Baselines = None,
        seed: int = 0,
        spp: int | None = None,
        replicates: int = DEFAULT_PASSES,
        denoise: Denoise = "auto",
        checkpoint: Folder = None,
        show_progress: bool = False,
    ) -> Result:
        """Attribute the metric to patches of textures.

        Parameters
        ----------
        inputs
            Textures ``(H, W, C)`` and grids ``(D, H, W, C)`` by parameter name; the renderer's own by default.
        target
            Which element of the metric's output is meant, where it is not a scalar; a list of them gives a list of
            results from the same renders.
        sliding_window_shapes
            ``(h, w)`` of the window in texels, ``(d, h, w)`` in a grid, one number for all directions, or a
            mapping from names or globs to these. By default 8 × 8 patches cover a texture, 4 × 4 × 4 a grid.
        strides
            How far the window moves, likewise; by default by its own size, so that windows do not overlap.
        baselines
            What a hidden patch shows: by default the mean of its texture in each channel; otherwise ``"dark"``,
            ``"black"``, ``"grey"``, a number, a mapping by name, glob or kind, or another renderer.
        seed
            Seed from which those of all replicates are drawn; the same for the scene with and without a patch.
        spp
            Total samples per pixel over the unchanged scene and all changed ones, the renderer's by default: each
            scene gets its share, rounded up, split over the replicates, and each replicate at least one sample.
        replicates
            Number of independent seeds. Their spread gives the standard errors; with 1 there are none, and no
            correction of the bias that a noisy image puts into a non-linear metric.
        denoise
            Whether a metric that is not linear sees denoised pictures (Open Image Denoise). ``"auto"`` measures on
            two halves of the samples whether that brings them nearer to the truth; ``info["picture"]`` says what
            was done.
        checkpoint
            A folder that keeps every finished pass: a job that was killed goes on from there when it is started
            again with the same arguments. ``info["checkpoint"]`` counts the passes that came from it.
        show_progress
            Whether to show a progress bar.

        Returns
        -------
        SceneAttribution
            Signed effects in units of the metric, shaped like the parameters.

        Raises
        ------
        SceneCaptumError
            Where an input is no texture, a window or stride does not fit, the baselines hide nothing, or the
            metric is not a finite scalar.
        AttributionInterrupted
            On Ctrl-C after all patches of one texture or more, with the result for these.
        """
        values = input_values(self.renderer, inputs)
        textures = _textures(values, chosen=inputs is not None)
        means = {n: t.reshape(-1, t.shape[-1]).mean(0).expand_as(t) for n, t in textures.items()}
        hidden = resolve_baselines(self.renderer, textures, baselines, default=means)
        windows = _all_windows(textures, sliding_window_shapes, strides)
        patches = [
            _Patch(name, index, window)
            for name, slid in windows.items()
            for index, window in enumerate(slid)
            if not torch.equal(textures[name][window], hidden[name][window])
        ]
        if not patches:
            raise SceneCaptumError(
                f"There is nothing to hide: the baselines of {', '.join(textures)} are what they show already. "
                "Give others with baselines=, a number or a mapping by name, say."
            )
        arms = [Arm("the unchanged scene", lambda: values)]
        arms += [Arm(one.what, partial(_hide, one, values, hidden)) for one in patches]
        measured = self._measure(
            arms,
            target,
            Settings(seed, spp, replicates, show_progress, checkpoint=checkpoint, denoise=denoise),
        )

        def effects_of(pseudo: torch.Tensor) -> tuple[Effects, None]:
            return _effects(pseudo, patches, windows, textures), None

        return self._results(measured, target, effects_of, quantity="effect of occlusion")


@dataclass(frozen=True)
class _Patch:
    """One window of a texture, and its number there."""

    name: str
    index: int
    window: Window

    @property
    def what(self) -> str:
        place = ", ".join(f"{one.start}:{one.stop}" for one in self.window)
        return f"the scene with {self.name!r}[{place}] at its baseline"


def _textures(values: Values, *, chosen: bool) -> dict[str, torch.Tensor]:
    flat = [name for name, value in values.items() if value.ndim < 3]
    if chosen and flat:
        raise SceneCaptumError(_no_texture(flat[0], values[flat[0]]))
    textures = {name: value for name, value in values.items() if name not in flat}
    if not textures:
        raise SceneCaptumError(
            f"None of the {len(values)} inputs is a texture or an environment map, (H, W, C): there is nothing to "
            'slide a window over. Select some with SceneRenderer(…, inputs="textures"), or use '
            "FeatureAblationScene."
        )
    return textures


def _no_texture(name: str, value: torch.Tensor) -> str:
    return (
        f"{name!r} has shape {tuple(value.shape)}; occlusion slides a window over textures, (H, W, C). "
        "Leave it out, or use FeatureAblationScene."
    )


def _all_windows(textures: Values, shapes: Extents, strides: Extents) -> dict[str, list[Window]]:
    shape_of = _extents("sliding_window_shapes", shapes, textures)
    stride_of = _extents("strides", strides, textures)
    return {
        name: _windows(name, texture.shape[:-1], shape_of.get(name), stride_of.get(name))
        for name, texture in textures.items()
    }


def _extents(setting: str, given: Extents, textures: Values) -> dict[str, tuple[int, ...]]:
    """Return what a setting says for each texture, leaving out those that it says nothing about."""
    if given is None:
        return {}
    wanted = given if isinstance(given, Mapping) else {"*": given}
    chosen: dict[str, tuple[int, ...]] = {}
    for key, extent in wanted.items():
        names = [key] if key in textures else [name for name in textures if fnmatchcase(name, key)]
        if not names:
            raise SceneCaptumError(
                f"{setting} names {key!r}, which is none of the textures: {', '.join(textures)}."
                f"{near_misses(key, textures)}"
            )
        # An exact name counts before a glob, and of two globs the first.
        fitted = {name: _extent(setting, name, extent, textures[name].ndim - 1) for name in names}
        chosen = {**chosen, **fitted} if key in textures else {**fitted, **chosen}
    return chosen


def _extent(setting: str, name: str, extent: Any, directions: int) -> tuple[int, ...]:
    numbers = tuple(extent) if isinstance(extent, Sequence) and not isinstance(extent, str) else None
    numbers = (extent,) * directions if numbers is None else numbers
    if len(numbers) != directions:
        raise SceneCaptumError(
            f"{setting} for {name!r} must have {directions} numbers of texels, without the channels; it has "
            f"{len(numbers)}."
        )
    return tuple(whole_number(f"{setting} for {name!r}", number) for number in numbers)


def _windows(
    name: str, size: Sequence[int], shape: tuple[int, ...] | None, stride: tuple[int, ...] | None
) -> list[Window]:
    """Return the places of the window; the last along a direction is cut off where the texture ends."""
    if shape is None:
        a_side = round(_DEFAULT_PATCHES ** (1 / len(size)))
        shape = tuple(math.ceil(texels / a_side) for texels in size)
    stride = shape if stride is None else stride
    if any(window > texels for window, texels in zip(shape, size, strict=True)):
        raise SceneCaptumError(
            f"sliding_window_shapes for {name!r} is {shape}, larger than the texture's {tuple(size)} texels."
        )
    along = []
    for texels, window, step in zip(size, shape, stride, strict=True):
        if step > window < texels:
            raise SceneCaptumError(
                f"strides for {name!r} is {stride}, longer than the window's {shape} texels: some would never be "
                "hidden. Give strides no longer than the window."
            )
        count = 1 + math.ceil((texels - window) / step)
        along.append([slice(i * step, min(i * step + window, texels)) for i in range(count)])
    return list(itertools.product(*along))


def _hide(patch: _Patch, values: Values, hidden: Values) -> dict[str, torch.Tensor]:
    changed = values[patch.name].clone()
    changed[patch.window] = hidden[patch.name][patch.window]
    return {**values, patch.name: changed}


def _effects(
    pseudo: torch.Tensor, patches: list[_Patch], windows: Mapping[str, list[Window]], textures: Values
) -> Effects:
    """Return the effects on every texture whose patches have all been measured."""
    effects: Effects = {}
    done = len(pseudo) - 1
    for name, texture in textures.items():
        own = [(arm, patch.index) for arm, patch in enumerate(patches) if patch.name == name]
        if any(arm >= done for arm, _ in own):
            continue
        drops = pseudo.new_zeros(pseudo.shape[1], len(windows[name]))
        for arm, index in own:
            drops[:, index] = pseudo[0] - pseudo[1 + arm]
        effects[name] = _effect(drops, windows[name], texture)
    return effects


def _effect(drops: torch.Tensor, windows: list[Window], texture: torch.Tensor) -> Effect:
    """Paint the ``(replicates, windows)`` drops of the metric onto the texels."""
    count, size = len(drops), texture.shape[:-1]
    mean = _painted(drops.mean(0), windows, size)
    squares, sums = torch.zeros_like(mean), []
    for replicate in drops:
        painted = _painted(replicate, windows, size)
        squares += (painted - mean).square()
        sums.append(painted.sum())

    def shaped(texels: torch.Tensor) -> torch.Tensor:
        return texels.to(texture)[..., None].expand(texture.shape).clone()

    totals = torch.stack(sums)[:, None].expand(count, texture.shape[-1])
    if count == 1:
        return Effect(shaped(mean), None, totals, None)
    error = (squares / (count * (count - 1))).sqrt()
    return Effect(shaped(mean), shaped(error), totals, covariance_of_mean(totals))


def _painted(drops: torch.Tensor, windows: list[Window], size: Sequence[int]) -> torch.Tensor:
    """Return for each texel the mean over the windows that cover it."""
    summed, covered = drops.new_zeros(size), drops.new_zeros(size)
    for drop, window in zip(drops, windows, strict=True):
        summed[window] += drop
        covered[window] += 1
    return summed / covered
