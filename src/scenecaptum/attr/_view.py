"""The picture that a metric sees: denoised where a measurement says that this brings it nearer to the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import torch

from ..denoising import Guides, denoise, is_picture
from ..errors import SceneCaptumError

Denoise: TypeAlias = "Literal['auto'] | bool"

_DARKEST = 0.1  # of the mean: errors of darker pixels are relative to this


@dataclass(frozen=True)
class View:
    """How a metric sees a picture.

    Attributes
    ----------
    denoises
        Whether the picture is denoised first.
    guides
        For the denoiser, where they are known.
    raw_error, denoised_error
        Mean squared relative errors of half of the samples, as they are and denoised, where they were measured.
    nearer
        Another view that is nearer to the truth, where it was not wanted.
    """

    denoises: bool = False
    guides: Guides | None = None
    raw_error: float | None = None
    denoised_error: float | None = None
    nearer: View | None = None

    def __call__(self, image: torch.Tensor) -> torch.Tensor:
        """Return the picture as the metric sees it."""
        return denoise(image, self.guides) if self.denoises else image


RAW = View()


def check_denoise(mode: Any) -> None:
    """Refuse what ``denoise=`` does not know."""
    if mode not in ("auto", True, False):
        raise SceneCaptumError(f'denoise must be "auto", True or False, not {mode!r}.')


def choose_view(
    mode: Denoise, images: Sequence[torch.Tensor], samples: Sequence[float] | None, guides: Guides | None
) -> View:
    """Choose whether pictures are denoised; ``"auto"`` by what brings them nearer to the truth.

    Let A and B be the means of two halves of the pictures, independent and unbiased, and D the denoiser. Then
    ``E‖D(A) − B‖² = E‖D(A) − truth‖² + E‖B − truth‖²``: of the denoised half the squared error is
    ``‖D(A) − B‖² − ‖A − B‖² / 2``, of the half itself ``‖A − B‖² / 2``. Squares are relative to the denoised
    picture, where a lamp would outweigh the room.

    References
    ----------
    Lehtinen and others, "Noise2Noise: Learning Image Restoration without Clean Data", 2018, for errors measured
    against an independent noisy picture.
    """
    if not is_picture(images[0]):
        if mode is True:
            raise SceneCaptumError(
                f"denoise=True takes a picture (H, W, 3), and this sensor gives {tuple(images[0].shape)}. Leave "
                "denoise out."
            )
        return RAW
    if len(images) == 1:
        # One picture tells nothing of its own noise.
        return View(True, guides) if mode is True else RAW
    halves = _halves(images, samples)
    denoised = [denoise(half, guides) for half in halves]
    size = (denoised[0] + denoised[1]).double().mean(-1, keepdim=True) / 2
    weight = 1 / (size.square() + (_DARKEST * size.mean()).square()).clamp_min(
        torch.finfo(torch.float64).tiny
    )

    def distance(one: torch.Tensor, other: torch.Tensor) -> float:
        return (weight * (one.double() - other.double()).square()).mean().item()

    raw_error = distance(*halves) / 2
    crossed = (distance(denoised[0], halves[1]) + distance(denoised[1], halves[0])) / 2
    denoised_error = max(0.0, crossed - raw_error)
    denoises = denoised_error < raw_error
    found = View(denoises or mode is True, guides, raw_error, denoised_error)
    if mode is False:
        return View(False, None, raw_error, denoised_error, nearer=found if denoises else None)
    return found


def _halves(
    images: Sequence[torch.Tensor], samples: Sequence[float] | None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the means of two parts with about as many samples each: the largest pictures are dealt out first."""
    weights = [1.0] * len(images) if samples is None else list(samples)
    parts: tuple[list[int], list[int]] = ([], [])
    totals = [0.0, 0.0]
    for index in sorted(range(len(images)), key=lambda one: -weights[one]):
        smaller = int(totals[1] < totals[0])
        parts[smaller].append(index)
        totals[smaller] += weights[index]
    first, second = (
        torch.stack([images[index] * (weights[index] / total) for index in part]).sum(0)
        for part, total in zip(parts, totals, strict=True)
    )
    return first, second


class Viewer:
    """Chooses how metrics see the pictures of one call of ``attribute``.

    Parameters
    ----------
    mode
        ``denoise=`` of the call.
    renderer
        Its ``guides`` help the denoiser, where it has any.
    """

    def __init__(self, mode: Denoise, renderer: Any) -> None:
        check_denoise(mode)
        self.mode = mode
        self._renderer = renderer
        self._last = RAW

    def choose(self, images: Sequence[torch.Tensor], samples: Sequence[float] | None = None) -> View:
        """Choose by independent pictures of a scene; a single one is seen like those before."""
        if len(images) > 1 or self._last is RAW:
            guides = getattr(self._renderer, "guides", None) if is_picture(images[0]) else None
            self._last = choose_view(self.mode, images, samples, guides)
        return self._last
