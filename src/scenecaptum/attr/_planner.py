"""Sampling until an error is small enough, an order is clear, or time is up."""

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
from ._against import differences
from ._attribution import SceneAttribution, surfaces_of
from ._gradients import GradientSum, Point, require_memory
from ._method import Own, Result, Run
from ._passes import Budget, channel_totals
from ._rounds import PassTime, Rounds, RoundSum, TimeLimit
from ._simultaneous import LEVEL, Quantity, simultaneous_quantile

SHARE = 0.05
TIE = 0.05  # how near two saliencies are that count as tied, where no tolerance is given

_FREE = 2**14  # samples of a whole picture, for which a pass takes little longer than for none
_FIRST = 8  # samples of each pass of the first round, where the size of the picture is not known
_FAR = 8.0  # a prediction of more growth than this is made again on the way
_LEAST, _MOST = 1.1, 8.0  # growth of all samples by one round
_SECOND = 1.5  # least growth by the second round: the first does not miss what it has not seen
_ROUNDS = 10
_SAMPLES = 2**17  # per pixel, in all rounds
_CLEAR = 6.0  # standard errors apart: no need to compare
_MANY = 30.0  # effective samples: a pilot has not seen rare paths either
_COMPARED = 4  # one sample for so many tells what another renderer would change: they share their seeds
_SAFE = 0.95  # of the time that is left, to be filled by a round
_SPENT = 0.05  # of a time limit, too little to begin another round
_SHORT = 0.5  # of a time limit, which a pass may take that is only timed
_LITTLE = 1.25  # times the shortest pass: samples that make it no longer are nearly free


@dataclass(frozen=True)
class Goal:
    """What ``attribute`` was asked to reach: see there."""

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
        """Whether there is anything to reach."""
        return not (self.tolerance is None and self.top is None and self.time_limit is None)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


@dataclass(frozen=True)
class Verdict:
    """What is known of one metric's gradients after a round.

    Attributes
    ----------
    widths
        The parameters that may have the share, which the report is about.
    wanted
        What the goal asks for: that these are known well enough, or the differences between neighbours.
    quantiles
        Of ``widths`` and of ``wanted``.
    order
        All parameters by falling saliency.
    degrees
        Degrees of freedom of the errors.
    """

    widths: list[Quantity]
    wanted: list[Quantity]
    quantiles: tuple[float, float]
    order: list[str]
    degrees: int

    @property
    def half_widths(self) -> dict[str, float]:
        """The simultaneous half-width of each parameter that may have the share, in the ℓ2 norm."""
        return {one.names[0]: self.quantiles[0] * one.error for one in self.widths if self.degrees}

    @property
    def is_exact(self) -> bool:
        """Whether there is no noise but rounding, of which no other round would tell more."""
        return all(one.is_exact for one in self.widths)

    @property
    def is_calm(self) -> bool:
        """Whether many samples make up all spread, as a pilot tells."""
        return all(one.effective is not None and one.effective >= _MANY for one in self.wanted)

    @property
    def is_reached(self) -> bool:
        """Whether the goal is reached."""
        return all(one.is_reached(self.quantiles[1]) for one in self.wanted)

    @property
    def relative_width(self) -> float:
        """The largest half-width in units of its parameter's saliency."""
        if not self.degrees or any(one.error and not one.size for one in self.widths):
            return math.inf
        return max(
            (self.quantiles[0] * one.error / one.size for one in self.widths if one.error), default=0.0
        )

    def tiers(self, top: int) -> list[list[str]]:
        """Return the first parameters in their order, those together that are tied or not told apart."""
        together = {one.names for one in self.wanted if self.quantiles[1] * one.error > one.total.item()}
        tiers = [[self.order[0]]] if self.order else []
        for above, below in pairwise(self.order[:top]):
            if (above, below) in together:
                tiers[-1].append(below)
            else:
                tiers.append([below])
        last = self.order[min(top, len(self.order)) - 1]
        return [*tiers[:-1], [*tiers[-1], *(b for a, b in together if a == last)]]

    def growth(self, passes: int) -> float:
        """Return by which factor the samples must grow, where they come in so many more passes."""
        quantile = simultaneous_quantile(self.wanted, self.degrees + passes)
        return max((one.growth(quantile) for one in self.wanted), default=1.0)


def judge(
    found: GradientSum,
    goal: Goal,
    members: Mapping[str, tuple[str, ...]] | None,
    effective: Mapping[str, float] | None = None,
) -> Verdict:
    """Compare what is known with what is wanted.

    ``effective`` are the samples that make up the spread of each parameter's gradient, in effect, where a renderer
    tells.

    A parameter is known well enough where its half-width is within the tolerance, or where even the upper limit of
    its saliency is below the share of the lower limit of all saliency: an estimate that happens to be small says
    nothing as long as its error is large.
    """
    quantities = _totals(found, members, effective or {})
    degrees = found.degrees_of_freedom
    slack = goal.tolerance or 0.0
    every = _sum_of_sizes(quantities)
    near = [one for one in quantities if one.upper(_CLEAR) >= goal.share * every.lower(_CLEAR)]
    quantile = simultaneous_quantile([*near, every], degrees)
    floor = goal.share * every.lower(quantile)
    widths = [one for one in near if one.upper(quantile) > floor] or quantities[:1]
    order = [one.names[0] for one in quantities]
    if goal.top is None:
        wanted = [dataclasses.replace(one, target=max(slack * one.size, floor - one.size)) for one in near]
        return Verdict(widths, wanted, (quantile, quantile), order, degrees)
    wanted = _differences(quantities, goal.top, slack or TIE)
    return Verdict(widths, wanted, (quantile, simultaneous_quantile(wanted, degrees)), order, degrees)


def _totals(
    found: GradientSum,
    members: Mapping[str, tuple[str, ...]] | None,
    effective: Mapping[str, float],
) -> list[Quantity]:
    """Return the channel totals of every parameter, or group, by falling size."""
    whole = 1 / found.share
    vectors = {
        name: (
            whole * channel_totals(mean).double(),
            whole * found.deviations(name)
            if found.degrees_of_freedom
            else torch.zeros_like(channel_totals(mean).double())[None],
            whole
            * channel_totals(torch.zeros_like(mean) if found.bias is None else found.bias[name]).double(),
        )
        for name, mean in found.mean.items()
    }
    # None has been met by a pilot: nothing is known.
    counts = {name: count for name, count in effective.items() if count > 0}
    if members is not None:
        counts = _of_groups(counts, {name: vector[1] for name, vector in vectors.items()}, members)
        vectors = {
            group: (
                torch.stack([vectors[name][0].sum() for name in names]).sum(0, keepdim=True),
                torch.stack([vectors[name][1].sum(1, keepdim=True) for name in names]).sum(0),
                torch.stack([vectors[name][2].sum() for name in names]).sum(0, keepdim=True),
            )
            for group, names in members.items()
        }
    quantities = [
        Quantity((name,), *vector, target=0.0, effective=counts.get(name)) for name, vector in vectors.items()
    ]
    return sorted(quantities, key=lambda one: -one.size)


def _of_groups(
    counts: Mapping[str, float], noise: Mapping[str, torch.Tensor], members: Mapping[str, tuple[str, ...]]
) -> dict[str, float]:
    """Return the effective samples of sums, whose members are taken to be independent."""
    found = {}
    for group, names in members.items():
        variances = {name: noise[name].square().sum().item() for name in names}
        fourth = sum(variances[name] ** 2 / counts[name] for name in names if name in counts)
        if fourth and all(name in counts for name in names if variances[name]):
            found[group] = sum(variances.values()) ** 2 / fourth
    return found


def _sum_of_sizes(quantities: list[Quantity]) -> Quantity:
    """Return all saliency."""
    changes = [_changes(one) for one in quantities]
    return Quantity(
        ("all saliency",),
        quantities[0].total.new_tensor([sum(one.size for one in quantities)]),
        torch.stack([noise for noise, _ in changes]).sum(0),
        torch.stack([bias for _, bias in changes]).sum(0),
        target=0.0,
    )


def _differences(quantities: list[Quantity], top: int, tie: float) -> list[Quantity]:
    """Return the differences that the order of the first ones rests on: of neighbours, and of the last to others.

    One is known well enough where its interval leaves out 0, or where all of it is nearer to 0 than a tie.
    """
    pairs = list(pairwise(quantities[: top + 1]))
    pairs += [(quantities[top - 1], other) for other in quantities[top + 1 :]]
    found = []
    for above, below in pairs:
        difference = above.size - below.size
        (noise, bias), (less_noise, less_bias) = _changes(above), _changes(below)
        one = Quantity(
            (above.names[0], below.names[0]),
            above.total.new_tensor([difference]),
            noise - less_noise,
            bias - less_bias,
            max(difference, tie * above.size - difference),
            min((one.effective for one in (above, below) if one.effective is not None), default=None),
        )
        if difference < _CLEAR * one.error:
            found.append(one)
    return found


def _changes(quantity: Quantity) -> tuple[torch.Tensor, torch.Tensor]:
    """Return by how much noise and bias change the size, ``(passes, 1)`` and ``(1,)``.

    These are their components along the vector. Where noise may have turned it, they count in full.
    """
    norm = quantity.total.norm()
    along = (quantity.total / norm if norm > 0 else quantity.total)[:, None]
    noise, bias = quantity.noise @ along, quantity.bias @ along
    known = math.sqrt(noise.square().sum().item() + bias.square().sum().item())
    if quantity.size < _CLEAR * quantity.error and known > 0:
        noise, bias = (quantity.error / known * one for one in (noise, bias))
    return noise, bias


def reach(
    run: Run, point: Point, goal: Goal, first: int | None, *, against: Any = None, **info: Any
) -> Result:
    """Take gradients in rounds until a goal is reached or time is up; return what ``attribute`` returns.

    A first round, of ``first`` samples per pixel, tells how large the errors are and so how many samples the goal
    takes; the next takes these, or a third of them where they are many, to predict once more. A round that falls
    short is followed by another, up to a number of rounds and of samples.

    To look at errors and stop where they are small favours errors that are underestimated. Few looks keep that
    small, each with the degrees of freedom of all replicates so far, or fewer where one of these has most of the
    spread, or few paths of a pilot have it. And the first round does not end it, because rare paths that it has
    missed are missing in its errors as well: the second has half its samples at least.

    Without a goal all samples are taken at once. With one, the effect of rendering ``against`` another renderer is
    measured afterwards.

    References
    ----------
    Stein, "A two-sample test for a linear hypothesis whose power is independent of the variance", Annals of
    Mathematical Statistics 16(3), 1945.
    """
    if not goal.is_set:
        if against is not None:
            raise SceneCaptumError(
                "against= belongs to a goal: give tolerance=, top= or time_limit= as well."
            )
        return run.finish([point], **info)
    if run.settings.replicates < 2:
        raise SceneCaptumError(
            "tolerance=, top= and time_limit= need errors, which take two passes or more: leave out replicates=1."
        )
    first = _first(run.renderer) * run.settings.replicates if first is None else whole_number("spp", first)
    if against is not None:
        against = with_checkpoint(against, getattr(run.renderer, "checkpoint", None))
    search = _Search(run, point, goal, first, against)
    interrupted = search.run_rounds()
    return run.hand_over(search.results(interrupted, **info), interrupted=interrupted)


def _first(renderer: Any) -> int:
    """Return the samples of each pass of the first round: what is nearly free, and enough to tell the noise by."""
    width, height = getattr(renderer, "resolution", (0, 0))
    return min(max(_FREE // (width * height), 4), 64) if width * height else _FIRST


class _Search:
    """One search for a goal."""

    def __init__(self, run: Run, point: Point, goal: Goal, first: int, against: Any) -> None:
        self.run = run
        self.point = point
        self.goal = goal
        self.against = against
        self.changes: list[dict[str, Any] | None] = [None] * len(run.metrics)
        self.sums = [RoundSum(run.values) for _ in run.metrics]
        self.verdicts: list[Verdict] = []
        self.passes = run.settings.replicates
        self.first = math.ceil(first / self.passes)  # samples of a pass
        self.seconds: list[float] = []  # of each round
        self.setup = 0.0  # seconds before the clock begins
        self.pass_time = PassTime()
        asked = dataclasses.asdict(goal), run.settings.seed, self.passes, self.first, run.values
        about = getattr(run.renderer, "info", {})
        self.time = TimeLimit(goal.time_limit, run.renderer, (asked, about))
        self.bar = tqdm(
            total=0, disable=not run.settings.show_progress, desc=run.metrics[0].name, unit="pass"
        )
        self.rounds = Rounds(
            run.renderer,
            run.metrics,
            run.viewer,
            self.bar,
            seed=run.settings.seed,
            time=self.time,
            picture_ratio=Budget((), (), ()).with_pictures(run.settings.picture_spp, first).picture_ratio,
        )

    def run_rounds(self) -> bool:
        """Take rounds until one reaches the goal; say whether Ctrl-C ended it early."""
        with self.bar:
            size: tuple[int, int] | None = self._first_size()
            try:
                while size is not None:
                    if self._round(*size):
                        return True
                    size = self._decide("next", self._next_size)
                if self.against is not None:
                    self._compare()
            except KeyboardInterrupt:
                if not self.verdicts:
                    raise
                return True
        return False

    def _round(self, passes: int, spp: int) -> bool:
        require_memory(self.run.renderer, [spp], passes)
        began = self.time.now()
        self.bar.total += 2 * passes
        found, interrupted = self.rounds.take(self.point, passes, spp)
        if interrupted and not all(one.passes for one in found):
            raise KeyboardInterrupt
        for one, into in zip(found, self.sums, strict=True):
            into.add(one)
        self.verdicts = [
            judge(one, self.goal, self.run.members, self._effective(number))
            for number, one in enumerate(self.sums)
        ]
        self.seconds.append(self.time.now() - began)
        self.pass_time.note(spp, self.seconds[-1] / max(1, min(one.passes for one in found)))
        return interrupted

    def _effective(self, number: int) -> Mapping[str, float]:
        """Return how many samples make up the spread of each gradient of a metric, where the renderer tells."""
        ask = getattr(self.run.renderer, "effective_samples", None)
        if ask is None:
            return {}
        replicates = self.sums[number].replicates
        spp = max(1, int(self.sums[number].share) // replicates)
        found: Mapping[str, float] = ask(
            self.run.values, self.rounds.propagated[number], spp=spp, replicates=replicates
        )
        return found

    def _first_size(self) -> tuple[int, int] | None:
        """Return the passes of the first round and their samples; a time limit may leave only few.

        What happens only once, compiling above all, is done before the clock begins; then a pass of one sample is
        timed and, where it is short, one of the first round's size.
        """
        limit = self.goal.time_limit
        if limit is None:
            return self.passes, self.first
        surfaces_of(self.run.renderer, self.run.values)
        self.rounds.rehearse(self.point, 1)
        self._time_pass(1)
        if self.first * self.pass_time.shortest < _SHORT * limit:
            self._time_pass(self.first)
        self.setup = self.time.restart()
        shortest = self.pass_time.shortest
        passes = min(self.passes, max(2, int(limit / (2 * shortest))))
        spp = self.pass_time.samples_within(max(limit / (4 * passes), _LITTLE * shortest))
        return self._decide("first", lambda: (passes, min(self.first, spp)))

    def _time_pass(self, spp: int) -> None:
        began = self.time.now()
        self.rounds.rehearse(self.point, spp)
        self.pass_time.note(spp, self.time.now() - began)

    def _decide(self, what: str, choose: Callable[[], tuple[int, int] | None]) -> tuple[int, int] | None:
        """Choose the size of a round; where the clock has a say, once and for all."""
        known = [(one.order, one.half_widths) for one in self.verdicts]
        size = self.time.decide((what, known), choose)
        return None if size is None else (size[0], size[1])

    def _next_size(self) -> tuple[int, int] | None:
        """Return the passes of the next round and their samples, or None where there is to be none."""
        sampled = self.sums[0].share
        if self._is_over() or not self._samples_left():
            return None
        # What is predicted is as uncertain as the errors that it is predicted from.
        margin = 1 + 1 / math.sqrt(max(1, min(one.degrees for one in self.verdicts)))
        growth = margin * max(one.growth(self.passes) for one in self.verdicts)
        least_growth = _SECOND if len(self.seconds) == 1 else _LEAST
        growth = min(max(growth / 3 if growth > _FAR else growth, least_growth), _MOST)
        samples = min(math.ceil((growth - 1) * sampled), self._samples_left())
        most = 3 * self.passes
        if self.goal.time_limit is not None:
            left = self.time.left()
            if left < max(_SPENT * self.goal.time_limit, 2 * self.pass_time.shortest):
                return None
            # Few passes of many samples would tell little of the error.
            most = min(self.passes, max(2, int(left / (_LITTLE * self.pass_time.shortest))))
            samples = min(samples, most * self.pass_time.samples_within(_SAFE * left / most))
        # A round that counts little tells little of the error: half as many passes do.
        least = self.passes if samples > sampled else math.ceil(self.passes / 2)
        passes = max(2, min(max(samples // (4 * self.first), least), most))
        fewest = self.first if self.goal.time_limit is None else 1
        return passes, max(fewest, samples // passes)

    def _samples_left(self) -> int:
        """Return how many samples per pixel there may be, or 0 where these are less than a first round."""
        left = _SAMPLES - int(self.sums[0].share)
        return left if left >= self.passes * self.first else 0

    def _is_over(self) -> bool:
        return len(self.seconds) == _ROUNDS or all(map(self.is_reached, self.verdicts))

    def is_reached(self, verdict: Verdict) -> bool:
        """Whether a goal is reached, and not by what a single round tells of its own noise.

        Where the metric is linear and a pilot has seen no rare paths either, that is enough.
        """
        linear = all(one.seen is not None and one.seen.is_linear for one in self.sums)
        enough = len(self.seconds) > 1 or verdict.is_exact or (linear and verdict.is_calm)
        return verdict.is_reached and enough

    def _compare(self) -> None:
        """Measure what the other renderer would change, in a quarter of the samples."""
        run = self.run
        samples = max(self.first * self.passes, int(self.sums[0].share) // _COMPARED)
        seed = int(np.random.SeedSequence([run.settings.seed, 3]).generate_state(1)[0])
        budget = Budget.split(samples, self.passes, seed)
        self.bar.total += 2 * budget.passes[0]
        found = differences(run.renderer, self.against, run.metrics, self.point, budget, self.bar)
        self.changes = [
            _change(one, verdict, run.members, getattr(self.against, "info", {}))
            for one, verdict in zip(found, self.verdicts, strict=True)
        ]

    def results(self, interrupted: bool, **info: Any) -> list[SceneAttribution]:
        """Return the results so far, each with a report."""
        found = []
        for number, (metric, one) in enumerate(zip(self.run.metrics, self.sums, strict=True)):
            verdict = self.verdicts[number]
            assert one.seen is not None
            own = Own(one.seen, self.rounds.image, self.rounds.samples, metric.through(one.seen.view))
            report = {
                **self._report(verdict),
                "stopped": self.stopped(interrupted=interrupted),
                "against": self.changes[number],
            }
            found.append(
                self.run.result(
                    metric,
                    one,
                    own,
                    self.rounds.budget,
                    self.rounds,
                    interrupted=interrupted,
                    planner=report,
                    **info,
                )
            )
        return found

    def stopped(self, *, interrupted: bool = False) -> str:
        if interrupted:
            return "interrupted"
        if all(map(self.is_reached, self.verdicts)):
            return "goal"
        if len(self.seconds) == _ROUNDS:
            return "the number of rounds"
        return "the time limit" if self._samples_left() else "the number of samples"

    def _report(self, verdict: Verdict) -> dict[str, Any]:
        budget = self.rounds.budget
        relative = verdict.relative_width
        return {
            **dataclasses.asdict(self.goal),
            "level": LEVEL,
            "reached": None if self.goal.tolerance is self.goal.top is None else self.is_reached(verdict),
            "relative_half_width": relative if math.isfinite(relative) else None,
            "half_widths": verdict.half_widths,
            "order": verdict.tiers(self.goal.top) if self.goal.top and verdict.degrees else None,
            "rounds": [
                {"passes": passes, "spp_per_pass": spp, "seconds": seconds}
                for passes, spp, seconds in zip(budget.passes, budget.spp, self.seconds, strict=False)
            ],
            "setup_seconds": self.setup,
        }


def _change(
    found: GradientSum,
    verdict: Verdict,
    members: Mapping[str, tuple[str, ...]] | None,
    info: Mapping[str, Any],
) -> dict[str, Any]:
    """Say by how much the gradients that have the share would change, and how well that is known."""
    size = {one.names[0]: one.size for one in verdict.widths}
    changes = [one for one in _totals(found, members, {}) if one.names[0] in size]
    quantile = simultaneous_quantile(changes, found.degrees_of_freedom)
    norms = {one.names[0]: one.total.norm().item() for one in changes}
    widths = {one.names[0]: quantile * one.error for one in changes}
    worst = max((n for n in norms if size[n]), key=lambda n: norms[n] / size[n], default=None)
    return {
        **{key: info[key] for key in ("scene", "max_depth", "resolution") if key in info},
        "changes": norms,
        "half_widths": widths,
        "relative_change": None if worst is None else norms[worst] / size[worst],
        "relative_half_width": None if worst is None else widths[worst] / size[worst],
    }
