"""Check that a refactoring does not change results: record every method's attributions before, and compare after.

``record`` writes the attributions of each method in the Cornell box, the office and the living room with fixed
seeds, those to logits of a network, and those to poses; ``compare`` computes them again and prints the largest
difference of each run, relative to the largest value of that input. A table of the documentation, times aside,
holds for today's code if the runs of its kind are the same as at the commit that wrote it: ``record`` there, with
this file and ``PYTHONPATH``, and ``compare`` here. Gradients of few samples repeat to about 1e-6, because sums on
the device have no fixed order.
``repeat`` shows how far: the gradient of a light is a sum over nearly all samples, whose rounding grows with their
number; a deep network with kinks has another gradient at a picture that differs in its last bits, and pixels are
sampled by that gradient.

    python benchmarks/same_numbers.py record FILE
    python benchmarks/same_numbers.py compare FILE
    python benchmarks/same_numbers.py repeat
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch

from scenecaptum import (
    FeatureAblationScene,
    GradientShapScene,
    InputXGradientScene,
    IntegratedGradientsScene,
    OcclusionScene,
    SceneRenderer,
    ShapleyValueScene,
    SmoothGradScene,
    VanillaSceneGradient,
    activate,
    metrics,
)
from scenecaptum.scene import BUNDLED

SCENES = Path(os.environ.get("SCENECAPTUM_SCENES", Path(__file__).parents[2] / "shared" / "scenes"))
LIMIT, NEGLIGIBLE = 1e-5, 1e-6

METHODS: tuple[tuple[Any, dict[str, Any]], ...] = (
    (VanillaSceneGradient, {}),
    (VanillaSceneGradient, {"denoise": True}),
    (VanillaSceneGradient, {"tolerance": 0.2}),
    (InputXGradientScene, {}),
    (IntegratedGradientsScene, {"n_steps": 4}),
    (SmoothGradScene, {"nt_samples": 3}),
    (GradientShapScene, {"n_samples": 3}),
    (FeatureAblationScene, {"replicates": 3}),
    (ShapleyValueScene, {"n_samples": 2, "replicates": 2}),
)
NETWORK_METHODS: tuple[tuple[Any, dict[str, Any]], ...] = (
    (VanillaSceneGradient, {}),
    (IntegratedGradientsScene, {"n_steps": 4, "picture_spp": 64}),
)
WINDOWS = (OcclusionScene, {"replicates": 2, "sliding_window_shapes": 16})


def renderers() -> Iterator[tuple[str, SceneRenderer]]:
    """Yield the three rooms, small and with few inputs."""
    for name in ("cornell-box", "office"):
        yield (
            name,
            SceneRenderer(BUNDLED[name](), inputs="materials", resolution=(24, 24), spp=8, max_depth=4),
        )
    room = SCENES / "living-room" / "scene.xml"
    if room.is_file():
        inputs = ["reflectance", "roughness", "*.scale"]
        yield "living room", SceneRenderer(room, inputs=inputs, resolution=(32, 18), spp=8, max_depth=4)
    else:
        print(f"skipped: {room} does not exist")


def attributions() -> Iterator[tuple[str, dict[str, torch.Tensor]]]:
    """Yield the name, and the values and errors, of each run."""
    for room, renderer in renderers():
        glare = metrics.UnifiedGlareRating(renderer.camera, threshold_factor=5)
        for metric in (metrics.MeanLuminance(), glare):
            for method, options in METHODS:
                run = f"{room} · {type(metric).__name__} · {method.__name__} {options or ''}"
                yield run, numbers(method(renderer, metric).attribute(seed=3, **options))
    yield from attributions_to_logits()
    yield from attributions_to_poses()
    office = SceneRenderer(BUNDLED["office"](), inputs="textures", resolution=(24, 24), spp=8, max_depth=4)
    if office.inputs:
        method, options = WINDOWS
        attribution = method(office, metrics.MeanLuminance()).attribute(seed=3, **options)
        yield f"office · textures · {method.__name__}", numbers(attribution)


def attributions_to_logits() -> Iterator[tuple[str, dict[str, torch.Tensor]]]:
    """Yield the runs of a smoothed and of a plain logit in the office."""
    inputs = ["reflectance", "emitters"]
    renderer = SceneRenderer(BUNDLED["office"](), inputs=inputs, resolution=(32, 18), spp=8, max_depth=4)
    network = metrics.ShapeClassifier.pretrained()
    for name, logit in (
        ("smoothed logit", metrics.ClassLogit(network, "cube", smoothing=0.3)),
        ("plain logit", metrics.ClassLogit(network, "cube")),
    ):
        for method, options in NETWORK_METHODS:
            run = f"office · {name} · {method.__name__} {options or ''}"
            yield run, numbers(method(renderer, logit).attribute(seed=3, **options))


def attributions_to_poses() -> Iterator[tuple[str, dict[str, torch.Tensor]]]:
    """Yield the run of the camera and of an object of the Cornell box."""
    inputs = ["tall_box_shape.pose.*", "camera.pose.*"]
    renderer = SceneRenderer(BUNDLED["cornell-box"](), inputs=inputs, resolution=(24, 24), spp=8, max_depth=4)
    attribution = VanillaSceneGradient(renderer, metrics.MeanLuminance()).attribute(seed=3)
    yield "cornell-box · poses · MeanLuminance", numbers(attribution)


def numbers(attribution: Any) -> dict[str, torch.Tensor]:
    """Return the values, their errors and the metric of an attribution."""
    values = {f"value {name}": value.double() for name, value in attribution.items()}
    errors = {f"error {name}": error.double() for name, error in (attribution.standard_error or {}).items()}
    metric = torch.tensor([float(attribution.metric_value), float(attribution.metric_standard_error or 0)])
    return values | errors | {"metric": metric.double()}


def distance(name: str, now: Mapping[str, torch.Tensor], before: Mapping[str, torch.Tensor]) -> float:
    """Return the largest difference of an entry, relative to the largest value of its parameter, errors too.

    What is below a millionth of the largest entry is rounding, which does not repeat: it counts relative to that.
    """
    largest = max(value.abs().max().item() for value in before.values())
    value = before[name.replace("error ", "value ")]
    scale = max(value.abs().max().item(), NEGLIGIBLE * largest) or 1.0
    return (now[name] - before[name]).abs().max().item() / scale


def compare(file: Path) -> int:
    """Print the difference of each run from the record, and return 1 if any exceeds the limit."""
    before = torch.load(file, weights_only=True)
    exceeded = 0
    for run, now in attributions():
        if run not in before:
            print(f"   new      {run}")
            continue
        if now.keys() != before[run].keys():
            print(f"   names    {run}: {sorted(now.keys() ^ before[run].keys())}")
            exceeded += 1
            continue
        distances = {name: distance(name, now, before[run]) for name in now}
        worst, largest = max(distances.items(), key=lambda item: item[1])
        exceeded += largest > LIMIT
        print(f"{largest:9.1e} {'!' if largest > LIMIT else ' '} {run} ({worst})", flush=True)
    print(f"{exceeded} of {len(before)} runs differ by more than {LIMIT:g}")
    return int(exceeded > 0)


def deep_network() -> torch.nn.Module:
    """Return a random network of 16 convolutions with ReLUs."""
    torch.manual_seed(0)
    layers: list[torch.nn.Module] = []
    for before, after, stride in ((3, 32, 2), *((32, 32, 1),) * 7, (32, 64, 2), *((64, 64, 1),) * 7):
        convolution = torch.nn.Conv2d(before, after, 3, stride=stride, padding=1, bias=False)
        layers += [convolution, torch.nn.BatchNorm2d(after), torch.nn.ReLU()]
    return torch.nn.Sequential(
        *layers, torch.nn.AdaptiveAvgPool2d(1), torch.nn.Flatten(), torch.nn.Linear(64, 3)
    )


def repeat(runs: int = 5) -> int:
    """Print how far the effects of runs with the same seed differ, relative to the largest, and in errors."""
    box = SceneRenderer(BUNDLED["cornell-box"](), inputs="all", resolution=(48, 48), spp=32, max_depth=3)
    office = SceneRenderer(BUNDLED["office"](), inputs="emitters", resolution=(96, 54), spp=1024, max_depth=6)
    picture = metrics.ResizeCropNormalize(48, 48)
    logit = metrics.ClassLogit(deep_network(), 0, transform=picture, smoothing=0.3)
    luminance = metrics.MeanLuminance()
    for name, renderer, metric in (
        ("mean luminance", box, luminance),
        ("logit of a deep network", box, logit),
        ("mean luminance, light of many samples", office, luminance),
    ):
        found = [VanillaSceneGradient(renderer, metric).attribute(seed=3) for _ in range(runs)]
        effects = torch.tensor([list(one.effects().values()) for one in found])
        errors = torch.tensor(list((found[0].effects_error() or {}).values()))
        spread = effects.amax(0) - effects.amin(0)
        print(
            f"{name}: effects differ by at most {spread.max() / effects.abs().max():.1e} of the largest, and "
            f"{(spread / errors).max():.2g} of their standard errors"
        )
    return 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("action", choices=("record", "compare", "repeat"))
    parser.add_argument("file", type=Path, nargs="?", help="of record and compare")
    args = parser.parse_args()
    activate()
    if args.action == "repeat":
        return repeat()
    if args.file is None:
        parser.error(f"{args.action} needs a FILE")
    if args.action == "compare":
        return compare(args.file)
    torch.save(dict(attributions()), args.file)
    print(f"written to {args.file}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
