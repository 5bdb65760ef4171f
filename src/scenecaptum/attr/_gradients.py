"""Weighted sums of gradients over points of parameter space: what every gradient method comes down to."""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from tqdm import tqdm

from ..errors import SceneCaptumError
from ._metric import TargetedMetric
from ._passes import Adjoints, Budget, Spread, channel_totals, jackknife

Tensors = Mapping[str, torch.Tensor]

# Samples per pixel that a metric sees at least at each of several points, where it is not linear: what the noise
# of fewer puts into its derivative is more than the jackknife can take out again.
LEAST_SEEN = 16


@dataclass(frozen=True)
class Point:
    """Parameter values at which the gradient is taken, and what it counts.

    Attributes
    ----------
    values
        Where.
    share
        Its part of the sum: the shares of all points sum to 1.
    factors
        What each parameter's gradient is multiplied by, elementwise; 1 where a name is missing.
    """

    values: Tensors
    share: float = 1.0
    factors: Tensors = field(default_factory=dict)


def between(start: Tensors, end: Tensors, place: float, share: float) -> Point:
    """Return a point on the straight line between two scenes, whose gradient is multiplied by the way."""
    # lerp works from the nearer end, so that rounding does not lead beyond either: they may be physical bounds.
    values = {name: torch.lerp(start[name], end[name], place) for name in end}
    return Point(values, share, {name: end[name] - start[name] for name in end})


@dataclass
class PointGradient:
    """A point's gradients, times its factors: their spread over the passes, and what the metric saw.

    ``bias`` is what the image's noise would have put into them, or None where that is not known.
    """

    spreads: dict[str, Spread]
    adjoints: Adjoints
    share: float
    bias: dict[str, torch.Tensor] | None = None

    @property
    def passes(self) -> int:
        """How many passes are finished."""
        return min(len(spread.totals) for spread in self.spreads.values())


class GradientSum:
    """Running sum of the gradients of points, each weighted by its share.

    The error comes from the spread of the passes at each point. Where the points are drawn at random it comes from
    the spread of the points, which holds that of the passes as well.

    Attributes
    ----------
    mean
        By parameter name, elementwise: the sum.
    bias
        What the image's noise would have put into the sum, or None.
    share
        The sum of the shares so far: below 1 where Ctrl-C ended it.
    seen
        What the metric made of the last point.
    kept
        All points, where they are to be kept.
    """

    def __init__(self, values: Tensors, *, at_random: bool = False, keep: bool = False) -> None:
        self.mean = {name: torch.zeros_like(value) for name, value in values.items()}
        self.bias: dict[str, torch.Tensor] | None = {n: torch.zeros_like(v) for n, v in values.items()}
        self.share = 0.0
        self.seen: Adjoints | None = None
        self._variance = {name: torch.zeros_like(value) for name, value in values.items()}
        self._deviations: dict[str, list[torch.Tensor]] = {name: [] for name in values}
        self._passes: list[int] = []
        self._points = {name: Spread(value) for name, value in values.items()} if at_random else None
        self.kept: list[PointGradient] | None = [] if keep else None

    def add(self, point: PointGradient) -> None:
        """Take in a point, all of it or what Ctrl-C has left of it."""
        for name, spread in point.spreads.items():
            self.mean[name] += point.share * spread.mean
            if point.passes > 1:
                self._variance[name] += (point.share * spread.standard_error()).square()
            totals = torch.stack(spread.totals)
            self._deviations[name].extend(point.share * (totals - totals.mean(0)))
            if self._points is not None:
                self._points[name].add(spread.mean.clone())
        if self.bias is None or point.bias is None:
            self.bias = None
        else:
            for name, one in point.bias.items():
                self.bias[name] += point.share * one
        self.share += point.share
        self.seen = point.adjoints
        self._passes.append(point.passes)
        if self.kept is not None:
            self.kept.append(point)

    @property
    def replicates(self) -> int:
        """How many independent replicates the error is told by: points or passes."""
        return sum(self._passes) if self._by_passes else len(self._passes)

    @property
    def degrees_of_freedom(self) -> int:
        """How many independent deviations tell the error; none for a single pass."""
        return sum(n - 1 for n in self._passes) if self._by_passes else len(self._passes) - 1

    def variance(self, name: str) -> torch.Tensor:
        """Return the variance of ``mean``, elementwise."""
        if self._by_passes or self._points is None:
            return self._variance[name]
        return (self.share * self._points[name].standard_error()).square()

    def rows(self, name: str) -> torch.Tensor:
        """Return ``(replicates, C)`` channel totals whose mean, and whose mean's covariance, are those of the sum.

        For a single point these are the totals of its passes.
        """
        if self._by_passes or self._points is None:
            deviations, each = torch.stack(self._deviations[name]), self._passes[0]
        else:
            totals = torch.stack(self._points[name].totals)
            deviations, each = self.share * (totals - totals.mean(0)), len(totals)
        count = len(deviations)
        # The passes of a point deviate from its own mean: all rows from the mean of all would count too little.
        stretch = math.sqrt(count * (count - 1) / (each * (each - 1))) if each > 1 else 0.0
        return channel_totals(self.mean[name]) + stretch * deviations

    @property
    def _by_passes(self) -> bool:
        return self._points is None or len(self._passes) == 1


class Gradients:
    """Takes gradients at points, for several metrics at once: each point is rendered once for all of them.

    Parameters
    ----------
    renderer
        As for every attribution method.
    metrics
        Whose gradients are taken.
    budget
        How samples are split over points and passes.
    bar
        Moves on by one with every rendering and with every backward pass.
    """

    def __init__(
        self, renderer: Any, metrics: Sequence[TargetedMetric], budget: Budget, bar: tqdm[Any]
    ) -> None:
        self.renderer = renderer
        self.metrics = metrics
        self.budget = budget
        self.bar = bar
        self.image = torch.zeros(())  # of the last point
        # Samples per pixel that were added to let a metric see enough.
        self.extra = 0
        # A renderer that cannot replay its backward pass with another seed is called twice.
        self._replays = "seed_grad" in inspect.signature(getattr(renderer, "forward", renderer)).parameters

    def at(self, index: int, point: Point) -> tuple[list[PointGradient], bool]:
        """Take the gradients at a point, the number ``index`` of the budget.

        Returns
        -------
        found
            One for each metric; with the passes that were finished.
        interrupted
            Whether Ctrl-C ended it before its last pass.
        """
        leaves = {name: value.detach().clone().requires_grad_() for name, value in point.values.items()}
        images, graphs = self._render(index, leaves)
        self.image = torch.stack(images).mean(0)
        found = [
            PointGradient({name: Spread(value) for name, value in leaves.items()}, adjoints, point.share)
            for adjoints in self._seen(index, point.values, images)
        ]
        try:
            for number, graph in enumerate(graphs):
                pulled = [_pull_back(graph, leaves, one.adjoints.passes[number], point) for one in found]
                for one, gradients in zip(found, pulled, strict=True):
                    for name, gradient in gradients.items():
                        one.spreads[name].add(gradient)
                self.bar.update()
            for one in found:
                one.bias = _bias(graphs[0], leaves, one.adjoints, point)
        except KeyboardInterrupt:
            return found, True
        return found, False

    def _render(
        self, index: int, leaves: dict[str, torch.Tensor]
    ) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
        """Render every pass: the images that the metric sees, and the same as graphs to be differentiated."""
        spp = self.budget.spp[index]
        images, graphs = [], []
        for seed, seed_grad in zip(self.budget.seeds[index], self.budget.gradient_seeds[index], strict=True):
            if self._replays:
                graph = self.renderer(leaves, seed=seed, spp=spp, seed_grad=seed_grad)
                images.append(graph.detach())
            else:
                graph = self.renderer(leaves, seed=seed_grad, spp=spp)
                images.append(self.renderer(leaves, seed=seed, spp=spp).detach())
            graphs.append(graph)
            self.bar.update()
        return images, graphs

    def _seen(self, index: int, values: Tensors, images: list[torch.Tensor]) -> list[Adjoints]:
        """Return what each metric makes of the images, or of better ones where it needs them."""
        adjoints = [jackknife(metric, images) for metric in self.metrics]
        spp = self.budget.spp[index]
        few = spp is not None and spp * len(images) < LEAST_SEEN and len(self.budget.spp) > 1
        if not few or all(one.is_linear for one in adjoints):
            return adjoints
        enough = math.ceil(LEAST_SEEN / len(images))
        self.extra += enough * len(images)
        with torch.no_grad():
            better = [self.renderer(values, seed=seed, spp=enough) for seed in self.budget.seeds[index]]
        return [
            seen if seen.is_linear else jackknife(metric, better)
            for metric, seen in zip(self.metrics, adjoints, strict=True)
        ]


def sum_gradients(
    gradients: Gradients, points: Iterable[Point], *, at_random: bool = False, keep: bool = False
) -> tuple[list[GradientSum], bool]:
    """Sum the gradients of points, one sum for each metric; and say whether Ctrl-C ended it early.

    What is finished then is kept: the points before the last, or the passes of the first.
    """
    sums: list[GradientSum] = []
    try:
        for index, point in enumerate(points):
            found, interrupted = gradients.at(index, point)
            if interrupted and (index or not all(one.passes for one in found)):
                raise KeyboardInterrupt
            sums = sums or [GradientSum(point.values, at_random=at_random, keep=keep) for _ in found]
            for one, into in zip(found, sums, strict=True):
                into.add(one)
            if interrupted:
                return sums, True
    except KeyboardInterrupt:
        if not sums:
            raise
        return sums, True
    return sums, False


def input_values(renderer: Any, inputs: Tensors | None) -> dict[str, torch.Tensor]:
    """Return the values to attribute to: those given, or the renderer's own."""
    values = getattr(renderer, "inputs", None) if inputs is None else inputs
    if not values:
        raise SceneCaptumError(
            "There is nothing to attribute to: give inputs=, a dict from parameter name to tensor."
        )
    for name, value in values.items():
        if not isinstance(value, torch.Tensor) or not value.is_floating_point():
            came = value.dtype if isinstance(value, torch.Tensor) else type(value).__name__
            raise SceneCaptumError(f"{name!r} must be a floating point tensor, not {came}.")
    return {name: value.detach() for name, value in values.items()}


def _pull_back(
    graph: torch.Tensor, leaves: dict[str, torch.Tensor], adjoint: torch.Tensor, point: Point
) -> dict[str, torch.Tensor]:
    gradients = torch.autograd.grad(
        graph, list(leaves.values()), adjoint, retain_graph=True, allow_unused=True
    )
    return {
        name: torch.zeros_like(leaf) if gradient is None else gradient * point.factors.get(name, 1)
        for (name, leaf), gradient in zip(leaves.items(), gradients, strict=True)
    }


def _bias(
    graph: torch.Tensor, leaves: dict[str, torch.Tensor], adjoints: Adjoints, point: Point
) -> dict[str, torch.Tensor] | None:
    """Return the bias that the image's noise would have put into each gradient, from the samples of one pass."""
    if adjoints.bias is None:
        return None
    if adjoints.bias_adjoint is None:
        return {name: leaf.new_zeros(()).expand_as(leaf) for name, leaf in leaves.items()}
    return _pull_back(graph, leaves, adjoints.bias_adjoint, point)
