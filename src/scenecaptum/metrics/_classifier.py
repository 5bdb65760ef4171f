"""What the metrics of an image classifier have in common: logits, class names, and the verdict."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import torch

from ..errors import SceneCaptumError
from ..visualization import rounded
from ._classes import (
    check_class,
    check_names,
    class_index,
    class_name,
    class_names,
    from_start,
    named_class,
    warn_of_probabilities,
)
from ._measure import Measure
from ._network import Model, NetworkMetric, Transform, describe_output, wrap_it
from ._noise import without_smoothing
from ._preprocessing import ResizeCropNormalize


class ClassifierMetric(NetworkMetric):
    """A value of each class from the logits of a classifier; of one class, or the vector of all.

    A subclass defines ``values``, from logits to values, and ``class_measure``, what they are called.
    """

    def __init__(
        self,
        model: Model,
        target: int | str | None,
        transform: Transform | None,
        exposure: float,
        classes: Sequence[str] | None,
        smoothing: float | None,
    ) -> None:
        super().__init__(model, transform, ResizeCropNormalize(), exposure, smoothing)
        self.classes = class_names(model, classes)
        self.target = None if target is None else class_index(target, self.classes)
        self.n_classes = len(self.classes)  # 0 until the network has been called, if they have no names

    @abstractmethod
    def values(self, logits: torch.Tensor) -> torch.Tensor:
        """Return the values of all classes for logits, both ``(N, classes)``."""

    @abstractmethod
    def class_measure(self, index: int | None) -> str:
        """Return the name of the value of a class."""

    def of_batch(self, images: torch.Tensor) -> torch.Tensor:
        """Return the values of images ``(N, H, W, 3)`` without smoothing: ``(N,)``, or ``(N, classes)``."""
        logits = self.logits(images)
        if self.target is None:
            return self.values(logits)
        check_class(self.target, logits.shape[1], self.model)
        return self.values(logits)[:, self.target]

    def logits(self, images: torch.Tensor) -> torch.Tensor:
        """Return the logits of images ``(N, H, W, 3)`` without smoothing, ``(N, classes)``."""
        logits = self.output(images)
        if not isinstance(logits, torch.Tensor) or logits.ndim != 2 or len(logits) != len(images):
            raise SceneCaptumError(_not_logits(self.model, logits))
        check_names(self.classes, logits.shape[1], self.model)
        warn_of_probabilities(logits, self.model)
        self.n_classes = logits.shape[1]
        return logits

    def target_index(self, name: str) -> int:
        """Return the element of the output for a class, by its name in ``classes``; raise if there is none."""
        return class_index(name, self.classes)

    def measure_of(self, target: int | tuple[int, ...] | None) -> Measure:
        """Return what an element of the output measures."""
        return self.named_measure(self.class_measure(from_start(_first(target), self.n_classes)))

    @property
    def measure(self) -> Measure:
        """Name of the value."""
        return self.measure_of(self.target)

    def verdict(self, image: torch.Tensor, target: int | tuple[int, ...] | None = None) -> str:
        """Return the probability of the class (softmax) and, if another is more likely, which.

        ``image`` is an ``(H, W, 3)`` linear-radiance image, ``target`` the class if the metric has none itself.
        """
        index = self.target if self.target is not None else _first(target)
        with torch.no_grad():
            logits = self.logits(image[None]).double()
        if (index := from_start(index, logits.shape[1])) is None:
            return ""
        text = self._probabilities(logits[0].softmax(0), index)
        return text if self.noise is None else without_smoothing(self.values(logits)[0, index].item(), text)

    def _probabilities(self, probabilities: torch.Tensor, index: int) -> str:
        """Return the probability of a class and, if another is more likely, which.

        With a third digit where two do not tell the probabilities apart.
        """
        best = int(probabilities.argmax())
        name, likelier = class_name(index, self.classes), class_name(best, self.classes)
        own, largest = probabilities[index].item(), probabilities[best].item()
        text = f"probability {_probability(own)} of {name}"
        if best == index:
            return text
        for digits in (2, 3):
            written = [_probability(share, digits) for share in (own, largest)]
            if written[0] != written[1]:
                return f"probability {written[0]} of {name}, but {written[1]} of {likelier}"
        return f"{text}, about equal to that of {likelier}"

    def extra_repr(self) -> str:
        """Show the class and the settings."""
        return f"target={named_class(self.target, self.classes)}, {self.settings()}"


def _first(target: int | tuple[int, ...] | None) -> int | None:
    return target[0] if isinstance(target, tuple) else target


def _not_logits(model: object, output: Any) -> str:
    fix = (
        wrap_it(output, 2, "its logits", "logits")
        if not isinstance(output, torch.Tensor)
        else "Reduce it: torch.nn.Sequential(model, torch.nn.AdaptiveAvgPool2d(1), torch.nn.Flatten())."
        if output.ndim == 4
        else "Pass a torch.nn.Module that returns one row of logits."
    )
    return (
        f"A classifier must return logits of shape (1, classes); {type(model).__name__} returned "
        f"{describe_output(output)}. {fix}"
    )


def _probability(share: float, digits: int = 2) -> str:
    return "above 0.99" if share > 0.99 else rounded(share, digits)
