"""Logits of image classifiers, and their differences."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from ._classes import class_name, named_class
from ._classifier import ClassifierMetric
from ._margins import differences, resolve_against
from ._network import Model, Transform


class ClassLogit(ClassifierMetric):
    """Logit of a classifier for one class: ``model(transform(sRGB(exposure · L)))[target]``.

    Example
    -------
    >>> model = torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d(1), torch.nn.Flatten(), torch.nn.Linear(3, 1000))
    >>> ClassLogit(model, target=559, smoothing=0.3)(torch.rand(180, 320, 3)).shape
    torch.Size([])

    Parameters
    ----------
    model
        Any classifier, from torchvision, timm or your own, that maps ``(1, 3, h, w)`` to ``(1, classes)`` logits.
        It runs in evaluation mode; its mode, its parameters and their ``grad`` do not change.
    target
        Index of the class, or its name in ``classes``. Without it the metric is the vector of all logits, which
        ``attribute(target=)`` indexes.
    transform
        Differentiable preprocessing from an sRGB picture ``(1, 3, H, W)`` in [0, 1] to the model's input; for a
        torchvision model ``weights.transforms()``. By default the model's own ``preprocess`` if it has one,
        otherwise ImageNet's ``ResizeCropNormalize()``.
    against
        Index or name of another class, for the difference of the two logits: why this class and not that one.
        ``"best"``: the margin, the logit minus the largest logit of the other classes, unless one of the
        ``classes`` has the name ``"best"``. None: the logit itself.
    exposure
        Factor on radiance before it is clipped at white and encoded as sRGB. Above white the derivative is 0.
    classes
        The names of the classes, in the order of the logits; by default ``model.classes`` if it exists.
    smoothing
        The ``sigma`` of log-normal noise of the picture over which the logit is averaged, for a gradient that the
        noise of a render does not dominate; 0.3 is a good choice. None: the logit itself. It takes 256 draws,
        which limit the error from about 1000 samples per pixel on; ``Smoothed(metric, sigma=0.3, n=2048)`` takes
        more, has more settings, and says what is averaged.

    Attributes
    ----------
    against
        The index of the other class, ``"best"``, or None.

    Raises
    ------
    SceneCaptumError
        If the target is not one of the classes or is the class ``against``, or the model does not return
        ``(1, classes)``. From ``forward``, if radiance is negative or not finite, or the model cannot take what
        ``transform`` returns.

    Notes
    -----
    Unlike a softmax output, a logit does not depend on the scores of other classes, and its derivative does not
    vanish by saturation. A difference of logits is the logarithm of the ratio of the two probabilities; what all
    logits depend on, such as the brightness of the picture, cancels in it.
    """

    def __init__(
        self,
        model: Model,
        target: int | str | None = None,
        transform: Transform | None = None,
        *,
        against: int | str | None = None,
        exposure: float = 1.0,
        classes: Sequence[str] | None = None,
        smoothing: float | None = None,
    ) -> None:
        super().__init__(model, target, transform, exposure, classes, smoothing)
        self.against = resolve_against(against, self.target, self.classes)

    @classmethod
    def pretrained(
        cls,
        name: str,
        weights: Any = "DEFAULT",
        target: int | str | None = None,
        *,
        against: int | str | None = None,
        exposure: float = 1.0,
        smoothing: float | None = None,
    ) -> ClassLogit:
        """Return the logit of a pretrained torchvision classifier, with the preprocessing of its weights.

        Parameters
        ----------
        name
            Name of the model in torchvision, such as ``"resnet50"``.
        weights
            A member of its weights enumeration, such as ``ResNet50_Weights.IMAGENET1K_V2``, or its name.
        target, against
            As in ``ClassLogit``; the class names are the weights' ``meta["categories"]``.
        exposure, smoothing
            As in ``ClassLogit``.

        Raises
        ------
        SceneCaptumError
            If torchvision is missing, does not have the model or the weights, or cannot download them.
        """
        from ._torchvision import load_pretrained

        model, chosen = load_pretrained(name, weights)
        return cls(
            model,
            target,
            chosen.transforms(),
            against=against,
            exposure=exposure,
            classes=chosen.meta.get("categories"),
            smoothing=smoothing,
        )

    def values(self, logits: torch.Tensor) -> torch.Tensor:
        """Return the logits, or their differences, ``(N, classes)``."""
        return differences(logits, self.against, self.model)

    def class_measure(self, index: int | None) -> str:
        """Return the name of the logit of a class, or of its difference."""
        name = class_name(index, self.classes)
        if self.against is None:
            return f"logit of {name}"
        if self.against == "best":
            return f"margin of {name} over the best other class"
        return f"logit of {name} minus that of {class_name(self.against, self.classes)}"

    def extra_repr(self) -> str:
        """Show the classes and the settings."""
        if self.against is None:
            return super().extra_repr()
        other = "best" if self.against == "best" else named_class(self.against, self.classes)
        return f"{super().extra_repr()}, against={other}"
