"""Evaluating a metric and its adjoint image, with clear errors for metrics that cannot be used."""

from __future__ import annotations

import dataclasses
import math
import re
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Any, TypeAlias, cast

import torch

from ..errors import SceneCaptumError, check_callable, listed, refuse_class
from ..finite import NotFiniteError, describe_location
from ..protocols import Capabilities, Measure, Renderer, takes_keyword
from ..training_mode import warn_of_training_mode
from ._autograd import gradients_enabled
from ._metric_image import IDENTITY, ImageTransform

Metric: TypeAlias = Callable[[torch.Tensor], torch.Tensor]
Target: TypeAlias = "int | str | tuple[int, ...] | None"  # a str is the name of a class
Draws: TypeAlias = Mapping[int, int]  # the number of draws of each seed
# Against large errors, for a metric that does not say itself what it measures.
MORE_SAMPLES = "use more samples"
OWN_ADVICE = (
    f"{MORE_SAMPLES}; if the metric contains a network, metrics.Smoothed(metric, sigma=0.3) has a gradient with "
    "smaller errors"
)


def check_renderer_and_metric(renderer: Renderer, metric: Any) -> None:
    """Raise if either is not callable, is a class, or if they were passed in the wrong order.

    Warn if the metric refers to a network in training mode.
    """
    for name, value in (("renderer", renderer), ("metric", metric)):
        check_callable(name, value, ": pass a renderer, then a metric")
    if Capabilities(metric).inputs is not None and Capabilities(renderer).inputs is None:
        raise SceneCaptumError("The renderer and the metric are swapped: the renderer comes first.")
    if takes_keyword(metric, "seed") and not takes_keyword(renderer, "seed"):
        raise SceneCaptumError("The renderer and the metric are swapped: the renderer comes first.")
    warn_of_training_mode(metric)


@dataclass(frozen=True)
class TargetedMetric:
    """A metric, the element of its output that is attributed, and the transform of its input image.

    If the image ``I`` is first denoised to ``S``, the value is ``M(S) + ⟨∇M(S), I − S⟩`` and the adjoint
    ``∇M(S)``. To first order, the value is then free of the denoiser's bias, and linear in the noise of the image,
    which therefore causes no bias.
    """

    metric: Metric
    target: Target = None
    transform: ImageTransform = IDENTITY

    def __post_init__(self) -> None:
        refuse_class("metric", self.metric)
        if isinstance(self.target, str):
            # Frozen, and everything else knows elements by their index.
            object.__setattr__(self, "target", self._index_of(self.target))
        elif _is_index(self.target):
            object.__setattr__(self, "target", int(cast(Any, self.target)))
        indices = self.target if isinstance(self.target, tuple) else (self.target,)
        if self.target is not None and not all(isinstance(index, Integral) for index in indices):
            raise SceneCaptumError(
                f"target must be the index of an element of the metric, such as 0, not {self.target!r}."
            )
        if isinstance(self.target, Integral) and -len(self._classes) <= int(self.target) < 0:
            object.__setattr__(self, "target", int(self.target) + len(self._classes))

    def _index_of(self, name: str) -> int:
        find = getattr(self.metric, "target_index", None)
        if find is None:
            raise SceneCaptumError(
                f"target must be the index of an element of {self._metric_name}, such as 0, not {name!r}: only "
                "the metrics of classifiers, such as ClassLogit, have elements with names."
            )
        index: int = find(name)
        return index

    @property
    def name(self) -> str:
        """Name for tables and figures: ``ClassLogit[cube]``, or ``metric[1]`` if its elements have no names."""
        if self.target is None:
            return self._metric_name
        element = self.target
        if isinstance(element, int) and element < 0 and (count := getattr(self.metric, "n_classes", 0)):
            element += count  # known once the metric has been called
        if isinstance(element, int) and 0 <= element < len(self._classes):
            element = self._classes[element]
        return f"{self._metric_name}[{element}]"

    @property
    def _classes(self) -> tuple[str, ...]:
        """The names of the metric's elements; empty if they have none."""
        found = getattr(self.metric, "classes", ())
        return found if isinstance(found, tuple) else ()

    @property
    def _metric_name(self) -> str:
        """Name of the metric without its element."""
        return str(getattr(self.metric, "__name__", type(self.metric).__name__))

    @property
    def label(self) -> str:
        """What is measured, in words if the metric says so, for a progress bar."""
        return self.name if self.measure is None else self.measure.name

    @property
    def measure(self) -> Measure | None:
        """What the attributed value measures, if the metric says so."""
        if self.target is not None and (of_element := getattr(self.metric, "measure_of", None)) is not None:
            found: Measure = of_element(self.target)
            return found
        return getattr(self.metric, "measure", None)

    @property
    def unit(self) -> str:
        """The unit of the attributed value; empty if it has none, or none is known."""
        described = {} if self.measure is None else self.measure.describe()
        return str(described.get("unit") or "")

    @property
    def caution(self) -> str | None:
        """Why the metric is not valid for these images, if it says so."""
        return getattr(self.metric, "caution", None)

    def caution_of(self, image: torch.Tensor) -> str | None:
        """Return why the metric is not valid for these images, or its value for this one, if it says so."""
        of_image = getattr(self.metric, "caution_of", None)
        if self.caution or of_image is None:
            return self.caution
        with torch.no_grad():
            return str(of_image(self.transform(image.detach()), self.target)) or None

    @property
    def tolerated_noise(self) -> float | None:
        """Relative noise of the pixels above which it biases the value, if the metric says so."""
        return getattr(self.metric, "tolerated_noise", None)

    def verdict(self, value: float, image: torch.Tensor) -> str:
        """Return what the value means, for a metric of these images that has classes or says it itself."""
        own = getattr(self.metric, "verdict", None)
        if own is not None:
            text: str = own(self.transform(image.detach()), self.target)
            return text
        return self._unrated(image) or ("" if self.measure is None else self.measure.verdict(value))

    def _unrated(self, image: torch.Tensor) -> str:
        """Return why a rating of this image has no class; empty if it has one."""
        unrated = getattr(self.metric, "unrated", None)
        return "" if unrated is None else str(unrated(self.transform(image.detach())))

    def describe(self, value: float, image: torch.Tensor) -> dict[str, Any]:
        """Return name, measure and meaning of a value, for the ``info`` of a result."""
        relaxed = getattr(self.metric, "is_relaxed_at", None)
        verdict = self.verdict(value, image)  # first, as a classifier's verdict finds how many classes it has
        return {
            "metric": self.name,
            "measure": None if self.measure is None else self.measure.describe(),
            "relaxed": relaxed is not None and bool(relaxed(self.transform(image.detach()))),
            "verdict": verdict,
            "gradient_note": getattr(self.metric, "gradient_note", None),
            "advice": getattr(self.metric, "advice", self._own_advice()),
        }

    def _own_advice(self) -> str | None:
        """Return what helps against large errors, for a metric that says neither this nor what it measures."""
        if self.measure is not None:
            return None
        return MORE_SAMPLES if self.is_smoothed else OWN_ADVICE

    @property
    def n_draws(self) -> int:
        """Number of draws of noise that the metric is a mean of, 0 if it is none; see ``metrics.Smoothed``."""
        return int(getattr(self.metric, "n_draws", 0))

    @property
    def is_smoothed(self) -> bool:
        """Whether the metric is a mean over draws of noise."""
        return self.n_draws > 0

    def with_draws(self, draws: Draws) -> TargetedMetric:
        """Return the mean over other draws."""
        return dataclasses.replace(self, metric=cast(Any, self.metric).with_draws(draws))

    def with_few_draws(self) -> TargetedMetric:
        """Return the mean over two draws of a smoothed metric, to compile or to time it; otherwise the metric."""
        return self.with_draws({0: 2}) if self.is_smoothed else self

    def split_draws(self, seeds: Sequence[int], points: int = 1) -> list[Draws] | None:
        """Split the draws among images with these seeds at each of several points; None without draws."""
        if not self.n_draws:
            return None
        return [{seed: math.ceil(self.n_draws / (points * len(seeds)))} for seed in seeds]

    def by_definition(self) -> TargetedMetric | None:
        """Return a relaxed metric without its relaxation, so that it may jump; None if it has none."""
        hard = getattr(self.metric, "hard", None)
        if hard is None or not getattr(self.metric, "relaxation", 0.0):
            return None
        return dataclasses.replace(self, metric=hard)

    def with_transform(self, transform: ImageTransform) -> TargetedMetric:
        """Return the same metric with another transform."""
        return dataclasses.replace(self, transform=transform)

    def value_and_adjoint(self, image: torch.Tensor) -> tuple[float, torch.Tensor]:
        """Return the metric's value at an image and its derivative with respect to every pixel.

        Raises if the metric does not return a finite scalar that depends on the image.
        """
        metric_image = self.transform(image.detach())
        value, adjoint = self.value_and_adjoint_at(metric_image)
        return value + _inner_product(adjoint, image.detach() - metric_image), adjoint

    def value_and_adjoint_at(self, metric_image: torch.Tensor) -> tuple[float, torch.Tensor]:
        """Return value and adjoint at this image, without the transform."""
        leaf = metric_image.detach().requires_grad_()
        with gradients_enabled():
            value = self._scalar(self.output(leaf))
        adjoint = torch.autograd.grad(value, leaf, allow_unused=True)[0] if value.requires_grad else None
        if adjoint is None:
            raise SceneCaptumError(
                f"The metric {self.name} does not depend on the image through differentiable torch operations: "
                "look for .detach(), torch.no_grad(), rounding, comparisons or an integer result."
            )
        bad = ~torch.isfinite(adjoint)
        location = describe_location(bad, "camera") if bad.any() else ""
        if not torch.isfinite(value):
            where = f", with a derivative that is not finite at {location}" if location else ""
            raise NotFiniteError(
                f"The metric {self.name} is {value.item()} on the rendered image, which is finite{where}."
            )
        if location:
            raise NotFiniteError(
                f"The metric {self.name} has a derivative that is not finite on {int(bad.any(-1).sum())} of "
                f"{adjoint[..., 0].numel()} pixels: {location}. A square root or logarithm of 0 is the usual "
                "cause: add a small constant inside it."
            )
        return value.item(), adjoint

    def output(self, image: torch.Tensor) -> Any:
        """Call the metric on an image, which it must not modify in place."""
        version = image._version
        try:
            output = self.metric(image)
        except (RuntimeError, TypeError) as error:
            if (reason := self._mistake(error, image)) is None:
                raise
            raise SceneCaptumError(reason) from error
        if image._version != version:
            raise SceneCaptumError(self._changes_the_image())
        return output

    def _mistake(self, error: Exception, image: torch.Tensor) -> str | None:
        """Return what is wrong with a metric that raises such an error; None if that is unknown."""
        message = str(error)
        if "leaf Variable" in message:
            return self._changes_the_image()
        if "input" in message and "channels" in message:
            return (
                f"The metric {self.name} cannot take an image of shape {tuple(image.shape)} (height, width, "
                "channels). A network expects (1, 3, H, W): use metrics.ClassLogit(network), or "
                f"image.movedim(-1, 0)[None]. torch says: {message}"
            )
        if "Can't call numpy()" in message or _is_raised_by("numpy", error):
            return (
                f"The metric {self.name} leaves torch for NumPy, which has no derivatives: write it in torch "
                "operations, without .numpy(), .item() or float(). For a method without gradients, such as an "
                "ablation, image.detach().numpy() will do."
            )
        if re.search(r"(same|mixed) dtype|type \(.*\) should be the same|scalar type \w+ but found", message):
            return (
                f"The metric {self.name} mixes numbers of different precision; the image is {image.dtype}: "
                f"convert it or what it meets, as by image.double() or network.float(). torch says: {message}"
            )
        return None

    def value(self, image: torch.Tensor) -> float:
        """Return the metric's value at an image, which may be infinite, like the logarithm of a black image.

        Without a derivative, the value at the denoised image is returned without correction.
        """
        image = image.detach()
        metric_image = self.transform(image)
        value, adjoint = self.value_and_derivative(metric_image, differentiate=metric_image is not image)
        return value if adjoint is None else value + _inner_product(adjoint, image - metric_image)

    def value_and_derivative(
        self, metric_image: torch.Tensor, *, differentiate: bool = True
    ) -> tuple[float, torch.Tensor | None]:
        """Return the value at this image, without the transform, and its derivative or None if there is none."""
        leaf = metric_image.detach().requires_grad_(differentiate)
        with gradients_enabled() if differentiate else torch.no_grad():
            value = self._scalar(self.output(leaf))
        if not (value.requires_grad and torch.isfinite(value)):
            return value.item(), None
        (adjoint,) = torch.autograd.grad(value, leaf, allow_unused=True)
        return value.item(), adjoint if adjoint is not None and torch.isfinite(adjoint).all() else None

    def value_of(self, output: Any) -> float:
        """Return the attributed value from an output of the metric; raise if it is not a finite scalar."""
        return self.check_value(self._scalar(output).item())

    def check_value(self, value: float) -> float:
        """Return the value if it is finite; raise otherwise."""
        if not math.isfinite(value):
            raise SceneCaptumError(
                f"The metric {self.name} is {value}. A logarithm of 0 or a division by 0 is the usual cause: "
                "add a small constant inside it, or choose other baselines=."
            )
        return value

    def _scalar(self, output: Any) -> torch.Tensor:
        if not isinstance(output, torch.Tensor):
            raise SceneCaptumError(
                f"The metric {self.name} must return a torch tensor, not {type(output).__name__}. "
                "Write it in torch operations, without .item(), float() or numpy; for a method without gradients, "
                "such as an ablation, torch.tensor(number) will do."
            )
        if self.target is not None:
            output = self._at_target(output)
        if output.is_meta or output.is_complex():
            kind = "on the meta device, which has no data" if output.is_meta else "complex"
            raise SceneCaptumError(
                f"The metric {self.name} must return a real number; it returned one {kind}."
            )
        if output.numel() != 1:
            raise SceneCaptumError(
                f"The metric {self.name} must return a scalar; it returned shape {tuple(output.shape)}. "
                f"{self._how_to_select()}"
            )
        scalar: torch.Tensor = output.reshape(())
        return scalar

    def _how_to_select(self) -> str:
        """Return how to choose an element of an output: by the names of the classes, if the metric knows them."""
        classes = self._classes
        if not classes:
            return "Select an element with target=, or reduce it, for example with .mean()."
        return (
            f"It has a value for each of {len(classes)} classes: choose one with --target on the command line or "
            f"target= in Python{listed(classes)}."
        )

    def _at_target(self, output: torch.Tensor) -> torch.Tensor:
        index: Any = self.target  # no name any more
        try:
            element: torch.Tensor = output[index]
        except (IndexError, TypeError) as error:
            batch = (
                f" The first axis is a batch of one: use target=(0, {self.target}), or return output[0]."
                if output.ndim == 2 and len(output) == 1 and isinstance(self.target, Integral)
                else " The metric has a single value: leave out target=."
                if output.ndim == 0
                else f" It has a value for each of {len(self._classes)} classes{listed(self._classes)}."
                if self._classes
                else ""
            )
            raise SceneCaptumError(
                f"target={self.target!r} does not index the metric's output of shape {tuple(output.shape)}.{batch}"
            ) from error
        return element

    def _changes_the_image(self) -> str:
        return (
            f"The metric {self.name} modifies its input image in place. Write image = image * 2 instead of "
            "image *= 2 or image.mul_(2), or begin with image = image.clone()."
        )


def _is_raised_by(package: str, error: Exception) -> bool:
    """Return whether an error comes from a package's own code, as of ``numpy.mean`` called with a tensor."""
    *_, (frame, _) = traceback.walk_tb(error.__traceback__)
    return str(frame.f_globals.get("__name__")).split(".")[0] == package


def _is_index(target: Any) -> bool:
    """Whether a target is a tensor with one integer, as Captum takes it."""
    is_one = isinstance(target, torch.Tensor) and target.numel() == 1
    return is_one and not (target.is_floating_point() or target.is_complex() or target.dtype == torch.bool)


def _inner_product(adjoint: torch.Tensor, difference: torch.Tensor) -> float:
    return float((adjoint.double() * difference.double()).sum())
