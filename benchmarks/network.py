"""What a network sees: the noise, the intervals, the time and the memory of attributions of a class logit.

``spread``: the office at 128×72, the bundled classifier's smoothed logit of a cube, reflectances and lamps. Prints
the root mean square spread of the effects of default runs with different seeds, relative to the norm of their
mean, the seconds, and the coverage of 95 % intervals against long runs. Beside it, with as many samples as take
the same time: the hand-written script (``dr.wrap`` around ``mi.render`` with ``prb``, one picture) with the plain
and with the smoothed logit, and Captum's SmoothGrad over ``renderer.as_captum``.

``limits``: the spread of runs with a time limit, in which a pilot chooses the samples.

``filters``: smoothing against fixed edge-aware filters of the picture (weights from noise-free albedo and normals)
in front of the network: spread, and bias against the gradient of the plain logit of a converged picture.

``path``: integrated gradients in the Cornell box at 48×48, of the plain and of the smoothed logit, by the samples:
spread, bias against long runs of the same logit, and the standard errors that the runs state.

``resnet``: time and peak memory of an attribution of torchvision's ResNet-50 with random weights and its own
preprocessing, at 224×224 in the living room, by the number of draws, each in its own process.

    python benchmarks/network.py spread [--seeds 20] [--resolution 128x72] [--spp 64]
    python benchmarks/network.py limits --limit 5 --limit 20
    python benchmarks/network.py filters
    python benchmarks/network.py path --seeds 5
    python benchmarks/network.py resnet --draws 64 --draws 128
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import resource
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import _torchvision
import torch
from peers import Script

from scenecaptum import (
    IntegratedGradientsScene,
    SceneAttribution,
    SceneRenderer,
    VanillaSceneGradient,
    metrics,
)
from scenecaptum.estimation import channel_totals, student_t

SCENES = Path(os.environ.get("SCENECAPTUM_SCENES", Path(__file__).parents[2] / "shared" / "scenes"))
INPUTS = ["reflectance", "emitters"]
DEPTH = 6
SIGMA = 0.3
TARGET = "cube"
LONGER = 8  # times the samples and draws of a run, in a run of the reference
REFERENCE_RUNS = 6
STDEV = 0.05  # of each range, for Captum's SmoothGrad
CAPTUM_SPP = 64  # of each of its samples
GIBIBYTE = 2**30
PATH_SIZE = (48, 48)
PATH_RUNS = 3
PATH_REFERENCE = {"n_steps": 16, "spp": 1024, "picture_spp": 16384}
PATH_SETTINGS: tuple[dict[str, int], ...] = (
    {"n_steps": 16, "spp": 32},
    {"n_steps": 16, "spp": 32, "picture_spp": 4096},
    {"n_steps": 16, "spp": 512, "picture_spp": 4096},
)


def main() -> None:
    """Run the section that is asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("section", choices=SECTIONS)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--resolution", type=size, default=(128, 72))
    parser.add_argument("--spp", type=int, default=None, help="by default the scene's")
    parser.add_argument("--limit", type=float, action="append", help="seconds")
    parser.add_argument("--draws", type=int, action="append")
    options = parser.parse_args()
    SECTIONS[options.section](options)


def size(text: str) -> tuple[int, int]:
    """Return ``(width, height)`` of ``128x72``."""
    width, height = text.split("x")
    return int(width), int(height)


# ---------------------------------------------------------------------------------------------------- statistics


def office(options: argparse.Namespace) -> SceneRenderer:
    """Return the office with reflectances and lamps as inputs."""
    return SceneRenderer("office", INPUTS, resolution=options.resolution, spp=options.spp, max_depth=DEPTH)


def plain_logit() -> metrics.ClassLogit:
    """Return the logit without smoothing."""
    return metrics.ClassLogit(metrics.ShapeClassifier.pretrained(), TARGET)


def smoothed_logit() -> metrics.ClassLogit:
    """Return the smoothed logit with its default settings."""
    return metrics.ClassLogit(metrics.ShapeClassifier.pretrained(), TARGET, smoothing=SIGMA)


def effects(attribution: SceneAttribution) -> torch.Tensor:
    """Return the effects of all parameters."""
    return torch.tensor(list(attribution.effects().values()), dtype=torch.float64)


def relative_spread(runs: torch.Tensor) -> tuple[float, float]:
    """Return the root mean square spread relative to the norm of the mean, and its standard error (jackknife).

    The squared norm of the mean is corrected for the noise of the mean.
    """

    def spread(rows: torch.Tensor) -> float:
        variance = rows.var(0).sum()
        norm = (rows.mean(0).square().sum() - variance / len(rows)).clamp_min(0)
        return float((variance / norm).sqrt())

    count = len(runs)
    without = torch.tensor([spread(torch.cat([runs[:k], runs[k + 1 :]])) for k in range(count)])
    return spread(runs), float(((count - 1) ** 2 / count * without.var()).sqrt())


def timed(run: Callable[[int], torch.Tensor], seeds: Sequence[int]) -> tuple[torch.Tensor, float]:
    """Return the results ``(runs, effects)`` and the median seconds; a first run, to compile, is left out."""
    run(0)
    results, seconds = [], []
    for seed in seeds:
        start = time.perf_counter()
        results.append(run(seed))
        seconds.append(time.perf_counter() - start)
    return torch.stack(results), float(torch.tensor(seconds).median())


def report(name: str, runs: torch.Tensor, seconds: float, settings: str) -> None:
    """Print a row."""
    value, error = relative_spread(runs)
    print(f"{name:<44} {100 * value:6.1f} ± {100 * error:.1f} %  {seconds:6.1f} s  {settings}", flush=True)


# ------------------------------------------------------------------------------------------------------ sections


def spread(options: argparse.Namespace) -> None:
    """Compare default runs with those of other tools in the same time."""
    renderer, logit = office(options), smoothed_logit()
    seeds = range(1, options.seeds + 1)
    attributions: dict[int, SceneAttribution] = {}
    gradient = VanillaSceneGradient(renderer, logit)

    def ours(seed: int) -> torch.Tensor:
        attributions[seed] = gradient.attribute(seed=seed)
        return effects(attributions[seed])

    runs, seconds = timed(ours, seeds)
    print(
        f"{len(renderer.inputs)} inputs, {options.resolution[0]}×{options.resolution[1]}, {options.seeds} seeds"
    )
    report(
        "VanillaSceneGradient, smoothed logit", runs, seconds, f"{renderer.spp} spp, {logit.n_draws} draws"
    )

    factors = {name: factor.double() for name, factor in attributions[seeds[0]].factors().items()}
    for name, metric in (("plain", plain_logit()), ("smoothed", logit)):
        run, spp = script_of_the_same_time(renderer, metric, factors, seconds)
        report(f"hand-written script, {name} logit", *timed(run, seeds), f"{spp} spp")
    run, samples = smooth_grad_of_the_same_time(renderer, factors, seconds)
    report("Captum's SmoothGrad, plain logit", *timed(run, seeds), f"{samples} samples of {CAPTUM_SPP} spp")
    coverage(renderer, logit, [attributions[seed] for seed in seeds])


def coverage(renderer: SceneRenderer, logit: metrics.ClassLogit, runs: Sequence[SceneAttribution]) -> None:
    """Print the share of 95 % intervals that hold the result of long runs, whose own error widens them."""
    gradient = VanillaSceneGradient(renderer, logit.with_draws({0: LONGER * logit.n_draws}))
    long = torch.stack(
        [
            effects(gradient.attribute(seed=10_000 + seed, spp=LONGER * renderer.spp))
            for seed in range(REFERENCE_RUNS)
        ]
    )
    truth, truth_error = long.mean(0), long.std(0) / len(long) ** 0.5
    held = []
    for run in runs:
        low, high = effect_interval(run)
        half = ((high - low) / 2).hypot(1.96 * truth_error)
        held.append(((low + high) / 2 - truth).abs() <= half)
    inside = torch.stack(held).double()
    by_parameter = inside.mean(0)
    share = 100 * inside.mean().item()
    print(
        f"95 % intervals that hold the result of {REFERENCE_RUNS} runs of {LONGER} times the samples: "
        f"{share:.1f} %; by parameter {100 * by_parameter.min():.0f} to {100 * by_parameter.max():.0f} %"
    )


def effect_interval(run: SceneAttribution) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the limits of the 95 % intervals of the effects."""
    error = torch.tensor(list((run.effects_error() or {}).values()), dtype=torch.float64)
    half = student_t(0.95, run.info["degrees_of_freedom"]) * error
    return effects(run) - half, effects(run) + half


def totals_over_ranges(
    gradients: Mapping[str, torch.Tensor], factors: Mapping[str, torch.Tensor]
) -> torch.Tensor:
    """Return the effects of gradients from elsewhere."""
    return torch.stack(
        [channel_totals(gradients[name]).double() @ factor for name, factor in factors.items()]
    )


def script_of_the_same_time(
    renderer: SceneRenderer,
    metric: torch.nn.Module,
    factors: Mapping[str, torch.Tensor],
    seconds: float,
) -> tuple[Callable[[int], torch.Tensor], int]:
    """Return the hand-written script, and the samples per pixel with which it takes so many seconds."""
    values = renderer.inputs
    script = Script("office", list(values), renderer.resolution)

    def run(seed: int, spp: int) -> torch.Tensor:
        return totals_over_ranges(script.gradient(values, metric, 2 * seed, spp), factors)

    spp = samples_in(lambda spp: run(0, spp), seconds, 64, 256)
    return lambda seed: run(seed, spp), spp


def smooth_grad_of_the_same_time(
    renderer: SceneRenderer, factors: Mapping[str, torch.Tensor], seconds: float
) -> tuple[Callable[[int], torch.Tensor], int]:
    """Return Captum's SmoothGrad, and the number of samples with which it takes so many seconds."""
    from captum.attr import NoiseTunnel, Saliency

    low_spp = renderer.replace()
    low_spp.spp = CAPTUM_SPP
    # A new seed for each row averages the noise of the pictures as well.
    forward, inputs = low_spp.as_captum(plain_logit(), seed=None, bounds="reflect")
    stdevs = tuple(STDEV * range_of(renderer, name) for name in renderer.inputs)
    tunnel = NoiseTunnel(Saliency(forward))

    def run(seed: int, samples: int) -> torch.Tensor:
        torch.manual_seed(seed)
        found = tunnel.attribute(
            inputs,
            nt_type="smoothgrad",
            nt_samples=samples,
            nt_samples_batch_size=1,
            stdevs=stdevs,
            abs=False,
        )
        gradients = {name: value[0] for name, value in zip(renderer.inputs, found, strict=True)}
        return totals_over_ranges(gradients, factors)

    samples = samples_in(lambda samples: run(0, samples), seconds, 2, 6)
    return lambda seed: run(seed, samples), samples


def range_of(renderer: SceneRenderer, name: str) -> float:
    """Return the length of a parameter's range; that of a lamp is its own value, if it has no upper limit."""
    low, high = renderer.bounds[name]
    length = float(torch.as_tensor(high - low).max())
    return length if length < 1e6 else float(renderer.inputs[name].abs().max())


def samples_in(run: Callable[[int], object], seconds: float, few: int, many: int) -> int:
    """Return the samples that a run takes so many seconds with, by a line through two timings."""
    run(few)
    taken = []
    for count in (few, many):
        start = time.perf_counter()
        run(count)
        taken.append(time.perf_counter() - start)
    per_sample = (taken[1] - taken[0]) / (many - few)
    return max(few, round(many + (seconds - taken[1]) / per_sample))


def limits(options: argparse.Namespace) -> None:
    """Print the spread of runs with a time limit."""
    renderer = office(options)
    gradient = VanillaSceneGradient(renderer, smoothed_logit())
    for limit in options.limit or [5.0, 20.0]:
        mixes: list[dict[str, float]] = []

        def run(seed: int, limit: float = limit, mixes: list[dict[str, float]] = mixes) -> torch.Tensor:
            attribution = gradient.attribute(seed=seed, time_limit=limit)
            mixes.append(attribution.info["planner"]["mix"])
            return effects(attribution)

        runs, seconds = timed(run, range(1, options.seeds + 1))
        picture, draws = (sorted(mix[key] for mix in mixes) for key in ("picture", "draws"))
        middle = len(mixes) // 2
        report(
            f"time limit {limit:g} s",
            runs,
            seconds,
            f"median for each sample of a backward pass: {picture[middle]:.1f} of the picture, "
            f"{draws[middle]:.2f} draws",
        )


class Filtered(torch.nn.Module):
    """A metric of the picture after a fixed linear filter whose weights depend on albedo and normals."""

    def __init__(self, metric: torch.nn.Module, renderer: SceneRenderer, radius: int, width: float) -> None:
        super().__init__()
        guides = renderer.guides
        features = torch.cat([guides.albedo, guides.normal], dim=-1)
        self.metric, self.radius = metric, radius
        around = self.neighbours(features)
        weights = torch.exp(-(around - features[None]).square().sum(-1, keepdim=True) / (2 * width**2))
        inside = self.neighbours(torch.ones_like(features[..., :1]))
        self.weights = weights * inside / (weights * inside).sum(0)

    def neighbours(self, image: torch.Tensor) -> torch.Tensor:
        """Return the pixels around each pixel ``(neighbours, H, W, C)``, 0 outside the image."""
        height, width, _ = image.shape
        side = 2 * self.radius + 1
        padded = torch.nn.functional.pad(image, (0, 0, self.radius, self.radius, self.radius, self.radius))
        return torch.stack([padded[y : y + height, x : x + width] for y in range(side) for x in range(side)])

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return the metric of the filtered picture."""
        value: torch.Tensor = self.metric((self.weights * self.neighbours(image)).sum(0))
        return value


def filters(options: argparse.Namespace) -> None:
    """Print bias and spread of smoothing and of filters, with the same samples."""
    renderer, plain = office(options), plain_logit()
    spp, picture = renderer.spp, 16 * renderer.spp
    reference = VanillaSceneGradient(renderer, plain)
    long = torch.stack(
        [
            effects(
                reference.attribute(
                    seed=10_000 + seed, spp=4 * spp, picture_spp=LONGER * picture, denoise=False
                )
            )
            for seed in range(REFERENCE_RUNS)
        ]
    )
    truth = long.mean(0)
    own = float((long.var(0).sum() / len(long)).sqrt() / truth.norm())
    print(
        f"the plain logit of pictures with {LONGER * picture} spp is known to {100 * own:.0f} %", flush=True
    )
    candidates: list[tuple[str, torch.nn.Module]] = [("plain", plain)]
    candidates += [(f"smoothing {s:g}", metrics.Smoothed(plain, s)) for s in (0.1, 0.2, 0.3, 0.6)]
    for radius, width in ((1, 0.05), (2, 0.05), (2, 0.3), (4, 0.05)):
        side = 2 * radius + 1
        filtered = Filtered(plain, renderer, radius, width)
        candidates.append((f"filter {side}×{side}, width {width:g}", filtered))
    both = metrics.Smoothed(Filtered(plain, renderer, 2, 0.05), 0.1)
    candidates.append(("filter 5×5, width 0.05, and smoothing 0.1", both))
    for name, metric in candidates:
        gradient = VanillaSceneGradient(renderer, metric)

        def run(seed: int, gradient: VanillaSceneGradient = gradient) -> torch.Tensor:
            return effects(gradient.attribute(seed=seed, spp=spp, picture_spp=picture, denoise=False))

        runs, seconds = timed(run, range(1, options.seeds + 1))
        noise = runs.var(0).sum() / len(runs) + long.var(0).sum() / len(long)
        bias = ((runs.mean(0) - truth).square().sum() - noise).clamp_min(0).sqrt() / truth.norm()
        report(name, runs, seconds, f"bias {100 * bias:.0f} %")


def path(options: argparse.Namespace) -> None:
    """Print spread, bias and stated errors of integrated gradients by their samples."""
    renderer = SceneRenderer("cornell-box", INPUTS, resolution=PATH_SIZE, spp=32, max_depth=4)
    for name, logit in (("plain", plain_logit()), ("smoothed", smoothed_logit())):
        method = IntegratedGradientsScene(renderer, logit)
        long = torch.stack(
            [effects(method.attribute(seed=10_000 + seed, **PATH_REFERENCE)) for seed in range(PATH_RUNS)]
        )
        own = float((long.var(0).sum() / len(long)).sqrt() / long.mean(0).norm())
        print(
            f"{name} logit: the reference ({settings_of(PATH_REFERENCE)}) is known to {100 * own:.0f} %",
            flush=True,
        )
        for settings in PATH_SETTINGS:
            stated = []

            def run(
                seed: int,
                method: IntegratedGradientsScene = method,
                settings: Mapping[str, int] = settings,
                stated: list[float] = stated,
            ) -> torch.Tensor:
                found = method.attribute(seed=seed, **settings)
                errors = torch.tensor(list((found.effects_error() or {}).values()), dtype=torch.float64)
                stated.append(float(errors.norm()))
                return effects(found)

            runs, seconds = timed(run, range(1, options.seeds + 1))
            norm = long.mean(0).norm()
            noise = runs.var(0).sum() / len(runs) + long.var(0).sum() / len(long)
            bias = ((runs.mean(0) - long.mean(0)).square().sum() - noise).clamp_min(0).sqrt() / norm
            errors = sum(stated) / len(stated) / norm
            text = f"bias {100 * bias:.0f} %, stated error {100 * errors:.0f} %"
            report(f"{name} logit, {settings_of(settings)}", runs, seconds, text)


def settings_of(settings: Mapping[str, int]) -> str:
    """Return settings in words."""
    return ", ".join(f"{name}={value}" for name, value in settings.items())


def resnet(options: argparse.Namespace) -> None:
    """Print time and peak memory by the number of draws, each in a process of its own."""
    spawn = multiprocessing.get_context("spawn")
    for draws in options.draws or [32, 128, 512]:
        process = spawn.Process(target=_resnet, args=(draws, options.spp or 64))
        process.start()
        process.join()


def _resnet(draws: int, spp: int) -> None:
    models = _torchvision.load().models
    torch.manual_seed(0)
    network = models.resnet50(weights=None)
    logit = metrics.ClassLogit(network, 559, models.ResNet50_Weights.IMAGENET1K_V2.transforms())
    renderer = SceneRenderer(
        str(SCENES / "living-room" / "scene.xml"), INPUTS, resolution=(224, 224), spp=spp, max_depth=DEPTH
    )
    start = time.perf_counter()
    found = VanillaSceneGradient(renderer, metrics.Smoothed(logit, SIGMA, n=draws)).attribute(seed=0)
    seconds = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / GIBIBYTE
    first = found.ranking(top=1)[0]
    print(
        f"ResNet-50, {len(renderer.inputs)} inputs, {spp} spp, {draws} draws: {seconds:.0f} s with compilation, "
        f"peak memory {peak:.2f} GiB; first: {first.label}",
        flush=True,
    )


SECTIONS: dict[str, Callable[[argparse.Namespace], None]] = {
    "spread": spread,
    "limits": limits,
    "filters": filters,
    "path": path,
    "resnet": resnet,
}

if __name__ == "__main__":
    main()
