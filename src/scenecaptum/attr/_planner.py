"""Adaptive sampling until errors are small enough, a ranking is resolved, or a time limit is reached."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from ..checkpoint import with_checkpoint
from ..errors import SceneCaptumError, whole_number
from ..estimation import (
    LEVEL,
    Budget,
    GradientSum,
    Point,
    Quantity,
    ReplicateTime,
    Rounds,
    RoundSum,
    TimeLimit,
    channel_totals,
    differences,
    require_memory,
    simultaneous_quantile,
)
from ..protocols import Capabilities, Renderer
from ._attribution import SceneAttribution, surfaces_of
from ._method import InputEvaluation, Result, Run

DEFAULT_SHARE = 0.05
DEFAULT_TIE = 0.05  # relative difference below which two saliencies are tied

NEARLY_FREE_SAMPLES = 2**14  # of a whole image; they cost little compared to the overhead of a replicate
DEFAULT_FIRST_SPP = 8  # of each replicate of the first round, if the resolution is unknown
MAX_RELIABLE_GROWTH = 8.0  # a larger predicted growth is reached in several rounds
MIN_GROWTH, MAX_GROWTH = 1.1, 8.0  # of the total number of samples, by one round
# By the second round: light paths that the first round has missed are missing in its errors.
MIN_SECOND_GROWTH = 1.5
MAX_ROUNDS = 10
MAX_SPP = 2**17  # in all rounds
CLEARLY_SEPARATED = 6.0  # standard errors
MANY_EFFECTIVE_SAMPLES = 30.0  # from a pilot: rare paths are unlikely
COMPARISON_DIVISOR = 4  # common random numbers need fewer samples to compare with another renderer
TIME_SAFETY_FACTOR = 0.95  # of the remaining time, for a round
MIN_TIME_FRACTION = 0.05  # of the time limit, to start another round
MAX_TIMING_FRACTION = 0.5  # of the time limit, for a replicate that is only timed
NEARLY_FREE_FACTOR = 1.25  # times the shortest replicate: samples that fit into this time are nearly free


@dataclass(frozen=True)
class Goal:
    """Stopping criterion; see ``VanillaSceneGradient.attribute``."""

    tolerance: float | None
    share: float
    top: int | None
    time_limit: float | None

    def __post_init__(self) -> None:
        for name in ("tolerance", "time_limit"):
            value = getattr(self, name)
            if value is not None and not (_is_number(value) and 0 < value < math.inf):
                raise SceneCaptumError(f"{name} must be a positive number, not {value!r}.")
        if not (_is_number(self.share) and 0 <= self.share <= 1):
            raise SceneCaptumError(f"share must lie between 0 and 1, not {self.share!r}.")
        if self.top is not None:
            whole_number("top", self.top)

    @property
    def is_set(self) -> bool:
        """Whether there is any stopping criterion."""
        return not (self.tolerance is None and self.top is None and self.time_limit is None)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


@dataclass(frozen=True)
class Assessment:
    """What is known about the gradients of one metric after a round.

    Attributes
    ----------
    significant
        The parameters that may have the share; they are reported.
    criteria
        The quantities that the goal requires to be accurate: parameters, or differences between neighbours.
    quantiles
        Of ``significant`` and of ``criteria``.
    order
        All parameters by descending saliency.
    degrees
        Degrees of freedom of the errors.
    """

    significant: list[Quantity]
    criteria: list[Quantity]
    quantiles: tuple[float, float]
    order: list[str]
    degrees: int

    @property
    def half_widths(self) -> dict[str, float]:
        """Simultaneous half-width (ℓ2 norm) of each significant parameter."""
        return {q.names[0]: self.quantiles[0] * q.error for q in self.significant if self.degrees}

    @property
    def is_exact(self) -> bool:
        """Whether all errors are only due to rounding, so that more rounds would not help."""
        return all(quantity.is_exact for quantity in self.significant)

    @property
    def has_many_samples(self) -> bool:
        """Whether all criteria have many effective samples, according to a pilot."""
        return all(
            quantity.effective_samples is not None and quantity.effective_samples >= MANY_EFFECTIVE_SAMPLES
            for quantity in self.criteria
        )

    @property
    def is_reached(self) -> bool:
        """Whether the goal is reached."""
        return all(quantity.meets_target(self.quantiles[1]) for quantity in self.criteria)

    @property
    def relative_half_width(self) -> float:
        """The largest half-width relative to the saliency of its parameter."""
        if not self.degrees or any(quantity.error and not quantity.size for quantity in self.significant):
            return math.inf
        ratios = (quantity.error / quantity.size for quantity in self.significant if quantity.error)
        return max((self.quantiles[0] * ratio for ratio in ratios), default=0.0)

    def tiers(self, top: int) -> list[list[str]]:
        """Return the first parameters in order; parameters that are tied or not separated share a tier."""
        unresolved = {q.names for q in self.criteria if self.quantiles[1] * q.error > q.total.item()}
        tiers = [[self.order[0]]] if self.order else []
        for above, below in pairwise(self.order[:top]):
            if (above, below) in unresolved:
                tiers[-1].append(below)
            else:
                tiers.append([below])
        last = self.order[min(top, len(self.order)) - 1]
        return [*tiers[:-1], [*tiers[-1], *(below for above, below in unresolved if above == last)]]

    def required_growth(self, replicates: int) -> float:
        """Return the factor by which the samples must grow, given this number of additional replicates."""
        quantile = simultaneous_quantile(self.criteria, self.degrees + replicates)
        return max((quantity.required_growth(quantile) for quantity in self.criteria), default=1.0)


def assess(
    gradients: GradientSum,
    goal: Goal,
    members: Mapping[str, tuple[str, ...]] | None,
    effective_samples: Mapping[str, float] | None = None,
) -> Assessment:
    """Compare the errors with the goal.

    ``effective_samples`` are the effective numbers of samples behind the variance of each parameter's gradient, if
    the renderer provides them.

    A parameter is accurate enough if its half-width is within the tolerance, or if the upper limit of its saliency
    is below the share of the lower limit of the total saliency. A small estimate alone does not suffice as long as
    its error is large.
    """
    quantities = _totals(gradients, members, effective_samples or {})
    degrees = gradients.degrees_of_freedom
    tolerance = goal.tolerance or 0.0
    total = _total_saliency(quantities)
    candidates = [
        quantity
        for quantity in quantities
        if quantity.upper(CLEARLY_SEPARATED) >= goal.share * total.lower(CLEARLY_SEPARATED)
    ]
    quantile = simultaneous_quantile([*candidates, total], degrees)
    threshold = goal.share * total.lower(quantile)
    significant = [quantity for quantity in candidates if quantity.upper(quantile) > threshold]
    significant = significant or quantities[:1]
    order = [quantity.names[0] for quantity in quantities]
    if goal.top is None:
        criteria = [
            dataclasses.replace(q, target=max(tolerance * q.size, threshold - q.size)) for q in candidates
        ]
        return Assessment(significant, criteria, (quantile, quantile), order, degrees)
    criteria = _saliency_differences(quantities, goal.top, tolerance or DEFAULT_TIE)
    quantiles = quantile, simultaneous_quantile(criteria, degrees)
    return Assessment(significant, criteria, quantiles, order, degrees)


def _totals(
    gradients: GradientSum,
    members: Mapping[str, tuple[str, ...]] | None,
    effective_samples: Mapping[str, float],
) -> list[Quantity]:
    """Return the channel totals of every parameter or group, by descending size."""
    scale = 1 / gradients.weight
    vectors = {
        name: (
            scale * channel_totals(mean).double(),
            scale * gradients.deviations(name)
            if gradients.degrees_of_freedom
            else torch.zeros_like(channel_totals(mean).double())[None],
            scale
            * channel_totals(
                torch.zeros_like(mean) if gradients.bias is None else gradients.bias[name]
            ).double(),
        )
        for name, mean in gradients.mean.items()
    }
    # 0 means that the pilot has found no path: nothing is known.
    counts = {name: count for name, count in effective_samples.items() if count > 0}
    if members is not None:
        deviations = {name: vector[1] for name, vector in vectors.items()}
        counts = _group_effective_samples(counts, deviations, members)
        vectors = {
            group: (
                torch.stack([vectors[name][0].sum() for name in names]).sum(0, keepdim=True),
                torch.stack([vectors[name][1].sum(1, keepdim=True) for name in names]).sum(0),
                torch.stack([vectors[name][2].sum() for name in names]).sum(0, keepdim=True),
            )
            for group, names in members.items()
        }
    quantities = [
        Quantity((name,), *vector, target=0.0, effective_samples=counts.get(name))
        for name, vector in vectors.items()
    ]
    return sorted(quantities, key=lambda quantity: -quantity.size)


def _group_effective_samples(
    counts: Mapping[str, float],
    deviations: Mapping[str, torch.Tensor],
    members: Mapping[str, tuple[str, ...]],
) -> dict[str, float]:
    """Return the effective samples of the sums over groups, assuming independent members."""
    by_group = {}
    for group, names in members.items():
        variances = {name: deviations[name].square().sum().item() for name in names}
        fourth = sum(variances[name] ** 2 / counts[name] for name in names if name in counts)
        if fourth and all(name in counts for name in names if variances[name]):
            by_group[group] = sum(variances.values()) ** 2 / fourth
    return by_group


def _total_saliency(quantities: list[Quantity]) -> Quantity:
    """Return the sum of all saliencies."""
    errors = [_size_errors(quantity) for quantity in quantities]
    return Quantity(
        ("all saliency",),
        quantities[0].total.new_tensor([sum(quantity.size for quantity in quantities)]),
        torch.stack([deviations for deviations, _ in errors]).sum(0),
        torch.stack([bias for _, bias in errors]).sum(0),
        target=0.0,
    )


def _saliency_differences(quantities: list[Quantity], top: int, tie: float) -> list[Quantity]:
    """Return the differences that determine the first ``top``: between neighbours, and of the last to all others.

    A difference is accurate enough if its interval excludes 0, or if all of the interval is within a tie.
    """
    pairs = list(pairwise(quantities[: top + 1]))
    pairs += [(quantities[top - 1], other) for other in quantities[top + 1 :]]
    differences = []
    for above, below in pairs:
        difference = above.size - below.size
        (deviations, bias), (deviations_below, bias_below) = _size_errors(above), _size_errors(below)
        counts = [q.effective_samples for q in (above, below) if q.effective_samples is not None]
        quantity = Quantity(
            (above.names[0], below.names[0]),
            above.total.new_tensor([difference]),
            deviations - deviations_below,
            bias - bias_below,
            max(difference, tie * above.size - difference),
            min(counts, default=None),
        )
        if difference < CLEARLY_SEPARATED * quantity.error:
            differences.append(quantity)
    return differences


def _size_errors(quantity: Quantity) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the deviations ``(replicates, 1)`` and the bias ``(1,)`` of the size.

    These are the components in the direction of the vector. If noise may have changed the direction, they are
    scaled to the full error.
    """
    norm = quantity.total.norm()
    direction = (quantity.total / norm if norm > 0 else quantity.total)[:, None]
    deviations, bias = quantity.deviations @ direction, quantity.bias @ direction
    error = math.sqrt(deviations.square().sum().item() + bias.square().sum().item())
    if quantity.size < CLEARLY_SEPARATED * quantity.error and error > 0:
        scale = quantity.error / error
        return scale * deviations, scale * bias
    return deviations, bias


def attribute_to_goal(
    run: Run, point: Point, goal: Goal, first_spp: int | None, *, against: Any = None, **info: Any
) -> Result:
    """Estimate gradients in rounds until a goal is reached; return the result of ``attribute``.

    The first round has ``first_spp`` samples per pixel and gives an estimate of the errors, which predicts the
    samples that the goal requires. The next round takes these, or a third of them if the prediction is far. More
    rounds follow until the goal is reached, up to a maximum number of rounds and of samples.

    Stopping when the estimated errors are small favours errors that are underestimated. To keep this effect small,
    there are few rounds. Each test uses the degrees of freedom of all replicates so far, or fewer if one replicate
    dominates the variance or a pilot found few paths. The search does not end after the first round, because rare
    paths that it has missed are missing in its errors as well; the second round has at least half as many samples.

    Without a goal all samples are taken at once. With a goal, the effect of rendering with ``against`` instead is
    measured afterwards.

    References
    ----------
    Stein, "A two-sample test for a linear hypothesis whose power is independent of the variance", Annals of
    Mathematical Statistics 16(3), 1945.
    """
    if not goal.is_set:
        if against is not None:
            raise SceneCaptumError("against= requires a goal: give tolerance=, top= or time_limit= as well.")
        return run.attribute([point], **info)
    replicates = run.settings.replicates
    if replicates < 2:
        raise SceneCaptumError(
            "tolerance=, top= and time_limit= require errors, and these at least two replicates: leave out "
            "replicates=1."
        )
    if first_spp is None:
        first_spp = _first_spp_per_replicate(run.renderer) * replicates
    else:
        first_spp = whole_number("spp", first_spp)
    if against is not None:
        against = with_checkpoint(against, Capabilities(run.renderer).checkpoint)
    search = _Search(run, point, goal, first_spp, against)
    interrupted = search.run_rounds()
    return run.return_results(search.results(interrupted, **info), interrupted=interrupted)


def _first_spp_per_replicate(renderer: Renderer) -> int:
    """Return the samples per replicate of the first round: nearly free, but enough to estimate the noise."""
    width, height = Capabilities(renderer).resolution or (0, 0)
    return min(max(NEARLY_FREE_SAMPLES // (width * height), 4), 64) if width * height else DEFAULT_FIRST_SPP


class _Search:
    """Adaptive sampling towards a goal."""

    def __init__(self, run: Run, point: Point, goal: Goal, first_spp: int, against: Any) -> None:
        self.run = run
        self.point = point
        self.goal = goal
        self.against = against
        self.changes: list[dict[str, Any] | None] = [None] * len(run.metrics)
        self.sums = [RoundSum(run.values) for _ in run.metrics]
        self.assessments: list[Assessment] = []
        self.replicates = run.settings.replicates
        self.first_spp = math.ceil(first_spp / self.replicates)  # per replicate
        self.round_seconds: list[float] = []
        self.setup_seconds = 0.0  # before the time limit starts
        self.replicate_time = ReplicateTime()
        settings = dataclasses.asdict(goal), run.settings.seed, self.replicates, self.first_spp, run.values
        renderer_info = Capabilities(run.renderer).info or {}
        self.time = TimeLimit(goal.time_limit, run.renderer, (settings, renderer_info))
        self.bar = tqdm(
            total=0, disable=not run.settings.show_progress, desc=run.metrics[0].name, unit="replicate"
        )
        budget = Budget((), (), ()).with_picture_spp(run.settings.picture_spp, first_spp)
        self.rounds = Rounds(
            run.renderer,
            run.metrics,
            run.transform_selector,
            self.bar,
            seed=run.settings.seed,
            time=self.time,
            picture_ratio=budget.picture_ratio,
        )

    def run_rounds(self) -> bool:
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
        require_memory(self.run.renderer, [spp], replicates)
        start = self.time.now()
        self.bar.total += 2 * replicates
        estimates, interrupted = self.rounds.add_round(self.point, replicates, spp)
        if interrupted and not all(estimate.replicates for estimate in estimates):
            raise KeyboardInterrupt
        for estimate, total in zip(estimates, self.sums, strict=True):
            total.add(estimate)
        self.assessments = [
            assess(total, self.goal, self.run.members, self._effective_samples(number))
            for number, total in enumerate(self.sums)
        ]
        seconds = self.time.now() - start
        self.round_seconds.append(seconds)
        finished = min(estimate.replicates for estimate in estimates)
        self.replicate_time.record(spp, seconds / max(1, finished))
        return interrupted

    def _effective_samples(self, number: int) -> Mapping[str, float]:
        """Return the effective samples behind the gradients of a metric, if the renderer provides them."""
        estimate = Capabilities(self.run.renderer).effective_samples
        if estimate is None:
            return {}
        replicates = self.sums[number].replicates
        spp = max(1, int(self.sums[number].weight) // replicates)
        adjoint = self.rounds.mean_adjoints[number]
        counts: Mapping[str, float] = estimate(self.run.values, adjoint, spp=spp, replicates=replicates)
        return counts

    def _first_size(self) -> tuple[int, int] | None:
        """Return the replicates of the first round and their spp, which a time limit may reduce.

        One-time costs, mainly compilation, are paid before the time limit starts. Then a replicate with one sample
        is timed and, if that is fast, one of the size of the first round.
        """
        limit = self.goal.time_limit
        if limit is None:
            return self.replicates, self.first_spp
        surfaces_of(self.run.renderer, self.run.values)
        self.rounds.warm_up(self.point, 1)
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
        self.replicate_time.record(spp, self.time.now() - start)

    def _decide(self, what: str, decide: Callable[[], tuple[int, int] | None]) -> tuple[int, int] | None:
        """Decide on the size of a round; decisions that depend on the clock are stored in the checkpoint."""
        state = [(assessment.order, assessment.half_widths) for assessment in self.assessments]
        size = self.time.decide((what, state), decide)
        return None if size is None else (size[0], size[1])

    def _next_size(self) -> tuple[int, int] | None:
        """Return the replicates of the next round and their spp, or None to stop."""
        sampled = self.sums[0].weight
        if self._is_over() or not self._remaining_spp():
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

    def _is_over(self) -> bool:
        return len(self.round_seconds) == MAX_ROUNDS or all(map(self.is_reached, self.assessments))

    def is_reached(self, assessment: Assessment) -> bool:
        """Whether the goal is reached, based on more than the first round's estimate of its own noise.

        One round suffices for a linear metric if a pilot has found no rare paths.
        """
        linear = all(total.adjoints is not None and total.adjoints.is_linear for total in self.sums)
        is_reliable = (
            len(self.round_seconds) > 1 or assessment.is_exact or (linear and assessment.has_many_samples)
        )
        return assessment.is_reached and is_reliable

    def _compare(self) -> None:
        """Measure the change of the gradients with the other renderer, with a quarter of the samples."""
        run = self.run
        samples = max(self.first_spp * self.replicates, int(self.sums[0].weight) // COMPARISON_DIVISOR)
        seed = int(np.random.SeedSequence([run.settings.seed, 3]).generate_state(1)[0])
        budget = Budget.split(samples, self.replicates, seed)
        self.bar.total += 2 * budget.replicates[0]
        changes = differences(run.renderer, self.against, run.metrics, self.point, budget, self.bar)
        self.changes = [
            _describe_change(change, assessment, run.members, Capabilities(self.against).info or {})
            for change, assessment in zip(changes, self.assessments, strict=True)
        ]

    def results(self, interrupted: bool, **info: Any) -> list[SceneAttribution]:
        """Return the current results with the planner's report in ``info``."""
        results = []
        for number, (metric, total) in enumerate(zip(self.run.metrics, self.sums, strict=True)):
            adjoints = total.adjoints
            assert adjoints is not None
            evaluation = InputEvaluation(
                adjoints,
                self.rounds.image,
                self.rounds.total_image_spp,
                metric.with_transform(adjoints.transform),
            )
            report = {
                **self._report(self.assessments[number]),
                "stopped": self.stopped(interrupted=interrupted),
                "against": self.changes[number],
            }
            results.append(
                self.run.result(
                    metric,
                    total,
                    evaluation,
                    self.rounds.budget,
                    self.rounds,
                    interrupted=interrupted,
                    planner=report,
                    **info,
                )
            )
        return results

    def stopped(self, *, interrupted: bool = False) -> str:
        """Return why the search ended."""
        if interrupted:
            return "interrupted"
        if all(map(self.is_reached, self.assessments)):
            return "goal"
        if len(self.round_seconds) == MAX_ROUNDS:
            return "the number of rounds"
        return "the time limit" if self._remaining_spp() else "the number of samples"

    def _report(self, assessment: Assessment) -> dict[str, Any]:
        budget = self.rounds.budget
        relative = assessment.relative_half_width
        has_goal = not (self.goal.tolerance is self.goal.top is None)
        rounds = zip(budget.replicates, budget.spp, self.round_seconds, strict=False)
        return {
            **dataclasses.asdict(self.goal),
            "level": LEVEL,
            "reached": self.is_reached(assessment) if has_goal else None,
            "relative_half_width": relative if math.isfinite(relative) else None,
            "half_widths": assessment.half_widths,
            "order": assessment.tiers(self.goal.top) if self.goal.top and assessment.degrees else None,
            "rounds": [
                {"replicates": replicates, "spp_per_replicate": spp, "seconds": seconds}
                for replicates, spp, seconds in rounds
            ],
            "setup_seconds": self.setup_seconds,
        }


def _describe_change(
    change: GradientSum,
    assessment: Assessment,
    members: Mapping[str, tuple[str, ...]] | None,
    info: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the changes of the significant gradients and their half-widths."""
    sizes = {quantity.names[0]: quantity.size for quantity in assessment.significant}
    changes = [quantity for quantity in _totals(change, members, {}) if quantity.names[0] in sizes]
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
