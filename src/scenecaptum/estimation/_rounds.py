"""Gradients at one point, estimated in several rounds of replicates that are combined into one estimate."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

from ..checkpoint import Stopwatch, without_checkpoint
from ..protocols import Capabilities, Renderer
from ._adjoints import Adjoints
from ._autograd import gradients_enabled
from ._gradients import GradientEstimator, GradientSum, Point, PointGradient
from ._image_info import pixel_error, relative_noise
from ._jackknife import jackknife, with_image_transform
from ._linearity import is_linear
from ._metric import Draws, TargetedMetric
from ._metric_image import TransformSelector
from ._mix import Mix
from ._progress import Progress
from ._replicates import NOISY_PICTURE_RATIO, SMOOTHED_PICTURE_RATIO, Budget, render_images

MIN_SAMPLE_TIME_FRACTION = 0.5  # of a replicate's time that is spent on its samples
MAX_EXTRAPOLATION = 4  # do not extrapolate beyond 4× the largest timed spp
BACKWARD_COST_RATIO = 3  # cost of a backward pass relative to a render with the same number of samples
IMAGE_GROUPS = 4  # into which earlier images are merged, to bound memory and the cost of the jackknife


class TimeLimit:
    """A time limit, and the decisions that depend on it.

    The elapsed time includes the original render time of results from a checkpoint. Decisions that depend on the
    clock are stored in the renderer's checkpoint, if it has one, so that a resumed job repeats them; ``job``
    identifies it there.
    """

    def __init__(self, limit: float | None = None, renderer: Renderer | None = None, job: Any = ()) -> None:
        self.limit = limit  # seconds
        self._job = job
        self._checkpoint = Capabilities(renderer).checkpoint
        self._watch = Stopwatch(renderer)
        self._start = self.now()

    def now(self) -> float:
        """Return the current time in seconds."""
        return self._watch.now()

    def restart(self) -> float:
        """Restart the clock; return the seconds elapsed so far."""
        start, self._start = self._start, self.now()
        return self._start - start

    def remaining(self) -> float:
        """Return the remaining seconds."""
        return math.inf if self.limit is None else self.limit - (self.now() - self._start)

    def decide(self, what: Any, decide: Callable[[], Sequence[int] | None]) -> tuple[int, ...] | None:
        """Return a decision that depends on the clock, or the stored decision of an earlier run."""
        if self._checkpoint is None or self.limit is None:
            decision = decide()
            return None if decision is None else tuple(decision)
        stored: tuple[int, ...] | None = self._checkpoint.get_or_decide((self.limit, self._job, what), decide)
        return stored


class ReplicateTime:
    """Linear cost model of a replicate: fixed overhead plus cost per sample, from measured times."""

    def __init__(self) -> None:
        self._seconds: dict[int, float] = {}  # by spp; the latest measurement

    def record(self, spp: int, seconds: float) -> None:
        """Record a measured time."""
        self._seconds[spp] = seconds

    @property
    def shortest(self) -> float:
        """Seconds of a replicate with the smallest spp measured."""
        return self._seconds[min(self._seconds)]

    def max_spp(self, seconds: float) -> int:
        """Return the samples per pixel that a replicate can have in a time, at least 1.

        With a single measurement the overhead is assumed to be 0. With several, the cost per sample is the slope,
        but at least half of the cost without overhead.
        """
        low, high = min(self._seconds), max(self._seconds)
        longest = self._seconds[high]
        per_sample = longest / high
        if high > low:
            slope = (longest - self._seconds[low]) / (high - low)
            per_sample = max(MIN_SAMPLE_TIME_FRACTION * per_sample, slope)
        spp = int(high + (seconds - longest) / per_sample) if per_sample > 0 else high
        return min(max(1, spp), MAX_EXTRAPOLATION * high)


class RoundSum(GradientSum):
    """Running sum of the gradients of rounds, weighted by their samples.

    Inverse-variance weights would favour rounds that miss rare bright paths.
    """

    def add(self, point: PointGradient) -> None:
        """Add a round; its biases replace the previous ones, since they are based on the images of all rounds."""
        before, weight = self.biases, self.weight
        super().add(point)
        if self.biases is not None and point.biases is not None:
            self.biases = {
                name: self.weight * point.biases[name] if name in point.biases else torch.zeros_like(value)
                for name, value in self.biases.items()
            }
        if self.biases is not None and before is not None and weight:
            settled = self._deviations.keys() - point.statistics.keys()
            self.biases |= {name: before[name] * (self.weight / weight) for name in settled}


class Rounds(GradientEstimator):
    """Estimates the gradients at a point in rounds; metrics are evaluated on the images of all rounds so far.

    Let ``a_r`` be the bias-corrected adjoint image of a metric after round ``r``, from ``N_r`` samples per pixel.
    Round ``r`` propagates ``(N_r a_r − N_{r−1} a_{r−1}) / (N_r − N_{r−1})``, so that all rounds together, weighted
    by their samples, have propagated ``a_r``, however noisy the images of the first rounds were. To first order
    this is the adjoint of the round's own images, so that rounds are independent and their variances add up. A
    round stops early if there is no time for another backward pass.
    """

    def __init__(
        self,
        renderer: Renderer,
        metrics: Sequence[TargetedMetric],
        transform_selector: TransformSelector,
        bar: Progress,
        *,
        seed: int,
        time: TimeLimit,
        picture_ratio: float | None = None,
    ) -> None:
        super().__init__(renderer, metrics, Budget((), (), (), picture_ratio), transform_selector, bar)
        self._seed = seed
        self._time = time
        self.mix: Mix | None = None  # of the samples, if a pilot has chosen it
        self._phase_start = 0.0  # of the images of this round, then of its backward passes
        self._bias_passes = 0  # additional backward passes for biases
        # Mean images, their samples per pixel, and the draws of noise that belong to them.
        self._image_groups: list[tuple[torch.Tensor, int, Draws]] = []
        self.mean_adjoints: list[torch.Tensor] = []  # what all rounds so far have propagated, for each metric

    @property
    def n_points(self) -> int:
        """All rounds are at the same point."""
        return 1

    @gradients_enabled()
    def warm_up(self, point: Point, spp: int) -> None:
        """Render and differentiate once to compile all kernels; discard the results."""
        leaves = {name: value.detach().clone().requires_grad_() for name, value in point.values.items()}
        # Results from a checkpoint would not compile anything.
        renderer = without_checkpoint(self.renderer)
        replaying = Capabilities(renderer).with_seed_grad
        if replaying is None:
            graph = renderer(leaves, seed=self._seed, spp=spp)
        else:
            graph = replaying(leaves, seed=self._seed, spp=spp, seed_grad=self._seed ^ 1)
        if not all(is_linear(metric, [graph.detach()]) for metric in self.metrics):
            more = math.ceil((self._ratio - 1) * spp)
            added = render_images(renderer, point.values, [self._seed ^ 2], more) if more else []
            self.transform_selector.select([graph.detach(), *added])  # may render guides
        for metric in self.metrics:
            _, adjoint = metric.with_few_draws().value_and_adjoint(graph)
            torch.autograd.grad(graph, list(leaves.values()), adjoint, retain_graph=True, allow_unused=True)

    def add_round(self, point: Point, replicates: int, spp: int) -> tuple[list[PointGradient], bool]:
        """Estimate another round as ``estimate`` does, weighted by the samples of the finished replicates."""
        before, self.budget = self.budget, self.budget.with_round(replicates, spp, self._seed)
        self._phase_start = self._time.now()
        try:
            estimates, interrupted = self.estimate(len(before.spp), point)
        except KeyboardInterrupt:
            self.budget = before
            raise
        for estimate in estimates:
            estimate.weight = float(estimate.replicates * spp)
        finished = min(estimate.replicates for estimate in estimates)
        # Only count samples that were propagated.
        self.budget = dataclasses.replace(
            self.budget,
            gradient_seeds=(*self.budget.gradient_seeds[:-1], self.budget.gradient_seeds[-1][:finished]),
        )
        return estimates, interrupted

    def _add_image_samples(
        self, index: int, values: Mapping[str, torch.Tensor], images: list[torch.Tensor]
    ) -> list[torch.Tensor]:
        """Add primal samples, unless the remaining time only suffices for the backward passes."""

        def skip() -> tuple[int]:
            cost = (self._ratio - 1 + BACKWARD_COST_RATIO) * (self._time.now() - self._phase_start)
            return (int(self._time.remaining() < cost),)

        if self._time.decide(("pictures", self._seed, self.budget.spp, self.budget.replicates), skip) == (1,):
            self.image_spp = self.budget.spp[index]
            return images
        return super()._add_image_samples(index, values, images)

    @property
    def _ratio(self) -> float:
        """Maximum number of primal samples per sample of a backward pass."""
        known = self.budget.picture_ratio
        return known or (SMOOTHED_PICTURE_RATIO if self.metrics[0].is_smoothed else NOISY_PICTURE_RATIO)

    def use_mix(self, mix: Mix) -> None:
        """Use a mix in all rounds, except for a number of picture samples that the user has given."""
        self.mix = dataclasses.replace(mix, picture=self.budget.picture_ratio or mix.picture)
        self.budget = dataclasses.replace(self.budget, picture_ratio=self.mix.picture)

    def _evaluate_metrics(
        self, index: int, values: Mapping[str, torch.Tensor], images: list[torch.Tensor]
    ) -> list[Adjoints]:
        spp, n_earlier = self.image_spp or 1, len(self._image_groups)
        new_groups = [(image, spp, draws) for image, draws in zip(images, self._draws(index), strict=True)]
        groups = [*self._image_groups, *new_groups]
        all_images = [image for image, _, _ in groups]
        samples = torch.tensor([count for _, count, _ in groups], dtype=torch.float32)
        fractions = (samples / samples.sum()).to(images[0])
        self.image = torch.tensordot(fractions, torch.stack(all_images), 1)
        self.pixel_error = pixel_error(all_images, fractions)
        self.pixel_noise = relative_noise(all_images, fractions)
        counts = samples.tolist()
        metrics = with_image_transform(self.metrics, all_images, self.transform_selector, counts)
        draws = [draws for _, _, draws in groups]
        evaluated = [
            jackknife(metric, all_images, counts, draws if metric.n_draws else None) for metric in metrics
        ]
        # The mean over the images is the bias-corrected adjoint.
        means = [torch.tensordot(fractions, torch.stack(result.per_replicate), 1) for result in evaluated]
        *earlier, latest = (
            n * (s or 1) for n, s in zip(self.budget.replicates, self.budget.spp, strict=True)
        )
        before = sum(earlier) / (sum(earlier) + latest)
        adjoints = []
        for number, (result, mean) in enumerate(zip(evaluated, means, strict=True)):
            new = torch.stack(result.per_replicate[n_earlier:])
            own = (mean - before * self.mean_adjoints[number]) / (1 - before) if n_earlier else mean
            adjoints.append(dataclasses.replace(result, per_replicate=tuple(new - new.mean(0) + own)))
        self.mean_adjoints = means
        self._bias_passes = sum(len(result.bias_adjoints) for result in evaluated)
        self._merge_images(new_groups)
        self._phase_start = self._time.now()
        return adjoints

    def _draws(self, index: int) -> Sequence[Draws]:
        """Return the draws of noise that belong to each image of a round, which later rounds keep."""
        seeds, spp = self.budget.seeds[index], self.budget.spp[index]
        if self.mix is not None:
            return [{seed: self.mix.draws_of(spp or 1)} for seed in seeds]
        return self.metrics[0].split_draws(seeds) or [{} for _ in seeds]

    def _merge_images(self, new: Sequence[tuple[torch.Tensor, int, Draws]]) -> None:
        """Merge each new image, with its draws, into the group with the fewest samples."""
        for image, spp, draws in new:
            if len(self._image_groups) < IMAGE_GROUPS:
                self._image_groups.append((image, spp, draws))
                continue
            index = min(range(IMAGE_GROUPS), key=lambda i: self._image_groups[i][1])
            mean, count, known = self._image_groups[index]
            merged = torch.lerp(mean, image, spp / (count + spp)), count + spp, {**known, **draws}
            self._image_groups[index] = merged

    def _is_out_of_time(self, finished: int) -> bool:
        if finished < 2:  # required for a standard error
            return False
        seconds_per_pass = (self._time.now() - self._phase_start) / finished

        def stop() -> tuple[int]:
            return (int(self._time.remaining() < (1 + self._bias_passes) * seconds_per_pass),)

        what = "late", self._seed, self.budget.spp, self.budget.replicates, finished
        return self._time.decide(what, stop) == (1,)
