"""Measure how many samples and bounces a stable ranking needs, and the bias from a noisy image.

The claim under test: at depth 6, 64 to 256 samples per pixel rank the materials of a room as 1024 do (Beresna
and Fiume). Three tables: error and rank agreement over samples, for several rooms and three metrics; the error
from shorter paths; and the bias of the gradient of a non-linear metric of a noisy image, on the Cornell box.
Errors and ranks do not depend on the load of the machine. The cache stores each finished case.

    python benchmarks/ranking_stability.py [--only 'office*'] [--runs 6] [--resume] [--write docs/performance.md]
"""

from __future__ import annotations

import argparse
import dataclasses
import fnmatch
import gc
import json
import os
import tempfile
import time
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path

import torch

from scenecaptum import SceneRenderer, metrics
from scenecaptum.estimation import TargetedMetric
from scenecaptum.tradeoff import Measured, Reference, Setting
from scenecaptum.tradeoff._measure import ReferenceGradient, SettingRunner, gradient_of
from scenecaptum.tradeoff._settings import own_setting
from scenecaptum.tradeoff._statistics import Bias, relative_bias

SCENES = Path(os.environ.get("SCENECAPTUM_SCENES", Path(__file__).parents[2] / "shared" / "scenes"))
DEPTH, SPP, REPLICATES = 6, 64, 4
SAMPLES, DEPTHS, LONGEST = (16, 64, 256), (2, 4, 6), 12
LOGIT = "smoothed class logit"
PICTURES = 16  # samples of the picture for each sample of a backward pass, for the logit; the default ratio
BEGIN, END = "<!-- ranking stability: begin -->", "<!-- ranking stability: end -->"

# Bias from a noisy image: resolution, samples per pixel, and runs of each.
BOX, NOISY, REPEATS = (32, 32), (4, 16, 64), 16

Metric = Callable[[torch.Tensor], torch.Tensor]
Row = list[str]


def rooms() -> dict[str, str]:
    found = {"office": "office"}
    for name in ("living-room", "dining-room"):
        path = SCENES / name / "scene.xml"
        if path.is_file():
            found[name] = str(path)
        else:
            print(f"{name}: skipped, {path} does not exist")
    return found


@lru_cache(maxsize=1)
def load(scene: str, width: int) -> tuple[SceneRenderer, dict[str, Metric]]:
    """Load a room and its metrics; the classifier's exposure gives an image of medium brightness."""
    gc.collect()  # frees the previous room
    size = width, 9 * width // 16
    renderer = SceneRenderer(scene, "materials", resolution=size, spp=SPP, max_depth=DEPTH)
    with torch.no_grad():
        mean = metrics.MeanLuminance()(renderer(seed=1, spp=16)).item()
    return renderer, {
        "mean luminance": metrics.MeanLuminance(),
        "UGR": metrics.UnifiedGlareRating(renderer.camera, threshold_factor=5),
        LOGIT: sphere_logit(0.4 / mean),
    }


def sphere_logit(exposure: float) -> Metric:
    network = metrics.ShapeClassifier.pretrained()
    return metrics.ClassLogit(network, "sphere", exposure=exposure, smoothing=0.3)


# ------------------------------------------------------------------------------------------------ the three tables


def by_samples(room: str, scene: str, name: str, options: argparse.Namespace) -> list[Row]:
    renderer, chosen = load(scene, options.width)
    pictures = PICTURES if name == LOGIT else 1
    settings = [setting(renderer, spp, pictures=pictures) for spp in SAMPLES]
    best = setting(renderer, options.reference, replicates=4 * REPLICATES)
    rows, reference = compare(renderer, chosen[name], settings, best, options.runs)
    known = f"{100 * reference.relative_error:.1f} %, {reference.kendall_of_halves:.2f}"
    return [
        [room, name, str(row.setting.gradient_spp), *agreement(row), known if row is rows[0] else ""]
        for row in rows
    ]


def by_depth(room: str, scene: str, options: argparse.Namespace) -> list[Row]:
    renderer, chosen = load(scene, options.width)
    settings = [setting(renderer, SPP, depth=depth) for depth in (*DEPTHS, LONGEST)]
    best = setting(renderer, options.reference // 2, depth=LONGEST, replicates=4 * REPLICATES)
    rows, _ = compare(renderer, chosen["mean luminance"], settings, best, options.runs)
    return [[room, str(row.setting.max_depth), *agreement(row)] for row in rows]


def compare(
    renderer: SceneRenderer, metric: Metric, settings: list[Setting], best: Setting, runs: int
) -> tuple[list[Measured], Reference]:
    runner = SettingRunner(renderer, lambda _: metric)
    reference = ReferenceGradient.of(runner.run(best, seed=10**6))
    rows = [
        reference.compare("", item, [runner.run(item, seed=1000 * number + run) for run in range(runs)])
        for number, item in enumerate(settings)
    ]
    return rows, reference.describe(best)


def setting(
    renderer: SceneRenderer,
    spp: int,
    *,
    depth: int | None = None,
    replicates: int = REPLICATES,
    pictures: int = 1,
) -> Setting:
    own = own_setting(renderer)
    return dataclasses.replace(
        own,
        primal_spp=pictures * spp,
        gradient_spp=spp,
        replicates=replicates,
        max_depth=depth or own.max_depth,
    )


def agreement(row: Measured) -> Row:
    return [
        percent(*row.relative_error),
        bias_text(row.bias),
        *(f"{rank.value:.2f}" for rank in (row.spearman, row.kendall, row.kendall_resolved)),
        f"{100 * row.top.value:.0f} %",
    ]


def noisy(name: str) -> list[Row]:
    """Return the relative bias of the gradient for three ways to differentiate a noisy image.

    All three use the same number of samples. The first replays them in the backward pass, the others draw new
    ones.
    """
    metric = noisy_metrics()[name]
    renderer = SceneRenderer("cornell-box", "reflectance", resolution=BOX, spp=16, max_depth=DEPTH)
    runner = SettingRunner(renderer, lambda _: metric)
    reference = ReferenceGradient.of(runner.run(setting(renderer, 8192, replicates=16), seed=10**6))
    targeted, rows = TargetedMetric(metric), []

    def replayed(seed: int, spp: int) -> torch.Tensor:
        leaves = renderer.leaves()
        image = renderer(leaves, seed=seed, spp=spp)
        image.backward(targeted.value_and_adjoint(image)[1])
        return torch.cat([leaf.grad.flatten() for leaf in leaves.values()]).double()

    def attributed(replicates: int) -> Callable[[int, int], torch.Tensor]:
        return lambda seed, spp: gradient_of(runner.run(setting(renderer, spp, replicates=replicates), seed))

    for spp in NOISY:
        row = [name, str(spp)]
        for gradient in (replayed, attributed(1), attributed(8)):
            found = torch.stack([gradient(seed, spp) for seed in range(REPEATS)])
            row.append(bias_text(relative_bias(found - reference.gradient, reference.noise, reference.size)))
        rows.append(row)
    return rows


def noisy_metrics() -> dict[str, Metric]:
    mean = metrics.MeanLuminance()
    return {
        "mean luminance (linear)": mean,
        "mean of the logarithm of each pixel": lambda image: (metrics.luminance(image) + 0.01).log().mean(),
        "share of pixels over 0.15, a sigmoid": lambda image: torch.sigmoid(
            (metrics.luminance(image) - 0.15) / 0.03
        ).mean(),
        "smoothed class logit (network)": sphere_logit(1.0),
    }


# ------------------------------------------------------------------------------------------------ text


def percent(value: float, error: float) -> str:
    digits = 1 if value < 0.1 else 0
    return f"{100 * value:.{digits}f} ± {max(100 * error, 0.1):.{digits}f} %"


def bias_text(bias: Bias) -> str:
    return percent(bias.value, bias.error) if bias.significant else f"≤ {100 * bias.upper_limit:.1f} %"


def table(head: Row, rows: list[Row]) -> str:
    lines = [head, ["---", *["--:"] * (len(head) - 1)], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def document(found: dict[str, list[Row]], options: argparse.Namespace) -> str:
    samples, depths, noisy_images = (
        [row for key, rows in found.items() if key.startswith(part) for row in rows]
        for part in ("samples", "depth", "noisy")
    )
    agreements = ["error", "bias", "Spearman", "Kendall", "Kendall, resolved", "top 5"]
    box = "×".join(map(str, BOX))
    ways = ["backward pass replays the samples", "independent samples", "8 replicates, jackknife"]
    size = f"{options.width}×{9 * options.width // 16}"
    parts = [
        (
            f"**Samples**, at depth {DEPTH}, in rooms at {size}, against an independent reference of "
            f"{options.reference} spp: all differentiable parameters of materials, {options.runs} runs of each "
            f"setting with {REPLICATES} replicates. The picture of the logit has {PICTURES} times the samples, "
            "the default for smoothed metrics.",
            ["room", "metric", "spp", *agreements, "reference"],
            samples,
        ),
        (
            f"**Depth**, mean luminance at {SPP} spp, in rooms at {size}, against {options.reference // 2} spp at "
            f"depth {LONGEST}: {options.runs} runs.",
            ["room", "depth", *agreements],
            depths,
        ),
        (
            f"**Bias from a noisy image**: bias of the gradient of the Cornell box at {box}, {REPEATS} runs.",
            ["metric", "spp", *ways],
            noisy_images,
        ),
    ]
    return "\n\n".join(f"{title}\n\n{table(head, rows)}" for title, head, rows in parts if rows)


# ------------------------------------------------------------------------------------------------ running


def cases(options: argparse.Namespace) -> dict[str, Callable[[], list[Row]]]:
    """Return the measurements by name, room by room."""
    found: dict[str, Callable[[], list[Row]]] = {}
    for room, scene in rooms().items():
        for name in ("mean luminance", "UGR", LOGIT):
            found[f"samples {room} {name}"] = partial(by_samples, room, scene, name, options)
        found[f"depth {room}"] = partial(by_depth, room, scene, options)
    return found | {f"noisy {name}": partial(noisy, name) for name in noisy_metrics()}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default="*", help="glob over the names of the cases")
    parser.add_argument("--width", type=int, default=64, help="width of the rooms' images, in pixels")
    parser.add_argument("--runs", type=int, default=6, help="runs of each setting")
    parser.add_argument("--reference", type=int, default=2048, help="samples per pixel of the reference")
    parser.add_argument("--resume", action="store_true", help="skip the cases in the cache")
    parser.add_argument(
        "--cache", type=Path, default=Path(tempfile.gettempdir()) / "scenecaptum-ranking-stability.json"
    )
    parser.add_argument("--write", type=Path, metavar="PAGE", help="put the tables into this page")
    options = parser.parse_args()

    found: dict[str, list[Row]] = {}
    if options.resume and options.cache.exists():
        found = json.loads(options.cache.read_text())
    chosen = cases(options)
    for name, run in chosen.items():
        if name not in found and fnmatch.fnmatch(name, options.only):
            began = time.perf_counter()
            found[name] = run()
            print(f"{name}: {time.perf_counter() - began:.0f} s", *found[name], sep="\n  ", flush=True)
            options.cache.write_text(json.dumps(found, indent=1))
    text = document({name: found[name] for name in chosen if name in found}, options)
    print(text)
    if options.write:
        page = options.write.read_text(encoding="utf-8")
        before, _, rest = page.partition(BEGIN)
        _, _, after = rest.partition(END)
        options.write.write_text(f"{before}{BEGIN}\n\n{text}\n\n{END}{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
