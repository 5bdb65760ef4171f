"""Adaptive sampling until errors are small enough, a ranking is resolved, or a time limit is reached."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, TypeAlias

import torch

from ..checkpoint import with_checkpoint
from ..errors import SceneCaptumError, whole_number
from ..protocols import Capabilities, Renderer
from ._comparison import differences
from ._goal import Assessment, Compared, Goal, assess, totals
from ._gradients import GradientSum, Point, require_memory
from ._metric import TargetedMetric
from ._metric_image import TransformSelector
from ._mix import Mix, Pilot
from ._progress import Progress
from ._replicates import Budget, Sampling
from ._rounds import IMAGE_GROUPS, ReplicateTime, Rounds, RoundSum, TimeLimit
from ._seeds import Stream, derived_seeds
from ._simultaneous import LEVEL, simultaneous_quantile

NEARLY_FREE_SAMPLES = 2**14  # of a whole image; they cost little compared to the overhead of a replicate
DEFAULT_FIRST_SPP = 8  # of each replicate of the first round, if the resolution is unknown
MAX_RELIABLE_GROWTH = 8.0  # a larger predicted growth is reached in several rounds
MIN_GROWTH, MAX_GROWTH = 1.1, 8.0  # of the total number of samples, by one round
# By the second round: light paths that the first round has missed are missing in its errors.
MIN_SECOND_GROWTH = 1.5
MAX_ROUNDS = 10
MAX_SPP = 2**17  # in all rounds
COMPARISON_DIVISOR = 4  # common random numbers need fewer samples to compare with another renderer
TIME_SAFETY_FACTOR = 0.95  # of the remaining time, for a round
MIN_TIME_FRACTION = 0.05  # of the time limit, to start another round
MAX_TIMING_FRACTION = 0.5  # of the time limit, for a replicate that is only timed
NEARLY_FREE_FACTOR = 1.25  # times the shortest replicate: samples that fit into this time are nearly free


Unranked: TypeAlias = (
    "Callable[[Collection[str], GradientSum, torch.Tensor, int], "
    "tuple[Collection[str], Mapping[str, Sequence[float]]]]"
)


def _first_spp_per_replicate(renderer: Renderer) -> int:
    """Return the samples per replicate of the first round: nearly free, but enough to estimate the noise."""
    width, height = Capabilities(renderer).resolution or (0, 0)
    return min(max(NEARLY_FREE_SAMPLES // (width * height), 4), 64) if width * height else DEFAULT_FIRST_SPP


class Planner:
    """Estimates gradients in rounds until a goal is reached.

    The first round has ``first_spp`` samples per pixel and gives an estimate of the errors, which predicts the
    samples that the goal requires. The next round takes these, or a third of them if the prediction is far. More
    rounds follow until the goal is reached, up to a maximum number of rounds and of samples.

    Stopping when the estimated errors are small favours errors that are underestimated. To keep this effect small,
    there are few rounds. Each test uses the degrees of freedom of all replicates so far, or fewer if one replicate
    dominates the variance or a pilot found few paths. Rare paths that the first round has missed are missing in
    its errors as well, so the search goes on, unless the metric is linear and a pilot has found many paths, or
    there is no noise. The second round has at least half as many samples.

    The ``sampling`` is that of the first round, by default few samples that cost nearly nothing; ``compared`` is
    what the goal refers to. With ``against``, another renderer, the gradients are compared at the end.
    ``prepare`` is called before the time limit starts, for one-time costs. ``unranked`` returns the parameters
    without a derivative, and for others which of their channels have one (1 or 0), given the gradients of the
    first round, the adjoint image and the samples.

    References
    ----------
    Stein, "A two-sample test for a linear hypothesis whose power is independent of the variance", Annals of
    Mathematical Statistics 16(3), 1945.
    """

    def __init__(  # noqa: PLR0913 -- what a run consists of, and what only the methods know
        self,
        renderer: Renderer,
        metrics: Sequence[TargetedMetric],
        transform_selector: TransformSelector,
        point: Point,
        compared: Compared,
        goal: Goal,
        sampling: Sampling,
        *,
        against: Any = None,
        prepare: Callable[[], object] = lambda: None,
        unranked: Unranked | None = None,
    ) -> None:
        seed, replicates, first_spp = sampling.seed, sampling.replicates, sampling.spp
        if replicates < 2:
            raise SceneCaptumError(
                "tolerance=, top= and time_limit= require errors, and these at least two replicates: leave out "
                "replicates=1."
            )
        if first_spp is None:
            first_spp = _first_spp_per_replicate(renderer) * replicates
        self.renderer = renderer
        self.metrics = metrics
        self.point = point
        self.compared = compared
        self.goal = goal
        self.seed = seed
        self.replicates = replicates
        self.against = (
            None if against is None else with_checkpoint(against, Capabilities(renderer).checkpoint)
        )
        self.prepare = prepare
        self.unranked = unranked
        self.has_none = False  # nothing has a derivative
        self.changes: list[dict[str, Any] | None] = [None] * len(metrics)
        self.sums = [RoundSum(point.values) for _ in metrics]  # the gradients so far
        self.assessments: list[Assessment] = []
        self.first_spp = math.ceil(whole_number("spp", first_spp) / replicates)  # per replicate
        self.round_seconds: list[float] = []
        self.setup_seconds = 0.0  # before the time limit starts
        self.replicate_time = ReplicateTime()
        settings = dataclasses.asdict(goal), seed, replicates, self.first_spp, point.values
        self.time = TimeLimit(goal.time_limit, renderer, (settings, Capabilities(renderer).info or {}))
        self.bar = Progress(metrics[0].label, show=sampling.show_progress)
        self.rounds = Rounds(
            renderer,
            metrics,
            transform_selector,
            self.bar,
            seed=seed,
            time=self.time,
            picture_ratio=Budget((), (), ()).with_picture_spp(sampling.picture_spp, first_spp).picture_ratio,
        )

    def run(self) -> bool:
        """Add rounds until the search ends; return whether Ctrl-C interrupted it."""
        with self.bar:
            size: tuple[int, int] | None = self._first_size()
            try:
                while size is not None:
                    if self._add_round(*size):
                        return True
                    size = self._decide("next", self._next_size)
                if self.against is not None:
                    self._compare()
            except KeyboardInterrupt:
                if not self.assessments:
                    raise
                return True
        return False

    def _add_round(self, replicates: int, spp: int) -> bool:
        require_memory(self.renderer, [spp], replicates)
        start = self.time.now()
        self.bar.expect(replicates)
        point = dataclasses.replace(self.point, settled=self._settled())
        estimates, interrupted = self.rounds.add_round(point, replicates, spp)
        if interrupted and not all(estimate.replicates for estimate in estimates):
            raise KeyboardInterrupt
        for estimate, total in zip(estimates, self.sums, strict=True):
            total.add(estimate)
        self.assessments = self._assess()
        if not self.round_seconds and self.unranked is not None:
            self._exclude(self.unranked, replicates * spp)
            self.assessments = self._assess()
        seconds = self.time.now() - start
        self.round_seconds.append(seconds)
        finished = min(estimate.replicates for estimate in estimates)
        self.replicate_time.record(spp, seconds / max(1, finished))
        return interrupted

    def _assess(self) -> list[Assessment]:
        return [
            assess(total, self.goal, self.compared, self._effective_samples(number))
            for number, total in enumerate(self.sums)
        ]

    def _exclude(self, unranked: Unranked, samples: int) -> None:
        """Leave out what has no derivative for any of the metrics, among what the goal depends on."""
        names: set[str] = set()
        undecided = self.point.values.keys() - self._settled()
        factors = dict(self.compared.factors or {})
        for total, adjoint in zip(self.sums, self.rounds.mean_adjoints, strict=True):
            without, kept = unranked(undecided, total, adjoint, samples)
            names |= set(without)
            factors |= {
                n: factors[n] * factors[n].new_tensor(mask) for n, mask in kept.items() if n in factors
            }
        self.has_none = names >= self.point.values.keys()
        if self.has_none:
            return
        if self.compared.members is not None:  # their sums are of all others
            factors |= {n: torch.zeros_like(factors[n]) for n in names if n in factors}
            names = set()
        self.compared = dataclasses.replace(self.compared, factors=factors or None, excluded=frozenset(names))

    def _settled(self) -> frozenset[str]:
        """Return the parameters that need no more renders of their own: no metric's goal depends on them.

        Those that are differentiated together with all others cost nothing.
        """
        separate = Capabilities(self.renderer).rendered_separately
        if not separate or not self.assessments or self.compared.members is not None:
            return frozenset()
        by_metric = (assessment.settled for assessment in self.assessments)
        return frozenset(separate).intersection(*by_metric) | self.compared.excluded

    def _effective_samples(self, number: int) -> Mapping[str, float]:
        """Return the effective samples behind the gradients of a metric, if the renderer provides them."""
        estimate = Capabilities(self.renderer).effective_samples
        if estimate is None:
            return {}
        replicates = self.sums[number].replicates
        spp = max(1, int(self.sums[number].weight) // replicates)
        adjoint = self.rounds.mean_adjoints[number]
        return estimate(self.point.values, adjoint, spp=spp, replicates=replicates)

    def _first_size(self) -> tuple[int, int] | None:
        """Return the replicates of the first round and their spp, which a time limit may reduce.

        One-time costs, mainly compilation, are paid before the time limit starts. Then a replicate with one sample
        is timed and, if that is fast, one of the size of the first round.
        """
        limit = self.goal.time_limit
        if limit is None:
            return self.replicates, self.first_spp
        self.prepare()
        self.rounds.warm_up(self.point, 1)
        if self.metrics[0].is_smoothed:
            self.rounds.use_mix(self._measure_mix())
        self._time_replicate(1)
        if self.first_spp * self.replicate_time.shortest < MAX_TIMING_FRACTION * limit:
            self._time_replicate(self.first_spp)
        self.setup_seconds = self.time.restart()
        shortest = self.replicate_time.shortest
        replicates = min(self.replicates, max(2, int(limit / (2 * shortest))))
        spp = self.replicate_time.max_spp(max(limit / (4 * replicates), NEARLY_FREE_FACTOR * shortest))
        return self._decide("first", lambda: (replicates, min(self.first_spp, spp)))

    def _time_replicate(self, spp: int) -> None:
        start = self.time.now()
        self.rounds.warm_up(self.point, spp)
        mix = self.rounds.mix
        draws = 0.0 if mix is None else mix.seconds_per_draw * mix.draws_of(spp)
        self.replicate_time.record(spp, self.time.now() - start + draws)

    def _measure_mix(self) -> Mix:
        """Return the mix of samples with which the time is spent best; the checkpoint stores it."""
        images = self.replicates + IMAGE_GROUPS
        pilot = Pilot(
            self.renderer, self.metrics, self.rounds.transform_selector, self.first_spp, self.seed, images
        )

        def measure() -> tuple[int, ...]:
            return Mix.best(*pilot.measure(self.point, self.compared)).to_integers()

        measured = self.time.decide("mix", measure)
        return Mix.from_integers(*measured or ())

    def _decide(self, what: str, decide: Callable[[], tuple[int, int] | None]) -> tuple[int, int] | None:
        """Decide on the size of a round; decisions that depend on the clock are stored in the checkpoint."""
        state = [(assessment.order, assessment.half_widths) for assessment in self.assessments]
        size = self.time.decide((what, state), decide)
        return None if size is None else (size[0], size[1])

    def _next_size(self) -> tuple[int, int] | None:
        """Return the replicates of the next round and their spp, or None to stop."""
        sampled = self.sums[0].weight
        is_reached = self.has_none or all(map(self.is_reached, self.assessments))
        if is_reached or len(self.round_seconds) == MAX_ROUNDS or not self._remaining_spp():
            return None
        # The prediction is as uncertain as the errors that it is based on.
        degrees = min(assessment.degrees for assessment in self.assessments)
        margin = 1 + 1 / math.sqrt(max(1, degrees))
        required = max(assessment.required_growth(self.replicates) for assessment in self.assessments)
        growth = margin * required
        min_growth = MIN_SECOND_GROWTH if len(self.round_seconds) == 1 else MIN_GROWTH
        growth = min(max(growth / 3 if growth > MAX_RELIABLE_GROWTH else growth, min_growth), MAX_GROWTH)
        samples = min(math.ceil((growth - 1) * sampled), self._remaining_spp())
        max_replicates = 3 * self.replicates
        if self.goal.time_limit is not None:
            remaining = self.time.remaining()
            shortest = self.replicate_time.shortest
            if remaining < max(MIN_TIME_FRACTION * self.goal.time_limit, 2 * shortest):
                return None
            # As many replicates as overhead permits: with few, the error would be uncertain.
            max_replicates = min(self.replicates, max(2, int(remaining / (NEARLY_FREE_FACTOR * shortest))))
            seconds = TIME_SAFETY_FACTOR * remaining / max_replicates
            samples = min(samples, max_replicates * self.replicate_time.max_spp(seconds))
        # A round with a small weight contributes little to the error estimate: half as many replicates suffice.
        min_replicates = self.replicates if samples > sampled else math.ceil(self.replicates / 2)
        replicates = max(2, min(max(samples // (4 * self.first_spp), min_replicates), max_replicates))
        min_spp = self.first_spp if self.goal.time_limit is None else 1
        return replicates, max(min_spp, samples // replicates)

    def _remaining_spp(self) -> int:
        """Return the remaining samples per pixel, or 0 if they are fewer than those of the first round."""
        remaining = MAX_SPP - int(self.sums[0].weight)
        return remaining if remaining >= self.replicates * self.first_spp else 0

    def is_reached(self, assessment: Assessment) -> bool:
        """Whether the goal is reached, based on more than the first round's estimate of its own noise.

        One round suffices if there is no noise, or for a linear metric if a pilot has found many paths.
        """
        linear = all(total.adjoints is not None and total.adjoints.is_linear for total in self.sums)
        is_reliable = (
            len(self.round_seconds) > 1 or assessment.is_exact or (linear and assessment.has_many_samples)
        )
        return assessment.is_reached and is_reliable

    def _compare(self) -> None:
        """Measure the change of the gradients with the other renderer, with a quarter of the samples."""
        samples = max(self.first_spp * self.replicates, int(self.sums[0].weight) // COMPARISON_DIVISOR)
        (seed,) = derived_seeds(self.seed, Stream.COMPARISON, 1)
        budget = Budget.split(samples, self.replicates, seed)
        self.bar.expect(budget.replicates[0])
        changes = differences(self.renderer, self.against, self.metrics, self.point, budget, self.bar)
        self.changes = [
            _describe_change(change, assessment, self.compared, Capabilities(self.against).info or {})
            for change, assessment in zip(changes, self.assessments, strict=True)
        ]

    def stopped(self, *, interrupted: bool = False) -> str:
        """Return why the search ended."""
        if interrupted:
            return "interrupted"
        if self.has_none:
            return "the lack of a derivative"
        if all(map(self.is_reached, self.assessments)):
            return "goal"
        if len(self.round_seconds) == MAX_ROUNDS:
            return "the number of rounds"
        return "the time limit" if self._remaining_spp() else "the number of samples"

    def report(self, number: int, *, interrupted: bool) -> dict[str, Any]:
        """Return in plain values how the search went for a metric."""
        assessment, budget = self.assessments[number], self.rounds.budget
        relative = assessment.relative_half_width
        has_goal = not (self.goal.tolerance is self.goal.top is None)
        top = self.goal.top if assessment.degrees and not self.has_none else None
        rounds = zip(budget.replicates, budget.spp, self.round_seconds, strict=False)
        return {
            **dataclasses.asdict(self.goal),
            "level": LEVEL,
            "reached": self.is_reached(assessment) and not self.has_none if has_goal else None,
            "relative_half_width": relative if math.isfinite(relative) and not self.has_none else None,
            "half_widths": {} if self.has_none else assessment.half_widths,
            "order": assessment.tiers(top) if top else None,
            "rounds": [
                {"replicates": replicates, "spp_per_replicate": spp, "seconds": seconds}
                for replicates, spp, seconds in rounds
            ],
            "settled": sorted(self._settled()),
            "mix": None if self.rounds.mix is None else dataclasses.asdict(self.rounds.mix),
            "setup_seconds": self.setup_seconds,
            "stopped": self.stopped(interrupted=interrupted),
            "against": self.changes[number],
        }


def _describe_change(
    change: GradientSum,
    assessment: Assessment,
    compared: Compared,
    info: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the changes of the significant gradients and their half-widths."""
    sizes = {quantity.names[0]: quantity.size for quantity in assessment.significant}
    changes = [quantity for quantity in totals(change, compared, {}) if quantity.names[0] in sizes]
    quantile = simultaneous_quantile(changes, change.degrees_of_freedom)
    norms = {quantity.names[0]: quantity.total.norm().item() for quantity in changes}
    half_widths = {quantity.names[0]: quantile * quantity.error for quantity in changes}
    worst = max((n for n in norms if sizes[n]), key=lambda n: norms[n] / sizes[n], default=None)
    return {
        **{key: info[key] for key in ("scene", "max_depth", "resolution") if key in info},
        "changes": norms,
        "half_widths": half_widths,
        "relative_change": None if worst is None else norms[worst] / sizes[worst],
        "relative_half_width": None if worst is None else half_widths[worst] / sizes[worst],
    }
