"""Compare the intervals and gradients of a glare rating of noisy images with those of a converged image.

    python benchmarks/noisy_pictures.py values SCENE FOLDER --sensor fisheye --metric dgp
    python benchmarks/noisy_pictures.py gradients SCENE FOLDER

`values` processes images in the same way as `attribute(spp=N)` for several seeds, and counts how often the 95 %
interval of the metric covers the value of a converged image, and how often the result has the caution. Seeds use
disjoint parts of a pool of images, which is stored in FOLDER; the converged image has independent samples.

`gradients` compares the leading gradients with finite differences of the rating at the converged image.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from scenecaptum import SceneRenderer, VanillaSceneGradient, metrics
from scenecaptum.estimation import (
    DEFAULT_REPLICATES,
    NOISY_PICTURE_RATIO,
    TargetedMetric,
    TransformSelector,
    channel_totals,
    describe_picture,
    jackknife,
    mean_and_error,
    student_t,
    with_image_transform,
)

RATINGS = {"ugr": metrics.UnifiedGlareRating, "dgp": metrics.DaylightGlareProbability}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("mode", choices=("values", "gradients"))
    parser.add_argument("scene")
    parser.add_argument("folder", type=Path, help="stores images, so that an interrupted run can be resumed")
    parser.add_argument("--metric", choices=RATINGS, default="ugr")
    parser.add_argument("--sensor", default="0")
    parser.add_argument("--resolution", type=int, nargs=2, default=(160, 90))
    parser.add_argument("--max-depth", type=int, default=6)
    parser.add_argument("--spp", type=int, nargs="+", default=[16, 64, 256])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument(
        "--converged", type=int, default=16384, help="samples per pixel of the converged image"
    )
    parser.add_argument(
        "--changed", type=int, default=1024, help="samples per pixel of the images of changed scenes"
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
    parts = [rating(images.mean(0)).item() for images in (reference, reference[:half], reference[half:])]
    exact = parts[0]
    print(f"converged, {options.converged} spp: {exact:.4f}; its halves {parts[1]:.4f} and {parts[2]:.4f}")
    for spp in options.spp:
        each = int(spp * NOISY_PICTURE_RATIO / DEFAULT_REPLICATES)  # samples of a replicate's image
        size = min(each, 32)
        count = options.seeds * DEFAULT_REPLICATES * each // size
        images = pool(renderer, options.folder / f"{name}-{size}spp.npy", count, size, 2)
        replicates = images.reshape(options.seeds, DEFAULT_REPLICATES, each // size, *images.shape[1:]).mean(
            2
        )
        rate(renderer, rating, list(replicates), spp, exact)


def rate(
    renderer: SceneRenderer, rating: torch.nn.Module, seeds: list[torch.Tensor], spp: int, exact: float
) -> None:
    """Print the coverage and the width of the intervals, and the frequency of the caution."""
    covered = cautions = either = denoised = 0
    widths, unmarked_widths, values, raw = [], [0.0], [], []
    for replicates in seeds:
        images = list(replicates)
        (metric,) = with_image_transform(
            [TargetedMetric(rating)], images, TransformSelector("auto", renderer, smoothed=False)
        )
        seen = jackknife(metric, images)
        assert seen.standard_error is not None
        width = student_t(0.95, len(images) - 1) * seen.standard_error
        about = describe_picture(
            seen.transform,
            seen.value,
            seen.drift,
            None,
            denoised=seen.denoised,
            interval=(seen.value - width, seen.value + width),
            half_class=rating.half_class,
        )
        covers, caution = abs(seen.value - exact) <= width, about["caution"] is not None
        covered, cautions, either = covered + covers, cautions + caution, either + (covers or caution)
        denoised += seen.transform.denoises
        widths.append(width)
        unmarked_widths += [] if caution else [width]
        values.append(seen.value)
        raw.append(rating(replicates.mean(0)).item())
    print(
        f"{spp:4d} spp: {np.mean(values):8.4f} (sd {np.std(values):.4f}; raw {np.mean(raw):.4f}), "
        f"of {len(seeds)}: covered {covered}, caution {cautions}, either {either}, denoised {denoised}; "
        f"half-width: median {np.median(widths):.4f}, largest without the caution {max(unmarked_widths):.4f}",
        flush=True,
    )


def gradients(renderer: SceneRenderer, rating: torch.nn.Module, options: argparse.Namespace) -> None:
    """Print the leading gradients and finite differences of the rating at the converged image.

    The change of the image between two scenes has little noise, because of common random numbers: half of it is
    added to the converged image, and subtracted from it.
    """

    def rise(image: torch.Tensor, half: torch.Tensor) -> float:
        upper, lower = ((image + sign * half).clamp_min(0) for sign in (1, -1))
        return (rating(upper) - rating(lower)).item()

    attribution = VanillaSceneGradient(renderer, rating).attribute(spp=options.spp[0], seed=0)
    print(attribution)
    path = options.folder / f"{room_name(options)}-converged.npy"
    reference = pool(renderer, path, options.converged // 256, 256, 1)
    count = DEFAULT_REPLICATES
    images = reference[: len(reference) // count * count].reshape(count, -1, *reference.shape[1:]).mean(1)
    for row in attribution.ranking(5):
        half, step = half_change(renderer, row.name, options.changed // count, count)
        exact, error = mean_and_error(pseudo_values(rise, images, half) / 2)
        predicted = float((attribution[row.name] * step).sum())
        total = float(channel_totals(attribution[row.name]).sum())
        own = abs(predicted / total) * float(attribution.covariance[row.name].sum().sqrt())
        z = (predicted - exact) / np.hypot(own, error)
        print(
            f"{row.label}: by the gradient {predicted:+.4f} ± {own:.4f}, difference {exact:+.4f} ± {error:.4f}, "
            f"z {z:+.2f}",
            flush=True,
        )


def half_change(
    renderer: SceneRenderer, name: str, spp: int, count: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return half of the image difference between a step up and a step down, as replicates, and half of the step.

    Either step is 0.05, clamped to the bounds.
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
    whole = function(*(values.mean(0) for values in replicates))
    leave_one_out = [
        function(*((values.sum(0) - values[index]) / (count - 1) for values in replicates))
        for index in range(count)
    ]
    return count * whole - (count - 1) * torch.tensor(leave_one_out, dtype=torch.float64)


def room_name(options: argparse.Namespace) -> str:
    return f"{Path(options.scene).resolve().parent.name}-{options.sensor}"


def pool(renderer: SceneRenderer, path: Path, count: int, spp: int, stream: int) -> torch.Tensor:
    """Return ``(count, H, W, 3)`` images, rendered or loaded from the file."""
    images = list(np.load(path)) if path.exists() else []
    seeds = np.random.SeedSequence([stream, spp]).generate_state(count).tolist()
    for number in range(len(images), count):
        images.append(renderer(seed=seeds[number], spp=spp).numpy())
        if number % 16 == 15 or number == count - 1:
            np.save(path, np.stack(images))
    return torch.from_numpy(np.stack(images[:count]))


if __name__ == "__main__":
    main()
