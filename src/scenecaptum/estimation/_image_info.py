"""Description of the metric image for a result's ``info``, and a warning if it was too noisy."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch

from ..protocols import Measure
from ..visualization import rounded
from ._jackknife import SIGNIFICANT_DRIFT
from ._metric import TargetedMetric
from ._metric_image import ImageTransform

ROUNDING = 1e-6
TOO_NOISY = "is too noisy for"
THIS_METRIC = "this metric"
_NEGLIGIBLE = 0.01  # of the value: a bias that needs no caution
_FLOOR = 0.01  # of the mean brightness: the relative noise of darker pixels does not count


class SampleOption(NamedTuple):
    """The option that the samples of a picture grow with: ``keyword=value`` gives as many as the picture has.

    ``instead`` follows where another option that is set has to be left out. ``needed`` returns the value for a
    multiple of the samples of the picture; without it, they are proportional.
    """

    keyword: str
    value: float
    instead: str = ""
    needed: Callable[[float], float] | None = None

    def times(self, factor: float) -> str:
        """Return ``"use spp=3400 or more"`` for a picture of at least ``factor`` times the samples."""
        value = factor * self.value if self.needed is None else self.needed(factor)
        return f"use {self.keyword}={math.ceil(_rounded_up(value))} or more{self.instead}"


def _more_samples(option: SampleOption | None, factor: float) -> str:
    return (
        f"use at least {_rounded_up(factor):g} times the samples" if option is None else option.times(factor)
    )


def _rounded_up(number: float) -> float:
    """Return the next number of two digits."""
    scale = 10.0 ** (math.floor(math.log10(number)) - 1)
    return round(math.ceil(number / scale * (1 - ROUNDING)) * scale, 9)


def relative_noise(images: Sequence[torch.Tensor], fractions: torch.Tensor | None = None) -> float | None:
    """Return the root mean square of the relative noise of the pixels of a mean image; None for a single image.

    ``fractions`` are as in ``pixel_error``.
    """
    if len(images) < 2:
        return None
    mean, variance = _mean_and_variance(images, fractions)
    return (variance.sqrt() / mean.clamp_min(_FLOOR * mean.mean())).square().mean().sqrt().item()


def pixel_error(images: Sequence[torch.Tensor], fractions: torch.Tensor | None = None) -> float | None:
    """Return the root mean square of the standard errors of the pixels of a mean image; None for a single image.

    It is in the unit of the image, averaged over the channels. ``fractions`` are those of the samples that each
    image has, by default equal. Black pixels do not count: they are points of a sensor grid that are left out.
    """
    if len(images) < 2:
        return None
    mean, variance = _mean_and_variance(images, fractions)
    lit = mean > 0
    return variance[lit].mean().sqrt().item() if lit.any() else 0.0


def _mean_and_variance(
    images: Sequence[torch.Tensor], fractions: torch.Tensor | None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the mean image and the variances of its pixels, both averaged over the channels first."""
    count = len(images)
    pixels = torch.stack([image.mean(-1) for image in images]).double()
    weights = torch.full((count,), 1 / count) if fractions is None else fractions
    weights = weights.to(pixels).reshape(-1, *[1] * (pixels.ndim - 1))
    mean = (weights * pixels).sum(0)
    return mean, (weights * (pixels - mean).square()).sum(0) / (count - 1)


def describe_picture(  # noqa: PLR0913 -- everything that is known of the picture
    transform: ImageTransform,
    value: float,
    drift: tuple[float, float] | None,
    spp: int | None,
    denoised: float | None = None,
    interval: tuple[float, float] | None = None,
    *,
    noise: float | None = None,
    standard_error: float | None = None,
    metric: TargetedMetric | None = None,
    image: torch.Tensor | None = None,
    option: SampleOption | None = None,
    compares: bool = False,
    shows_a_view: bool = True,
) -> dict[str, Any]:
    """Return a plain description of the metric image.

    ``transform``, ``value``, ``drift`` and ``denoised`` are as in ``Adjoints``; ``interval`` is the 95 % interval
    of the value, ``noise`` the relative noise of the pixels, ``standard_error`` as of ``pixel_error``, and
    ``metric`` may have classes of its values and cautions of its own, also of the ``image``. ``option`` is the one
    to set for more samples; it is not known of a renderer that does not say how many it takes. ``compares`` says
    that the effects are differences of values, which have its bias, and ``shows_a_view`` that it is a picture.

    The ``caution`` says what is doubtful, and the ``advice`` what to do.
    """
    raw, smooth = transform.raw_error, transform.denoised_error
    measure, own = (None, None) if metric is None else (metric.measure, metric.caution)
    if metric is not None and image is not None:
        own = metric.caution_of(image)
    noisy, factor = _differs(value, drift, spp, denoised, compares=compares, option=option)
    advice = _more_samples(option, factor) if factor else None
    noisy = noisy or _too_wide(interval, measure)
    biased, needed = (
        (None, 0.0) if metric is None else _above_tolerance(noise, transform, metric.tolerated_noise)
    )
    if biased and not noisy:
        noisy, advice = biased, _more_samples(option, needed) if needed > 1 else "do not denoise"
    elif biased and factor:
        advice = _more_samples(option, max(factor, needed))
    if noisy:
        noisy = f"the {'picture' if shows_a_view else 'result'} {TOO_NOISY} {THIS_METRIC}: {noisy}"
    if noisy and compares:
        noisy += "; the effects are biased, too"
    return {
        "spp": spp,
        "denoised": transform.denoises,
        "relative_error": None if raw is None else raw**0.5,
        "relative_error_denoised": None if smooth is None else smooth**0.5,
        "pixel_error": standard_error,
        "caution": own or noisy,
        "advice": None if own else advice,
    }


def _differs(
    value: float,
    drift: tuple[float, float] | None,
    spp: int | None,
    denoised: float | None,
    *,
    compares: bool,
    option: SampleOption | None,
) -> tuple[str | None, float]:
    """Return the values if the metric differs significantly at half of the samples, or after denoising.

    Also return how many times the samples it needs, or 0. Samples are counted only where the picture has as many
    as were asked for.
    The error of the value contains the difference. So it needs no caution if it is less than a percent of the
    value, unless the method ``compares`` values: of their differences it may be a large part.
    """
    if drift is None:
        return None, 0
    change, error = drift
    noise = max(SIGNIFICANT_DRIFT * error, ROUNDING * abs(value))
    limit = noise if compares else max(noise, _NEGLIGIBLE * abs(value))
    if abs(change) > limit:
        is_asked = spp is not None and option is not None and spp == option.value
        half, full = (
            (f"{spp / 2:g} spp", f"{spp} spp") if spp and is_asked else ("half of the samples", "all")
        )
        # The bias falls with the number of samples, the noise with its square root.
        factors = [(change / noise) ** 2] if noise else []
        factors += [] if compares or not value else [abs(change) / (_NEGLIGIBLE * abs(value))]
        said = f"{rounded(value + change, 4)} at {half}, {rounded(value, 4)} at {full}"
        return said, min(factors, default=0.0)
    if denoised is not None and abs(denoised - value) > limit:
        return f"{rounded(value, 4)} as rendered, {rounded(denoised, 4)} denoised", 0
    return None, 0


def _above_tolerance(
    noise: float | None, transform: ImageTransform, tolerated: float | None
) -> tuple[str | None, float]:
    """Return the error of the pixels if it is larger than a metric tolerates, and how many samples it needs.

    The latter is a multiple of those it has: 1 or less if only the denoiser is at fault.

    That of a denoised image is the one measured at half of its samples: the denoiser's bias hardly falls with
    them. At the number of samples that is advised, the image is good enough as rendered.
    """
    if noise is None or tolerated is None:
        return None, 0
    is_denoised = transform.denoises and transform.denoised_error is not None
    used = math.sqrt(transform.denoised_error or 0.0) if is_denoised else noise
    if used <= tolerated:
        return None, 0
    factor = (noise / tolerated) ** 2
    decimals = next((d for d in range(3) if round(100 * used, d) > round(100 * tolerated, 3)), 3)
    return (
        f"the {'error of a denoised' if is_denoised else 'noise of a'} pixel is {100 * used:.{decimals}f} %, and "
        f"more than {rounded(100 * tolerated)} % biases it",
        factor,
    )


def _too_wide(interval: tuple[float, float] | None, measure: Measure | None) -> str | None:
    """Return the interval of the value if it is wider than a class of the rating and includes a limit."""
    if interval is None or measure is None or measure.half_class is None:
        return None
    low, high = interval
    if (width := (high - low) / 2) <= measure.half_class or measure.verdict(low) == measure.verdict(high):
        return None
    return (
        f"its 95 % interval is ± {rounded(width, 2)}, and half the width of a class is {measure.half_class:g}"
    )
