"""What a glare rating makes of a noisy picture: its intervals against a converged picture, and its gradients.

    python benchmarks/noisy_pictures.py values SCENE FOLDER --sensor fisheye --metric dgp
    python benchmarks/noisy_pictures.py gradients SCENE FOLDER

`values` repeats what `attribute(spp=N)` does with its pictures for several seeds, and counts how often the 95 %
interval of the metric holds the value of a converged picture, or the result carries the caution. Seeds use parts
of one pool of pictures, which is kept in FOLDER; the converged picture has samples of its own.

`gradients` compares the leading gradients with finite differences of the rating at the converged picture.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from scenecaptum import SceneRenderer, VanillaSceneGradient, metrics
from scenecaptum.attr._jackknife import jackknife, through_view
from scenecaptum.attr._metric import TargetedMetric
from scenecaptum.attr._passes import DEFAULT_PASSES, NOISY_PICTURE_RATIO, channel_totals
from scenecaptum.attr._picture_info import describe_picture
from scenecaptum.attr._student import student_t
from scenecaptum.attr._view import Viewer
from scenecaptum.validation._scenes import mean_and_error

RATINGS = {"ugr": metrics.UnifiedGlareRating, "dgp": metrics.DaylightGlareProbability}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("mode", choices=("values", "gradients"))
    parser.add_argument("scene")
    parser.add_argument("folder", type=Path, help="keeps pictures, so that a run that was ended goes on")
    parser.add_argument("--metric", choices=RATINGS, default="ugr")
    parser.add_argument("--sensor", default="0")
    parser.add_argument("--resolution", type=int, nargs=2, default=(160, 90))
    parser.add_argument("--max-depth", type=int, default=6)
    parser.add_argument("--spp", type=int, nargs="+", default=[16, 64, 256])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument(
        "--converged", type=int, default=16384, help="samples per pixel of the converged picture"
    )
    parser.add_argument(
        "--changed", type=int, default=1024, help="samples per pixel of the pictures of changed scenes"
    )
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    sensor = int(options.sensor) if options.sensor.isdigit() else options.sensor
    renderer = SceneRenderer(
        options.scene,
        "reflectance",
        resolution=tuple(options.resolution),
        max_depth=options.max_depth,
        sensor=sensor,
    )
    rating = RATINGS[options.metric](renderer.camera, threshold_factor=5)
    if options.mode == "values":
        values(renderer, rating, options)
    else:
        gradients(renderer, rating, options)


def values(renderer: SceneRenderer, rating: torch.nn.Module, options: argparse.Namespace) -> None:
    name = room_name(options)
    reference = pool(renderer, options.folder / f"{name}-converged.npy", options.converged // 256, 256, 1)
    half = len(reference) // 2
    parts = [rating(one.mean(0)).item() for one in (reference, reference[:half], reference[half:])]
    exact = parts[0]
    print(f"converged, {options.converged} spp: {exact:.4f}; its halves {parts[1]:.4f} and {parts[2]:.4f}")
    for spp in options.spp:
        each = int(spp * NOISY_PICTURE_RATIO / DEFAULT_PASSES)  # samples of a replicate's picture
        size = min(each, 32)
        count = options.seeds * DEFAULT_PASSES * each // size
        pictures = pool(renderer, options.folder / f"{name}-{size}spp.npy", count, size, 2)
        replicates = pictures.reshape(options.seeds, DEFAULT_PASSES, each // size, *pictures.shape[1:]).mean(
            2
        )
        rate(renderer, rating, list(replicates), spp, exact)


def rate(
    renderer: SceneRenderer, rating: torch.nn.Module, seeds: list[torch.Tensor], spp: int, exact: float
) -> None:
    """Print how often the intervals hold a value, how wide they are, and how often the caution is given."""
    held = cautions = either = denoised = 0
    widths, plain, found, raw = [], [0.0], [], []
    for replicates in seeds:
        images = list(replicates)
        (metric,) = through_view([TargetedMetric(rating)], images, Viewer("auto", renderer))
        seen = jackknife(metric, images)
        assert seen.standard_error is not None
        width = student_t(0.95, len(images) - 1) * seen.standard_error
        about = describe_picture(
            seen.view,
            seen.value,
            seen.drift,
            None,
            denoised=seen.denoised,
            interval=(seen.value - width, seen.value + width),
            half_class=rating.half_class,
        )
        holds, caution = abs(seen.value - exact) <= width, about["caution"] is not None
        held, cautions, either = held + holds, cautions + caution, either + (holds or caution)
        denoised += seen.view.denoises
        widths.append(width)
        plain += [] if caution else [width]
        found.append(seen.value)
        raw.append(rating(replicates.mean(0)).item())
    print(
        f"{spp:4d} spp: {np.mean(found):8.4f} (sd {np.std(found):.4f}; raw {np.mean(raw):.4f}), of {len(seeds)}: "
        f"held {held}, caution {cautions}, either {either}, denoised {denoised}; half-width: median "
        f"{np.median(widths):.4f}, largest without the caution {max(plain):.4f}",
        flush=True,
    )


def gradients(renderer: SceneRenderer, rating: torch.nn.Module, options: argparse.Namespace) -> None:
    """Print the leading gradients beside differences of the rating at the converged picture.

    What a change of the scene does to the picture has little noise, by common random numbers: half of it is added
    to the converged picture, and taken away from it.
    """

    def rise(picture: torch.Tensor, half: torch.Tensor) -> float:
        upper, lower = ((picture + sign * half).clamp_min(0) for sign in (1, -1))
        return (rating(upper) - rating(lower)).item()

    attribution = VanillaSceneGradient(renderer, rating).attribute(spp=options.spp[0], seed=0)
    print(attribution)
    path = options.folder / f"{room_name(options)}-converged.npy"
    reference = pool(renderer, path, options.converged // 256, 256, 1)
    count = DEFAULT_PASSES
    pictures = reference[: len(reference) // count * count].reshape(count, -1, *reference.shape[1:]).mean(1)
    for row in attribution.ranking(5):
        half, way = half_change(renderer, row.name, options.changed // count, count)
        exact, error = mean_and_error(pseudo_values(rise, pictures, half) / 2)
        told = float((attribution[row.name] * way).sum())
        total = float(channel_totals(attribution[row.name]).sum())
        own = abs(told / total) * float(attribution.covariance[row.name].sum().sqrt())
        z = (told - exact) / np.hypot(own, error)
        print(
            f"{row.label}: by the gradient {told:+.4f} ± {own:.4f}, difference {exact:+.4f} ± {error:.4f}, "
            f"z {z:+.2f}",
            flush=True,
        )


def half_change(
    renderer: SceneRenderer, name: str, spp: int, count: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return half of what a step up and one down differ by in the picture, replicates of it, and half the way.

    Either step is 0.05, and less for what would cross a bound.
    """
    value, (low, high) = renderer.inputs[name], renderer.bounds[name]
    upper, lower = ((value + sign * 0.05).clamp(low, high) for sign in (1, -1))
    seeds = np.random.SeedSequence([3, spp]).generate_state(count).tolist()
    sides = [
        torch.stack([renderer({name: moved}, seed=seed, spp=spp).detach() for seed in seeds])
        for moved in (upper, lower)
    ]
    return (sides[0] - sides[1]) / 2, (upper - lower) / 2


def pseudo_values(function: Callable[..., float], *replicates: torch.Tensor) -> torch.Tensor:
    """Return the jackknife pseudo-values of a function of means."""
    count = len(replicates[0])
    whole = function(*(one.mean(0) for one in replicates))
    without = [
        function(*((one.sum(0) - one[left_out]) / (count - 1) for one in replicates))
        for left_out in range(count)
    ]
    return count * whole - (count - 1) * torch.tensor(without, dtype=torch.float64)


def room_name(options: argparse.Namespace) -> str:
    return f"{Path(options.scene).resolve().parent.name}-{options.sensor}"


def pool(renderer: SceneRenderer, path: Path, count: int, spp: int, stream: int) -> torch.Tensor:
    """Render pictures, or read those that are there: ``(count, H, W, 3)``."""
    kept = list(np.load(path)) if path.exists() else []
    seeds = np.random.SeedSequence([stream, spp]).generate_state(count).tolist()
    for number in range(len(kept), count):
        kept.append(renderer(seed=seeds[number], spp=spp).numpy())
        if number % 16 == 15 or number == count - 1:
            np.save(path, np.stack(kept))
    return torch.from_numpy(np.stack(kept[:count]))


if __name__ == "__main__":
    main()
