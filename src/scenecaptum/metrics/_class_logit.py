"""Logits of image classifiers."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

from ..errors import SceneCaptumError, near_misses, whole_number
from ..visualization import rounded
from ._frozen import run_frozen
from ._measure import Measure
from ._noise import PictureNoise, smoothed_measure, without_smoothing
from ._picture import check_exposure, srgb_picture
from ._preprocessing import ResizeCropNormalize, own_preprocessing


class ClassLogit(torch.nn.Module):
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
    exposure
        Factor on radiance before it is clipped at white and encoded as sRGB. Above white the derivative is 0.
    classes
        The names of the classes, in the order of the logits; by default ``model.classes`` if it exists.
    smoothing
        The ``sigma`` of log-normal noise of the picture over which the logit is averaged, for a gradient that the
        noise of a render does not dominate; 0.3 is a good choice. None: the logit itself. ``Smoothed`` has more
        settings, and says what is averaged.

    Raises
    ------
    SceneCaptumError
        If the target is not one of the classes, or the model does not return ``(1, classes)``. From
        ``forward``, if radiance is negative or not finite.

    Notes
    -----
    Unlike a softmax output, a logit does not depend on the scores of other classes, and its derivative does not
    vanish by saturation.
    """

    def __init__(
        self,
        model: Callable[[torch.Tensor], torch.Tensor],
        target: int | str | None = None,
        transform: Callable[[torch.Tensor], torch.Tensor] | None = None,
        *,
        exposure: float = 1.0,
        classes: Sequence[str] | None = None,
        smoothing: float | None = None,
    ) -> None:
        super().__init__()
        own = getattr(model, "classes", None)
        self.classes = tuple(classes if classes is not None else own if isinstance(own, list | tuple) else ())
        self.target = self._index(target)
        self.exposure = check_exposure(exposure)
        self.transform = transform or own_preprocessing(model, ResizeCropNormalize())
        self.model = model
        self.noise = None if smoothing is None else PictureNoise.create(smoothing)

    @classmethod
    def pretrained(
        cls,
        name: str,
        weights: Any = "DEFAULT",
        target: int | str | None = None,
        *,
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
        target
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
        classes = chosen.meta.get("categories")
        return cls(
            model, target, chosen.transforms(), exposure=exposure, classes=classes, smoothing=smoothing
        )

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return the logit of an ``(H, W, 3)`` image, a 0-d tensor; without a target all, ``(classes,)``."""
        return self.of_batch(image[None])[0] if self.noise is None else self.noise.mean(self.of_batch, image)

    def of_batch(self, images: torch.Tensor) -> torch.Tensor:
        """Return the logits of images ``(N, H, W, 3)`` without smoothing: ``(N,)``, or ``(N, classes)``."""
        logits = self._logits(images)
        if self.target is None:
            return logits
        if self.target >= logits.shape[1]:
            raise SceneCaptumError(
                f"target={self.target} is not a class of {type(self.model).__name__}: it has {logits.shape[1]} "
                f"classes, 0 to {logits.shape[1] - 1}."
            )
        return logits[:, self.target]

    @property
    def n_draws(self) -> int:
        """Number of draws of noise over which the logit is averaged, 0 without smoothing."""
        return 0 if self.noise is None else self.noise.n

    def with_draws(self, draws: Mapping[int, int]) -> ClassLogit:
        """Return the same metric with other draws of noise: a number of them for each seed, rounded up to even."""
        other = copy.copy(self)
        other.noise = None if self.noise is None else self.noise.with_draws(draws)
        return other

    def _logits(self, images: torch.Tensor) -> torch.Tensor:
        logits = run_frozen(self.model, self.transform(srgb_picture(images, self.exposure)))
        if not isinstance(logits, torch.Tensor) or logits.ndim != 2 or len(logits) != len(images):
            raise SceneCaptumError(_not_logits(self.model, logits))
        return logits

    def measure_of(self, target: int | tuple[int, ...] | None) -> Measure:
        """Return what an element of the output measures."""
        index = target[0] if isinstance(target, tuple) else target
        measure = Measure(f"logit of {self._class_name(index)}")
        return measure if self.noise is None else smoothed_measure(measure)

    @property
    def measure(self) -> Measure:
        """Name of the logit."""
        return self.measure_of(self.target)

    def verdict(self, image: torch.Tensor, target: int | tuple[int, ...] | None = None) -> str:
        """Return the probability of the class (softmax) and, if another is more likely, which.

        ``image`` is an ``(H, W, 3)`` linear-radiance image, ``target`` the class if the metric has none itself.
        """
        index = self.target if self.target is not None else target[0] if isinstance(target, tuple) else target
        with torch.no_grad():
            logits = self._logits(image[None])[0].double()
        if index is None:
            return ""
        text = self._probabilities(logits.softmax(0), index)
        return text if self.noise is None else without_smoothing(logits[index].item(), text)

    def _probabilities(self, probabilities: torch.Tensor, index: int) -> str:
        """Return the probability of a class and, if another is more likely, which."""
        text = f"probability {_probability(probabilities[index].item())} of {self._class_name(index)}"
        best = int(probabilities.argmax())
        if best == index:
            return text
        return f"{text}; {_probability(probabilities[best].item())} of {self._class_name(best)}"

    def _class_name(self, index: int | None) -> str:
        return f"class {index}" if index is None or index >= len(self.classes) else self.classes[index]

    def _index(self, target: int | str | None) -> int | None:
        if target is None:
            return None
        if not isinstance(target, str):
            return whole_number("target", target, 0, len(self.classes) - 1 if self.classes else None)
        if target in self.classes:
            return self.classes.index(target)
        known = (
            f"It has {len(self.classes)} classes.{near_misses(target, self.classes)}"
            if self.classes
            else "Give the names of its classes with classes=, or the class's index."
        )
        raise SceneCaptumError(f"The model has no class called {target!r}. {known}")

    def extra_repr(self) -> str:
        """Show the class and the exposure."""
        name = f" ({self.classes[self.target]})" if self.target is not None and self.classes else ""
        smoothing = "" if self.noise is None else f", smoothing={self.noise.sigma:g}"
        return f"target={self.target}{name}, exposure={self.exposure:g}{smoothing}"


def _not_logits(model: object, output: Any) -> str:
    name = type(model).__name__
    got = f"shape {tuple(output.shape)}" if isinstance(output, torch.Tensor) else f"a {type(output).__name__}"
    fix = (
        "Pass a function that returns its logits, for example lambda x: model(x).logits."
        if not isinstance(output, torch.Tensor)
        else "Reduce it to one row of logits, for example with lambda x: model(x).mean((2, 3))."
        if output.ndim == 4
        else "Pass a function that returns one row of logits."
    )
    return f"A classifier must return logits of shape (1, classes); {name} returned {got}. {fix}"


def _probability(share: float) -> str:
    return "above 0.99" if share > 0.99 else rounded(share, 2)
