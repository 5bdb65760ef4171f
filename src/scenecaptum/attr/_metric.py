"""Evaluating a metric and its adjoint image, and saying clearly what is wrong with one that cannot be used."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import torch

from .._finite import NotFiniteError, place
from ..errors import SceneCaptumError
from ._view import RAW, View

Metric: TypeAlias = Callable[[torch.Tensor], torch.Tensor]
Target: TypeAlias = "int | tuple[int, ...] | None"


@dataclass(frozen=True)
class TargetedMetric:
    """A metric, the element of its output that is attributed, and how it sees a picture.

    Where the picture ``I`` is denoised first, to ``S``, the value is ``M(S) + ⟨∇M(S), I − S⟩`` and the adjoint
    ``∇M(S)``. To first order the value is then free of what the denoiser has changed, and linear in the noise of
    the picture, which therefore puts no bias into it.
    """

    metric: Metric
    target: Target = None
    view: View = RAW

    @property
    def name(self) -> str:
        """What the metric is called, in tables and figures."""
        name = getattr(self.metric, "__name__", type(self.metric).__name__)
        return name if self.target is None else f"{name}[{self.target}]"

    def through(self, view: View) -> TargetedMetric:
        """Return the same metric with another view."""
        return dataclasses.replace(self, view=view)

    def value_and_adjoint(self, image: torch.Tensor) -> tuple[float, torch.Tensor]:
        """Return the metric's value at an image and its derivative with respect to every pixel.

        Raises
        ------
        SceneCaptumError
            Where the metric does not return a finite scalar that depends on the image.
        """
        seen = self.view(image.detach())
        value, adjoint = self.value_and_adjoint_at(seen)
        return value + _product(adjoint, image.detach() - seen), adjoint

    def value_and_adjoint_at(self, seen: torch.Tensor) -> tuple[float, torch.Tensor]:
        """Return the same at the very picture that is given, which is not denoised."""
        leaf = seen.detach().requires_grad_()
        with torch.enable_grad():
            value = self._scalar(self.output(leaf))
        if not value.requires_grad:
            raise SceneCaptumError(self._does_not_depend())
        (adjoint,) = torch.autograd.grad(value, leaf, allow_unused=True)
        if adjoint is None:
            raise SceneCaptumError(self._does_not_depend())
        bad = ~torch.isfinite(adjoint)
        if not torch.isfinite(value):
            where = f", with a derivative that is not finite at {place(bad, 'camera')}" if bad.any() else ""
            raise NotFiniteError(
                f"The metric {self.name} is {value.item()} on the rendered image, which is finite{where}."
            )
        if bad.any():
            raise NotFiniteError(
                f"The metric {self.name} has a derivative that is not finite on {int(bad.any(-1).sum())} of "
                f"{adjoint[..., 0].numel()} pixels: {place(bad, 'camera')}. A square root or logarithm of 0 is "
                "the usual cause: add a small constant inside it."
            )
        return value.item(), adjoint

    def output(self, image: torch.Tensor) -> Any:
        """Call the metric on an image, which it must leave as it is: other passes see it too."""
        version = image._version
        try:
            output = self.metric(image)
        except RuntimeError as error:
            if "leaf Variable" not in str(error):
                raise
            raise SceneCaptumError(self._changes_the_image()) from error
        if image._version != version:
            raise SceneCaptumError(self._changes_the_image())
        return output

    def value(self, image: torch.Tensor) -> float:
        """Return the metric's value at an image, finite or not: a logarithm of a black image is -inf.

        A metric without derivatives sees what the denoiser makes of the image, and is not corrected.
        """
        image = image.detach()
        seen = self.view(image)
        value, adjoint = self.value_and_derivative(seen, wanted=seen is not image)
        return value if adjoint is None else value + _product(adjoint, image - seen)

    def value_and_derivative(
        self, seen: torch.Tensor, *, wanted: bool = True
    ) -> tuple[float, torch.Tensor | None]:
        """Return the value at the very picture that is given and its derivative, or None where it has none."""
        leaf = seen.detach().requires_grad_(wanted)
        with torch.set_grad_enabled(wanted):
            value = self._scalar(self.output(leaf))
        if not (value.requires_grad and torch.isfinite(value)):
            return value.item(), None
        (adjoint,) = torch.autograd.grad(value, leaf, allow_unused=True)
        return value.item(), adjoint if adjoint is not None and torch.isfinite(adjoint).all() else None

    def value_of(self, output: Any) -> float:
        """Return the value that is attributed, from an output of the metric.

        Raises
        ------
        SceneCaptumError
            Where it is not a finite scalar.
        """
        return self.check_value(self._scalar(output).item())

    def check_value(self, value: float) -> float:
        """Return a value of the metric, if it is finite; raise otherwise."""
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
                "Write it in torch operations, without .item(), float() or numpy."
            )
        if self.target is not None:
            output = self._at_target(output)
        if output.is_meta or output.is_complex():
            came = "on the meta device, which holds no numbers" if output.is_meta else "complex"
            raise SceneCaptumError(
                f"The metric {self.name} must return a real number; it returned one {came}."
            )
        if output.numel() != 1:
            raise SceneCaptumError(
                f"The metric {self.name} must return a scalar; it returned shape {tuple(output.shape)}. "
                "Say which element is meant with target=, or reduce it, for example with .mean()."
            )
        scalar: torch.Tensor = output.reshape(())
        return scalar

    def _at_target(self, output: torch.Tensor) -> torch.Tensor:
        try:
            chosen: torch.Tensor = output[self.target]
        except (IndexError, TypeError) as error:
            raise SceneCaptumError(
                f"target={self.target!r} does not index the metric's output of shape {tuple(output.shape)}."
            ) from error
        return chosen

    def _changes_the_image(self) -> str:
        return (
            f"The metric {self.name} changes the image that it is given. Write image = image * 2 instead of "
            "image *= 2 or image.mul_(2), or begin with image = image.clone()."
        )

    def _does_not_depend(self) -> str:
        return (
            f"The metric {self.name} does not depend on the image through differentiable torch operations: "
            "look for .detach(), torch.no_grad(), rounding, comparisons or an integer result."
        )


def _product(adjoint: torch.Tensor, difference: torch.Tensor) -> float:
    """Return the inner product of two pictures; of a picture that is not changed it is 0."""
    return float((adjoint.double() * difference.double()).sum())
