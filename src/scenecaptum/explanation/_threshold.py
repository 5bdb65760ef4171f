"""What the threshold of a glare rating means for a picture."""

from __future__ import annotations

import torch

from ..estimation import Metric
from ..metrics import GlareRating, luminance
from ..visualization import rounded

NEAR = 3.0  # times the threshold: below, a dimmed source may stop counting


def threshold_notes(metric: Metric, image: torch.Tensor) -> list[str]:
    """Return a note if a picture has no glare source, or its main source is close to an absolute threshold."""
    if not isinstance(metric, GlareRating):
        return []
    factor = metric.threshold_factor
    limit = f"{metric.threshold:g} cd/m²" if factor is None else f"{factor:g} times the mean luminance"
    sources = metric.sources(image)
    if not sources:
        brightest = rounded(metric.efficacy * luminance(image).max().item())
        remedy = "check the scene's units, or use "
        remedy += "a threshold factor of 5" if factor is None else "a smaller threshold factor"
        return [
            f"no pixel is brighter than {limit} (the brightest: {brightest} cd/m²): nothing counts as a glare "
            f"source; {remedy}"
        ]
    main = max(sources, key=lambda one: one.luminance**2 * one.solid_angle / one.position_index**2)
    if factor is None and main.luminance < NEAR * metric.threshold:
        return [
            f"only pixels brighter than {limit} count; a source that falls below stops counting at once: check "
            "with a threshold factor of 5"
        ]
    return []
