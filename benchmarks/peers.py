"""Compare with other tools, on the same scene and metrics, at equal error.

Gradients are compared by the time that they need for a common relative error of the vector of P scalars: the
median time of a run, times the factor by which its samples have to grow. The error is that of repeated runs
against a reference of many samples, corrected for the reference's own error. Its variance is inversely
proportional to the samples. The systematic part, a bias from the noisy image, decreases faster; the bias of finite
differences from their step is treated in the same way, in their favour. Every scalar is scaled by its physical
range. The peers:

- ours: ``VanillaSceneGradient(renderer, metric).attribute()`` with its defaults, error bars included, and with
  ``replicates=1``, without error bars and without the correction of the bias from a noisy image;
- hand-written: ``dr.wrap`` around ``mi.render`` with ``prb``, one render and one backward pass;
- Captum: its ``Saliency`` on top of that;
- finite differences: central, with Mitsuba's ``path``, common random numbers, no Russian roulette, the best of
  three steps.

Peers take turns in one process and reload the scene for every turn, because a second loaded scene slows down the
first. They are compared for scalars whose derivative stock ``prb`` computes correctly (docs/derivatives.md); those
that it computes wrongly are listed. Brackets are 95 % intervals from a bootstrap over the repeats.

Morris's and Sobol's methods, through SALib, are compared by the number of renders until their top 5 is stable.

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
STEPS = (0.005, 0.02, 0.08)  # fractions of a scalar's range
BOOTSTRAPS = 1000
OURS, SINGLE, SCRIPT = "scenecaptum", "scenecaptum, one replicate", "hand-written"
CAPTUM, DIFFERENCES = "Captum", "finite differences"
BEGIN, END = "<!-- peers: begin -->", "<!-- peers: end -->"
HEADING = "## Comparison with other tools"

Metric = Callable[[torch.Tensor], torch.Tensor]


@dataclass(frozen=True)
class Size:
    """Amount of work.

    ``repeats`` is the number of runs per turn with all scalars; with fewer scalars there is one run, for its time.
    """

    resolution: tuple[int, int]
    spp: int
    turns: int
    repeats: int
    reference: int  # samples of the reference, as a multiple of those of a run
    seeds: int  # of each finite difference
    small: tuple[int, int]  # resolution and samples for Morris's and Sobol's methods
    small_spp: int
    trajectories: int
    base_samples: int
    points: int


FULL = Size((64, 36), 128, 3, 8, 32, 3, (64, 36), 16, 12, 32, 32)
QUICK = Size((32, 18), 16, 2, 2, 8, 2, (24, 14), 8, 4, 8, 8)


@dataclass(frozen=True)
class Number:
    """One scalar element of a parameter, and its physical interval."""

    name: str
    index: int
    low: float
    high: float

    @property
    def length(self) -> float:
        """Length of the interval."""
        return self.high - self.low

    @property
    def label(self) -> str:
        """Unique name."""
        return f"{self.name}[{self.index}]"


@dataclass
class Case:
    """A scene, its metrics, and its scalars in decreasing importance."""

    scene: Any
    values: dict[str, torch.Tensor]
    metrics: dict[str, Metric]
    numbers: list[Number]
    reference: dict[str, torch.Tensor]  # by metric: one derivative for each scalar, times its range
    reference_error: dict[str, torch.Tensor]

    @property
    def counts(self) -> list[int]:
        """Numbers P of scalars to compare."""
        return sorted({min(count, len(self.numbers)) for count in COUNTS})

    def names(self, count: int) -> list[str]:
        """Return the parameters of the first ``count`` scalars."""
        return list(dict.fromkeys(number.name for number in self.numbers[:count]))

    def vector(self, gradients: Mapping[str, torch.Tensor], count: int) -> torch.Tensor:
        """Return the gradient with respect to the first ``count`` scalars, each times its range."""
        return torch.stack(
            [gradients[n.name].reshape(-1)[n.index].double() * n.length for n in self.numbers[:count]]
        )


# --------------------------------------------------------------------------------------------- the scene


def make_case(scene: Any, size: Size) -> Case:
    """Select the scalars, most important for any of the metrics first, and compute the reference."""
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
    for name, attribution in zip(chosen, found, strict=True):
        vector = case.vector(attribution, len(numbers))
        if vector.norm() > 0:
            vectors[name], errors[name] = vector, case.vector(attribution.standard_error, len(numbers))
        else:
            print(f"{name}: left out, it does not depend on this scene")
    case.metrics = {name: chosen[name] for name in vectors}
    weight = torch.stack([vector.abs() / vector.norm() for vector in vectors.values()]).sum(0)
    order = weight.argsort(descending=True).tolist()
    case.numbers = [numbers[k] for k in order]
    case.reference = {name: vector[order] for name, vector in vectors.items()}
    case.reference_error = {name: error[order] for name, error in errors.items()}
    return case


def at_size(scene: Any, resolution: tuple[int, int]) -> Any:
    """Return a bundled scene with a film of this size, for the same image in all peers; a file unchanged."""
    if isinstance(scene, Path):
        return scene
    built = BUNDLED[scene]()
    built["sensor"]["film"] |= dict(zip(("width", "height"), resolution, strict=True))
    return built


def make_renderer(scene: Any, names: Any, resolution: tuple[int, int], spp: int) -> SceneRenderer:
    built = at_size(scene, resolution)
    return SceneRenderer(built, names, resolution=resolution, spp=spp, max_depth=DEPTH)


def make_metrics(renderer: SceneRenderer, spp: int) -> dict[str, Metric]:
    """Return the metrics; the glare threshold is fixed, because finite differences would move it."""
    with torch.no_grad():
        image = renderer(renderer.inputs, seed=10**6, spp=spp)
    glare = metrics.UnifiedGlareRating(renderer.camera, threshold_factor=5)
    return {
        "mean luminance": metrics.MeanLuminance(),
        "UGR": glare.held_at(image),
        "class logit": metrics.ClassLogit(metrics.ShapeClassifier.pretrained(), target="sphere"),
    }


def together(chosen: Mapping[str, Metric]) -> Metric:
    """Return one metric with the values of all of them as a vector."""

    def evaluate(image: torch.Tensor) -> torch.Tensor:
        return torch.stack([metric(image) for metric in chosen.values()])

    return evaluate


def interval(bounds: tuple[float, float], value: float) -> tuple[float, float]:
    """Return the physical interval, or 0.5 to 1.5 times the value if that is infinite."""
    low, high = bounds
    if math.isfinite(high - low):
        return (low or 1e-3 * high), high  # a roughness of 0 is another material
    return 0.5 * value, 1.5 * value


# --------------------------------------------------------------------------------------------- the peers


class Script:
    """The script of a Mitsuba and torch user."""

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
        # Russian roulette would terminate different paths on the two sides of a difference.
        path = mi.load_dict({"type": "path", "max_depth": DEPTH, "rr_depth": DEPTH + 1})
        params = mi.traverse(loaded)
        params.keep(list(names))

        def update(values: Mapping[str, Any]) -> None:
            for name, value in values.items():
                kind = type(params[name])
                params[name] = dr.unravel(kind, value.array) if dr.depth_v(kind) > 1 else kind(value.array)
            params.update()

        @dr.wrap(source="torch", target="drjit")
        def render(values: dict[str, Any], seed: int, spp: int) -> Any:
            update(values)
            return mi.render(loaded, params, integrator=replay, seed=seed, seed_grad=seed + 1, spp=spp)

        def set_values(values: Mapping[str, torch.Tensor]) -> None:
            update({name: mi.TensorXf(value.reshape(-1).numpy()) for name, value in values.items()})

        def primal(values: Mapping[str, torch.Tensor], seed: int, spp: int) -> torch.Tensor:
            set_values(values)
            with dr.suspend_grad():
                return path.render(loaded, seed=seed, spp=spp).torch()

        self.render = render
        self.set_values = set_values
        self.primal = primal

    def gradient(
        self, values: Mapping[str, torch.Tensor], metric: Metric, seed: int, spp: int
    ) -> dict[str, torch.Tensor]:
        """Return the gradient of the metric by autograd."""
        leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
        metric(self.render(leaves, seed, spp)).backward()
        return {name: leaf.grad for name, leaf in leaves.items()}

    def captum(
        self, values: Mapping[str, torch.Tensor], metric: Metric, seed: int, spp: int
    ) -> dict[str, torch.Tensor]:
        """Return the gradient of the metric by Captum's ``Saliency``."""
        from captum.attr import Saliency

        method = Saliency(self.batched(list(values), metric, seed, spp))
        inputs = tuple(value.clone()[None].requires_grad_() for value in values.values())
        found = method.attribute(inputs, abs=False)
        return {name: value[0] for name, value in zip(values, found, strict=True)}

    def batched(self, names: Sequence[str], metric: Metric, seed: int, spp: int) -> Metric:
        """Return the batched function for Captum."""

        def forward(*inputs: torch.Tensor) -> torch.Tensor:
            rows = [dict(zip(names, row, strict=True)) for row in zip(*inputs, strict=True)]
            return torch.stack([metric(self.render(row, seed, spp)) for row in rows])

        return forward


class Samples:
    """Gradients and seconds of repeated runs, by peer, metric and number of scalars."""

    def __init__(self) -> None:
        self.gradients: dict[tuple[str, str, int], list[torch.Tensor]] = defaultdict(list)
        self.seconds: dict[tuple[str, str, int], list[float]] = defaultdict(list)

    def add(self, peer: str, metric: str, count: int, gradient: torch.Tensor, seconds: float) -> None:
        """Add a run."""
        self.gradients[peer, metric, count].append(gradient)
        self.seconds[peer, metric, count].append(seconds)

    def errors(self, case: Case, peer: str, metric: str, count: int) -> torch.Tensor:
        """Return the ``(runs, count)`` deviations from the reference, of all runs with at least these scalars."""
        runs = [
            run[:count]
            for (p, m, n), gradients in self.gradients.items()
            if (p, m) == (peer, metric) and n >= count
            for run in gradients
        ]
        return torch.stack(runs) - case.reference[metric][:count]


def sample_gradients(case: Case, size: Size) -> Samples:
    """Run the peers that compute gradients, in turns."""
    samples = Samples()
    for turn in range(size.turns):
        for peer in (OURS, SINGLE, SCRIPT, CAPTUM):
            gc.collect()  # frees the previous peer's scene
            run = start(peer, case, size)
            for count in case.counts:
                values = {name: case.values[name] for name in case.names(count)}
                run(values, metrics.MeanLuminance(), 1)  # compiles
                for number, (name, metric) in enumerate(case.metrics.items()):
                    repeated = count == case.counts[-1] and peer != CAPTUM
                    for repeat in range(size.repeats if repeated else 1):
                        # All runs of a peer have different seeds: runs with more scalars also count for fewer.
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
    if peer in (OURS, SINGLE):
        options = {"replicates": 1} if peer == SINGLE else {}
        renderer = make_renderer(case.scene, list(case.values), size.resolution, size.spp)

        def attribute(
            values: dict[str, torch.Tensor], metric: Metric, seed: int
        ) -> Mapping[str, torch.Tensor]:
            found: Mapping[str, torch.Tensor]
            found = VanillaSceneGradient(renderer, metric).attribute(values, seed=seed, **options)
            return found

        return attribute
    script = Script(case.scene, list(case.values), size.resolution)
    differentiate = script.gradient if peer == SCRIPT else script.captum
    return lambda values, metric, seed: differentiate(values, metric, seed, size.spp)


def sample_differences(case: Case, size: Size, samples: Samples) -> dict[str, float]:
    """Sample finite differences with the best step on a subset of scalars; return that step for each metric."""
    gc.collect()
    script = Script(case.scene, list(case.values), size.resolution)
    script.set_values(case.values)  # setting a value for the first time changes the kernel
    largest = case.counts[-1]
    subset = range(0, largest, max(1, largest // 6))
    trial = {step: differences(case, script, size, subset, step) for step in STEPS}
    best = {
        metric: min(STEPS, key=lambda step: _mean_square(trial[step][0][metric], case, metric, subset))
        for metric in case.metrics
    }
    for step in sorted(set(best.values())):
        found, seconds = differences(case, script, size, range(largest), step)
        for metric in [name for name, chosen in best.items() if chosen == step]:
            for count in case.counts:
                for run in found[metric]:
                    samples.add(DIFFERENCES, metric, count, run[:count], 2 * count * seconds[metric])
    return best


def differences(
    case: Case, script: Script, size: Size, which: Sequence[int], step: float
) -> tuple[dict[str, torch.Tensor], dict[str, float]]:
    """Return for each metric the ``(seeds, scalars)`` differences times ranges, and the seconds of one render."""
    found = {name: torch.zeros(size.seeds, len(which), dtype=torch.float64) for name in case.metrics}
    rendering: list[float] = []
    evaluating: dict[str, list[float]] = defaultdict(list)
    for seed in range(size.seeds):
        for column, number in enumerate(case.numbers[k] for k in which):
            value = case.values[number.name]
            center = value.reshape(-1)[number.index].item()
            ends = [
                max(center - step * number.length, number.low),
                min(center + step * number.length, number.high),
            ]
            for sign, end in zip((-1, 1), ends, strict=True):
                moved = value.clone()
                moved.view(-1)[number.index] = end
                began = time.perf_counter()
                image = script.primal({number.name: moved}, 2 * seed + 10**5, size.spp)
                rendering.append(time.perf_counter() - began)
                for name, metric in case.metrics.items():
                    began = time.perf_counter()
                    found[name][seed, column] += sign * metric(image).item()
                    evaluating[name].append(time.perf_counter() - began)
            script.set_values({number.name: value})
            for name in case.metrics:
                found[name][seed, column] *= number.length / (ends[1] - ends[0])
    render = statistics.median(rendering)
    return found, {name: render + statistics.median(evaluating[name]) for name in case.metrics}


def _mean_square(runs: torch.Tensor, case: Case, metric: str, which: Sequence[int]) -> float:
    return (runs - case.reference[metric][list(which)]).square().mean().item()


# ------------------------------------------------------------------------------------------- equal error


@dataclass(frozen=True)
class Cost:
    """Cost of a peer at the common error.

    ``error`` is the relative error of one run of ``seconds``, of which ``systematic`` is the part common to all
    runs, or 0 if it is not significant. ``ratio`` is the cost relative to ours, with its interval; ``resolved`` is
    whether the reference is precise enough for it.
    """

    seconds: float
    error: float
    systematic: float
    to_target: float
    ratio: float
    low: float
    high: float
    resolved: bool


@dataclass(frozen=True)
class Errors:
    """Relative errors of repeated runs, ``(runs, numbers)``.

    ``known`` is the contribution of the reference to the squared error.
    """

    runs: torch.Tensor
    known: float

    def square(self, runs: torch.Tensor) -> float:
        """Return the mean squared norm without the contribution of the reference, but at least a tenth of it."""
        whole = runs.square().sum(1).mean().item()
        return max(whole - self.known, 0.1 * whole)

    @property
    def resolved(self) -> bool:
        """Whether the error of the reference is small compared with that of the runs."""
        return self.known < 0.25 * self.runs.square().sum(1).mean().item()

    @property
    def systematic(self) -> float:
        """Norm of the error common to all runs, or 0 if noise may explain it."""
        variance = self.runs.var(0) / len(self.runs)
        excess = self.runs.mean(0).square().sum().item() - variance.sum().item() - self.known
        # Standard deviation of a sum of squares of normal variables; few runs have wider tails.
        noise = math.sqrt(2 * (variance.square().sum().item() + self.known**2))
        return math.sqrt(excess) if excess > 5 * noise else 0.0

    def times(self, square: float) -> float:
        """Return the factor on the samples that reaches the target error, given the mean square of a run."""
        bias = self.systematic**2
        variance = max(square - bias, 0.0)
        # variance / n + bias / n² = target²
        return (variance + math.sqrt(variance**2 + 4 * TARGET**2 * bias)) / (2 * TARGET**2)

    def draw(self, generator: torch.Generator) -> float:
        """Return ``times`` for a bootstrap sample of the runs."""
        chosen = torch.randint(len(self.runs), (len(self.runs),), generator=generator)
        return self.times(self.square(self.runs[chosen]))


def cost(case: Case, samples: Samples, peer: str, metric: str, count: int) -> Cost:
    size = case.reference[metric][:count].norm()
    known = (case.reference_error[metric][:count] / size).square().sum().item()
    theirs, ours = (Errors(samples.errors(case, side, metric, count) / size, known) for side in (peer, OURS))
    seconds, our_seconds = (statistics.median(samples.seconds[side, metric, count]) for side in (peer, OURS))
    to_target = seconds * theirs.times(theirs.square(theirs.runs))
    ratio = to_target / (our_seconds * ours.times(ours.square(ours.runs)))
    low, high = (1.0, 1.0) if peer == OURS else _interval(seconds / our_seconds, theirs, ours)
    error = math.sqrt(theirs.square(theirs.runs))
    resolved = all(errors.resolved for errors in (theirs, ours))
    return Cost(seconds, error, theirs.systematic, to_target, ratio, low, high, resolved)


def _interval(seconds: float, theirs: Errors, ours: Errors) -> tuple[float, float]:
    """Return the 95 % interval of a ratio of costs, given the ratio of the seconds of a run."""
    generator = torch.Generator().manual_seed(0)
    drawn = [seconds * theirs.draw(generator) / ours.draw(generator) for _ in range(BOOTSTRAPS)]
    low, high = torch.tensor(drawn).quantile(torch.tensor([0.025, 0.975]))
    return low.item(), high.item()


# ------------------------------------------------------------------------------- Morris's and Sobol's methods


class Numbers:
    """A renderer whose inputs are scalars, for Morris's and Sobol's methods."""

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
        """Return the image for these scalars."""
        values = {}
        for name, value in self.own.items():
            elements = list(value.reshape(-1).unbind())
            for number in self.numbers:
                if number.name == name:
                    elements[number.index] = inputs[number.label]
            values[name] = torch.stack(elements).reshape(value.shape)
        return self.renderer(values, seed=seed, spp=spp, seed_grad=seed_grad)


def compare_global(case: Case, size: Size) -> dict[tuple[str, int], SensitivityComparison]:
    """Compare sampling-based methods and ours on small images, by the number of renders."""
    gc.collect()
    renderer = make_renderer(case.scene, list(case.values), size.small, size.small_spp)
    available = make_metrics(renderer, 16 * size.small_spp)
    chosen = {name: available[name] for name in case.metrics}
    found = {}
    for count in case.counts:
        if count <= 5:
            continue
        comparisons = compare_sensitivity(
            Numbers(renderer, case, count),
            together(chosen),
            list(range(len(chosen))),
            trajectories=size.trajectories,
            base_samples=size.base_samples,
            points=size.points,
        )
        found |= {(name, count): result for name, result in zip(chosen, comparisons, strict=True)}
        print(f"Morris and Sobol, {count} scalars: {comparisons[0].sobol.seconds:.0f} s", flush=True)
    return found


# -------------------------------------------------------------------------------------- wrong derivatives


@dataclass(frozen=True)
class Wrong:
    """Derivatives of a parameter, summed over its elements, with standard errors; the script may have none."""

    name: str
    difference: tuple[float, float]
    ours: tuple[float, float]
    script: tuple[float, float] | None


def find_wrong(case: Case, size: Size) -> list[Wrong]:
    """Differentiate the mean luminance with respect to the remaining parameters, by all three methods."""
    gc.collect()
    renderer = make_renderer(case.scene, "all", size.resolution, size.spp)
    table = renderer.parameters_table()
    tracked = [
        n for n in renderer.inputs if n not in case.values and table[n].tracked and not table[n].is_texture
    ]
    inside = [n for n in tracked if _allows_central_difference(renderer, n)]
    values = {name: renderer.inputs[name] for name in inside}
    if not values:
        return []
    metric = metrics.MeanLuminance()
    ours = VanillaSceneGradient(renderer, metric).attribute(values, spp=4 * size.spp)
    script = Script(case.scene, inside, size.resolution)
    script.set_values(values)
    runs = []
    for seed in range(4):
        try:
            runs.append(script.gradient(values, metric, 2 * seed + 2, size.spp))
        except Exception as problem:  # Mitsuba raises if no parameter is tracked
            print(f"hand-written, {len(inside)} more parameters: {problem}")
            break
    found = []
    for name, value in values.items():
        step = 0.02 * min(1.0, value.abs().max().item() or 1.0)
        slopes = torch.tensor([_slope(script, metric, name, value, step, seed, size) for seed in range(4)])
        stock = [run[name].sum() for run in runs]
        mine = torch.stack([replicate.sum() for replicate in ours.replicates[name]])
        found.append(
            Wrong(name, _estimate(slopes), _estimate(mine), _estimate(torch.stack(stock)) if stock else None)
        )
    return found


def _estimate(draws: torch.Tensor) -> tuple[float, float]:
    return draws.mean().item(), (draws.std() / len(draws) ** 0.5).item()


def _allows_central_difference(renderer: SceneRenderer, name: str) -> bool:
    """Return whether a central difference stays inside the physical bounds."""
    value, (low, high) = renderer.inputs[name], renderer.bounds[name]
    return value.min().item() > low + 0.02 and value.max().item() < high - 0.02


def _slope(
    script: Script, metric: Metric, name: str, value: torch.Tensor, step: float, seed: int, size: Size
) -> float:
    ends = [metric(script.primal({name: value + s * step}, 2 * seed, size.spp)).item() for s in (-1, 1)]
    script.set_values({name: value})
    return (ends[1] - ends[0]) / (2 * step)


def batched_share(case: Case, size: Size) -> tuple[float, float]:
    """Return the share of a difference that Captum's Integrated Gradients explain, with dr.wrap and with ours."""
    from captum.attr import IntegratedGradients

    gc.collect()
    chosen, metric = case.names(case.counts[0]), metrics.MeanLuminance()
    renderer = make_renderer(case.scene, chosen, size.resolution, size.spp)
    ours, inputs = renderer.as_captum(metric, seed=3)
    script = Script(case.scene, chosen, size.resolution)
    plain = script.batched(list(renderer.inputs), metric, 3, size.spp)
    start, end = tuple(value.detach() / 2 for value in inputs), tuple(value.detach() for value in inputs)
    shares = []
    for forward in (plain, ours):
        found = IntegratedGradients(forward).attribute(end, start, n_steps=4)
        with torch.no_grad():
            whole = (forward(*end) - forward(*start)).item()
        shares.append(sum(value.sum().item() for value in found) / whole)
    return shares[0], shares[1]


# ---------------------------------------------------------------------------------------------- output


@dataclass
class Results:
    """All measurements."""

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
            own = f"{ours.to_target:.2g} s" if ours.resolved else "–"
            cells = [own, *map(_ratio, others), f"{count / 4:g}×"]
            lines.append(f"| {metric} | {count} | " + " | ".join(cells) + " |")
    return lines


def _ratio(cost: Cost) -> str:
    return f"{cost.ratio:.3g}× [{cost.low:.3g}, {cost.high:.3g}]" if cost.resolved else "reference too noisy"


def single_runs(results: Results) -> list[str]:
    """Return the table of the time and error of one run."""
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
    systematic = f", of which {cost.systematic:.1%} systematic" if cost.systematic else ""
    return f"{cost.seconds:.2g} s, error {cost.error:.1%}{systematic}"


def render_table(results: Results) -> list[str]:
    """Return the table of renders until the top is stable."""
    lines = [
        "| metric | P | gradient | DGSM | Morris | Sobol | Morris ÷ DGSM | Sobol ÷ DGSM | in Sobol's top 5 |",
        "|---|--:|--:|--:|--:|--:|--:|--:|---|",
    ]
    for (metric, count), found in results.sampled.items():
        ours = found.dgsm.renders_until_stable
        cells = [_renders(method) for method in found.methods]
        cells += [f"{m.renders_until_stable / ours:.3g}×" for m in (found.morris, found.sobol)]
        shared = (
            f"{name} {len(set(method.top) & set(found.sobol.top))}"
            for name, method in (("gradient", found.local), ("DGSM", found.dgsm), ("Morris", found.morris))
        )
        lines.append(f"| {metric} | {count} | {' | '.join(cells)} | {', '.join(shared)} |")
    return lines


def _renders(method: Any) -> str:
    stable = f"{method.renders_until_stable:.4g}"
    return f"{'' if method.stable else '≥ '}{stable}{'' if method.resolved else ' (tied)'}"


def wrong_lines(results: Results) -> list[str]:
    """Return a list of the parameters that stock prb differentiates wrongly."""
    clear = [w for w in results.wrong if abs(w.difference[0]) > 4 * w.difference[1]]
    if not clear:
        return ["This scene has no other parameters with a significant finite difference."]
    bad = [w for w in clear if w.script is None or _is_wrong(w.script, w)]
    ours = sum(_is_wrong(w.ours, w) for w in clear)
    lines = [
        f"Of {len(clear)} more parameters of this scene with a significant finite difference (at least one step "
        f"from their bounds, and tracked by Mitsuba) stock `prb` is wrong for {len(bad)}, by more than a tenth "
        f"and 4 standard errors; scenecaptum for {ours}."
    ]
    lines += [
        f"- `{w.name}`: difference {_pair(w.difference)}, ours {_pair(w.ours)}, "
        f"`prb` {'none' if w.script is None else _pair(w.script)}"
        for w in bad
    ]
    return lines


def _pair(estimate: tuple[float, float]) -> str:
    return f"{estimate[0]:.3g} ± {estimate[1]:.1g}"


def _is_wrong(estimate: tuple[float, float], wrong: Wrong) -> bool:
    (value, error), (difference, its_error) = estimate, wrong.difference
    return abs(value - difference) > max(0.1 * abs(difference), 4 * math.hypot(error, its_error))


PEERS = (OURS, SINGLE, SCRIPT, CAPTUM, DIFFERENCES)

SECTION = """{heading}

Measured by `python benchmarks/peers.py --write docs/performance.md` with {versions}, on {cores} cores: {scene},
{width}×{height}, {spp} spp, depth 6, gradients with respect to the P scalars (channels of colours,
roughness, radiance) that matter most to any of the metrics.

Seconds that scenecaptum needs for a relative error of the gradient of {target:.0%}, and the time of the others as
a multiple of that, with a [95 % interval]. Above 1×, scenecaptum is faster.

{gradients}

Time and relative error of one run of each (the reference, with {reference} spp, has an error of {known} itself):

{runs}

- *One replicate* is scenecaptum without error bars and without the correction of the bias from a noisy image.
  *Hand-written* is `dr.wrap` around `mi.render` with `prb`: one render, one backward pass, no error bars.
  *Captum* is its `Saliency` on top of that. *Finite differences* are central, with Mitsuba's `path`, common random
  numbers and the best step of {steps} of the range ({best}).
- The P scalars are those for which stock `prb` is correct. {wrong}
- Captum's Integrated Gradients, which render a batch and then differentiate, add up to {share:.0%} of the
  difference that they should explain with a plain `dr.wrap`, whose graph only has the last scene, and to
  {our_share:.0%} with `renderer.as_captum`.

Morris's and Sobol's methods (SALib) on images of {small[0]}×{small[1]}, {small_spp} spp: the number of renders
after which their top 5 equals that after {trajectories} trajectories or {base} base samples. A backward pass
counts as a render; "tied" means that the fifth and the sixth are equal within their errors, ≥ that the last sample
still changed the set.

{renders}

*Gradient* is a single gradient at the scene's own values; *DGSM* averages squared gradients over the same
intervals as Morris and Sobol, at {points} points.

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
    """Replace the section in a page, or append it."""
    page = path.read_text() if path.exists() else "# Performance\n"
    before, begin, rest = page.partition(BEGIN)
    after = rest.partition(END)[2] if begin else "\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"{before.rstrip()}\n\n{BEGIN}\n{text}{END}{after}")


def draw(results: Results) -> Any:
    """Draw the cost, and the renders until the top is stable, over the number of parameters."""
    from scenecaptum.visualization._figures import SMALL, TEXT, WIDTH, new_figure

    figure = new_figure(WIDTH + 0.8, 5.2)
    names = list(results.case.metrics)
    upper, lower = figure.subplots(2, len(names), sharex=True, sharey="row")
    colours = dict(zip(PEERS, ("#0072B2", "#56B4E9", "#D55E00", "#CC79A7", "#009E73"), strict=True))
    styles = dict(zip(PEERS, ("o-", "o:", "s-", "^:", "D--"), strict=True))
    for ax, metric in zip(upper, names, strict=True):
        for peer in PEERS:
            found = [results.costs[metric, count, peer] for count in results.case.counts]
            costs = [peer_cost.to_target if peer_cost.resolved else math.nan for peer_cost in found]
            ax.loglog(results.case.counts, costs, styles[peer], color=colours[peer], markersize=4, label=peer)
        if not any(results.costs[metric, count, OURS].resolved for count in results.case.counts):
            ax.text(
                0.5,
                0.5,
                "the reference is too noisy",
                transform=ax.transAxes,
                ha="center",
            )
        ax.set_title(metric, fontsize=TEXT)
    kinds = {"gradient": "local", "DGSM": "dgsm", "Morris": "morris", "Sobol": "sobol"}
    line_styles = dict(
        zip(
            kinds, (("o-", "#0072B2"), ("s-", "#56B4E9"), ("D--", "#E69F00"), ("^--", "#000000")), strict=True
        )
    )
    for ax, metric in zip(lower, names, strict=True):
        counts = [count for name, count in results.sampled if name == metric]
        for label, attribute in kinds.items():
            methods = [getattr(results.sampled[metric, count], attribute) for count in counts]
            style, colour = line_styles[label]
            ax.loglog(
                counts,
                [method.renders_until_stable for method in methods],
                style,
                color=colour,
                markersize=4,
                label=label,
            )
        ax.set_xlabel("scalars P", fontsize=TEXT)
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
    began = time.perf_counter()

    def log(step: str) -> None:
        print(f"{time.perf_counter() - began:5.0f} s: {step}", flush=True)

    case = make_case(scene, size)
    log(f"reference; {len(case.numbers)} scalars of {len(case.values)} parameters")
    samples = sample_gradients(case, size)
    log("gradients")
    steps = sample_differences(case, size, samples)
    log("finite differences")
    costs = {
        (metric, count, peer): cost(case, samples, peer, metric, count)
        for metric in case.metrics
        for count in case.counts
        for peer in PEERS
    }
    sampled = compare_global(case, size)
    log("Morris and Sobol")
    results = Results(
        case, size, name, costs, steps, sampled, find_wrong(case, size), batched_share(case, size)
    )
    log("wrong derivatives of prb")
    return results


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", default="office", help="a bundled scene, or a file")
    parser.add_argument("--repeats", type=int, help="runs per turn with all scalars")
    parser.add_argument("--quick", action="store_true", help="tiny images, as a smoke test")
    parser.add_argument(
        "--write",
        type=Path,
        metavar="FILE",
        help="write the section into this page, and its figure beside it",
    )
    options = parser.parse_args()
    activate()
    torch.set_num_threads(1)  # the metrics are small, and Dr.Jit has its own threads
    scene = options.scene if options.scene in BUNDLED else Path(options.scene)
    name = options.scene if options.scene in BUNDLED else scene.parent.name
    size = QUICK if options.quick else FULL
    results = measure(scene, name, replace(size, repeats=options.repeats or size.repeats))
    print(document(results))
    if options.write:
        write_section(options.write, document(results))
        figure = options.write.parent / "pictures" / "peers.png"
        figure.parent.mkdir(exist_ok=True)
        draw(results).savefig(figure)


if __name__ == "__main__":
    main()
