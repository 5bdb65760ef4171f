"""The logits of the bundled classifier as a metric with a name."""

from __future__ import annotations

from ._class_logit import ClassLogit
from ._shape_classifier import ShapeClassifier


def shape_logit(
    target: int | str | None = None, against: int | str | None = None, smoothing: float | None = None
) -> ClassLogit:
    """Return the logits of the bundled ``ShapeClassifier``, or that of a class; options as for ``ClassLogit``."""
    return ClassLogit(ShapeClassifier.pretrained(), target, against=against, smoothing=smoothing)
