"""What a result records of the picture that its metric saw, and whether that picture was too noisy for it."""

from __future__ import annotations

from typing import Any

from ._jackknife import Adjoints

CHANCE = 2.0  # standard errors by which the metric at half of the samples may differ from that at all


def describe_picture(seen: Adjoints, samples: int | None) -> dict[str, Any]:
    """Return in plain values how a metric saw a picture of so many samples per pixel."""
    view = seen.view
    return {
        "spp": samples,
        "denoised": view.denoises,
        "relative_error": None if view.raw_error is None else view.raw_error**0.5,
        "relative_error_denoised": None if view.denoised_error is None else view.denoised_error**0.5,
        "caution": _caution(seen, samples),
    }


def _caution(seen: Adjoints, samples: int | None) -> str | None:
    """Say that the picture is too noisy, where the metric is another at half of the samples, beyond chance."""
    if seen.drift is None:
        return None
    drift, chance = seen.drift
    if abs(drift) <= CHANCE * chance or abs(drift) <= 1e-6 * abs(seen.value):
        return None
    half, every = f"{seen.value + drift:.4g}", f"{seen.value:.4g}"
    counted = (
        ("half of the samples", "all") if samples is None else (f"{samples / 2:g} spp", f"{samples} spp")
    )
    return f"the picture is too noisy for this metric: {half} at {counted[0]}, {every} at {counted[1]}"
