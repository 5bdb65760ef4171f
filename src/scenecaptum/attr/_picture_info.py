"""What a result records of the picture that its metric saw, and whether that picture was too noisy for it."""

from __future__ import annotations

from typing import Any

from ._jackknife import CHANCE
from ._view import View

ROUNDING = 1e-6


def describe_picture(
    view: View,
    value: float,
    drift: tuple[float, float] | None,
    samples: int | None,
    denoised: float | None = None,
    interval: tuple[float, float] | None = None,
    half_class: float | None = None,
) -> dict[str, Any]:
    """Return in plain values how a metric saw a picture of so many samples per pixel.

    Parameters
    ----------
    view, value, drift, denoised
        As in ``Adjoints``.
    samples
        Per pixel of the picture, or None where that is not known.
    interval, half_class
        The 95 % interval of the value, and half the width of the metric's classes, where it has any.
    """
    return {
        "spp": samples,
        "denoised": view.denoises,
        "relative_error": None if view.raw_error is None else view.raw_error**0.5,
        "relative_error_denoised": None if view.denoised_error is None else view.denoised_error**0.5,
        "caution": _caution(value, drift, samples, denoised) or _too_wide(interval, half_class),
    }


def _caution(
    value: float, drift: tuple[float, float] | None, samples: int | None, denoised: float | None
) -> str | None:
    """Say that the picture is too noisy, where the metric is another at half of the samples, or denoised."""
    if drift is None:
        return None
    more, chance = drift
    least = max(CHANCE * chance, ROUNDING * abs(value))
    noisy = "the picture is too noisy for this metric"
    if abs(more) > least:
        counted = (
            ("half of the samples", "all") if samples is None else (f"{samples / 2:g} spp", f"{samples} spp")
        )
        return f"{noisy}: {value + more:.4g} at {counted[0]}, {value:.4g} at {counted[1]}"
    if denoised is not None and abs(denoised - value) > least:
        return f"{noisy}: {value:.4g} as it is, {denoised:.4g} denoised"
    return None


def _too_wide(interval: tuple[float, float] | None, half_class: float | None) -> str | None:
    """Say that the picture is too noisy to tell the class of a rating."""
    if interval is None or half_class is None or not (width := (interval[1] - interval[0]) / 2) > half_class:
        return None
    return (
        f"the picture is too noisy for this metric: its 95 % interval is ± {width:.2g}, and half the width of a "
        f"class is {half_class:g}"
    )
