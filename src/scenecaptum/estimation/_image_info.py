"""Description of the metric image for a result's ``info``, and a warning if it was too noisy."""

from __future__ import annotations

from typing import Any

from ..visualization import rounded
from ._jackknife import SIGNIFICANT_DRIFT
from ._metric import TargetedMetric
from ._metric_image import ImageTransform

ROUNDING = 1e-6


def describe_picture(
    transform: ImageTransform,
    value: float,
    drift: tuple[float, float] | None,
    spp: int | None,
    denoised: float | None = None,
    interval: tuple[float, float] | None = None,
    *,
    metric: TargetedMetric | None = None,
    compares: bool = False,
) -> dict[str, Any]:
    """Return a plain description of the metric image.

    ``transform``, ``value``, ``drift`` and ``denoised`` are as in ``Adjoints``; ``interval`` is the 95 % interval
    of the value, and ``metric`` may have classes of its values and cautions of its own. ``compares`` says that the
    effects are differences of values, which have its bias.
    """
    raw, smooth = transform.raw_error, transform.denoised_error
    measure, own = (None, None) if metric is None else (metric.measure, metric.caution)
    half_class = None if measure is None else measure.half_class
    noisy = _caution(value, drift, spp, denoised) or _too_wide(interval, half_class)
    if noisy and compares:
        noisy += "; the effects are biased, too, and their errors do not include it"
    return {
        "spp": spp,
        "denoised": transform.denoises,
        "relative_error": None if raw is None else raw**0.5,
        "relative_error_denoised": None if smooth is None else smooth**0.5,
        "caution": own or noisy,
    }


def _caution(
    value: float, drift: tuple[float, float] | None, spp: int | None, denoised: float | None
) -> str | None:
    """Return a warning if the metric differs significantly at half of the samples, or after denoising."""
    if drift is None:
        return None
    change, error = drift
    limit = max(SIGNIFICANT_DRIFT * error, ROUNDING * abs(value))
    noisy = "the picture is too noisy for this metric"
    if abs(change) > limit:
        half, full = ("half of the samples", "all") if spp is None else (f"{spp / 2:g} spp", f"{spp} spp")
        return f"{noisy}: {rounded(value + change, 4)} at {half}, {rounded(value, 4)} at {full}"
    if denoised is not None and abs(denoised - value) > limit:
        return f"{noisy}: {rounded(value, 4)} as rendered, {rounded(denoised, 4)} denoised"
    return None


def _too_wide(interval: tuple[float, float] | None, half_class: float | None) -> str | None:
    """Return a warning if the interval of the value is wider than a class of the rating."""
    if interval is None or half_class is None or not (width := (interval[1] - interval[0]) / 2) > half_class:
        return None
    return (
        f"the picture is too noisy for this metric: its 95 % interval is ± {rounded(width, 2)}, and half the "
        f"width of a class is {half_class:g}"
    )
