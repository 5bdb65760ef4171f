"""The metric image: the render, or a denoised version of it if that is estimated to be more accurate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import torch

from ..denoising import Guides, denoise, guides_of, is_picture
from ..errors import SceneCaptumError
from ..protocols import Capabilities, Renderer

Denoise: TypeAlias = "Literal['auto'] | bool"

_RELATIVE_ERROR_FLOOR = 0.1  # of the mean: errors of darker pixels are relative to this


@dataclass(frozen=True)
class ImageTransform:
    """Transform from a render to the metric image, the image that the metric is evaluated on."""

    denoises: bool = False
    guides: Guides | None = None  # albedo and normals for the denoiser, if known
    # Mean squared relative errors of the mean of half of the samples, if measured.
    raw_error: float | None = None
    denoised_error: float | None = None
    more_accurate: ImageTransform | None = None  # by the estimates, but not requested

    def __call__(self, image: torch.Tensor) -> torch.Tensor:
        """Return the metric image."""
        return denoise(image, self.guides) if self.denoises else image

    def remembering(self) -> ImageTransform:
        """Return the same transform, which denoises no image twice; it keeps all of them."""
        return _Remembering(self.denoises, self.guides)


@dataclass(frozen=True)
class _Remembering(ImageTransform):
    known: list[tuple[torch.Tensor, torch.Tensor]] = field(default_factory=list, compare=False)

    def __call__(self, image: torch.Tensor) -> torch.Tensor:
        for before, after in self.known:
            if torch.equal(before, image):
                return after
        self.known.append((image, super().__call__(image)))
        return self.known[-1][1]


IDENTITY = ImageTransform()


def choose_transform(
    mode: Denoise, images: Sequence[torch.Tensor], samples: Sequence[float] | None, guides: Guides | None
) -> ImageTransform:
    """Decide whether images are denoised; ``"auto"`` compares the estimated errors with and without denoising.

    Let A and B be the means of two halves of the images, independent and unbiased, and D the denoiser. Then
    ``E‖D(A) − B‖² = E‖D(A) − truth‖² + E‖B − truth‖²``, so the squared error of the denoised half is estimated by
    ``‖D(A) − B‖² − ‖A − B‖² / 2``, and that of the half itself by ``‖A − B‖² / 2``. Errors are relative to the
    denoised image, because lamps would dominate absolute errors.

    References
    ----------
    Lehtinen and others, "Noise2Noise: Learning Image Restoration without Clean Data", 2018, for errors measured
    against an independent noisy image.
    """
    if not is_picture(images[0]):
        if mode is True:
            raise SceneCaptumError(
                f"Denoising requires an image (H, W, 3), but this sensor returns {tuple(images[0].shape)}. "
                "Leave denoise out."
            )
        return IDENTITY
    if len(images) == 1:
        # The noise cannot be estimated from a single image.
        return ImageTransform(True, guides) if mode is True else IDENTITY
    halves = _halves(images, samples)
    denoised = [denoise(half, guides) for half in halves]
    brightness = (denoised[0] + denoised[1]).double().mean(-1, keepdim=True) / 2
    floor = _RELATIVE_ERROR_FLOOR * brightness.mean()
    weight = 1 / (brightness.square() + floor.square()).clamp_min(torch.finfo(torch.float64).tiny)

    def squared_distance(a: torch.Tensor, b: torch.Tensor) -> float:
        return (weight * (a.double() - b.double()).square()).mean().item()

    raw_error = squared_distance(*halves) / 2
    crossed = (squared_distance(denoised[0], halves[1]) + squared_distance(denoised[1], halves[0])) / 2
    denoised_error = max(0.0, crossed - raw_error)
    denoising_helps = denoised_error < raw_error
    best = ImageTransform(denoising_helps or mode is True, guides, raw_error, denoised_error)
    if mode is False:
        more_accurate = best if denoising_helps else None
        return ImageTransform(False, None, raw_error, denoised_error, more_accurate)
    return best


def _halves(
    images: Sequence[torch.Tensor], samples: Sequence[float] | None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the means of two subsets with similar numbers of samples (greedy partition, largest images first)."""
    weights = [1.0] * len(images) if samples is None else list(samples)
    parts: tuple[list[int], list[int]] = ([], [])
    totals = [0.0, 0.0]
    for index in sorted(range(len(images)), key=lambda i: -weights[i]):
        smaller = int(totals[1] < totals[0])
        parts[smaller].append(index)
        totals[smaller] += weights[index]
    first, second = (
        torch.stack([images[index] * (weights[index] / total) for index in part]).sum(0)
        for part, total in zip(parts, totals, strict=True)
    )
    return first, second


class TransformSelector:
    """Selects the image transform for one call of ``attribute`` with ``denoise=mode``.

    A metric that averages over noise of the picture (``smoothed``) hardly changes by a little more noise, and is
    not denoised unless this is asked for. The images are those of the scene with these ``values``.
    """

    def __init__(
        self, mode: Denoise, renderer: Renderer, values: Mapping[str, torch.Tensor], *, smoothed: bool
    ) -> None:
        if mode not in ("auto", True, False):
            raise SceneCaptumError(f'denoise must be "auto", True or False, not {mode!r}.')
        shows_a_view = Capabilities(renderer).shows_a_view is not False
        if mode is True and not shows_a_view:
            raise SceneCaptumError(
                "Denoising requires a picture, and this sensor shows none: leave denoise= out."
            )
        self.mode = mode
        self._denoises = shows_a_view and (not smoothed or mode is True)
        self._renderer = renderer
        self._values = values
        self._last = IDENTITY

    def select(
        self, images: Sequence[torch.Tensor], samples: Sequence[float] | None = None
    ) -> ImageTransform:
        """Select by independent images of a scene; for a single image repeat the last selection."""
        if not self._denoises:
            return IDENTITY
        if len(images) > 1 or self._last is IDENTITY:
            guides = guides_of(self._renderer, self._values) if is_picture(images[0]) else None
            self._last = choose_transform(self.mode, images, samples, guides)
        return self._last
