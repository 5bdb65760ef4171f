"""How many samples and bounces a stable ranking takes, and what a noisy picture does to a non-linear metric.

The claim that is tested: at depth 6, 64 to 256 samples per pixel rank the materials of a room as 1024 do (Beresna
and Fiume). Three tables: error and rank agreement by samples, on the rooms and for three metrics; what a shorter
path leaves out; and the bias of a gradient through a noisy picture, on the Cornell box. Errors and ranks do not
depend on how busy the machine is. The cache keeps what is done, case by case.

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
from scenecaptum.attr._metric import TargetedMetric
from scenecaptum.tradeoff import Measured, Reference, Setting
from scenecaptum.tradeoff._measure import Bench, Judge, gradient_of
from scenecaptum.tradeoff._settings import own_setting
from scenecaptum.tradeoff._statistics import Bias, relative_bias

SCENES = Path(os.environ.get("SCENECAPTUM_SCENES", Path(__file__).parents[2] / "shared" / "scenes"))
DEPTH, SPP, PASSES = 6, 64, 4
SAMPLES, DEPTHS, LONGEST = (16, 64, 256), (2, 4, 6), 12
BEGIN, END = "<!-- ranking stability: begin -->", "<!-- ranking stability: end -->"

# The noisy pictures: samples per pixel of each, and how often.
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
    """Load a room, and its metrics; the classifier gets a picture of middling brightness."""
    gc.collect()  # the room before
    size = width, 9 * width // 16
    renderer = SceneRenderer(scene, "materials", resolution=size, spp=SPP, max_depth=DEPTH)
    with torch.no_grad():
        mean = metrics.MeanLuminance()(renderer(seed=1, spp=16)).item()
    return renderer, {
        "mean luminance": metrics.MeanLuminance(),
        "UGR": metrics.UnifiedGlareRating(renderer.camera, threshold_factor=5),
        "class logit": sphere_logit(0.4 / mean),
    }


def sphere_logit(exposure: float) -> Metric:
    return metrics.ClassLogit(metrics.ShapeClassifier.pretrained(), "sphere", exposure=exposure)


# ------------------------------------------------------------------------------------------------ the three tables


def by_samples(room: str, scene: str, name: str, options: argparse.Namespace) -> list[Row]:
    renderer, chosen = load(scene, options.width)
    settings = [setting(renderer, spp) for spp in SAMPLES]
    best = setting(renderer, options.reference, passes=4 * PASSES)
    rows, reference = compare(renderer, chosen[name], settings, best, options.runs)
    known = f"{100 * reference.relative_error:.1f} %, {reference.kendall_of_halves:.2f}"
    return [
        [room, name, str(row.setting.primal_spp), *agreement(row), known if row is rows[0] else ""]
        for row in rows
    ]


def by_depth(room: str, scene: str, options: argparse.Namespace) -> list[Row]:
    renderer, chosen = load(scene, options.width)
    settings = [setting(renderer, SPP, depth=depth) for depth in (*DEPTHS, LONGEST)]
    best = setting(renderer, options.reference // 2, depth=LONGEST, passes=4 * PASSES)
    rows, _ = compare(renderer, chosen["mean luminance"], settings, best, options.runs)
    return [[room, str(row.setting.max_depth), *agreement(row)] for row in rows]


def compare(
    renderer: SceneRenderer, metric: Metric, settings: list[Setting], best: Setting, runs: int
) -> tuple[list[Measured], Reference]:
    bench = Bench(renderer, lambda _: metric)
    judge = Judge.of(bench.run(best, seed=10**6))
    rows = [
        judge.compare("", one, [bench.run(one, seed=1000 * number + run) for run in range(runs)])
        for number, one in enumerate(settings)
    ]
    return rows, judge.describe(best)


def setting(renderer: SceneRenderer, spp: int, *, depth: int | None = None, passes: int = PASSES) -> Setting:
    own = own_setting(renderer)
    return dataclasses.replace(
        own, primal_spp=spp, gradient_spp=spp, replicates=passes, max_depth=depth or own.max_depth
    )


def agreement(row: Measured) -> Row:
    return [
        percent(*row.relative_error),
        bias_words(row.bias),
        *(f"{one.value:.2f}" for one in (row.spearman, row.kendall, row.kendall_resolved)),
        f"{100 * row.top.value:.0f} %",
    ]


def noisy(name: str) -> list[Row]:
    """Return the bias of three ways through a noisy picture, relative to the gradient.

    All three see as many samples. The first replays them in the backward pass, the others take new ones.
    """
    metric = noisy_metrics()[name]
    renderer = SceneRenderer("cornell-box", "reflectance", resolution=BOX, spp=16, max_depth=DEPTH)
    bench = Bench(renderer, lambda _: metric)
    judge = Judge.of(bench.run(setting(renderer, 8192, passes=16), seed=10**6))
    targeted, rows = TargetedMetric(metric), []

    def replayed(seed: int, spp: int) -> torch.Tensor:
        leaves = renderer.leaves()
        image = renderer(leaves, seed=seed, spp=spp)
        image.backward(targeted.value_and_adjoint(image)[1])
        return torch.cat([leaf.grad.flatten() for leaf in leaves.values()]).double()

    def attributed(replicates: int) -> Callable[[int, int], torch.Tensor]:
        return lambda seed, spp: gradient_of(bench.run(setting(renderer, spp, passes=replicates), seed))

    for spp in NOISY:
        row = [name, str(spp)]
        for gradient in (replayed, attributed(1), attributed(8)):
            found = torch.stack([gradient(seed, spp) for seed in range(REPEATS)])
            row.append(bias_words(relative_bias(found - judge.gradient, judge.noise, judge.size)))
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
        "class logit (network)": sphere_logit(1.0),
    }


# ------------------------------------------------------------------------------------------------ words


def percent(value: float, error: float) -> str:
    digits = 1 if value < 0.1 else 0
    return f"{100 * value:.{digits}f} ± {max(100 * error, 0.1):.{digits}f} %"


def bias_words(bias: Bias) -> str:
    return percent(bias.value, bias.error) if bias.told else f"≤ {100 * bias.limit:.1f} %"


def table(head: Row, rows: list[Row]) -> str:
    lines = [head, ["---", *["--:"] * (len(head) - 1)], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def document(found: dict[str, list[Row]], options: argparse.Namespace) -> str:
    samples, depths, pictures = (
        [row for key, rows in found.items() if key.startswith(part) for row in rows]
        for part in ("samples", "depth", "noisy")
    )
    agreements = ["error", "bias", "Spearman", "Kendall", "Kendall, resolved", "top 5"]
    box = "×".join(map(str, BOX))
    ways = ["samples of the picture replayed", "samples of their own", "8 passes, jackknifed"]
    size = f"{options.width}×{9 * options.width // 16}"
    parts = [
        (
            f"**Samples**, at depth {DEPTH}, in rooms at {size}, against an independent reference of "
            f"{options.reference} spp: all differentiable parameters of materials, {options.runs} runs of each "
            f"setting in {PASSES} passes.",
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
            f"**A noisy picture**: bias of the gradient of the Cornell box at {box}, {REPEATS} runs.",
            ["metric", "spp", *ways],
            pictures,
        ),
    ]
    return "\n\n".join(f"{words}\n\n{table(head, rows)}" for words, head, rows in parts if rows)


# ------------------------------------------------------------------------------------------------ running


def cases(options: argparse.Namespace) -> dict[str, Callable[[], list[Row]]]:
    """Name what is measured, room by room."""
    found: dict[str, Callable[[], list[Row]]] = {}
    for room, scene in rooms().items():
        for name in ("mean luminance", "UGR", "class logit"):
            found[f"samples {room} {name}"] = partial(by_samples, room, scene, name, options)
        found[f"depth {room}"] = partial(by_depth, room, scene, options)
    return found | {f"noisy {name}": partial(noisy, name) for name in noisy_metrics()}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default="*", help="glob over the names of the cases")
    parser.add_argument("--width", type=int, default=64, help="of the pictures of rooms, in pixels")
    parser.add_argument("--runs", type=int, default=6, help="of each setting")
    parser.add_argument("--reference", type=int, default=2048, help="its samples per pixel")
    parser.add_argument("--resume", action="store_true", help="keep the cases that the cache holds")
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
