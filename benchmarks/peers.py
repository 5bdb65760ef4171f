"""Compare with other tools, on the same scene and metrics, at equal error.

Gradients are compared by the time that they need for a common relative error of the vector of P scalars: that
which ``VanillaSceneGradient`` reaches in 10 seconds. Both are extrapolated from the runs of each by the number of
samples. The error is that of repeated runs against a reference of many samples, corrected for the reference's own
error. Its variance is inversely proportional to the samples. The systematic part, a bias from the noisy image,
decreases faster; any other bias is treated in the same way, in favour of the peer. Only the error of finite
differences from their step remains at any number of samples; it is measured without the reference, by another
step. A systematic error that is not significant counts as 0. Every scalar is scaled by its physical range. The
peers:

- ours: ``VanillaSceneGradient(renderer, metric).attribute()`` with its defaults, error bars included, and with
  ``replicates=1``, without error bars and without the correction of the bias from a noisy image;
- hand-written: ``dr.wrap`` around ``mi.render`` with ``prb``, one render and one backward pass;
- Captum: its ``Saliency`` on top of that;
- finite differences: central, with Mitsuba's ``path``, common random numbers, no Russian roulette, the best of
  four steps, chosen by a trial with some of the scalars.

Peers take turns in one process and reload the scene for every turn, because a second loaded scene slows down the
first. They are compared for scalars whose derivative stock ``prb`` computes correctly (docs/derivatives.md); those
that it computes wrongly are listed. Brackets are 95 % intervals from a bootstrap over the repeats.

Morris's and Sobol's methods, through SALib, are compared by the number of renders until their top 5 is stable,
only in bundled scenes. A scene from a file has a smaller amount of work, and a section of its own in the page.

    python benchmarks/peers.py [--scene ROOM] [--repeats N] [--quick] [--write docs/performance.md]
"""

from __future__ import annotations

import argparse
import gc
import importlib.metadata
import math
import os
import shlex
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from variance import RIGHT

from scenecaptum import SceneRenderer, VanillaSceneGradient, activate, metrics
from scenecaptum.scene import load_scene
from scenecaptum.scene.bundled import BUNDLED
from scenecaptum.validation import SensitivityComparison, compare_sensitivity

DEPTH = 6
TIME = 10.0  # seconds, in which scenecaptum reaches the common error
COUNTS = (4, 16, 64)
STEPS = (0.001, 0.005, 0.02, 0.08)  # fractions of a scalar's range
FEWER = 2  # runs, for their time
BOOTSTRAPS = 1000
OURS, SINGLE, SCRIPT = "scenecaptum", "scenecaptum, one replicate", "hand-written"
CAPTUM, DIFFERENCES = "Captum", "finite differences"
SCENES = Path(os.environ.get("SCENECAPTUM_SCENES", Path(__file__).parents[2] / "shared" / "scenes"))
DEFAULT_SCENE = "office"

Metric = Callable[[torch.Tensor], torch.Tensor]


@dataclass(frozen=True)
class Size:
    """Amount of work.

    ``repeats`` is the number of runs per turn with all scalars; with fewer scalars there are ``FEWER``.
    Finite differences are measured for up to ``differences`` scalars; for more, their time is scaled.
    """

    resolution: tuple[int, int]
    spp: int
    turns: int
    repeats: int
    reference: int  # samples of the reference, as a multiple of those of a run
    differences: int
    difference_spp: int
    others: int  # parameters that stock prb may differentiate wrongly, at most
    seeds: int  # of each finite difference
    small: tuple[int, int]  # resolution and samples for Morris's and Sobol's methods
    small_spp: int
    trajectories: int
    base_samples: int
    points: int


FULL = Size((64, 36), 256, 2, 5, 24, 64, 64, 32, 4, (64, 36), 16, 12, 32, 32)
FILE = Size((64, 36), 64, 2, 4, 32, 16, 32, 13, 4, (64, 36), 16, 12, 32, 32)  # slower scenes
QUICK = Size((32, 18), 16, 1, 4, 8, 16, 8, 4, 2, (24, 14), 8, 4, 8, 8)


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

        built = at_size(scene, resolution)
        loaded = load_scene(built) if isinstance(built, Path) else mi.load_dict(built, optimize=False)
        film = mi.traverse(loaded.sensors()[0])
        film["film.size"] = list(resolution)
        film.update()
        replay = mi.load_dict({"type": "prb", "max_depth": DEPTH})
        # Russian roulette would terminate different paths on the two sides of a difference.
        path = mi.load_dict({"type": "path", "max_depth": DEPTH, "rr_depth": DEPTH + 1})
        params = mi.traverse(loaded)
        params.keep(list(names))

        def update(values: Mapping[str, Any]) -> None:
            for name, value in values.items():
                kind = type(params[name])
                if dr.is_tensor_v(kind):  # a texture
                    params[name] = kind(value)
                else:
                    params[name] = (
                        dr.unravel(kind, value.array) if dr.depth_v(kind) > 1 else kind(value.array)
                    )
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
    """Gradients and seconds of repeated runs, by peer, metric and number of scalars.

    ``step_errors`` has the error of finite differences from their step, ``(runs, scalars)`` for each metric.
    """

    def __init__(self) -> None:
        self.step_errors: dict[str, torch.Tensor] = {}
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
                for metric in case.metrics.values():
                    run(values, metric, 1)  # compiles
                for number, (name, metric) in enumerate(case.metrics.items()):
                    repeats = size.repeats if peer != CAPTUM else (size.repeats + 1) // 2
                    for repeat in range(repeats if count == case.counts[-1] else FEWER):
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
    counts = [count for count in case.counts if count <= size.differences] or case.counts[:1]
    subset = range(0, counts[-1], max(1, counts[-1] // 6))
    trial = {step: differences(case, script, size, subset, step)[0] for step in STEPS}
    best = {metric: best_step(case, samples, metric, trial, subset) for metric in case.metrics}
    needed = sorted({step for chosen in best.values() for step in (chosen, neighbour(chosen))})
    found = {step: differences(case, script, size, range(counts[-1]), step) for step in needed}
    for metric, step in best.items():
        gradients, seconds = found[step]
        other = neighbour(step)
        samples.step_errors[metric] = step_error(gradients[metric], found[other][0][metric], step, other)
        for count in counts:
            for run in gradients[metric]:
                samples.add(DIFFERENCES, metric, count, run[:count], 2 * count * seconds[metric])
    return best


def best_step(
    case: Case,
    samples: Samples,
    metric: str,
    trial: Mapping[float, Mapping[str, torch.Tensor]],
    which: Sequence[int],
) -> float:
    """Return the step with the fewest samples to the common error of these scalars, or else the least error."""
    reference, error = (of[metric][list(which)] for of in (case.reference, case.reference_error))
    size = reference.norm()
    known = (error / size).square().sum().item()
    count = case.counts[-1]
    ours = Errors(samples.errors(case, OURS, metric, count)[:, list(which)] / size, known)
    target = ours.after(TIME / statistics.median(samples.seconds[OURS, metric, count]))

    def needed(step: float) -> tuple[float, float]:
        runs, other = trial[step][metric], neighbour(step)
        constant = Errors(step_error(runs, trial[other][metric], step, other) / size, 0.0).systematic
        errors = Errors((runs - reference) / size, known, constant)
        return errors.times(target), errors.square(errors.runs)

    return min(STEPS, key=needed)


def neighbour(step: float) -> float:
    """Return the next larger step, or the next smaller one of the largest."""
    place = STEPS.index(step)
    return STEPS[place + 1] if place + 1 < len(STEPS) else STEPS[place - 1]


def step_error(runs: torch.Tensor, others: torch.Tensor, step: float, other: float) -> torch.Tensor:
    """Return the error of central differences from their step, given those of another step, of the same seeds.

    It is proportional to the square of the step. Noise and a bias from it are common to both.
    """
    return (runs - others) * step**2 / (step**2 - other**2)


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
                image = script.primal({number.name: moved}, 2 * seed + 10**5, size.difference_spp)
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


# ------------------------------------------------------------------------------------------- equal error


@dataclass(frozen=True)
class Cost:
    """Cost of a peer at the common error, ``target``.

    ``error`` is the relative error of one run of ``seconds``, of which ``systematic`` is the part common to all
    runs, or 0 if it is not significant; ``constant`` is the part of that which remains at any number of samples.
    ``times`` is the factor on the samples of a run that reaches the target, ``ratio`` the cost relative to ours,
    with its interval; both may be infinite. ``resolved`` is whether the reference is precise enough for it, and
    ``scaled`` whether the errors are those of fewer scalars.
    """

    seconds: float
    error: float
    systematic: float
    constant: float
    target: float
    times: float
    ratio: float
    low: float
    high: float
    resolved: bool
    scaled: bool

    @property
    def to_target(self) -> float:
        """Seconds to the common error."""
        return self.seconds * self.times


@dataclass(frozen=True)
class Errors:
    """Relative errors of repeated runs, ``(runs, numbers)``.

    ``known`` is the contribution of the reference to the squared error. ``constant`` is the norm of the error that
    remains at any number of samples.
    """

    runs: torch.Tensor
    known: float
    constant: float = 0.0

    def square(self, runs: torch.Tensor) -> float:
        """Return the mean squared norm without the contribution of the reference, but at least a tenth of it."""
        whole = runs.square().sum(1).mean().item()
        return max(whole - self.known, 0.1 * whole)

    @property
    def resolved(self) -> bool:
        """Whether the error of the reference is small compared with that of the runs."""
        return self.known < 0.25 * self.runs.square().sum(1).mean().item()

    @cached_property
    def systematic(self) -> float:
        """Norm of the error common to all runs, or 0 if noise may explain it."""
        variance = self.runs.var(0) / len(self.runs)
        excess = self.runs.mean(0).square().sum().item() - variance.sum().item() - self.known
        # Standard deviation of a sum of squares of normal variables, at most: if the scalars of a run, which share
        # their paths, all have the same error. Few runs have wider tails.
        noise = math.sqrt(2) * (variance.sum().item() + self.known)
        return math.sqrt(excess) if excess > 5 * noise else 0.0

    def parts(self, square: float) -> tuple[float, float]:
        """Return the parts of the mean square of a run that decrease with the samples, and with their square.

        Their ratio is that of all runs, whatever the mean square of a bootstrap sample.
        """
        bias = max(self.systematic, self.constant) ** 2 - self.constant**2
        share = min(1.0, bias / max(self.square(self.runs) - self.constant**2, 1e-300))
        rest = max(square - self.constant**2, 0.0)
        return (1 - share) * rest, share * rest

    def after(self, times: float, square: float | None = None) -> float:
        """Return the error of a run with ``times`` as many samples, given the mean square of a run."""
        variance, bias = self.parts(self.square(self.runs) if square is None else square)
        return math.sqrt(variance / times + bias / times**2 + self.constant**2)

    def times(self, target: float, square: float | None = None) -> float:
        """Return the factor on the samples that reaches the target error, which may be infinite."""
        variance, bias = self.parts(self.square(self.runs) if square is None else square)
        allowed = target**2 - self.constant**2
        if allowed <= 0:
            return math.inf
        # variance / n + bias / n² = allowed
        return (variance + math.sqrt(variance**2 + 4 * allowed * bias)) / (2 * allowed)

    def draw(self, generator: torch.Generator) -> float:
        """Return the mean square of a bootstrap sample of the runs."""
        chosen = torch.randint(len(self.runs), (len(self.runs),), generator=generator)
        return self.square(self.runs[chosen])


def cost(case: Case, samples: Samples, peer: str, metric: str, count: int) -> Cost:
    """Return the cost of a peer at the error that ours has after ``TIME``."""
    ours = relative_errors(case, samples, OURS, metric, count)
    our_seconds = statistics.median(samples.seconds[OURS, metric, count])
    target = ours.after(TIME / our_seconds)
    measured = count
    if peer == DIFFERENCES:
        measured = min(count, samples.step_errors[metric].shape[1])
    theirs = relative_errors(case, samples, peer, metric, measured)
    seconds = statistics.median(samples.seconds[peer, metric, measured]) * count / measured
    times = theirs.times(target)
    low, high = (1.0, 1.0) if peer == OURS else _interval(theirs, seconds, ours, our_seconds)
    return Cost(
        seconds=seconds,
        error=math.sqrt(theirs.square(theirs.runs)),
        systematic=max(theirs.systematic, theirs.constant),
        constant=theirs.constant,
        target=target,
        times=times,
        ratio=seconds * times / TIME,
        low=low,
        high=high,
        resolved=ours.resolved and theirs.resolved,
        scaled=measured < count,
    )


def relative_errors(case: Case, samples: Samples, peer: str, metric: str, count: int) -> Errors:
    """Return the errors of a peer's runs relative to the norm of the gradient."""
    size = case.reference[metric][:count].norm()
    known = (case.reference_error[metric][:count] / size).square().sum().item()
    constant = 0.0
    if peer == DIFFERENCES:
        constant = Errors(samples.step_errors[metric][:, :count] / size, 0.0).systematic
    return Errors(samples.errors(case, peer, metric, count) / size, known, constant)


def _interval(theirs: Errors, seconds: float, ours: Errors, our_seconds: float) -> tuple[float, float]:
    """Return the 95 % interval of the ratio of costs; its ends may be infinite."""
    generator = torch.Generator().manual_seed(0)
    drawn = []
    for _ in range(BOOTSTRAPS):
        square = theirs.draw(generator)
        target = ours.after(TIME / our_seconds, ours.draw(generator))
        drawn.append(seconds * theirs.times(target, square) / TIME)
    low, high = torch.tensor(drawn).quantile(torch.tensor([0.025, 0.975]), interpolation="nearest")
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


def find_wrong(case: Case, size: Size) -> tuple[list[Wrong], int]:
    """Differentiate the mean luminance with respect to the remaining parameters, by all three methods.

    Return the derivatives with respect to every n-th of them, and n.
    """
    gc.collect()
    renderer = make_renderer(case.scene, "all", size.resolution, size.spp)
    table = renderer.parameters_table()
    tracked = [
        n for n in renderer.inputs if n not in case.values and table[n].tracked and not table[n].is_texture
    ]
    inside = [n for n in tracked if _allows_central_difference(renderer, n)]
    stride = max(1, math.ceil(len(inside) / size.others))
    inside = inside[::stride]
    values = {name: renderer.inputs[name] for name in inside}
    if not values:
        return [], stride
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
    return found, stride


def _estimate(draws: torch.Tensor) -> tuple[float, float]:
    return draws.mean().item(), (draws.std() / len(draws) ** 0.5).item()


def _allows_central_difference(renderer: SceneRenderer, name: str) -> bool:
    """Return whether a central difference stays inside the physical bounds."""
    value, (low, high) = renderer.inputs[name], renderer.bounds[name]
    return value.min().item() > low + 0.02 and value.max().item() < high - 0.02


def _slope(
    script: Script, metric: Metric, name: str, value: torch.Tensor, step: float, seed: int, size: Size
) -> float:
    ends = [
        metric(script.primal({name: value + s * step}, 2 * seed, 2 * size.difference_spp)).item()
        for s in (-1, 1)
    ]
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
    command: str
    costs: dict[tuple[str, int, str], Cost]  # metric, count, peer
    steps: dict[str, float]
    sampled: dict[tuple[str, int], SensitivityComparison]
    wrong: list[Wrong]
    stride: int  # of the parameters in ``wrong`` among all others
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
            own = f"{_percent(ours.target)} in {TIME:g} s" if ours.resolved else UNRESOLVED
            cells = [own, *map(_ratio, others), f"{count / 4:g}×"]
            lines.append(f"| {metric} | {count} | " + " | ".join(cells) + " |")
    return lines


UNRESOLVED, SCALED = "reference too noisy", r"\*"


def _ratio(cost: Cost) -> str:
    if not cost.resolved:
        return UNRESOLVED
    mark = SCALED if cost.scaled else ""
    if math.isinf(cost.low):
        return f"never{mark}"
    return f"{_multiple(cost.ratio)}{mark} [{_multiple(cost.low, '')}, {_multiple(cost.high, '')}]"


def _multiple(ratio: float, unit: str = "×") -> str:
    if math.isinf(ratio):
        return "never"
    return f"{ratio:.2g}{unit}" if ratio < 99.5 else f"{ratio:,.0f}{unit}".replace(",", " ")


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if share >= 0.1 else f"{100 * share:.2g} %"


def extrapolation(results: Results) -> str:
    """Return a sentence on each metric: how far its common error is extrapolated."""
    sentences = []
    for metric in results.case.metrics:
        seconds = [results.costs[metric, count, OURS].seconds for count in results.case.counts]
        runs = _range([f"{second:.2g}" for second in seconds])
        factors = _range([f"{TIME / second:.2g}" for second in seconds])
        sentences.append(
            f"{metric}: a run took {runs} s; the error at {TIME:g} s is extrapolated by a factor of {factors} in "
            "samples"
        )
    text = "; ".join(sentences)
    return f"{text[0].upper()}{text[1:]}."


def _range(values: Sequence[str]) -> str:
    ordered = sorted(set(values), key=float)
    return ordered[0] if len(ordered) == 1 else f"{ordered[0]} to {ordered[-1]}"


def single_runs(results: Results) -> list[str]:
    """Return the table of the time and error of one run."""
    count = results.case.counts[-1]
    lines = [
        f"| metric, P = {count} | " + " | ".join(PEERS) + " |",
        "|---|" + "---|" * len(PEERS),  # sentences, which wrap only on the left
    ]
    for metric in results.case.metrics:
        costs = [results.costs[metric, count, peer] for peer in PEERS]
        lines.append(f"| {metric} | " + " | ".join(map(_run, costs)) + " |")
    return lines


def _run(cost: Cost) -> str:
    parts = [f"{cost.seconds:.2g} s{SCALED if cost.scaled else ''}, error {_percent(cost.error)}"]
    if cost.systematic:
        parts.append(f"of which {_percent(cost.systematic)} systematic")
    if cost.constant:
        parts.append(f"{_percent(cost.constant)} from the step")
    parts.append(
        "–"
        if not cost.resolved
        else "never"
        if math.isinf(cost.times)
        else f"{_multiple(cost.times, '')} runs"
    )
    return ", ".join(parts[:-1]) + f" → {parts[-1]}"


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
    tried = f" (one in {results.stride} was tried)" if results.stride > 1 else ""
    clear = [w for w in results.wrong if abs(w.difference[0]) > 4 * w.difference[1]]
    if not clear:
        return [f"Among the other parameters{tried} none has a significant finite difference."]
    bad = [w for w in clear if w.script is None or _is_wrong(w.script, w)]
    ours = sum(_is_wrong(w.ours, w) for w in clear)
    lines = [
        f"Of {len(clear)} more parameters of this scene with a significant finite difference (at least one step "
        f"from their bounds, and tracked by Mitsuba){tried} stock `prb` is wrong for {len(bad)}, by more than a "
        f"tenth and 4 standard errors; scenecaptum for {ours}."
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

GRADIENTS = """{heading}

Measured with mitsuba {mitsuba}, on {cores} cores: {scene}, {width}×{height}, depth 6, gradients with respect
to the P scalars (channels of colours, roughness, radiance) that matter most to any of the metrics, by

```sh
{command}
```

The column *scenecaptum* is the relative error of the gradient that its defaults reach in {time:g} seconds.
The others are the time to the same error as a multiple of {time:g} seconds, with a [95 % interval]. Above 1×,
scenecaptum is faster. *Never* means that finite differences have an error from their step that no samples
remove, and that exceeds the common error.{scaled}

{gradients}

{extrapolation} Other tools are extrapolated from their own runs to the same error. Both by samples: variance
is inversely proportional to them, a bias from the noisy image decreases faster; a systematic error that is
not significant counts as 0.

Measured: time and relative error of one run of each, with {spp} spp, finite differences with {difference_spp}
spp; after the arrow, the number of such runs that the common error is extrapolated to take. The reference,
with {reference} spp, has an error of {known} itself:

{runs}

- *One replicate* is scenecaptum without error bars and without the correction of the bias from a noisy image.
  *Hand-written* is `dr.wrap` around `mi.render` with `prb`: one render, one backward pass, no error bars.
  *Captum* is its `Saliency` on top of that. *Finite differences* are central, with Mitsuba's `path`, common random
  numbers and the best step of {steps} of the range ({best}).
- The reference is computed by scenecaptum, with independent samples. The error of differences from their step does
  not depend on it: it is measured against another step.
- The P scalars are those for which stock `prb` is correct. {wrong}
- Captum's Integrated Gradients, which render a batch and then differentiate, add up to {share:.0%} of the
  difference that they should explain with a plain `dr.wrap`, whose graph only has the last scene, and to
  {our_share:.0%} with `renderer.as_captum`.
"""

GLOBAL = """
Morris's and Sobol's methods (SALib {salib}) on images of {small[0]}×{small[1]}, {small_spp} spp, by the same
command: the number of renders after which their top 5 equals that after {trajectories} trajectories or {base}
base samples. A backward pass counts as a render; "tied" means that the fifth and the sixth are equal within
their errors, ≥ that the last sample still changed the set.

{renders}

*Gradient* is a single gradient at the scene's own values; *DGSM* averages squared gradients over the same
intervals as Morris and Sobol, at {points} points.
"""

FIGURE = """
![Cost against the number of parameters](pictures/{name}.png)
"""


def document(results: Results) -> str:
    """Return the section in Markdown."""
    case, size = results.case, results.size
    known = max(case.reference_error[m].norm().item() / case.reference[m].norm().item() for m in case.metrics)
    default = results.scene == DEFAULT_SCENE
    text = GRADIENTS.format(
        heading="## Comparison with other tools" if default else f"### {results.scene.capitalize()}",
        mitsuba=importlib.metadata.version("mitsuba"),
        cores=len(os.sched_getaffinity(0)),
        scene=results.scene,
        command=results.command,
        width=size.resolution[0],
        height=size.resolution[1],
        spp=size.spp,
        difference_spp=size.difference_spp,
        time=TIME,
        scaled=scaled_note(results),
        gradients="\n".join(gradient_table(results)),
        extrapolation=extrapolation(results),
        reference=size.reference * size.spp,
        known=f"up to {_percent(known)}",
        runs="\n".join(single_runs(results)),
        steps=", ".join(f"{step:g}" for step in STEPS),
        best=", ".join(f"{metric} {results.steps[metric]:g}" for metric in case.metrics),
        wrong="\n  ".join(wrong_lines(results)),
        share=results.shares[0],
        our_share=results.shares[1],
    )
    if results.sampled:
        text += GLOBAL.format(
            salib=importlib.metadata.version("SALib"),
            small=size.small,
            small_spp=size.small_spp,
            trajectories=size.trajectories,
            base=size.base_samples,
            renders="\n".join(render_table(results)),
            points=size.points,
        )
    return text + FIGURE.format(name=section_name(results.scene))


def scaled_note(results: Results) -> str:
    """Return a sentence on the costs of finite differences that are scaled, if any."""
    if not any(found.scaled for found in results.costs.values()):
        return ""
    measured = max(
        n for (_, n, peer), found in results.costs.items() if peer == DIFFERENCES and not found.scaled
    )
    return (
        f" Finite differences were measured for the first {measured} scalars only: where marked \\*, "
        f"their time is scaled with P, and the relative error of these {measured} is taken for that of all."
    )


def section_name(scene: str) -> str:
    """Return the name of a scene's marks in the page and of its figure."""
    return "peers" if scene == DEFAULT_SCENE else f"peers-{scene}"


def marks(name: str) -> tuple[str, str]:
    """Return what marks the begin and the end of a section in a page."""
    return f"<!-- {name}: begin -->", f"<!-- {name}: end -->"


def write_section(path: Path, text: str, name: str = "peers") -> None:
    """Replace a section in a page, or insert it after that of the default scene, or append it."""
    page = path.read_text() if path.exists() else "# Performance\n"
    begin, end = marks(name)
    before, found, rest = page.partition(begin)
    after = rest.partition(end)[2]
    if not found:
        before, found, after = page.partition(marks("peers")[1])
        before, after = before + found, after or "\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"{before.rstrip()}\n\n{begin}\n{text}{end}{after}")


def draw(results: Results) -> Any:
    """Draw the cost, and the renders until the top is stable if counted, over the number of parameters."""
    from scenecaptum.visualization._figures import TEXT, WIDTH, new_figure

    names = list(results.case.metrics)
    rows = 2 if results.sampled else 1
    figure = new_figure(WIDTH + 2, 2.6 * rows)
    grid = figure.subplots(rows, len(names), sharex=True, sharey="row", squeeze=False)
    for ax, metric in zip(grid[0], names, strict=True):
        draw_costs(ax, results, metric)
        ax.set_title(metric, fontsize=TEXT)
    grid[0][0].set_ylabel(f"seconds to the error of\nscenecaptum after {TIME:g} s", fontsize=TEXT)
    if results.sampled:
        for ax, metric in zip(grid[1], names, strict=True):
            draw_renders(ax, results, metric)
        grid[1][0].set_ylabel("renders until the top 5 is stable", fontsize=TEXT)
    for ax in grid[-1]:
        ax.set_xlabel("scalars P", fontsize=TEXT)
        ax.set_xticks(results.case.counts, [str(count) for count in results.case.counts])
        ax.minorticks_off()
    finish(grid)
    return figure


def draw_costs(ax: Any, results: Results, metric: str) -> None:
    """Draw the time of each peer to the common error, where it reaches it and the reference resolves it."""
    colours = dict(zip(PEERS, ("#0072B2", "#56B4E9", "#D55E00", "#CC79A7", "#009E73"), strict=True))
    styles = dict(zip(PEERS, ("o-", "o:", "s-", "^:", "D--"), strict=True))
    for peer in PEERS:
        found = [results.costs[metric, count, peer] for count in results.case.counts]
        seconds = [c.to_target if c.resolved and math.isfinite(c.times) else math.nan for c in found]
        ax.loglog(results.case.counts, seconds, styles[peer], color=colours[peer], markersize=4, label=peer)
    if not any(results.costs[metric, count, OURS].resolved for count in results.case.counts):
        ax.text(0.5, 0.5, "the reference is too noisy", transform=ax.transAxes, ha="center")


def draw_renders(ax: Any, results: Results, metric: str) -> None:
    """Draw the renders until the top is stable."""
    kinds = {"gradient": "local", "DGSM": "dgsm", "Morris": "morris", "Sobol": "sobol"}
    styles = (("o-", "#0072B2"), ("s-", "#56B4E9"), ("D--", "#E69F00"), ("^--", "#8C8C8C"))
    counts = [count for name, count in results.sampled if name == metric]
    for (label, attribute), (style, colour) in zip(kinds.items(), styles, strict=True):
        methods = [getattr(results.sampled[metric, count], attribute) for count in counts]
        renders = [method.renders_until_stable for method in methods]
        ax.loglog(counts, renders, style, color=colour, markersize=4, label=label)


def finish(grid: Any) -> None:
    """Style the axes, with a legend for each row."""
    from scenecaptum.visualization._figures import SMALL

    for ax in grid.flat:
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(labelsize=SMALL)
        ax.grid(alpha=0.25)
    for row in grid:
        handles, labels = row[0].get_legend_handles_labels()
        row[-1].legend(
            handles, labels, fontsize=SMALL, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5)
        )


def measure(scene: Any, name: str, size: Size, command: str) -> Results:
    """Measure everything; Morris's and Sobol's methods only in bundled scenes."""
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
    sampled = {}
    if not isinstance(scene, Path):
        sampled = compare_global(case, size)
        log("Morris and Sobol")
    (wrong, stride), shares = find_wrong(case, size), batched_share(case, size)
    log("wrong derivatives of prb")
    return Results(case, size, name, command, costs, steps, sampled, wrong, stride, shares)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", default=DEFAULT_SCENE, help="a room, or a scene file")
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
    scene, name = find_scene(options.scene)
    size = QUICK if options.quick else FILE if isinstance(scene, Path) else FULL
    size = replace(size, repeats=options.repeats or size.repeats)
    results = measure(scene, name, size, command_line(options, name))
    print(document(results))
    if options.write:
        write_section(options.write, document(results), section_name(name))
        figure = options.write.parent / "pictures" / f"{section_name(name)}.png"
        figure.parent.mkdir(exist_ok=True)
        draw(results).savefig(figure)


def find_scene(scene: str) -> tuple[str | Path, str]:
    """Return the name of a bundled scene or the path of a file, and the name of the room."""
    if scene in BUNDLED:
        return scene, scene
    room = SCENES / scene / "scene.xml"
    path = room if room.exists() else Path(scene)
    return path, path.resolve().parent.name


def command_line(options: argparse.Namespace, name: str) -> str:
    """Return the command of this run, with the name of the room for its file."""
    words = ["python", "benchmarks/peers.py"]
    if name != DEFAULT_SCENE:
        words += ["--scene", name]
    if options.repeats:
        words += ["--repeats", str(options.repeats)]
    if options.quick:
        words.append("--quick")
    if options.write:
        words += ["--write", "docs/performance.md"]
    return shlex.join(words)


if __name__ == "__main__":
    main()
