"""Weighted sums of gradients over points of parameter space: the core of every gradient method."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import torch

from ..errors import SceneCaptumError
from ..finite import NotFiniteError, check_gradient, check_image, error_context
from ..protocols import Capabilities, Renderer, RenderPass
from ._adjoints import Adjoints
from ._autograd import gradients_enabled
from ._image_info import pixel_error, relative_noise
from ._jackknife import adjoints_if_linear, jackknife, with_image_transform
from ._linearity import is_linear
from ._metric import TargetedMetric
from ._metric_image import TransformSelector
from ._progress import Progress
from ._replicates import (
    NOISY_PICTURE_RATIO,
    PICTURE_RATIO,
    SMOOTHED_PICTURE_RATIO,
    Budget,
    ReplicateStatistics,
    begin_passes,
    channel_totals,
    dot,
    extra_image_seeds,
    render_images,
)

Tensors = Mapping[str, torch.Tensor]

# Minimum samples per pixel of the metric image at each of several points, for non-linear metrics. With fewer, the
# bias of the metric's derivative is larger than the jackknife can remove.
MIN_METRIC_SPP = 16

Graph = Callable[[], torch.Tensor]  # returns the image of a replicate with its graph


@dataclass(frozen=True)
class Point:
    """A point of parameter space where the gradient is evaluated."""

    values: Tensors
    weight: float = 1.0  # in the sum; the weights of all points sum to 1
    factors: Tensors = field(default_factory=dict)  # of the gradients, elementwise; missing names mean 1
    settled: frozenset[str] = frozenset()  # the parameters that are not differentiated any more


def interpolated_point(start: Tensors, end: Tensors, fraction: float, weight: float) -> Point:
    """Return a point on the line from ``start`` to ``end``, whose gradient is multiplied by ``end − start``."""
    # lerp stays within the interval despite rounding: its ends may be physical bounds.
    values = {name: torch.lerp(start[name], end[name], fraction) for name in end}
    return Point(values, weight, {name: end[name] - start[name] for name in end})


@dataclass
class PointGradient:
    """The gradients at a point, times its factors."""

    statistics: dict[str, ReplicateStatistics]  # mean and standard error over the replicates
    adjoints: Adjoints  # the metric's value and adjoint images at the point
    weight: float  # in a sum
    spp: int = 1  # of each replicate, or 1 for the renderer's default
    # Due to the noise of the images and to the denoiser, ``(2, …)``; missing names mean 0, None unknown.
    biases: dict[str, torch.Tensor] | None = None

    @property
    def replicates(self) -> int:
        """Number of finished replicates."""
        return min(len(statistics.totals) for statistics in self.statistics.values())


class GradientSum:
    """Running weighted sum of the gradients at points.

    The error is estimated from the replicates at points that have several. Points with a single replicate are
    assumed to have the same noise, scaled by their weight and samples. For random points, the error is estimated
    from the variance between points, which includes that of the replicates.

    ``values`` define the names and shapes; ``random_points`` are independent random samples.
    """

    def __init__(self, values: Tensors, *, random_points: bool = False, keep_points: bool = False) -> None:
        # Of the sum, as those of a point; None if unknown.
        self.biases: dict[str, torch.Tensor] | None = {
            name: value.new_zeros(()).expand(2, *value.shape) for name, value in values.items()
        }
        self.weight = 0.0  # sum of the weights so far: below 1 after an interruption
        self.adjoints: Adjoints | None = None  # at the last point
        self.points: list[PointGradient] | None = [] if keep_points else None
        self.totals: list[dict[str, list[torch.Tensor]]] = []  # of the replicates of each point
        self._counts: list[int] = []  # replicates of each point
        self._sum: dict[str, torch.Tensor] = {}
        self._error: dict[str, torch.Tensor] = {}
        self._deviations: dict[str, list[torch.Tensor]] = {name: [] for name in values}
        self._settled_weight = dict.fromkeys(values, 0.0)  # of the points that leave out a parameter
        self._variances: dict[str, list[float]] = {name: [] for name in values}  # of each point
        self._product_variance: dict[str, float] = {}  # of the sums of gradient × value of textures
        # Variance of all points, and of those with several replicates, in units of the variance of one sample.
        self._total_variance = self._measured_variance = 0.0
        self._between_points = {name: ReplicateStatistics() for name in values} if random_points else None

    def add(self, point: PointGradient) -> None:
        """Add a point; after an interruption it may have fewer replicates."""
        for known in ("degrees_of_freedom", "mean", "bias"):  # those of the points so far
            self.__dict__.pop(known, None)
        replicates = point.replicates
        self.weight += point.weight
        self.adjoints = point.adjoints
        self._counts.append(replicates)
        self.totals.append({name: statistics.totals for name, statistics in point.statistics.items()})
        variance = point.weight**2 / (replicates * point.spp)
        self._total_variance += variance
        self._measured_variance += variance if replicates > 1 else 0.0
        for name, statistics in point.statistics.items():
            if self._between_points is None:
                self._sum[name] = _added(self._sum.get(name), statistics.mean, point.weight)
            else:
                self._between_points[name].add(statistics.mean)
            if replicates > 1 and self._error_from_replicates:
                error = scaled(statistics.error, point.weight)
                self._error[name] = error.hypot(self._error[name]) if name in self._error else error
                totals = torch.stack(statistics.totals)
                scale = point.weight / math.sqrt(replicates * (replicates - 1))
                deviations = scale * (totals - totals.mean(0))
                self._deviations[name].extend(deviations)
                self._variances[name].append(deviations.square().sum().item())
                if statistics.products:
                    products = scale * torch.tensor(statistics.products, dtype=torch.float64)
                    variance_here = (products - products.mean()).square().sum().item()
                    self._product_variance[name] = self._product_variance.get(name, 0.0) + variance_here
        for name in self._deviations.keys() - point.statistics.keys():
            self._leave_out(name, point.weight, replicates)
        if self.biases is None or point.biases is None:
            self.biases = None
        else:
            for name, biases in point.biases.items():
                self.biases[name] = self.biases[name].add(biases, alpha=point.weight)
        if self.points is not None:
            self.points.append(point)

    def _leave_out(self, name: str, weight: float, replicates: int) -> None:
        """Note that a point has no gradient of a parameter: its sum so far stands for that as well."""
        self._settled_weight[name] += weight
        self._variances[name].append(0.0)
        zeros = torch.zeros_like(self._deviations[name][0])
        self._deviations[name].extend([zeros] * replicates)

    def _growth(self, name: str) -> float:
        """Return the factor from the sum over the points that have a parameter to that over all points."""
        return self.weight / (self.weight - self._settled_weight[name]) if self._settled_weight[name] else 1.0

    def share_of_samples(self, name: str) -> float:
        """Return the part of the samples that the gradient of a parameter has: less than 1 if it was left out."""
        return 1 / self._growth(name)

    @cached_property
    def mean(self) -> dict[str, torch.Tensor]:
        """The weighted sum by parameter name."""
        if self._between_points is None:
            return {name: scaled(value, self._growth(name)) for name, value in self._sum.items()}
        return {name: self.weight * points.mean for name, points in self._between_points.items()}

    @cached_property
    def bias(self) -> dict[str, torch.Tensor] | None:
        """The bias of the sum, an error; None if unknown.

        The sizes of the two biases add up: both may be of the same noise, and the sign of what remains of one that
        was removed is not known. The sign is that of the larger one.
        """
        if self.biases is None:
            return None
        larger = {name: torch.where(a.abs() > b.abs(), a, b) for name, (a, b) in self.biases.items()}
        return {name: (a.abs() + b.abs()).copysign(larger[name]) for name, (a, b) in self.biases.items()}

    @property
    def replicates(self) -> int:
        """Number of independent replicates behind the error: points if these are random, replicates otherwise."""
        if not self._error_from_replicates:
            return len(self._counts)
        return sum(n for n in self._counts if n > 1) or sum(self._counts)

    @cached_property
    def degrees_of_freedom(self) -> int:
        """Effective degrees of freedom of the error; 0 for a single replicate.

        If the points contribute unequally to the variance, these are fewer (Welch, 1947). The contributions are
        averaged over the parameters, because with few replicates they cannot be estimated for each.
        """
        if not self._error_from_replicates:
            return len(self._counts) - 1
        degrees = torch.tensor([n - 1.0 for n in self._counts if n > 1])
        variances = [torch.tensor(v, dtype=torch.float64) for v in self._variances.values() if sum(v) > 0]
        if not variances:
            return int(degrees.sum())
        fraction = torch.stack([variance / variance.sum() for variance in variances]).mean(0)
        return max(1, round(1 / (fraction.square() / degrees).sum().item()))

    def error(self, name: str) -> torch.Tensor:
        """Return the elementwise standard error of ``mean``."""
        if self._error_from_replicates or self._between_points is None:
            scale = self._growth(name) * math.sqrt(self._total_variance / self._measured_variance)
            return scaled(self._error[name], scale)
        return scaled(self._between_points[name].error, self.weight)

    def product_error(self, name: str) -> float | None:
        """Return the standard error of the sum of gradient × value of a texture, if all points have its values.

        The texels of a replicate share its paths, so it does not follow from the errors of the texels.
        """
        if self._between_points is not None or name not in self._product_variance:
            return None
        scale = self._growth(name) * math.sqrt(self._total_variance / self._measured_variance)
        return scale * math.sqrt(self._product_variance[name])

    def rows(self, name: str) -> torch.Tensor:
        """Return ``(replicates, C)`` channel totals that have the mean and the covariance of the mean of the sum.

        For a single point these are the totals of its replicates.
        """
        mean = channel_totals(self.mean[name]).double()
        if not self.degrees_of_freedom:
            return mean[None]
        deviations = self.deviations(name)
        count = len(deviations)
        # Deviations are from the mean of each point, so rescale them as deviations of all rows from one mean.
        return mean + math.sqrt(count * (count - 1)) * deviations

    def deviations(self, name: str) -> torch.Tensor:
        """Return ``(replicates, C)`` deviations of channel totals whose squares sum to its variance."""
        if self._error_from_replicates or self._between_points is None:
            scale = self._growth(name) * math.sqrt(self._total_variance / self._measured_variance)
            return scale * torch.stack(self._deviations[name])
        totals = torch.stack(self._between_points[name].totals)
        count = len(totals)
        return self.weight / math.sqrt(count * (count - 1)) * (totals - totals.mean(0))

    @property
    def _error_from_replicates(self) -> bool:
        return self._between_points is None or len(self._counts) == 1


def _added(total: torch.Tensor | None, value: torch.Tensor, weight: float) -> torch.Tensor:
    """Return ``total + weight · value``, which may be the value itself."""
    return scaled(value, weight) if total is None else total.add(value, alpha=weight)


def scaled(value: torch.Tensor, factor: float) -> torch.Tensor:
    """Return ``factor · value``, which may be the value itself: textures are large."""
    return value if factor == 1 else factor * value


class GradientEstimator:
    """Estimates gradients at points, for several metrics at once: each point is rendered once for all metrics.

    The ``bar`` is updated after every render and every backward pass.
    """

    def __init__(
        self,
        renderer: Renderer,
        metrics: Sequence[TargetedMetric],
        budget: Budget,
        transform_selector: TransformSelector,
        bar: Progress,
    ) -> None:
        self.renderer = renderer
        self.metrics = metrics
        self.budget = budget
        self.transform_selector = transform_selector
        self.bar = bar
        self.image = torch.zeros(())  # mean image of the last point
        self.pixel_error: float | None = None  # of that image
        self.pixel_noise: float | None = None  # the same, relative to each pixel
        self.image_spp: int | None = None  # of each of its images
        self.extra_spp = 0  # added for the metric images, over all points
        self._first_adjoints: list[Adjoints] = []
        # A renderer without seed_grad is called for each image, and again for each gradient of it.
        self._render_with_seed_grad = Capabilities(renderer).with_seed_grad

    @property
    def total_image_spp(self) -> int | None:
        """Samples per pixel in all images of a single point, or None for the renderer's default."""
        total = self.budget.total
        return None if total is None else total + self.extra_spp

    def spp_for(self, picture: float) -> float:
        """Return the ``spp`` from which on the pictures of several points have this many samples in all.

        A point that has fewer replicates than others, or fewer samples than a metric needs, gets pictures of its
        own; see ``_evaluate_metrics``.
        """
        replicates = self.budget.replicates
        own = sum(count < max(replicates) for count in replicates) / self.n_points
        least = MIN_METRIC_SPP * self.n_points
        return picture - least if picture <= (1 + own) * least else picture / (1 + own)

    def picture_spp_for(self, picture: float) -> float:
        """Return the ``picture_spp`` from which on the pictures of several points have this many samples in all.

        If it is more than ``spp``, every point gets pictures of its own.
        """
        total = self.budget.total or 0
        return max(picture - total, total + 1)

    @property
    def is_linear(self) -> bool:
        """Whether all metrics are linear, as far as they were evaluated."""
        return all(adjoints.is_linear for adjoints in self._first_adjoints)

    @property
    def n_points(self) -> int:
        """Number of points."""
        return len(self.budget.spp)

    @gradients_enabled()
    def estimate(self, index: int, point: Point) -> tuple[list[PointGradient], bool]:
        """Estimate the gradients at a point, number ``index`` of the budget.

        Returns those of each metric, from the finished replicates, and whether Ctrl-C was pressed before the last
        backward pass finished.
        """
        values = self._held(point)
        leaves = {name: value.requires_grad_() for name, value in values.items() if name not in point.settled}
        images, graphs = self._render(index, values)
        images = self._add_image_samples(index, point.values, images)
        self.image = torch.stack(images).mean(0)
        self.pixel_error, self.pixel_noise = pixel_error(images), relative_noise(images)
        spp = self.budget.spp[index] or 1
        results = [
            PointGradient({name: ReplicateStatistics() for name in leaves}, adjoints, point.weight, spp)
            for adjoints in self._evaluate_metrics(index, point.values, images)
        ]
        begun, bias_begun = self._begin_backward(index, values, leaves, results)
        try:
            for number, (graph, wait) in enumerate(zip(graphs, begun, strict=True)):
                if self._is_out_of_time(number):
                    break
                with error_context(f"In backward pass {number + 1} of {len(graphs)}"):
                    wait()
                    _add_replicate(results, number, graph, leaves, point)
                self.bar.differentiated()
            for result, wait in zip(results, bias_begun, strict=True):
                wait()
                result.biases = _biases(graphs[0], leaves, result.adjoints, point)
        except KeyboardInterrupt:
            return results, True
        return results, False

    def pictures(self, index: int, point: Point) -> tuple[list[torch.Tensor], list[TargetedMetric]]:
        """Return the images from which ``estimate`` evaluates the metrics at a single point, without gradients.

        Also return the metrics with the transform of these images.
        """
        values, spp = self._held(point), self.budget.spp[index]
        seeds = self.budget.seeds[index]
        images = self._add_image_samples(
            index, point.values, render_images(self.renderer, values, seeds, spp)
        )
        return images, self._transformed_metrics(images)

    def _begin_backward(
        self,
        index: int,
        values: dict[str, torch.Tensor],
        leaves: Collection[str],
        results: Sequence[PointGradient],
    ) -> tuple[Sequence[Callable[[], object]], Sequence[Callable[[], object]]]:
        """Begin all backward passes; return a function for each replicate, and one for each bias, that waits."""
        options, tracked = self._options(index), tuple(leaves)
        adjoints = [result.adjoints.per_replicate[n] for n in range(len(options)) for result in results]
        passes = [
            RenderPass(options[n // len(results)], adjoint, tracked) for n, adjoint in enumerate(adjoints)
        ]
        biases = [result.adjoints.bias_adjoints for result in results]
        passes += [RenderPass(options[0], bias, tracked) for each in biases for bias in each]
        waits = iter(begin_passes(self.renderer, values, passes))
        replicates = [[next(waits) for _ in results] for _ in options]
        bias_waits = [partial(_call_all, [next(waits) for _ in each]) for each in biases]
        return [partial(_call_all, each) for each in replicates], bias_waits

    def _options(self, index: int) -> list[dict[str, Any]]:
        """Return the options of the render of each replicate of a point."""
        spp, with_seed_grad = self.budget.spp[index], self._render_with_seed_grad is not None
        # A point may have more image seeds than replicates.
        seeds = zip(self.budget.gradient_seeds[index], self.budget.seeds[index], strict=False)
        return [
            {"seed": seed, "spp": spp, "seed_grad": seed_grad}
            if with_seed_grad
            else {"seed": seed_grad, "spp": spp}
            for seed_grad, seed in seeds
        ]

    def _held(self, point: Point) -> dict[str, torch.Tensor]:
        """Return the values of a point in tensors without a graph."""
        hold = Capabilities(self.renderer).held_values
        values = point.values if hold is None else hold(point.values)
        return {name: value.detach() for name, value in values.items()}

    def _is_out_of_time(self, finished: int) -> bool:
        """Whether there is no time for another backward pass."""
        return False

    def _render(self, index: int, values: dict[str, torch.Tensor]) -> tuple[list[torch.Tensor], list[Graph]]:
        """Render every replicate; return the images for the metric and the images to differentiate."""
        spp = self.budget.spp[index]
        images: list[torch.Tensor] = []
        graphs: list[Graph] = []
        # A point may have more image seeds than replicates.
        seeds = list(zip(self.budget.gradient_seeds[index], self.budget.seeds[index], strict=False))
        begun = begin_passes(self.renderer, values, [RenderPass(one) for one in self._options(index)])
        for number, ((seed_grad, seed), wait) in enumerate(zip(seeds, begun, strict=True), 1):
            with error_context(f"In replicate {number} of {len(seeds)}"):
                wait()
                if self._render_with_seed_grad is not None:
                    image = self._render_with_seed_grad(values, seed=seed, spp=spp, seed_grad=seed_grad)
                    graphs.append(partial(_same, image))
                else:
                    with torch.no_grad():
                        image = self.renderer(values, seed=seed, spp=spp)
                    # Not before it is differentiated: a graph of dr.wrap lasts only until the next one.
                    graphs.append(partial(self.renderer, values, seed=seed_grad, spp=spp))
                images.append(image.detach())
                check_image(images[-1], f"The render with seed {seed}")
            self.bar.rendered()
        return images, graphs

    def _evaluate_metrics(self, index: int, values: Tensors, images: list[torch.Tensor]) -> list[Adjoints]:
        """Evaluate each metric on the images; render images with more samples for the metrics that need them."""
        results: list[Adjoints | None]
        seeds = self.budget.seeds[index]

        def evaluate(metric: TargetedMetric, images: list[torch.Tensor]) -> Adjoints:
            return jackknife(metric, images, draws=metric.split_draws(seeds, self.n_points))

        if len(images) == len(seeds):
            results = [evaluate(metric, images) for metric in self._transformed_metrics(images)]
        else:
            known = zip(self.metrics, self._first_adjoints, strict=True)
            results = [adjoints_if_linear(metric, first, images[0]) for metric, first in known]
        spp = self.budget.spp[index]
        too_few = spp is not None and spp * len(images) < self._min_metric_spp(index) and self.n_points > 1
        if any(result is None or (too_few and not result.is_linear) for result in results):
            metric_images = self._render_metric_images(index, values, images)
            results = [
                result if result is not None and result.is_linear else evaluate(metric, metric_images)
                for metric, result in zip(self._transformed_metrics(metric_images), results, strict=True)
            ]
        adjoints = [_match_replicates(result, len(images)) for result in results if result is not None]
        self._first_adjoints = self._first_adjoints or adjoints
        return adjoints

    def _transformed_metrics(self, images: list[torch.Tensor]) -> list[TargetedMetric]:
        return with_image_transform(self.metrics, images, self.transform_selector)

    def _add_image_samples(
        self, index: int, values: Tensors, images: list[torch.Tensor]
    ) -> list[torch.Tensor]:
        """Add primal samples to the images of a single point if a metric is not linear.

        They cost a third of a sample of the backward pass.
        """
        spp = self.budget.spp[index]
        self.image_spp = spp
        if spp is None or self.n_points > 1 or all(is_linear(metric, images) for metric in self.metrics):
            return images
        more = math.ceil((self._choose_ratio(images) - 1) * spp)
        if more == 0:
            return images
        self.image_spp = spp + more
        seeds = extra_image_seeds(self.budget.seeds[index][: len(images)])
        added = render_images(self.renderer, values, seeds, more)
        self.extra_spp += more * len(images)
        return [torch.lerp(image, new, more / (spp + more)) for image, new in zip(images, added, strict=True)]

    def _choose_ratio(self, images: Sequence[torch.Tensor]) -> float:
        """Return the samples of the metric image per sample of the backward pass."""
        if self.budget.picture_ratio is not None:
            return self.budget.picture_ratio
        return self.default_ratio(denoises=self.transform_selector.select(images).denoises)

    def default_ratio(self, *, denoises: bool) -> float:
        """Return the samples of the image of a single point per sample of the backward pass, by default."""
        if self.metrics[0].is_smoothed:
            return SMOOTHED_PICTURE_RATIO
        return NOISY_PICTURE_RATIO if denoises else PICTURE_RATIO

    def _min_metric_spp(self, index: int) -> int:
        """Return the minimum samples per pixel for a non-linear metric at one of several points."""
        spp, ratio = self.budget.spp[index], self.budget.picture_ratio
        requested = 0 if spp is None or ratio is None else spp * ratio * self.budget.replicates[index]
        return max(MIN_METRIC_SPP, math.ceil(requested))

    def _render_metric_images(
        self, index: int, values: Tensors, images: list[torch.Tensor]
    ) -> list[torch.Tensor]:
        """Render an image for each seed with enough samples for a non-linear metric."""
        seeds, spp = self.budget.seeds[index], self.budget.spp[index]
        if spp is not None:
            spp = math.ceil(max(self._min_metric_spp(index), spp * len(images)) / len(seeds))
            self.extra_spp += spp * len(seeds)
        return render_images(self.renderer, values, seeds, spp)


def _match_replicates(adjoints: Adjoints, replicates: int) -> Adjoints:
    """Return adjoints for this number of replicates; a single replicate gets the mean."""
    if len(adjoints.per_replicate) == replicates:
        return adjoints
    return dataclasses.replace(adjoints, per_replicate=(torch.stack(adjoints.per_replicate).mean(0),))


def sum_gradients(
    gradients: GradientEstimator,
    points: Iterable[Point],
    *,
    random_points: bool = False,
    keep_points: bool = False,
) -> tuple[list[GradientSum], bool]:
    """Return the sum of the gradients at all points for each metric, and whether Ctrl-C interrupted it.

    After an interruption the sum has the finished points, or the finished replicates of the first point.
    """
    sums: list[GradientSum] = []
    try:
        for index, point in enumerate(points):
            try:
                estimates, interrupted = gradients.estimate(index, point)
            except NotFiniteError:
                if point.weight:
                    raise
                continue  # only used for an error estimate
            if interrupted and (index or not all(estimate.replicates for estimate in estimates)):
                raise KeyboardInterrupt
            sums = sums or [
                GradientSum(point.values, random_points=random_points, keep_points=keep_points)
                for _ in estimates
            ]
            for total, estimate in zip(sums, estimates, strict=True):
                total.add(estimate)
            if interrupted:
                return sums, True
    except KeyboardInterrupt:
        if not sums:
            raise
        return sums, True
    return sums, False


def input_values(renderer: Renderer, inputs: Tensors | None) -> dict[str, torch.Tensor]:
    """Return the values to attribute to: ``inputs``, or those of the renderer."""
    values = Capabilities(renderer).inputs if inputs is None else inputs
    if values is not None and not isinstance(values, Mapping):
        raise SceneCaptumError(
            "inputs must be a dict from parameter name to tensor, such as renderer.inputs, not "
            f"{type(values).__name__}."
        )
    if not values:
        raise SceneCaptumError(
            "There is nothing to attribute to: give inputs=, a dict from parameter name to tensor."
        )
    for name, value in values.items():
        if not isinstance(value, torch.Tensor) or not value.is_floating_point():
            came = value.dtype if isinstance(value, torch.Tensor) else type(value).__name__
            raise SceneCaptumError(
                f"{name!r} must be a floating point tensor, not {came}: torch.tensor([0.2, 0.2, 0.2]) is one."
            )
    return {name: value.detach() for name, value in values.items()}


def require_memory(renderer: Renderer, spp: Iterable[int | None], pictures: int) -> None:
    """Raise if this number of images will not fit into memory at the same time, where the renderer can predict it.

    The message suggests settings that would fit.
    """
    check = Capabilities(renderer).require_memory
    if check is not None:
        check(spp=max(count or 1 for count in spp), pictures=pictures)


def _add_replicate(
    results: Sequence[PointGradient],
    number: int,
    graph: Graph,
    leaves: dict[str, torch.Tensor],
    point: Point,
) -> None:
    """Add the gradients of a replicate to all results, or to none if this is interrupted.

    They are freed before the next backward pass needs the memory.
    """
    gradients = [vjp(graph(), leaves, result.adjoints.per_replicate[number], point) for result in results]
    # Finite totals show that all elements are finite.
    totals = [{name: channel_totals(gradient) for name, gradient in by_name.items()} for by_name in gradients]
    for by_name, own_totals in zip(gradients, totals, strict=True):
        for name in by_name:
            if not own_totals[name].isfinite().all():
                _check_gradient(name, by_name[name])
    for result, by_name, own_totals in zip(results, gradients, totals, strict=True):
        for name, gradient in by_name.items():
            result.statistics[name].add(gradient, own_totals[name])
            if gradient.ndim > 1:
                result.statistics[name].products.append(dot(gradient, leaves[name].detach()))


def _same(image: torch.Tensor) -> torch.Tensor:
    return image


def _do_nothing() -> None:
    pass


def _call_all(waits: Sequence[Callable[[], object]]) -> None:
    for wait in waits:
        wait()


def vjp(
    graph: torch.Tensor, leaves: dict[str, torch.Tensor], adjoint: torch.Tensor, point: Point
) -> dict[str, torch.Tensor]:
    """Return the gradients of ``⟨adjoint, image⟩`` times the factors of the point."""
    # Of a scalar: torch loads sympy for the first gradient of any other tensor, which takes half a second.
    product = (graph * adjoint).sum()
    gradients = torch.autograd.grad(product, list(leaves.values()), retain_graph=True, allow_unused=True)
    by_name = {
        name: torch.zeros_like(leaf) if gradient is None else gradient
        for (name, leaf), gradient in zip(leaves.items(), gradients, strict=True)
    }
    factors = {name: factor for name, factor in point.factors.items() if name in by_name}
    return {**by_name, **{name: by_name[name] * factor for name, factor in factors.items()}}


def _biases(
    graph: Graph, leaves: dict[str, torch.Tensor], adjoints: Adjoints, point: Point
) -> dict[str, torch.Tensor] | None:
    """Return the biases of each gradient, estimated with the samples of one replicate."""
    if adjoints.bias is None:
        return None
    parts = [vjp(graph(), leaves, adjoint, point) for adjoint in adjoints.bias_adjoints]
    for part in parts:
        for name, bias in part.items():
            _check_gradient(name, bias)
    if len(parts) == 1:  # not denoised
        parts.append({name: torch.zeros_like(bias) for name, bias in parts[0].items()})
    return {name: torch.stack([part[name] for part in parts]) for name in leaves} if parts else {}


def _check_gradient(name: str, gradient: torch.Tensor) -> None:
    check_gradient(name, gradient, "its adjoint image is finite")
