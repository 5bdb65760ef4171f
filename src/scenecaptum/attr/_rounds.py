"""Gradients at one point in several rounds of passes, which one estimate is made of."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from tqdm import tqdm

from ..checkpoint import Stopwatch, without_checkpoint
from ._gradients import Gradients, GradientSum, Point, PointGradient
from ._jackknife import Adjoints, is_linear, jackknife, through_view
from ._metric import TargetedMetric
from ._passes import NOISY_PICTURE_RATIO, Budget, pictures
from ._view import Viewer

_LEAST_SHARE = 0.5  # of a pass's time, for its samples
_FARTHEST = 4  # times the samples that were timed: farther away times are not foretold
_BACKWARD = 3  # times what a picture takes, for a backward pass with as many samples
_GROUPS = 4  # into which earlier pictures are merged: neither memory nor the jackknife grows with the rounds


class TimeLimit:
    """Tells how much time a limit leaves, and keeps what was chosen by it.

    It goes on as if the passes that a checkpoint gives back had been rendered; and since nobody would choose the
    same twice by the clock, a job that is resumed keeps to what was chosen.

    Parameters
    ----------
    limit
        In seconds, or None.
    renderer
        Whose checkpoint is meant.
    asked
        What tells this job from others.
    """

    def __init__(self, limit: float | None = None, renderer: Any = None, asked: Any = ()) -> None:
        self.limit = limit
        self._asked = asked
        self._checkpoint = getattr(renderer, "checkpoint", None)
        self._watch = Stopwatch(renderer)
        self._began = self.now()

    def now(self) -> float:
        """Return the time in seconds."""
        return self._watch.now()

    def restart(self) -> float:
        """Begin to count; return what was counted so far."""
        began, self._began = self._began, self.now()
        return self._began - began

    def left(self) -> float:
        """Return how many seconds are left."""
        return math.inf if self.limit is None else self.limit - (self.now() - self._began)

    def decide(self, what: Any, choose: Callable[[], Sequence[int] | None]) -> tuple[int, ...] | None:
        """Choose numbers by the clock, or return those that were chosen before."""
        if self._checkpoint is None or self.limit is None:
            chosen = choose()
            return None if chosen is None else tuple(chosen)
        found: tuple[int, ...] | None = self._checkpoint.decide((self.limit, self._asked, what), choose)
        return found


class PassTime:
    """What a pass takes: something for itself, and something for each of its samples, as passes have told."""

    def __init__(self) -> None:
        self._seconds: dict[int, float] = {}  # of the latest pass with so many samples per pixel

    def note(self, spp: int, seconds: float) -> None:
        """Remember how long a pass took."""
        self._seconds[spp] = seconds

    @property
    def shortest(self) -> float:
        """The seconds of a pass with as few samples as any."""
        return self._seconds[min(self._seconds)]

    def samples_within(self, seconds: float) -> int:
        """Return how many samples per pixel a pass can have in a time; 1 at least.

        A single pass that was timed takes its time for its samples alone, for all that is known. Of two, each
        sample takes what they differ by, and half at least of what it would if passes took nothing else.
        """
        low, high = min(self._seconds), max(self._seconds)
        longest = self._seconds[high]
        each = longest / high
        if high > low:
            each = max(_LEAST_SHARE * each, (longest - self._seconds[low]) / (high - low))
        spp = int(high + (seconds - longest) / each) if each > 0 else high
        return min(max(1, spp), _FARTHEST * high)


class RoundSum(GradientSum):
    """Running sum of the gradients of rounds, each weighted by its samples.

    Weights that follow from the rounds' own spread would favour rounds that miss the rare bright paths.
    """

    def add(self, point: PointGradient) -> None:
        """Take in a round; its bias is that of all rounds so far, because its metric saw all pictures."""
        super().add(point)
        if self.bias is not None and point.bias is not None:
            self.bias = {
                name: self.share * point.bias[name] if name in point.bias else torch.zeros_like(value)
                for name, value in self.bias.items()
            }


class Rounds(Gradients):
    """Takes the gradients at a point in rounds; a metric sees the pictures of all rounds so far.

    Let ``a_r`` be the adjoint image, corrected by the jackknife, that a metric has after round ``r``, when it has
    seen ``N_r`` samples per pixel. Round ``r`` propagates ``(N_r a_r − N_{r−1} a_{r−1}) / (N_r − N_{r−1})``:
    then the rounds together, weighted by their samples, have propagated ``a_r``, the best there is, however noisy
    the pictures of the first rounds were. To first order this is the adjoint of the round's own pictures, so that
    rounds are independent and their variances add up.

    Parameters
    ----------
    renderer, metrics, viewer, bar
        As for ``Gradients``.
    seed
        From which the seeds of all rounds are drawn.
    time
        A round ends before its last pass where it leaves no time for that.
    picture_ratio
        As in ``Budget``.
    """

    def __init__(
        self,
        renderer: Any,
        metrics: Sequence[TargetedMetric],
        viewer: Viewer,
        bar: tqdm[Any],
        *,
        seed: int,
        time: TimeLimit,
        picture_ratio: float | None = None,
    ) -> None:
        super().__init__(renderer, metrics, Budget((), (), (), picture_ratio), viewer, bar)
        self._seed = seed
        self._time = time
        self._began = 0.0  # the pictures of this round, and then its backward passes
        self._more = 0  # backward passes that a bias takes
        self._pictures: list[tuple[torch.Tensor, int]] = []  # means, and the samples of each
        self.propagated: list[torch.Tensor] = []  # by metric, in all rounds so far

    @property
    def points(self) -> int:
        """Rounds are all at one point."""
        return 1

    def rehearse(self, point: Point, spp: int) -> None:
        """Render and differentiate a pass, and keep nothing."""
        leaves = {name: value.detach().clone().requires_grad_() for name, value in point.values.items()}
        seeds = {"seed": self._seed, "seed_grad": self._seed ^ 1} if self._replays else {"seed": self._seed}
        # What a checkpoint has compiles nothing.
        renderer = without_checkpoint(self.renderer)
        graph = renderer(leaves, spp=spp, **seeds)
        if not all(is_linear(one, [graph.detach()]) for one in self.metrics):
            more = math.ceil((self._ratio - 1) * spp)
            added = pictures(renderer, point.values, [self._seed ^ 2], more) if more else []
            self.viewer.choose([graph.detach(), *added])  # for which guides may have to be rendered
        for metric in self.metrics:
            _, adjoint = metric.value_and_adjoint(graph)
            torch.autograd.grad(graph, list(leaves.values()), adjoint, retain_graph=True, allow_unused=True)

    def take(self, point: Point, passes: int, spp: int) -> tuple[list[PointGradient], bool]:
        """Take one more round; return as ``at``, each share being the samples of the passes that were finished."""
        before, self.budget = self.budget, self.budget.with_round(passes, spp, self._seed)
        self._began = self._time.now()
        try:
            found, interrupted = self.at(len(before.spp), point)
        except KeyboardInterrupt:
            self.budget = before
            raise
        for one in found:
            one.share = float(one.passes * spp)
        done = min(one.passes for one in found)
        # What was not propagated was not spent.
        self.budget = dataclasses.replace(
            self.budget,
            gradient_seeds=(*self.budget.gradient_seeds[:-1], self.budget.gradient_seeds[-1][:done]),
        )
        return found, interrupted

    def _with_picture_samples(
        self, index: int, values: Mapping[str, torch.Tensor], images: list[torch.Tensor]
    ) -> list[torch.Tensor]:
        """Leave them out where what the pictures took so far leaves no time for them and the backward passes."""

        def choose() -> tuple[int]:
            rest = (self._ratio - 1 + _BACKWARD) * (self._time.now() - self._began)
            return (int(self._time.left() < rest),)

        if self._time.decide(("pictures", self._seed, self.budget.spp, self.budget.passes), choose) == (1,):
            self.picture_spp = self.budget.spp[index]
            return images
        return super()._with_picture_samples(index, values, images)

    @property
    def _ratio(self) -> float:
        """How many samples of the pictures there are at most for each of a backward pass."""
        return self.budget.picture_ratio or NOISY_PICTURE_RATIO

    def _seen(
        self, index: int, values: Mapping[str, torch.Tensor], images: list[torch.Tensor]
    ) -> list[Adjoints]:
        spp, old = self.picture_spp or 1, len(self._pictures)
        every = [*(image for image, _ in self._pictures), *images]
        samples = torch.tensor(
            [*(count for _, count in self._pictures), *[spp] * len(images)], dtype=torch.float32
        )
        shares = (samples / samples.sum()).to(images[0])
        self.image = torch.tensordot(shares, torch.stack(every), 1)
        counts = samples.tolist()
        metrics = through_view(self.metrics, every, self.viewer, counts)
        seen = [jackknife(one, every, counts) for one in metrics]
        # The pseudo-values' mean is the adjoint without its bias.
        propagated = [torch.tensordot(shares, torch.stack(one.passes), 1) for one in seen]
        *earlier, latest = (p * (s or 1) for p, s in zip(self.budget.passes, self.budget.spp, strict=True))
        before = sum(earlier) / (sum(earlier) + latest)
        found = []
        for number, one in enumerate(seen):
            new, mean = torch.stack(one.passes[old:]), propagated[number]
            if old:
                mean = (mean - before * self.propagated[number]) / (1 - before)
            found.append(dataclasses.replace(one, passes=tuple(new - new.mean(0) + mean)))
        self.propagated = propagated
        self._more = 0 if all(one.is_linear for one in seen) else 1
        self._keep(images, spp)
        self._began = self._time.now()
        return found

    def _keep(self, images: Sequence[torch.Tensor], spp: int) -> None:
        """Merge new pictures into the groups, the smallest of which takes in each."""
        for image in images:
            if len(self._pictures) < _GROUPS:
                self._pictures.append((image, spp))
                continue
            index = min(range(_GROUPS), key=lambda one: self._pictures[one][1])
            mean, count = self._pictures[index]
            self._pictures[index] = (torch.lerp(mean, image, spp / (count + spp)), count + spp)

    def _is_late(self, done: int) -> bool:
        if done < 2:  # which an error takes
            return False
        each = (self._time.now() - self._began) / done

        def choose() -> tuple[int]:
            return (int(self._time.left() < (1 + self._more) * each),)

        asked = "late", self._seed, self.budget.spp, self.budget.passes, done
        return self._time.decide(asked, choose) == (1,)
