"""Compare the derivatives of every plugin's parameters with finite differences, and write the table.

The reference is independent: Mitsuba's own ``path`` or ``volpath`` renders the scene, loaded without this package,
with the parameter moved up and down and common random numbers. Ours are measured twice: with independent samples
in the backward pass, as in every attribution method, and by replay of the image's samples. The cache stores each
finished case; plugins without a case in the cache keep their section of the page. A blend with a perfectly
specular lobe is our own plugin in the reference, too: Mitsuba renders it wrongly.

    python benchmarks/derivatives.py [--only 'rough*'] [--quick] [--budget SECONDS] [--resume]
        [--write docs/derivatives.md]
"""

from __future__ import annotations

import argparse
import fnmatch
import gc
import importlib.metadata
import json
import math
import multiprocessing
import re
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from derivative_table import ABOVE, BELOW, CASES, GROUPS, WITHOUT_PARAMETERS, Case, Row

from scenecaptum import SceneRenderer, activate
from scenecaptum.errors import SceneCaptumError

SEEDS = 16  # for the estimate of a standard error
FIRST_SPP, MOST_SPP = 64, 4096
AIM = 0.07  # relative standard error at which sampling stops
GOOD = 0.10  # largest relative standard error of a resolved row
# A one-sided difference starts slightly inside the bounds, because some plugins treat the bound itself specially
# (at an index of exactly 1 the plastics jump by 0.1 %).
START = 1e-3  # steps
STEP_BIAS = 0.005  # allowed bias of a difference quotient from its step, as a fraction of its value
BUDGET, QUICK_BUDGET = 30.0, 4.0  # seconds for the difference of a row, and for our derivatives of three rows
# Separate seeds, so that the errors of the estimates are independent.
OURS, DIFFERENCE, STOCK, REPLAY = 0, 100_000, 200_000, 300_000
SIDES = {ABOVE: " ↑", BELOW: " ↓"}

Targets = Mapping[str, Row]  # by the parameter's full name


@dataclass(frozen=True)
class Estimate:
    """A mean over seeds with its standard error, and its total samples per pixel."""

    value: float
    error: float
    spp: int

    @property
    def relative_error(self) -> float:
        """Standard error over value; 0 for an exact zero."""
        return self.error / abs(self.value) if self.value else (math.inf if self.error else 0.0)

    @property
    def is_zero(self) -> bool:
        """Whether it is 0 up to rounding, for a metric of about 1."""
        return abs(self.value) + self.error < 1e-5

    def __str__(self) -> str:
        """Format the value to the precision of its error."""
        if not math.isfinite(self.value) or not math.isfinite(self.error):
            return str(self.value)
        if self.error == 0:
            return f"{self.value:.4g}"
        digits = -math.floor(math.log10(self.error))
        if digits <= 5:
            return f"{self.value:.{max(digits, 0)}f} ± {self.error:.{max(digits, 0)}f}"
        exponent = math.floor(math.log10(max(abs(self.value), self.error)))
        digits = max(digits + exponent, 0)
        return f"({self.value / 10**exponent:.{digits}f} ± {self.error / 10**exponent:.{digits}f})e{exponent}"


@dataclass(frozen=True)
class Outcome:
    """One row of the table."""

    case: str
    plugin: str
    parameter: str
    value: float | None
    step: str
    verdict: str
    z: float | None = None
    ours: Estimate | None = None
    replay: Estimate | None = None
    difference: Estimate | None = None
    stock: Estimate | str | None = None
    note: str = ""

    def __str__(self) -> str:
        """Format the row as a line of text."""
        value = "" if self.value is None else f"{self.value:.4g}"
        z = "" if self.z is None else f"{self.z:+.1f}"
        return (
            f"{self.verdict:11s} {self.parameter:48s} {value:>7s}  ours {self.ours or '–'!s:22s} difference "
            f"{self.difference or '–'!s:22s} z {z:6s} prb {self.stock or '–'!s:22s} {self.note}"
        )


# ------------------------------------------------------------------------------------------------ the two sides


def weights(width: int, height: int) -> np.ndarray[Any, Any]:
    """Return the pixel weights of the metric: non-uniform, to be sensitive to light that moves in the image."""
    u, v = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    return ((0.4 + 1.2 * u) * (1.4 - 0.8 * v) / (3 * width * height))[..., None]


SPECULAR = {"conductor", "dielectric", "thindielectric", "plastic"}


def _with_our_blends(scene: Any) -> Any:
    """Return a scene in which each blend with a perfectly specular lobe is our plugin."""
    if not isinstance(scene, Mapping):
        return scene
    built = {name: _with_our_blends(value) for name, value in scene.items()}
    types = {value.get("type") for value in built.values() if isinstance(value, Mapping)}
    if built.get("type") == "blendbsdf" and types & SPECULAR:
        from scenecaptum.scene import _blend  # noqa: F401 -- registers the plugin

        built["type"] = "scenecaptum_blendbsdf"
    return built


class MitsubaReference:
    """A scene in Mitsuba without this package: difference quotients of its images, and derivatives of ``prb``."""

    def __init__(self, case: Case) -> None:
        self._mi = activate()
        built = _with_our_blends(case.build())
        self._settings = built["integrator"]
        self._scene = self._mi.load_dict(built, optimize=False)
        self._integrator = self._scene.integrator()
        self._weights = weights(*self._scene.sensors()[0].film().size())
        self._params = self._mi.traverse(self._scene)
        self.targets = {self._full_name(row.parameter): row for row in case.rows}
        self._own = {name: self._copy(self._params[name]) for name in self.targets}

    def _full_name(self, parameter: str) -> str:
        endings = ("", ".value", ".data", ".values", ".value.value")
        return next(parameter + ending for ending in endings if parameter + ending in self._params)

    def _copy(self, value: Any) -> Any:
        import drjit as dr

        return type(value)(value) if dr.is_array_v(value) else value

    def value(self, name: str) -> float | None:
        """Return the mean of a parameter's elements; None for a transformation."""
        try:
            return float(np.mean(np.array(self._own[name], dtype=np.float64)))
        except (TypeError, ValueError):
            return None

    def quotient(self, name: str, seed: int, spp: int) -> float:
        """Return the second-order difference quotient of the metric, with common random numbers."""
        row = self.targets[name]
        assert row.step is not None

        def at(steps: float) -> float:
            self._move(name, steps)
            image = self._integrator.render(self._scene, 0, seed=seed, spp=spp)
            return float((np.array(image)[..., :3] * self._weights).sum(dtype=np.float64))

        if row.side == ABOVE:
            rise = (-3 * at(START) + 4 * at(1) - at(2)) / 2
        elif row.side == BELOW:
            rise = (3 * at(-START) - 4 * at(-1) + at(-2)) / 2
        else:
            rise = (at(1) - at(-1)) / 2
        return rise / row.step

    def _move(self, name: str, steps: float) -> None:
        row, own = self.targets[name], self._own[name]
        if steps:
            pattern = own / self.value(name) if row.scaled else 1
            self._params[name] = own + steps * row.step * pattern
        else:
            self._params[name] = self._copy(own)
        self._params.update()

    def restore(self, name: str) -> None:
        """Restore a parameter's own value."""
        self._move(name, 0)

    def difference(self, name: str, budget: float) -> Estimate:
        """Sample the difference quotient of one parameter."""
        try:
            (found,) = sample(lambda seed, spp: [self.quotient(name, seed, spp)], DIFFERENCE, budget)
        finally:
            self.restore(name)
        return found

    def stock(self, spp: int) -> dict[str, Estimate | str]:
        """Return the derivatives by Mitsuba's ``prb`` or ``prbvolpath``, or the reason why there are none."""
        import drjit as dr

        kind = {"path": "prb", "volpath": "prbvolpath"}[self._settings["type"]]
        integrator = self._mi.load_dict({**self._settings, "type": kind})
        adjoint = np.broadcast_to(self._weights, (*self._weights.shape[:2], 3)).astype(np.float32)
        leaves = {}
        for name, own in self._own.items():
            if self.targets[name].step is not None and dr.is_diff_v(own):
                leaves[name] = self._copy(own)
                dr.enable_grad(leaves[name])
                self._params[name] = leaves[name]
        self._params.update()

        def gradients(seed: int) -> list[float]:
            integrator.render_backward(
                self._scene, self._params, self._mi.TensorXf(adjoint), 0, seed=seed, spp=spp
            )
            found = [self._directional(name, np.array(dr.grad(leaf))) for name, leaf in leaves.items()]
            dr.clear_grad(list(leaves.values()))
            return found

        try:
            draws = np.array([gradients(STOCK + i) for i in range(SEEDS)]) if leaves else np.empty((SEEDS, 0))
        except RuntimeError:
            return dict.fromkeys(self.targets, "raises")
        found = dict(zip(leaves, estimates(draws, spp), strict=True))
        return {name: found.get(name, "not tracked") for name in self.targets}

    def _directional(self, name: str, gradient: np.ndarray[Any, Any]) -> float:
        own = np.array(self._own[name], dtype=np.float64)
        pattern = own / own.mean() if self.targets[name].scaled else 1.0
        return float((gradient * pattern).sum(dtype=np.float64))


@dataclass(frozen=True)
class Derivatives:
    """Our two derivatives of one parameter."""

    attributed: Estimate  # with independent samples in the backward pass, as attribution methods
    replayed: Estimate  # with the samples of the image, as plain ``backward()``


class Ours:
    """The same scene in this package."""

    def __init__(self, case: Case, targets: Targets) -> None:
        self.renderer = SceneRenderer(case.build(), list(targets))
        self._targets = targets
        self._weights = torch.from_numpy(weights(*self.renderer.resolution)).float()

    def attributed(self, names: Sequence[str], seed: int, spp: int) -> list[float]:
        """Return the directional derivatives of some rows as attribution methods take them."""
        # The metric is linear: its adjoint, and so the backward pass, does not depend on the image.
        return self._gradients(names, seed=seed, seed_grad=seed + 1, spp=1, spp_grad=spp)

    def replayed(self, seed: int, spp: int) -> list[float]:
        """Return the directional derivatives of all rows by replay of the image's samples."""
        return self._gradients(list(self._targets), seed=seed, spp=spp)

    def groups(self) -> list[list[str]]:
        """Divide the rows: each roughness alone, because light tracing starts only among low roughnesses."""
        table = self.renderer.parameters_table()
        alone = [name for name in self._targets if table[name].kind == "roughness"]
        others = [name for name in self._targets if name not in alone]
        return [group for group in (others, *([name] for name in alone)) if group]

    def _gradients(self, names: Sequence[str], **settings: int) -> list[float]:
        leaves = self.renderer.leaves()
        moved = {name: leaves[name] for name in names}
        (self.renderer(moved, **settings) * self._weights).sum().backward()
        return [self._directional(self._targets[name], leaf) for name, leaf in moved.items()]

    @staticmethod
    def _directional(row: Row, leaf: torch.Tensor) -> float:
        assert leaf.grad is not None
        pattern = leaf.detach() / leaf.detach().mean() if row.scaled else torch.ones_like(leaf)
        return float((leaf.grad * pattern).double().sum())


# ------------------------------------------------------------------------------------------------ sampling


def estimates(draws: np.ndarray[Any, Any], spp: int) -> list[Estimate]:
    """Return the mean and standard error of each column of independent draws with ``spp`` samples per pixel."""
    count = len(draws)
    return [
        Estimate(float(column.mean()), float(column.std(ddof=1) / math.sqrt(count)), count * spp)
        for column in draws.T
    ]


def sample(
    draw: Callable[[int, int], Sequence[float]], first_seed: int, budget: float, spp: int = FIRST_SPP
) -> list[Estimate]:
    """Draw with new seeds and increasing samples until all means are precise or the time budget is spent."""
    end = time.perf_counter() + budget
    count, seed = SEEDS, first_seed
    while True:
        began = time.perf_counter()
        draws = np.array([draw(seed + i, spp) for i in range(count)])
        seed += count
        found = estimates(draws, spp)
        worst = max(estimate.relative_error for estimate in found)
        # The time of a round grows at most linearly with its samples.
        affordable = (end - time.perf_counter()) / (time.perf_counter() - began)
        if worst <= AIM or affordable < 1.5 or not np.isfinite(draws).all():
            return found
        wanted = 1.3 * min((worst / AIM) ** 2, 1e6)
        total = spp * count * min(max(wanted, 1.5), affordable)
        spp = int(np.clip(total / SEEDS, spp, MOST_SPP))
        count = max(SEEDS, round(total / spp))


# ------------------------------------------------------------------------------------------------ comparing


def run_case(case: Case, known: Sequence[Outcome], budget: float, with_stock: bool) -> list[Outcome]:
    """Measure every row of a case; if the reference is known, only our derivatives."""
    if not known:
        try:
            known = measure_reference(case, budget, with_stock)
        except RuntimeError as error:
            note = f"Mitsuba's own path tracer does not render it: {_error_text(error)}"
            return [
                Outcome(
                    case.name, case.plugin, row.parameter, None, _step_text(row), "unsupported", note=note
                )
                for row in case.rows
            ]
        gc.collect()
    targets = {outcome.parameter: row for outcome, row in zip(known, case.rows, strict=True)}
    ours, notes = measure_ours(case, targets, budget)
    return [_judged(known, ours.get(known.parameter), notes.get(known.parameter, "")) for known in known]


def _judged(known: Outcome, ours: Derivatives | None, note: str) -> Outcome:
    """Return a row of the reference with our derivatives and the verdict."""
    theirs = known.difference
    if ours is None:
        return replace(known, verdict="unsupported", note=note)
    if theirs is None:
        return replace(known, verdict="unresolved", ours=ours.attributed, replay=ours.replayed, note=note)
    pairs = ((ours.attributed, theirs), (ours.replayed, theirs), (ours.attributed, ours.replayed))
    found = verdict(*pairs)
    if found != "right":
        distances = [f"{z_score(*pair):+.1f}" for pair in pairs[1:]]
        replay = f"replay {ours.replayed}, z {distances[0]}, ours from it {distances[1]}"
        note = f"{replay}; {note}" if note else replay
    # Two values of 0 are right whatever the standard errors of their rounding.
    z = None if ours.attributed.is_zero and theirs.is_zero else z_score(ours.attributed, theirs)
    return replace(known, verdict=found, z=z, ours=ours.attributed, replay=ours.replayed, note=note)


def measure_reference(case: Case, budget: float, with_stock: bool) -> list[Outcome]:
    """Return the rows of a case with the reference only."""
    reference = MitsubaReference(case)
    differences = {
        name: reference.difference(name, budget)
        for name, row in reference.targets.items()
        if row.step is not None
    }
    stock = reference.stock(4 * FIRST_SPP) if with_stock and differences else {}
    return [
        Outcome(
            case=case.name,
            plugin=case.plugin,
            parameter=name,
            value=reference.value(name),
            step=_step_text(row),
            verdict="",
            difference=differences.get(name),
            stock=stock.get(name),
        )
        for name, row in reference.targets.items()
    ]


def measure_ours(
    case: Case, targets: Targets, budget: float
) -> tuple[dict[str, Derivatives], dict[str, str]]:
    """Return our derivatives, and the error message or caution of parameters that have one."""
    try:
        ours = Ours(case, targets)
        notes = {name: f"caution: {caution}" for name, caution in ours.renderer.plan.cautions}
        return _sample_ours(ours, targets, budget), notes
    except Exception as error:
        if len(targets) == 1:
            return {}, dict.fromkeys(targets, _error_text(error))
    finally:
        ours = None
        gc.collect()
    # At least one of several failed: try them separately.
    supported, notes = {}, {}
    for name, row in targets.items():
        try:
            SceneRenderer(case.build(), [name])
            supported[name] = row
        except Exception as error:
            notes[name] = _error_text(error)
        gc.collect()
    some_failed = 0 < len(supported) < len(targets)
    parts = [supported] if some_failed else [{name: row} for name, row in supported.items()]
    found: dict[str, Derivatives] = {}
    for part in parts:
        part_found, part_notes = measure_ours(case, part, budget)
        found.update(part_found)
        notes.update(part_notes)
    return found, notes


def _sample_ours(ours: Ours, targets: Targets, budget: float) -> dict[str, Derivatives]:
    def seconds(rows: int) -> float:
        return budget * max(1.0, rows / 3)

    attributed: dict[str, Estimate] = {}
    for group in ours.groups():
        # Two seeds for each draw: that of the image and that of the backward pass.
        found = sample(
            lambda seed, spp, group=group: ours.attributed(group, 2 * seed, spp), OURS, seconds(len(group))
        )
        attributed.update(zip(group, found, strict=True))
    replayed = sample(ours.replayed, REPLAY, seconds(len(targets)))
    return {
        name: Derivatives(attributed[name], replay) for name, replay in zip(targets, replayed, strict=True)
    }


def z_score(ours: Estimate, other: Estimate) -> float:
    """Return the difference of the two in standard errors, which include the bias of the step."""
    error = math.hypot(ours.error, other.error, STEP_BIAS * other.value)
    deviation = ours.value - other.value
    return deviation / error if error else (0.0 if deviation == 0 else math.copysign(math.inf, deviation))


def verdict(*pairs: tuple[Estimate, Estimate]) -> str:
    """Return the worst verdict on any pair of estimates of the same derivative."""
    return max((_verdict_on_pair(*pair) for pair in pairs), key=("right", "unresolved", "wrong").index)


def _verdict_on_pair(ours: Estimate, other: Estimate) -> str:
    if ours.is_zero and other.is_zero:
        return "right"
    if not math.isfinite(ours.value) or abs(z_score(ours, other)) >= 4:
        return "wrong"
    return "right" if max(ours.relative_error, other.relative_error) <= GOOD else "unresolved"


_SYMBOLIC = "tried to evalute a *symbolic* variable"  # in Dr.Jit's message, spelt so


def _error_text(error: BaseException) -> str:
    """Return an error on one line: our message in full, or Mitsuba's innermost one in words or shortened."""
    while not isinstance(error, SceneCaptumError) and error.__cause__ is not None:
        error = error.__cause__
    text = " ".join(str(error).split())
    if _SYMBOLIC in text:
        return "Dr.Jit cannot compile it, because the plugin evaluates variables within a recorded loop"
    return text if isinstance(error, SceneCaptumError) or len(text) < 200 else f"{text[:200]} …"


# ------------------------------------------------------------------------------------------------ running


def run_plugin(plugin: str, chosen: set[str], options: argparse.Namespace) -> None:
    """Run the cases of one plugin in a separate process, because Dr.Jit's calls cover every scene of a process."""
    budget = options.budget or (QUICK_BUDGET if options.quick else BUDGET)
    for case in CASES:
        if case.plugin != plugin or case.name not in chosen:
            continue
        start = time.perf_counter()
        known = [o for o in outcomes_in(options.cache) if o.case == case.name] if options.ours else []
        outcomes = run_case(case, known, budget, not options.quick)
        record = json.loads(options.cache.read_text()) if options.cache.exists() else {}
        record[case.name] = [asdict(outcome) for outcome in outcomes]
        options.cache.write_text(json.dumps(record, indent=1))
        print(f"{case.name}  ({time.perf_counter() - start:.0f} s)", flush=True)
        for outcome in outcomes:
            print(f"  {outcome}", flush=True)


def outcomes_in(cache: Path) -> list[Outcome]:
    """Read the outcomes of those cases whose rows are unchanged, in the order of the cases."""
    record = json.loads(cache.read_text()) if cache.exists() else {}
    found = []
    for case in CASES:
        outcomes = [_outcome(entry) for entry in record.get(case.name, [])]
        if [outcome.step for outcome in outcomes] == [_step_text(row) for row in case.rows]:
            found += outcomes
    return found


def _step_text(row: Row) -> str:
    return "" if row.step is None else f"{row.step:.3g}{SIDES.get(row.side, '')}"


def _outcome(entry: dict[str, Any]) -> Outcome:
    sides = {
        k: Estimate(**v) if isinstance(v := entry[k], dict) else v
        for k in ("ours", "replay", "difference", "stock")
    }
    return Outcome(**{**entry, **sides})


def summary(outcomes: Sequence[Outcome]) -> str:
    counts = Counter(outcome.verdict for outcome in outcomes)
    return ", ".join(f"{counts[v]} {v}" for v in ("right", "wrong", "unresolved", "unsupported"))


# ------------------------------------------------------------------------------------------------ writing

INTRODUCTION = """# Derivatives against finite differences

After this page you know whether the derivative of a parameter can be trusted, here and in Mitsuba's own `prb`.
Every BSDF, texture, emitter and medium plugin of Mitsuba, and every continuous parameter that it exposes, was
compared with finite differences: **{summary}**.

{overview}

Known to be wrong, and marked with `!` in results: bump maps and normal maps where a bent normal turns away from
the viewer, as on a floor seen from the side; and, not in the table, the texture that masks a perfectly specular
material, whose sign may be wrong, too.

The derivative with respect to an index of refraction, or another number that path replay misses, is the mean
slope over a small step: ±0.02 for an index (±0.004 near 1), a reflectance or an opacity, and ±5% for others. Where
a glass ball shows the image of a lamp, which moves quickly with the index, the slope at one point may be several
times as large.

*Unresolved* rows are too noisy for a verdict. *Unsupported* are parameters that only control the sampling, poses
and positions (objects, lamps and cameras are [moved in another way](moving.md)), maps that rotate perfectly
specular reflections, and plugins that Mitsuba itself does not render or sample correctly; selecting one raises an
error with the reason. For `prb`, the rows with a finite difference are counted; *none* means that it refuses the
scene or does not track the parameter.

## How it was measured

Each parameter is in a small scene: a ball or two, a floor, a block, a lamp, and a non-uniform sky; or a floor that
reflects a lamp into the camera. Measured by `python benchmarks/derivatives.py --write docs/derivatives.md` with
{versions}. Rows are sampled for a time that `--budget` sets; here 8 seconds, 20 for textures of
roughness, and 25 in the cases where 8 left a row unresolved.

- *Ours* is the derivative of a weighted mean of the image from `SceneRenderer`, summed over all elements of the
  parameter (for a bump map, weighted by their values). It is taken with `seed_grad`, as in every attribution
  method: pixels are importance-sampled, low roughnesses are traced from the lights, and indices of refraction use
  differences of paths. Each roughness is the only input of its backward pass, because light tracing only starts
  where at least half of the inputs are low roughnesses.
- *Difference* is the finite difference of the same number,
  from Mitsuba's own `path` or `volpath` (same depth, no Russian roulette) on a scene loaded without this package:
  of second order, with common random numbers, central or from above (↑) or below (↓), with the given step. Each is
  a mean over at least {seeds} seeds ± its standard error. Blends with a perfectly specular lobe are our plugin
  there, too: Mitsuba adds the probability of that lobe to densities, and renders them too dark.
- *z* is their distance in standard errors, left out where both are 0 up to rounding; {bias:.1%} of the difference
  is added to the error for its step.
- *Replay*, which is shown in wrong rows only, is our derivative without `seed_grad`, as in plain `backward()`: it
  replays the samples of the image, with all parameters of a scene as inputs.
- *prb* is Mitsuba's own `prb` or `prbvolpath` on the same scene; *raises*: it refuses the scene; *not tracked*:
  the parameter has no derivative there.
- *right*: |z| < 4 between any two of ours, replay and difference, and all errors are at most {good:.0%} of
  their values; or both are 0 up to rounding, below 1e-5 for a metric of about 1. *wrong*: any |z| ≥ 4.
  *unresolved*: the errors are larger, after the samples per pixel below the table. *unsupported*: the error
  message is below the table. Parameters that only control the sampling, and poses, have only this message.
"""


def document(outcomes: Sequence[Outcome], page: str) -> str:
    """Return the table in Markdown; the sections of plugins without outcomes are those of the page."""
    measured = {outcome.plugin for outcome in outcomes}
    kept = {plugin: text for plugin, text in _sections(page).items() if plugin not in measured}
    outcomes = [*outcomes, *(row for plugin, text in kept.items() for row in _rows(plugin, text))]
    versions = " and ".join(f"{n} {importlib.metadata.version(n)}" for n in ("mitsuba", "drjit"))
    parts = [
        INTRODUCTION.format(
            versions=versions,
            summary=summary(outcomes),
            overview=overview(outcomes),
            seeds=SEEDS,
            bias=STEP_BIAS,
            good=GOOD,
        ),
        "Without continuous parameters: "
        + "; ".join(f"`{plugin}` ({why})" for plugin, why in WITHOUT_PARAMETERS.items())
        + ".\n",
    ]
    for plugin in dict.fromkeys(case.plugin for case in CASES):  # the cases of some are apart
        if plugin in kept:
            parts += [f"## {plugin}\n{kept[plugin]}"]
        elif group := [outcome for outcome in outcomes if outcome.plugin == plugin]:
            parts += ["\n".join((f"## {plugin}\n", *_table(group))) + "\n"]
    return "\n".join(parts)


def _sections(page: str) -> dict[str, str]:
    """Return the text below the heading of each plugin."""
    plugins = {case.plugin for case in CASES}
    parts = (part.split("\n", 1) for part in page.split("\n## ")[1:])
    return {name: f"{text.rstrip()}\n" for name, text in parts if name in plugins}


def _rows(plugin: str, section: str) -> Iterator[Outcome]:
    """Read the rows of a section, with the digits that it prints."""
    for line in section.splitlines():
        cells = [cell.strip() for cell in line.strip("| ").split(" | ")]
        if len(cells) == len(HEADS) and cells[0].startswith("`"):
            _, verdict, ours, stock, difference, _, step, _, scene = cells
            read = {"ours": _estimate(ours), "stock": _estimate(stock), "difference": _estimate(difference)}
            yield Outcome(f"{plugin}/{scene}", plugin, cells[0], None, step, verdict, **read)


def _estimate(text: str) -> Any:
    """Read a number with its error; None of a dash, and the text itself of another."""
    found = re.fullmatch(r"\(?(-?[\d.]+)(?: ± ([\d.]+))?(?:\)e(-?\d+))?", text)
    if found is None:
        return None if text == "–" else text
    factor = 10.0 ** int(found[3] or 0)
    return Estimate(factor * float(found[1]), factor * float(found[2] or 0), 0)


def overview(outcomes: Sequence[Outcome]) -> str:
    """Return the verdicts by group of plugins as Markdown, and the plugins for which ``prb`` is wrong."""
    group_of = {plugin: group for group, plugins in GROUPS.items() for plugin in plugins}
    lines = [
        "| | right | wrong | unresolved | unsupported | `prb`: right | wrong | unresolved | none |",
        "|---|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for group in ("materials", *GROUPS):
        members = [outcome for outcome in outcomes if group_of.get(outcome.plugin, "materials") == group]
        ours = Counter(outcome.verdict for outcome in members)
        stock = Counter(map(stock_verdict, members))
        counts = [ours[v] for v in ("right", "wrong", "unresolved", "unsupported")]
        counts += [stock[v] for v in ("right", "wrong", "unresolved", "none")]
        lines.append(f"| {group} | {' | '.join(map(str, counts))} |")
    failing = dict.fromkeys(o.plugin for o in outcomes if stock_verdict(o) in ("wrong", "none"))
    plugins = ", ".join(f"`{plugin}`" for plugin in failing)
    return "\n".join(
        [*lines, "", f"`prb` is wrong, or has no derivative, for at least one parameter of: {plugins}."]
    )


def stock_verdict(outcome: Outcome) -> str:
    """Return the verdict on ``prb``: as on ours, *none* without a derivative, and nothing without a difference."""
    if outcome.difference is None or outcome.stock is None:
        return ""
    return "none" if isinstance(outcome.stock, str) else _verdict_on_pair(outcome.stock, outcome.difference)


HEADS = ("parameter", "verdict", "ours", "prb", "difference", "z", "step", "value", "scene")


def _table(outcomes: Sequence[Outcome]) -> Iterator[str]:
    """Yield the lines of a table, and of a list of notes below it.

    The first columns are those in view on a phone. Notes would make the table wider than a page.
    """
    yield f"| {' | '.join(HEADS)} |"
    yield "|---|---|--:|--:|--:|--:|--:|--:|---|"
    for outcome in outcomes:
        cells = (
            f"`{_short(outcome.parameter)}`",
            outcome.verdict,
            str(outcome.ours or "–"),
            str(outcome.stock or "–"),
            str(outcome.difference or "–"),
            "" if outcome.z is None else f"{outcome.z:+.1f}",
            outcome.step,
            "" if outcome.value is None else f"{outcome.value:.4g}",
            _scene(outcome),
        )
        yield "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
    notes = [
        f"- `{_short(outcome.parameter)}`, {_scene(outcome)}, *{outcome.verdict}*: {note}"
        for outcome in outcomes
        if (note := _note(outcome))
    ]
    if notes:
        yield from ("", *notes)


def _scene(outcome: Outcome) -> str:
    return outcome.case.split("/", 1)[1]


def _short(parameter: str) -> str:
    """Return the parameter's name without its object and the common parts."""
    dropped = ("bsdf", "emitter", "value", "data")
    _, *rest = parameter.split(".")
    return ".".join(part for part in rest if part not in dropped) or parameter


def _note(outcome: Outcome) -> str:
    """Return the samples of an unresolved row, and the message or the reason of an unsupported or wrong one."""
    if outcome.verdict == "unresolved":
        sides = (("ours", outcome.ours), ("replay", outcome.replay), ("difference", outcome.difference))
        return ", ".join(f"{side} {estimate.spp} spp" for side, estimate in sides if estimate is not None)
    return outcome.note if outcome.verdict in ("unsupported", "wrong") else ""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", metavar="GLOB", default="*", help="cases to run: a plugin, or plugin/title")
    parser.add_argument("--quick", action="store_true", help="a few seconds per row, without stock prb")
    parser.add_argument(
        "--budget", type=float, metavar="SECONDS", help=f"for each row, by default {BUDGET:.0f}"
    )
    parser.add_argument("--cache", type=Path, metavar="FILE", default=Path("out/derivatives.json"))
    parser.add_argument("--resume", action="store_true", help="skip the cases in the cache")
    parser.add_argument("--ours", action="store_true", help="reuse the differences and prb of the cache")
    parser.add_argument(
        "--write", type=Path, metavar="FILE", help="put the tables of the plugins in the cache into this page"
    )
    options = parser.parse_args()

    options.cache.parent.mkdir(parents=True, exist_ok=True)
    done = {outcome.case for outcome in outcomes_in(options.cache)} if options.resume else set()
    chosen = {
        case.name: case.plugin
        for case in CASES
        if case.name not in done and any(fnmatch.fnmatch(n, options.only) for n in (case.name, case.plugin))
    }
    for plugin in dict.fromkeys(chosen.values()):
        worker = multiprocessing.get_context("spawn").Process(
            target=run_plugin, args=(plugin, set(chosen), options)
        )
        worker.start()
        worker.join()
        if worker.exitcode:
            print(f"{plugin}: the process ended with code {worker.exitcode}", flush=True)
    outcomes = outcomes_in(options.cache)
    print(summary(outcomes))
    if options.write:
        page = options.write.read_text() if options.write.exists() else ""
        options.write.write_text(document(outcomes, page))


if __name__ == "__main__":
    main()
