"""What else could be used, on the same scene and metrics, at equal error.

Gradients are compared by the seconds that they take to a common relative error of the vector of P numbers: the
median of the seconds of a run, times how many of its samples that takes. The error is that of repeated runs
against a reference of many samples, whose own error is taken out. More samples lower its square in proportion, and
the part that repeats in all runs, because the metric saw a noisy picture, faster; so is taken to be, in favour of
finite differences, what their steps are off. Every number is scaled by its physical range. The peers:

- ours: ``VanillaSceneGradient(renderer, metric).attribute()`` as it comes, error bars included, and with
  ``replicates=1``, without error bars and without the correction of the bias of a noisy picture;
- hand-written: ``dr.wrap`` around ``mi.render`` with ``prb``, one render and one backward pass;
- Captum: its ``Saliency`` over that;
- finite differences: central, with Mitsuba's ``path``, shared seeds, no Russian roulette, the best of three steps.

Peers take turns in one process and load the scene anew for every turn: one scene slows the other down while both
are alive. They are compared for numbers whose derivative stock ``prb`` gets right (docs/derivatives.md); of the
others those that it gets wrong are listed. Brackets are 95 % intervals by a bootstrap over the repeats.

Morris's and Sobol's methods, through SALib, are compared by the renders until their top 5 is stable.

    python benchmarks/peers.py [--scene FILE] [--repeats N] [--quick] [--write docs/performance.md]
"""

from __future__ import annotations

import argparse
import gc
import importlib.metadata
import math
import os
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from variance import RIGHT

from scenecaptum import SceneRenderer, VanillaSceneGradient, activate, metrics
from scenecaptum.scene.bundled import BUNDLED
from scenecaptum.validation import SensitivityComparison, compare_sensitivity

DEPTH, TARGET = 6, 0.05
COUNTS = (4, 16, 64)
STEPS = (0.005, 0.02, 0.08)  # of a number's range
BOOTSTRAPS = 1000
OURS, BARE, SCRIPT = "scenecaptum", "scenecaptum, one pass", "hand-written"
CAPTUM, DIFFERENCES = "Captum", "finite differences"
BEGIN, END = "<!-- peers: begin -->", "<!-- peers: end -->"
HEADING = "## Against what else could be used"

Metric = Callable[[torch.Tensor], torch.Tensor]


@dataclass(frozen=True)
class Size:
    """How much is computed.

    ``repeats`` are those of each turn with all numbers; with fewer numbers there is one, for its time.
    """

    resolution: tuple[int, int]
    spp: int
    turns: int
    repeats: int
    reference: int  # times the samples of a run
    seeds: int  # of each finite difference
    small: tuple[int, int]  # the pictures and samples of Morris's and Sobol's methods
    small_spp: int
    trajectories: int
    base_samples: int
    points: int


FULL = Size((64, 36), 128, 3, 8, 32, 3, (64, 36), 16, 12, 32, 32)
QUICK = Size((32, 18), 16, 2, 2, 8, 2, (24, 14), 8, 4, 8, 8)


@dataclass(frozen=True)
class Number:
    """One element of a parameter, and how far it can go."""

    name: str
    index: int
    low: float
    high: float

    @property
    def length(self) -> float:
        """How far it can go."""
        return self.high - self.low

    @property
    def label(self) -> str:
        """Its name, one of many."""
        return f"{self.name}[{self.index}]"


@dataclass
class Case:
    """A scene, its metrics, and the numbers in the order in which they are taken up."""

    scene: Any
    values: dict[str, torch.Tensor]
    metrics: dict[str, Metric]
    numbers: list[Number]
    reference: dict[str, torch.Tensor]  # by metric: one element for each number, times its range
    reference_error: dict[str, torch.Tensor]

    @property
    def counts(self) -> list[int]:
        """How many numbers are compared."""
        return sorted({min(count, len(self.numbers)) for count in COUNTS})

    def names(self, count: int) -> list[str]:
        """Return the parameters that the first so many numbers belong to."""
        return list(dict.fromkeys(number.name for number in self.numbers[:count]))

    def vector(self, gradients: Mapping[str, torch.Tensor], count: int) -> torch.Tensor:
        """Return the gradient with respect to the first so many numbers, each times its range."""
        return torch.stack(
            [gradients[n.name].reshape(-1)[n.index].double() * n.length for n in self.numbers[:count]]
        )


# --------------------------------------------------------------------------------------------- the scene


def make_case(scene: Any, size: Size) -> Case:
    """Choose the numbers, the most important for any of the metrics first, and take the reference."""
    whole = make_renderer(scene, "all", size.resolution, size.spp)
    table = whole.parameters_table()
    values = {
        name: value
        for name, value in whole.inputs.items()
        if table[name].role in RIGHT.get(table[name].plugin, ())
        and not table[name].is_texture
        and bool((value != 0).all())  # stock prb loses the indirect part at 0
    }
    renderer = make_renderer(scene, list(values), size.resolution, size.spp)
    chosen = make_metrics(renderer, size.reference * size.spp)
    numbers = [
        Number(name, index, *interval(renderer.bounds[name], element))
        for name, value in values.items()
        for index, element in enumerate(value.reshape(-1).tolist())
    ]
    found = VanillaSceneGradient(renderer, together(chosen)).attribute(
        target=list(range(len(chosen))), spp=size.reference * size.spp, seed=10**6, replicates=16
    )
    case = Case(scene, values, chosen, numbers, {}, {})
    vectors, errors = {}, {}
    for name, one in zip(chosen, found, strict=True):
        vector = case.vector(one, len(numbers))
        if vector.norm() > 0:
            vectors[name], errors[name] = vector, case.vector(one.standard_error, len(numbers))
        else:
            print(f"{name}: left out, it does not depend on the scene here")
    case.metrics = {name: chosen[name] for name in vectors}
    weight = torch.stack([vector.abs() / vector.norm() for vector in vectors.values()]).sum(0)
    order = weight.argsort(descending=True).tolist()
    case.numbers = [numbers[k] for k in order]
    case.reference = {name: vector[order] for name, vector in vectors.items()}
    case.reference_error = {name: error[order] for name, error in errors.items()}
    return case


def at_size(scene: Any, resolution: tuple[int, int]) -> Any:
    """Return a bundled scene with a film of this size, so that all peers see the same picture; a file as it is."""
    if isinstance(scene, Path):
        return scene
    built = BUNDLED[scene]()
    built["sensor"]["film"] |= dict(zip(("width", "height"), resolution, strict=True))
    return built


def make_renderer(scene: Any, names: Any, resolution: tuple[int, int], spp: int) -> SceneRenderer:
    """Return our renderer."""
    built = at_size(scene, resolution)
    return SceneRenderer(built, names, resolution=resolution, spp=spp, max_depth=DEPTH)


def make_metrics(renderer: SceneRenderer, spp: int) -> dict[str, Metric]:
    """Return the metrics; a glare threshold is fixed, since finite differences would move it."""
    with torch.no_grad():
        image = renderer(renderer.inputs, seed=10**6, spp=spp)
    glare = metrics.UnifiedGlareRating(renderer.camera, threshold_factor=5)
    return {
        "mean luminance": metrics.MeanLuminance(),
        "UGR": glare.held_at(image),
        "class logit": metrics.ClassLogit(metrics.ShapeClassifier.pretrained(), target="sphere"),
    }


def together(chosen: Mapping[str, Metric]) -> Metric:
    """Return one metric that gives them all as a vector."""

    def evaluate(image: torch.Tensor) -> torch.Tensor:
        return torch.stack([metric(image) for metric in chosen.values()])

    return evaluate


def interval(bounds: tuple[float, float], value: float) -> tuple[float, float]:
    """Return the physical interval, or half the value to one and a half of it where that is infinite."""
    low, high = bounds
    if math.isfinite(high - low):
        return (low or 1e-3 * high), high  # a roughness of 0 is no roughness
    return 0.5 * value, 1.5 * value


# --------------------------------------------------------------------------------------------- the peers


class Script:
    """What a user of Mitsuba and torch writes."""

    def __init__(self, scene: Any, names: Sequence[str], resolution: tuple[int, int]) -> None:
        mi = activate()
        import drjit as dr

        if isinstance(scene, Path):
            width, height = resolution
            loaded = mi.load_file(
                str(scene), optimize=False, resx=width, resy=height, texture_format="variant"
            )
        else:
            loaded = mi.load_dict(at_size(scene, resolution), optimize=False)
        replay = mi.load_dict({"type": "prb", "max_depth": DEPTH})
        # Russian roulette would end other paths on the two sides of a difference.
        path = mi.load_dict({"type": "path", "max_depth": DEPTH, "rr_depth": DEPTH + 1})
        params = mi.traverse(loaded)
        params.keep(list(names))

        def change(values: Mapping[str, Any]) -> None:
            for name, value in values.items():
                kind = type(params[name])
                params[name] = dr.unravel(kind, value.array) if dr.depth_v(kind) > 1 else kind(value.array)
            params.update()

        @dr.wrap(source="torch", target="drjit")
        def render(values: dict[str, Any], seed: int, spp: int) -> Any:
            change(values)
            return mi.render(loaded, params, integrator=replay, seed=seed, seed_grad=seed + 1, spp=spp)

        def put(values: Mapping[str, torch.Tensor]) -> None:
            change({name: mi.TensorXf(value.reshape(-1).numpy()) for name, value in values.items()})

        def picture(values: Mapping[str, torch.Tensor], seed: int, spp: int) -> torch.Tensor:
            put(values)
            with dr.suspend_grad():
                return path.render(loaded, seed=seed, spp=spp).torch()

        self.render = render
        self.put = put
        self.picture = picture

    def gradient(
        self, values: Mapping[str, torch.Tensor], metric: Metric, seed: int, spp: int
    ) -> dict[str, torch.Tensor]:
        """Differentiate the metric."""
        leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
        metric(self.render(leaves, seed, spp)).backward()
        return {name: leaf.grad for name, leaf in leaves.items()}

    def captum(
        self, values: Mapping[str, torch.Tensor], metric: Metric, seed: int, spp: int
    ) -> dict[str, torch.Tensor]:
        """Let Captum do it."""
        from captum.attr import Saliency

        method = Saliency(self.batched(list(values), metric, seed, spp))
        inputs = tuple(value.clone()[None].requires_grad_() for value in values.values())
        found = method.attribute(inputs, abs=False)
        return {name: one[0] for name, one in zip(values, found, strict=True)}

    def batched(self, names: Sequence[str], metric: Metric, seed: int, spp: int) -> Metric:
        """Return the function of batches that Captum calls."""

        def forward(*inputs: torch.Tensor) -> torch.Tensor:
            rows = [dict(zip(names, row, strict=True)) for row in zip(*inputs, strict=True)]
            return torch.stack([metric(self.render(row, seed, spp)) for row in rows])

        return forward


class Samples:
    """Gradients and seconds of repeated runs, by peer, metric and how many numbers."""

    def __init__(self) -> None:
        self.gradients: dict[tuple[str, str, int], list[torch.Tensor]] = defaultdict(list)
        self.seconds: dict[tuple[str, str, int], list[float]] = defaultdict(list)

    def add(self, peer: str, metric: str, count: int, gradient: torch.Tensor, seconds: float) -> None:
        """Take in a run."""
        self.gradients[peer, metric, count].append(gradient)
        self.seconds[peer, metric, count].append(seconds)

    def errors(self, case: Case, peer: str, metric: str, count: int) -> torch.Tensor:
        """Return ``(runs, count)`` deviations from the reference, of all runs that hold the first numbers."""
        runs = [
            run[:count]
            for (p, m, n), several in self.gradients.items()
            if (p, m) == (peer, metric) and n >= count
            for run in several
        ]
        return torch.stack(runs) - case.reference[metric][:count]


def sample_gradients(case: Case, size: Size) -> Samples:
    """Let the peers that differentiate take turns."""
    samples = Samples()
    for turn in range(size.turns):
        for peer in (OURS, BARE, SCRIPT, CAPTUM):
            gc.collect()  # the other's scene
            run = start(peer, case, size)
            for count in case.counts:
                values = {name: case.values[name] for name in case.names(count)}
                run(values, metrics.MeanLuminance(), 1)  # compiles
                for number, (name, metric) in enumerate(case.metrics.items()):
                    several = count == case.counts[-1] and peer != CAPTUM
                    for repeat in range(size.repeats if several else 1):
                        # No two runs of a peer share a seed: those of fewer numbers count as well.
                        seed = 2 * (1000 * (10 * turn + number) + 10 * count + repeat) + 2
                        began = time.perf_counter()
                        gradient = case.vector(run(values, metric, seed), count)
                        samples.add(peer, name, count, gradient, time.perf_counter() - began)
            del run
        print(f"turn {turn + 1} of {size.turns}", flush=True)
    return samples


def start(
    peer: str, case: Case, size: Size
) -> Callable[[dict[str, torch.Tensor], Metric, int], Mapping[str, torch.Tensor]]:
    """Load the scene for a peer; return its gradient as a function of values, metric and seed."""
    if peer in (OURS, BARE):
        passes = {"replicates": 1} if peer == BARE else {}
        renderer = make_renderer(case.scene, list(case.values), size.resolution, size.spp)

        def attribute(
            values: dict[str, torch.Tensor], metric: Metric, seed: int
        ) -> Mapping[str, torch.Tensor]:
            found: Mapping[str, torch.Tensor]
            found = VanillaSceneGradient(renderer, metric).attribute(values, seed=seed, **passes)
            return found

        return attribute
    script = Script(case.scene, list(case.values), size.resolution)
    differentiate = script.gradient if peer == SCRIPT else script.captum
    return lambda values, metric, seed: differentiate(values, metric, seed, size.spp)


def sample_differences(case: Case, size: Size, samples: Samples) -> dict[str, float]:
    """Take finite differences, with the step that does best by the first numbers; return it for each metric."""
    gc.collect()
    script = Script(case.scene, list(case.values), size.resolution)
    script.put(case.values)  # a value that is set for the first time would change the kernel
    most = case.counts[-1]
    few = range(0, most, max(1, most // 6))
    trial = {step: differences(case, script, size, few, step) for step in STEPS}
    best = {
        metric: min(STEPS, key=lambda step: _mean_square(trial[step][0][metric], case, metric, few))
        for metric in case.metrics
    }
    for step in sorted(set(best.values())):
        found, seconds = differences(case, script, size, range(most), step)
        for metric in [name for name, chosen in best.items() if chosen == step]:
            for count in case.counts:
                for run in found[metric]:
                    samples.add(DIFFERENCES, metric, count, run[:count], 2 * count * seconds[metric])
    return best


def differences(
    case: Case, script: Script, size: Size, which: Sequence[int], step: float
) -> tuple[dict[str, torch.Tensor], dict[str, float]]:
    """Return for each metric ``(seeds, numbers)`` differences times ranges, and the seconds of one render."""
    found = {name: torch.zeros(size.seeds, len(which), dtype=torch.float64) for name in case.metrics}
    rendering: list[float] = []
    evaluating: dict[str, list[float]] = defaultdict(list)
    for seed in range(size.seeds):
        for column, number in enumerate(case.numbers[k] for k in which):
            value = case.values[number.name]
            at = value.reshape(-1)[number.index].item()
            ends = [max(at - step * number.length, number.low), min(at + step * number.length, number.high)]
            for sign, end in zip((-1, 1), ends, strict=True):
                moved = value.clone()
                moved.view(-1)[number.index] = end
                began = time.perf_counter()
                image = script.picture({number.name: moved}, 2 * seed + 10**5, size.spp)
                rendering.append(time.perf_counter() - began)
                for name, metric in case.metrics.items():
                    began = time.perf_counter()
                    found[name][seed, column] += sign * metric(image).item()
                    evaluating[name].append(time.perf_counter() - began)
            script.put({number.name: value})
            for name in case.metrics:
                found[name][seed, column] *= number.length / (ends[1] - ends[0])
    render = statistics.median(rendering)
    return found, {name: render + statistics.median(evaluating[name]) for name in case.metrics}


def _mean_square(runs: torch.Tensor, case: Case, metric: str, which: Sequence[int]) -> float:
    return (runs - case.reference[metric][list(which)]).square().mean().item()


# ------------------------------------------------------------------------------------------- equal error


@dataclass(frozen=True)
class Cost:
    """What a peer takes to the common error.

    ``error`` is the relative error of one run of ``seconds``, of which ``systematic`` is the part that repeats; 0
    where it is not told from noise. ``ratio`` is the cost divided by ours, with its interval; ``told`` is whether
    the reference is good enough for it.
    """

    seconds: float
    error: float
    systematic: float
    to_target: float
    ratio: float
    low: float
    high: float
    told: bool


@dataclass(frozen=True)
class Errors:
    """Relative errors of repeated runs, ``(runs, numbers)``.

    ``known`` is what the reference adds to their square.
    """

    runs: torch.Tensor
    known: float

    def square(self, runs: torch.Tensor) -> float:
        """Return the mean squared norm, without what the reference adds, which is never all of it."""
        whole = runs.square().sum(1).mean().item()
        return max(whole - self.known, 0.1 * whole)

    @property
    def told(self) -> bool:
        """Whether most of what is seen is theirs and not the reference's."""
        return self.known < 0.25 * self.runs.square().sum(1).mean().item()

    @property
    def systematic(self) -> float:
        """The norm of what repeats, or 0 where noise alone may have left as much."""
        variance = self.runs.var(0) / len(self.runs)
        excess = self.runs.mean(0).square().sum().item() - variance.sum().item() - self.known
        # The spread of a sum of squares of normal variables; few runs have wider tails.
        noise = math.sqrt(2 * (variance.square().sum().item() + self.known**2))
        return math.sqrt(excess) if excess > 5 * noise else 0.0

    def times(self, square: float) -> float:
        """Return by how much more samples it takes to the target, from the mean square of a run."""
        bias = self.systematic**2
        variance = max(square - bias, 0.0)
        # variance / n + bias / n² = target²
        return (variance + math.sqrt(variance**2 + 4 * TARGET**2 * bias)) / (2 * TARGET**2)

    def draw(self, generator: torch.Generator) -> float:
        """Return ``times`` for a bootstrap sample of the runs."""
        chosen = torch.randint(len(self.runs), (len(self.runs),), generator=generator)
        return self.times(self.square(self.runs[chosen]))


def cost(case: Case, samples: Samples, peer: str, metric: str, count: int) -> Cost:
    """Return the cost of a peer."""
    size = case.reference[metric][:count].norm()
    known = (case.reference_error[metric][:count] / size).square().sum().item()
    theirs, ours = (Errors(samples.errors(case, one, metric, count) / size, known) for one in (peer, OURS))
    seconds, our_seconds = (statistics.median(samples.seconds[one, metric, count]) for one in (peer, OURS))
    to_target = seconds * theirs.times(theirs.square(theirs.runs))
    ratio = to_target / (our_seconds * ours.times(ours.square(ours.runs)))
    low, high = (1.0, 1.0) if peer == OURS else _interval(seconds / our_seconds, theirs, ours)
    error = math.sqrt(theirs.square(theirs.runs))
    told = all(one.told for one in (theirs, ours))
    return Cost(seconds, error, theirs.systematic, to_target, ratio, low, high, told)


def _interval(seconds: float, theirs: Errors, ours: Errors) -> tuple[float, float]:
    """Return the 95 % interval of a ratio of costs, from that of the seconds of a run."""
    generator = torch.Generator().manual_seed(0)
    drawn = [seconds * theirs.draw(generator) / ours.draw(generator) for _ in range(BOOTSTRAPS)]
    low, high = torch.tensor(drawn).quantile(torch.tensor([0.025, 0.975]))
    return low.item(), high.item()


# ------------------------------------------------------------------------------- Morris's and Sobol's methods


class Numbers:
    """A renderer whose inputs are single numbers, for the methods that vary these."""

    def __init__(self, renderer: SceneRenderer, case: Case, count: int) -> None:
        self.renderer = renderer
        self.numbers = case.numbers[:count]
        self.spp = renderer.spp
        self.own = {name: case.values[name] for name in case.names(count)}
        self.inputs = {n.label: case.values[n.name].reshape(-1)[n.index].clone() for n in self.numbers}
        self.bounds = {n.label: (n.low, n.high) for n in self.numbers}

    def __call__(
        self, inputs: Mapping[str, torch.Tensor], *, seed: int, spp: int, seed_grad: int | None = None
    ) -> torch.Tensor:
        """Render."""
        values = {}
        for name, value in self.own.items():
            elements = list(value.reshape(-1).unbind())
            for number in self.numbers:
                if number.name == name:
                    elements[number.index] = inputs[number.label]
            values[name] = torch.stack(elements).reshape(value.shape)
        return self.renderer(values, seed=seed, spp=spp, seed_grad=seed_grad)


def compare_global(case: Case, size: Size) -> dict[tuple[str, int], SensitivityComparison]:
    """Compare the methods that sample, and ours, on small pictures: what counts is the number of renders."""
    gc.collect()
    renderer = make_renderer(case.scene, list(case.values), size.small, size.small_spp)
    everything = make_metrics(renderer, 16 * size.small_spp)
    chosen = {name: everything[name] for name in case.metrics}
    found = {}
    for count in case.counts:
        if count <= 5:
            continue
        several = compare_sensitivity(
            Numbers(renderer, case, count),
            together(chosen),
            list(range(len(chosen))),
            trajectories=size.trajectories,
            base_samples=size.base_samples,
            points=size.points,
        )
        found |= {(name, count): one for name, one in zip(chosen, several, strict=True)}
        print(f"Morris and Sobol, {count} numbers: {several[0].sobol.seconds:.0f} s", flush=True)
    return found


# ----------------------------------------------------------------------------------- what no time makes up for


@dataclass(frozen=True)
class Wrong:
    """Derivatives along all elements of a parameter, each with its standard error; the script may have none."""

    name: str
    difference: tuple[float, float]
    ours: tuple[float, float]
    script: tuple[float, float] | None


def find_wrong(case: Case, size: Size) -> list[Wrong]:
    """Differentiate the mean luminance by the parameters that were left out, in all three ways."""
    gc.collect()
    renderer = make_renderer(case.scene, "all", size.resolution, size.spp)
    table = renderer.parameters_table()
    tracked = [
        n for n in renderer.inputs if n not in case.values and table[n].tracked and not table[n].is_texture
    ]
    inside = [n for n in tracked if _has_room(renderer, n)]
    values = {name: renderer.inputs[name] for name in inside}
    if not values:
        return []
    metric = metrics.MeanLuminance()
    ours = VanillaSceneGradient(renderer, metric).attribute(values, spp=4 * size.spp)
    script = Script(case.scene, inside, size.resolution)
    script.put(values)
    runs = []
    for seed in range(4):
        try:
            runs.append(script.gradient(values, metric, 2 * seed + 2, size.spp))
        except Exception as problem:  # Mitsuba refuses where nothing is tracked
            print(f"hand-written, {len(inside)} more parameters: {problem}")
            break
    found = []
    for name, value in values.items():
        step = 0.02 * min(1.0, value.abs().max().item() or 1.0)
        slopes = torch.tensor([_slope(script, metric, name, value, step, seed, size) for seed in range(4)])
        stock = [run[name].sum() for run in runs]
        mine = torch.stack([one.sum() for one in ours.replicates[name]])
        found.append(
            Wrong(name, _estimate(slopes), _estimate(mine), _estimate(torch.stack(stock)) if stock else None)
        )
    return found


def _estimate(draws: torch.Tensor) -> tuple[float, float]:
    return draws.mean().item(), (draws.std() / len(draws) ** 0.5).item()


def _has_room(renderer: SceneRenderer, name: str) -> bool:
    """Whether a central difference stays inside the physical bounds."""
    value, (low, high) = renderer.inputs[name], renderer.bounds[name]
    return value.min().item() > low + 0.02 and value.max().item() < high - 0.02


def _slope(
    script: Script, metric: Metric, name: str, value: torch.Tensor, step: float, seed: int, size: Size
) -> float:
    ends = [metric(script.picture({name: value + s * step}, 2 * seed, size.spp)).item() for s in (-1, 1)]
    script.put({name: value})
    return (ends[1] - ends[0]) / (2 * step)


def batched_share(case: Case, size: Size) -> tuple[float, float]:
    """Return which part of a difference Captum's Integrated Gradients explain: over dr.wrap, and over ours."""
    from captum.attr import IntegratedGradients

    gc.collect()
    chosen, metric = case.names(case.counts[0]), metrics.MeanLuminance()
    renderer = make_renderer(case.scene, chosen, size.resolution, size.spp)
    ours, inputs = renderer.as_captum(metric, seed=3)
    script = Script(case.scene, chosen, size.resolution)
    plain = script.batched(list(renderer.inputs), metric, 3, size.spp)
    start, end = tuple(one.detach() / 2 for one in inputs), tuple(one.detach() for one in inputs)
    shares = []
    for forward in (plain, ours):
        found = IntegratedGradients(forward).attribute(end, start, n_steps=4)
        with torch.no_grad():
            whole = (forward(*end) - forward(*start)).item()
        shares.append(sum(one.sum().item() for one in found) / whole)
    return shares[0], shares[1]


# ---------------------------------------------------------------------------------------------- what it says


@dataclass
class Results:
    """Everything that was measured."""

    case: Case
    size: Size
    scene: str
    costs: dict[tuple[str, int, str], Cost]  # metric, count, peer
    steps: dict[str, float]
    sampled: dict[tuple[str, int], SensitivityComparison]
    wrong: list[Wrong]
    shares: tuple[float, float]


def gradient_table(results: Results) -> list[str]:
    """Return the table of the peers that give gradients."""
    lines = [
        f"| metric | P | {' | '.join(PEERS)} | P/4 |",
        "|---|--:|" + "--:|" * len(PEERS) + "--:|",
    ]
    for metric in results.case.metrics:
        for count in results.case.counts:
            ours, *others = (results.costs[metric, count, peer] for peer in PEERS)
            cells = [f"{ours.to_target:.2g} s" if ours.told else "–", *map(_ratio, others), f"{count / 4:g}×"]
            lines.append(f"| {metric} | {count} | " + " | ".join(cells) + " |")
    return lines


def _ratio(cost: Cost) -> str:
    return f"{cost.ratio:.3g}× [{cost.low:.3g}, {cost.high:.3g}]" if cost.told else "reference too noisy"


def single_runs(results: Results) -> list[str]:
    """Return the table of what one run takes, and its error."""
    count = results.case.counts[-1]
    lines = [
        f"| metric, P = {count} | " + " | ".join(PEERS) + " |",
        "|---|" + "--:|" * len(PEERS),
    ]
    for metric in results.case.metrics:
        costs = [results.costs[metric, count, peer] for peer in PEERS]
        lines.append(f"| {metric} | " + " | ".join(map(_run, costs)) + " |")
    return lines


def _run(cost: Cost) -> str:
    kept = f", of which {cost.systematic:.1%} in all runs alike" if cost.systematic else ""
    return f"{cost.seconds:.2g} s, error {cost.error:.1%}{kept}"


def render_table(results: Results) -> list[str]:
    """Return the table of renders until the top is stable."""
    lines = [
        "| metric | P | gradient | DGSM | Morris | Sobol | Morris ÷ DGSM | Sobol ÷ DGSM | in Sobol's top 5 |",
        "|---|--:|--:|--:|--:|--:|--:|--:|---|",
    ]
    for (metric, count), one in results.sampled.items():
        ours = one.dgsm.renders_until_stable
        cells = [_renders(method) for method in one.methods]
        cells += [f"{m.renders_until_stable / ours:.3g}×" for m in (one.morris, one.sobol)]
        shared = (
            f"{name} {len(set(method.top) & set(one.sobol.top))}"
            for name, method in (("gradient", one.local), ("DGSM", one.dgsm), ("Morris", one.morris))
        )
        lines.append(f"| {metric} | {count} | {' | '.join(cells)} | {', '.join(shared)} |")
    return lines


def _renders(method: Any) -> str:
    stable = f"{method.renders_until_stable:.4g}"
    return f"{'' if method.stable else '≥ '}{stable}{'' if method.resolved else ' (tied)'}"


def wrong_lines(results: Results) -> list[str]:
    """Say what stock prb gets wrong here."""
    clear = [w for w in results.wrong if abs(w.difference[0]) > 4 * w.difference[1]]
    if not clear:
        return ["There are no others in this scene that a finite difference could judge."]
    bad = [w for w in clear if w.script is None or _off(w.script, w)]
    ours = sum(_off(w.ours, w) for w in clear)
    lines = [
        f"Of {len(clear)} more parameters of this scene whose finite difference is told from 0 (with room on "
        f"both sides, and tracked by Mitsuba) stock `prb` gets {len(bad)} wrong, by more than a tenth and 4 "
        f"standard errors; scenecaptum {ours}."
    ]
    lines += [
        f"- `{w.name}`: difference {_pair(w.difference)}, ours {_pair(w.ours)}, "
        f"`prb` {'none' if w.script is None else _pair(w.script)}"
        for w in bad
    ]
    return lines


def _pair(estimate: tuple[float, float]) -> str:
    return f"{estimate[0]:.3g} ± {estimate[1]:.1g}"


def _off(estimate: tuple[float, float], wrong: Wrong) -> bool:
    (value, error), (difference, its_error) = estimate, wrong.difference
    return abs(value - difference) > max(0.1 * abs(difference), 4 * math.hypot(error, its_error))


PEERS = (OURS, BARE, SCRIPT, CAPTUM, DIFFERENCES)

SECTION = """{heading}

Made by `python benchmarks/peers.py --write docs/performance.md` with {versions}, on {cores} cores: {scene},
{width}×{height}, {spp} spp, depth 6, gradients with respect to the P single numbers (channels of colours,
roughness, radiance) that matter most to any of the metrics.

Seconds that scenecaptum takes until the relative error of the gradient is {target:.0%}, and what the others take
as a multiple, [95 % interval]. Above 1× scenecaptum is the quicker one.

{gradients}

One run of each, and its relative error (the reference, of {reference} spp, is itself {known} off):

{runs}

- *One pass* is scenecaptum without error bars and without the correction of the bias that a noisy picture causes.
  *Hand-written* is `dr.wrap` around `mi.render` with `prb`: one render, one backward pass, no error bars.
  *Captum* is its `Saliency` over that. *Finite differences* are central, with Mitsuba's `path`, shared seeds and
  the best of {steps} of the range as a step ({best}).
- The P numbers are those whose derivative stock `prb` gets right. {wrong}
- Captum's Integrated Gradients, which render a batch and then differentiate, add up to {share:.0%} of the
  difference that they explain over a plain `dr.wrap`, whose graph forgets all scenes but the last, and to
  {our_share:.0%} over `renderer.as_captum`.

Morris's and Sobol's methods (SALib) on pictures of {small[0]}×{small[1]}, {small_spp} spp: the renders until their
top 5 is what it is after {trajectories} trajectories or {base} base samples. A backward pass counts as a render;
"tied" where the fifth is not told from the sixth by its errors; ≥ where the last sample still changed the set.

{renders}

*Gradient* is one at the scene's own values; *DGSM* averages squared gradients over the same intervals as Morris
and Sobol, at {points} points.

![Cost against the number of parameters](pictures/peers.png)
"""


def document(results: Results) -> str:
    """Return the section in Markdown."""
    case, size = results.case, results.size
    versions = " and ".join(f"{n} {importlib.metadata.version(n)}" for n in ("mitsuba", "SALib"))
    known = max(case.reference_error[m].norm().item() / case.reference[m].norm().item() for m in case.metrics)
    return SECTION.format(
        heading=HEADING,
        versions=versions,
        cores=os.cpu_count(),
        scene=results.scene,
        width=size.resolution[0],
        height=size.resolution[1],
        spp=size.spp,
        target=TARGET,
        gradients="\n".join(gradient_table(results)),
        reference=size.reference * size.spp,
        known=f"up to {known:.1%}",
        runs="\n".join(single_runs(results)),
        steps=", ".join(f"{step:g}" for step in STEPS),
        best=", ".join(f"{metric} {results.steps[metric]:g}" for metric in case.metrics),
        wrong="\n  ".join(wrong_lines(results)),
        share=results.shares[0],
        our_share=results.shares[1],
        small=size.small,
        small_spp=size.small_spp,
        trajectories=size.trajectories,
        base=size.base_samples,
        renders="\n".join(render_table(results)),
        points=size.points,
    )


def write_section(path: Path, text: str) -> None:
    """Put the section where the last one was, or at the end."""
    whole = path.read_text() if path.exists() else "# Performance\n"
    before, begin, rest = whole.partition(BEGIN)
    after = rest.partition(END)[2] if begin else "\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"{before.rstrip()}\n\n{BEGIN}\n{text}{END}{after}")


def draw(results: Results) -> Any:
    """Draw cost, and renders until the top is stable, against the number of parameters."""
    from scenecaptum.visualization._figures import SMALL, TEXT, WIDTH, new_figure

    figure = new_figure(WIDTH + 0.8, 5.2)
    names = list(results.case.metrics)
    upper, lower = figure.subplots(2, len(names), sharex=True, sharey="row")
    colours = dict(zip(PEERS, ("#0072B2", "#56B4E9", "#D55E00", "#CC79A7", "#009E73"), strict=True))
    styles = dict(zip(PEERS, ("o-", "o:", "s-", "^:", "D--"), strict=True))
    for ax, metric in zip(upper, names, strict=True):
        for peer in PEERS:
            found = [results.costs[metric, count, peer] for count in results.case.counts]
            costs = [one.to_target if one.told else math.nan for one in found]
            ax.loglog(results.case.counts, costs, styles[peer], color=colours[peer], markersize=4, label=peer)
        if not any(results.costs[metric, count, OURS].told for count in results.case.counts):
            ax.text(
                0.5,
                0.5,
                "the reference is too noisy\nto tell errors from",
                transform=ax.transAxes,
                ha="center",
            )
        ax.set_title(metric, fontsize=TEXT)
    kinds = {"gradient": "local", "DGSM": "dgsm", "Morris": "morris", "Sobol": "sobol"}
    looks = dict(
        zip(
            kinds, (("o-", "#0072B2"), ("s-", "#56B4E9"), ("D--", "#E69F00"), ("^--", "#000000")), strict=True
        )
    )
    for ax, metric in zip(lower, names, strict=True):
        counts = [count for name, count in results.sampled if name == metric]
        for label, attribute in kinds.items():
            methods = [getattr(results.sampled[metric, count], attribute) for count in counts]
            style, colour = looks[label]
            ax.loglog(
                counts,
                [method.renders_until_stable for method in methods],
                style,
                color=colour,
                markersize=4,
                label=label,
            )
        ax.set_xlabel("numbers P", fontsize=TEXT)
        ax.set_xticks(results.case.counts, [str(count) for count in results.case.counts])
        ax.minorticks_off()
    upper[0].set_ylabel(f"seconds to an error of {TARGET:.0%}", fontsize=TEXT)
    lower[0].set_ylabel("renders until the top 5 is stable", fontsize=TEXT)
    for ax in (*upper, *lower):
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(labelsize=SMALL)
        ax.grid(alpha=0.25)
    upper[0].legend(fontsize=SMALL, frameon=False)
    lower[0].legend(fontsize=SMALL, frameon=False)
    return figure


def measure(scene: Any, name: str, size: Size) -> Results:
    """Measure everything."""
    began = time.perf_counter()

    def done(what: str) -> None:
        print(f"{time.perf_counter() - began:5.0f} s: {what}", flush=True)

    case = make_case(scene, size)
    done(f"reference; {len(case.numbers)} numbers of {len(case.values)} parameters")
    samples = sample_gradients(case, size)
    done("gradients")
    steps = sample_differences(case, size, samples)
    done("finite differences")
    costs = {
        (metric, count, peer): cost(case, samples, peer, metric, count)
        for metric in case.metrics
        for count in case.counts
        for peer in PEERS
    }
    sampled = compare_global(case, size)
    done("Morris and Sobol")
    results = Results(
        case, size, name, costs, steps, sampled, find_wrong(case, size), batched_share(case, size)
    )
    done("what prb gets wrong")
    return results


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", default="office", help="a bundled scene, or a file")
    parser.add_argument("--repeats", type=int, help="runs of each turn with all numbers")
    parser.add_argument("--quick", action="store_true", help="tiny pictures, to see that it works")
    parser.add_argument(
        "--write", type=Path, metavar="FILE", help="write the section, and its figure beside it"
    )
    options = parser.parse_args()
    activate()
    torch.set_num_threads(1)  # the metrics are small, and Dr.Jit has threads of its own
    scene = options.scene if options.scene in BUNDLED else Path(options.scene)
    name = options.scene if options.scene in BUNDLED else scene.parent.name
    size = QUICK if options.quick else FULL
    results = measure(scene, name, replace(size, repeats=options.repeats or size.repeats))
    print(document(results))
    if options.write:
        write_section(options.write, document(results))
        picture = options.write.parent / "pictures" / "peers.png"
        picture.parent.mkdir(exist_ok=True)
        draw(results).savefig(picture)


if __name__ == "__main__":
    main()
