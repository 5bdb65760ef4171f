"""Weighted sums of gradients over points of parameter space: what every gradient method comes down to."""

from __future__ import annotations

import dataclasses
import inspect
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
from tqdm import tqdm

from .._finite import NotFiniteError, check_gradient, check_image, located
from ..errors import SceneCaptumError
from ._jackknife import Adjoints, is_linear, jackknife, still_linear, through_view
from ._metric import TargetedMetric
from ._passes import (
    NOISY_PICTURE_RATIO,
    PICTURE_RATIO,
    Budget,
    Spread,
    channel_totals,
    picture_seeds,
    pictures,
)
from ._view import Viewer

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

    ``spp`` are the samples per pixel of each pass, or 1 where the renderer decides.

    ``bias`` is what the image's noise would have put into them, 0 for a name that is missing, or None where that
    is not known.
    """

    spreads: dict[str, Spread]
    adjoints: Adjoints
    share: float
    spp: int = 1
    bias: dict[str, torch.Tensor] | None = None

    @property
    def passes(self) -> int:
        """How many passes are finished."""
        return min(len(spread.totals) for spread in self.spreads.values())


class GradientSum:
    """Running sum of the gradients of points, each weighted by its share.

    The error comes from the spread of the passes at those points that have several; those with a single pass are
    taken to be as noisy, for their share and their samples. Where the points are drawn at random the error comes
    from the spread of the points, which holds that of the passes as well.

    Attributes
    ----------
    bias
        What the image's noise would have put into the sum, or None.
    share
        The sum of the shares so far: below 1 where Ctrl-C ended it.
    seen
        What the metric made of the last point.
    kept
        All points, where they are to be kept.
    totals
        For each point the channel totals of its passes, by name.
    """

    def __init__(self, values: Tensors, *, at_random: bool = False, keep: bool = False) -> None:
        self.bias: dict[str, torch.Tensor] | None = {n: torch.zeros_like(v) for n, v in values.items()}
        self.share = 0.0
        self.seen: Adjoints | None = None
        self.kept: list[PointGradient] | None = [] if keep else None
        self.totals: list[dict[str, list[torch.Tensor]]] = []
        self._passes: list[int] = []
        self._sum = {name: torch.zeros_like(value) for name, value in values.items()}
        self._error = {name: torch.zeros_like(value) for name, value in values.items()}
        self._deviations: dict[str, list[torch.Tensor]] = {name: [] for name in values}
        self._noise: dict[str, list[float]] = {name: [] for name in values}  # of each point
        # How much of the variance is told by several passes, and how much there is, in units of that of a sample.
        self._told = self._whole = 0.0
        self._points = {name: Spread() for name in values} if at_random else None

    def add(self, point: PointGradient) -> None:
        """Take in a point, all of it or what Ctrl-C has left of it."""
        self.share += point.share
        self.seen = point.adjoints
        self._passes.append(point.passes)
        self.totals.append({name: spread.totals for name, spread in point.spreads.items()})
        of_a_sample = point.share**2 / (point.passes * point.spp)
        self._whole += of_a_sample
        self._told += of_a_sample if point.passes > 1 else 0.0
        for name, spread in point.spreads.items():
            if self._points is None:
                self._sum[name].add_(spread.mean, alpha=point.share)
            else:
                self._points[name].add(spread.mean)
            if point.passes > 1 and self._by_passes:
                self._error[name].hypot_(point.share * spread.error())
                totals = torch.stack(spread.totals)
                scale = point.share / math.sqrt(point.passes * (point.passes - 1))
                deviations = scale * (totals - totals.mean(0))
                self._deviations[name].extend(deviations)
                self._noise[name].append(deviations.square().sum().item())
        if self.bias is None or point.bias is None:
            self.bias = None
        else:
            for name, one in point.bias.items():
                self.bias[name].add_(one, alpha=point.share)
        if self.kept is not None:
            self.kept.append(point)

    @cached_property
    def mean(self) -> dict[str, torch.Tensor]:
        """By parameter name, elementwise: the sum, once the last point is in."""
        if self._points is None:
            return self._sum
        return {name: self.share * points.mean for name, points in self._points.items()}

    @property
    def replicates(self) -> int:
        """How many independent replicates the error is told by: points or passes."""
        if not self._by_passes:
            return len(self._passes)
        return sum(n for n in self._passes if n > 1) or sum(self._passes)

    @property
    def degrees_of_freedom(self) -> int:
        """How many independent deviations tell the error; none for a single pass.

        Where some points have more of the noise than others, these are fewer than there are (Welch, 1947). What
        part each has is the same for all parameters, as far as the noise of so few passes can tell.
        """
        if not self._by_passes:
            return len(self._passes) - 1
        free = torch.tensor([n - 1.0 for n in self._passes if n > 1])
        noise = [torch.tensor(one, dtype=torch.float64) for one in self._noise.values() if sum(one) > 0]
        if not noise:
            return int(free.sum())
        part = torch.stack([one / one.sum() for one in noise]).mean(0)
        return max(1, round(1 / (part.square() / free).sum().item()))

    def error(self, name: str) -> torch.Tensor:
        """Return the standard error of ``mean``, elementwise."""
        if self._by_passes or self._points is None:
            return math.sqrt(self._whole / self._told) * self._error[name]
        return self.share * self._points[name].error()

    def rows(self, name: str) -> torch.Tensor:
        """Return ``(replicates, C)`` channel totals whose mean, and whose mean's covariance, are those of the sum.

        For a single point these are the totals of its passes.
        """
        mean = channel_totals(self.mean[name]).double()
        if not self.degrees_of_freedom:
            return mean[None]
        deviations = self.deviations(name)
        count = len(deviations)
        # The passes of a point deviate from its own mean: all rows from the mean of all would count too little.
        return mean + math.sqrt(count * (count - 1)) * deviations

    def deviations(self, name: str) -> torch.Tensor:
        """Return ``(replicates, C)`` channel totals whose squares sum to the variance of those of the sum."""
        if self._by_passes or self._points is None:
            return math.sqrt(self._whole / self._told) * torch.stack(self._deviations[name])
        totals = torch.stack(self._points[name].totals)
        count = len(totals)
        return self.share / math.sqrt(count * (count - 1)) * (totals - totals.mean(0))

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
    viewer
        How metrics that are not linear see the pictures.
    bar
        Moves on by one with every rendering and with every backward pass.
    """

    def __init__(
        self,
        renderer: Any,
        metrics: Sequence[TargetedMetric],
        budget: Budget,
        viewer: Viewer,
        bar: tqdm[Any],
    ) -> None:
        self.renderer = renderer
        self.metrics = metrics
        self.budget = budget
        self.viewer = viewer
        self.bar = bar
        self.image = torch.zeros(())  # of the last point
        self.picture_spp: int | None = None  # of each picture of the last point
        # Samples per pixel that were added to let a metric see enough.
        self.extra = 0
        self._first: list[Adjoints] = []
        # A renderer that cannot replay its backward pass with another seed is called twice.
        self._replays = "seed_grad" in inspect.signature(getattr(renderer, "forward", renderer)).parameters

    @property
    def samples(self) -> int | None:
        """Samples per pixel of all pictures of a single point, or None where the renderer decides."""
        total = self.budget.total
        return None if total is None else total + self.extra

    @property
    def points(self) -> int:
        """At how many points gradients are taken."""
        return len(self.budget.spp)

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
        images = self._with_picture_samples(index, point.values, images)
        self.image = torch.stack(images).mean(0)
        found = [
            PointGradient(
                {name: Spread() for name in leaves}, adjoints, point.share, self.budget.spp[index] or 1
            )
            for adjoints in self._seen(index, point.values, images)
        ]
        try:
            for number, graph in enumerate(graphs):
                if self._is_late(number):
                    break
                with located(f"In backward pass {number + 1} of {len(graphs)}"):
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

    def _is_late(self, done: int) -> bool:
        """Whether there is no time for one more pass after those that are done."""
        return False

    def _render(
        self, index: int, leaves: dict[str, torch.Tensor]
    ) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
        """Render every pass: the images that the metric sees, and the same as graphs to be differentiated."""
        spp = self.budget.spp[index]
        images, graphs = [], []
        # A point may have more seeds for pictures than it has passes.
        seeds = list(zip(self.budget.gradient_seeds[index], self.budget.seeds[index], strict=False))
        for number, (seed_grad, seed) in enumerate(seeds, 1):
            with located(f"In pass {number} of {len(seeds)}"):
                if self._replays:
                    graph = self.renderer(leaves, seed=seed, spp=spp, seed_grad=seed_grad)
                    images.append(graph.detach())
                else:
                    graph = self.renderer(leaves, seed=seed_grad, spp=spp)
                    images.append(self.renderer(leaves, seed=seed, spp=spp).detach())
                check_image(images[-1], f"The render with seed {seed}")
            graphs.append(graph)
            self.bar.update()
        return images, graphs

    def _seen(self, index: int, values: Tensors, images: list[torch.Tensor]) -> list[Adjoints]:
        """Return what each metric makes of the images, or of more and better ones where it needs them."""
        found: list[Adjoints | None]
        if len(images) == len(self.budget.seeds[index]):
            found = [jackknife(metric, images) for metric in through_view(self.metrics, images, self.viewer)]
        else:
            found = [still_linear(*one, images[0]) for one in zip(self.metrics, self._first, strict=True)]
        spp = self.budget.spp[index]
        few = spp is not None and spp * len(images) < self._least(index) and len(self.budget.spp) > 1
        if any(one is None or (few and not one.is_linear) for one in found):
            better = self._better(index, values, images)
            found = [
                one if one is not None and one.is_linear else jackknife(metric, better)
                for metric, one in zip(through_view(self.metrics, better, self.viewer), found, strict=True)
            ]
        seen = [_for_passes(one, len(images)) for one in found if one is not None]
        self._first = self._first or seen
        return seen

    def _with_picture_samples(
        self, index: int, values: Tensors, images: list[torch.Tensor]
    ) -> list[torch.Tensor]:
        """Add samples to the pictures of a single point, without a graph, where a metric is not linear.

        They cost a third of what a sample of the backward pass costs.
        """
        spp = self.budget.spp[index]
        self.picture_spp = spp
        if spp is None or self.points > 1 or all(is_linear(one, images) for one in self.metrics):
            return images
        ratio = self.budget.picture_ratio
        if ratio is None:
            ratio = NOISY_PICTURE_RATIO if self.viewer.choose(images).denoises else PICTURE_RATIO
        more = math.ceil((ratio - 1) * spp)
        if more == 0:
            return images
        self.picture_spp = spp + more
        seeds = picture_seeds(self.budget.seeds[index][: len(images)])
        added = pictures(self.renderer, values, seeds, more)
        self.extra += more * len(images)
        return [torch.lerp(one, new, more / (spp + more)) for one, new in zip(images, added, strict=True)]

    def _least(self, index: int) -> int:
        """Return how many samples a metric that is not linear has to see at one of several points."""
        spp, ratio = self.budget.spp[index], self.budget.picture_ratio
        asked = 0 if spp is None or ratio is None else spp * ratio * self.budget.passes[index]
        return max(LEAST_SEEN, math.ceil(asked))

    def _better(self, index: int, values: Tensors, images: list[torch.Tensor]) -> list[torch.Tensor]:
        """Render a picture for each seed, with as many samples as a metric that is not linear has to see."""
        seeds, spp = self.budget.seeds[index], self.budget.spp[index]
        if spp is not None:
            spp = math.ceil(max(self._least(index), spp * len(images)) / len(seeds))
            self.extra += spp * len(seeds)
        return pictures(self.renderer, values, seeds, spp)


def _for_passes(adjoints: Adjoints, passes: int) -> Adjoints:
    """Return adjoints for so many passes: a single one takes the mean."""
    if len(adjoints.passes) == passes:
        return adjoints
    return dataclasses.replace(adjoints, passes=(torch.stack(adjoints.passes).mean(0),))


def sum_gradients(
    gradients: Gradients, points: Iterable[Point], *, at_random: bool = False, keep: bool = False
) -> tuple[list[GradientSum], bool]:
    """Sum the gradients of points, one sum for each metric; and say whether Ctrl-C ended it early.

    What is finished then is kept: the points before the last, or the passes of the first.
    """
    sums: list[GradientSum] = []
    try:
        for index, point in enumerate(points):
            try:
                found, interrupted = gradients.at(index, point)
            except NotFiniteError:
                if point.share:
                    raise
                continue  # it would only have told an error
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


def require_memory(renderer: Any, spp: Iterable[int | None], pictures: int) -> None:
    """Refuse what will not fit into memory, where the renderer can tell: so many pictures at the same time.

    Raises
    ------
    SceneCaptumError
        With settings that would fit.
    """
    if hasattr(renderer, "require_memory"):
        renderer.require_memory(spp=max(one or 1 for one in spp), pictures=pictures)


def _pull_back(
    graph: torch.Tensor, leaves: dict[str, torch.Tensor], adjoint: torch.Tensor, point: Point
) -> dict[str, torch.Tensor]:
    gradients = torch.autograd.grad(
        graph, list(leaves.values()), adjoint, retain_graph=True, allow_unused=True
    )
    found = {
        name: torch.zeros_like(leaf) if gradient is None else gradient
        for (name, leaf), gradient in zip(leaves.items(), gradients, strict=True)
    }
    for name, gradient in found.items():
        check_gradient(name, gradient, "its adjoint image is finite")
    return {**found, **{name: found[name] * factor for name, factor in point.factors.items()}}


def _bias(
    graph: torch.Tensor, leaves: dict[str, torch.Tensor], adjoints: Adjoints, point: Point
) -> dict[str, torch.Tensor] | None:
    """Return the bias that the image's noise would have put into each gradient, from the samples of one pass."""
    if adjoints.bias is None:
        return None
    if adjoints.bias_adjoint is None:
        return {}
    return _pull_back(graph, leaves, adjoints.bias_adjoint, point)
