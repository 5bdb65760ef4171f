"""Probabilities of image classifiers."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from ._classes import class_name
from ._classifier import ClassifierMetric
from ._network import Model, Transform


class ClassProbability(ClassifierMetric):
    """Probability of a class, ``softmax(model(transform(sRGB(exposure · L))))[target]``.

    Example
    -------
    >>> from scenecaptum import metrics
    >>> network = metrics.ShapeClassifier.pretrained()
    >>> bool(0 < metrics.ClassProbability(network, "cube", smoothing=0.3)(torch.rand(48, 48, 3)) < 1)
    True

    Parameters
    ----------
    model, target, transform, exposure, classes
        As in ``ClassLogit``; without a target the metric is the vector of all probabilities.
    smoothing
        As in ``ClassLogit``: the probability is averaged over noise of the picture, not computed from the mean of
        the logits.

    Raises
    ------
    SceneCaptumError
        As in ``ClassLogit``.

    Notes
    -----
    Prefer ``ClassLogit``, or its difference ``against`` another class, unless the probability itself is the
    question. The gradient of a probability is ``p (1 − p)`` times that of the contrast of its class with all
    others, ``z_target − log Σ_other exp z``. It vanishes where the network is certain, for or against the class,
    so that a scene without a doubt has no attribution, and it changes if any other class becomes likely.
    """

    def __init__(
        self,
        model: Model,
        target: int | str | None = None,
        transform: Transform | None = None,
        *,
        exposure: float = 1.0,
        classes: Sequence[str] | None = None,
        smoothing: float | None = None,
    ) -> None:
        super().__init__(model, target, transform, exposure, classes, smoothing)

    def values(self, logits: torch.Tensor) -> torch.Tensor:
        """Return the probabilities, ``(N, classes)``."""
        return logits.softmax(1)

    def class_measure(self, index: int | None) -> str:
        """Return the name of the probability of a class."""
        return f"probability of {class_name(index, self.classes)}"
