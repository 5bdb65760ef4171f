"""Train the shape classifier that ships with scenecaptum on synthetic renders.

python examples/train_shape_classifier.py [--images 4000] [--epochs 40] [--out FILE]

Renders spheres, cubes and cylinders in random poses, colours, materials and lights, trains
``metrics.ShapeClassifier`` on them, and prints its accuracy on held-out renders with other seeds.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.figure import Figure
from tqdm import tqdm

import scenecaptum as sc
from scenecaptum import metrics
from scenecaptum.visualization import display_image

Plugin = dict[str, Any]
WEIGHTS = Path(metrics.__file__).with_name("shape_classifier.pt")
RESOLUTION = 48
HELD_OUT = 1_000_000  # the first seed of the held-out images; training seeds start at 0


# --- Images ---------------------------------------------------------------------------------------


def render_example(seed: int) -> tuple[torch.Tensor, int]:
    """Return an ``(H, W, 3)`` linear-radiance render and its class, both determined by the seed."""
    import drjit as dr
    import mitsuba as mi

    rng = np.random.default_rng(seed)
    label = seed % len(metrics.ShapeClassifier.classes)
    scene = mi.load_dict(random_scene(metrics.ShapeClassifier.classes[label], rng))
    # Opaque values are not compiled into the kernel, so that one kernel serves thousands of scenes.
    dr.make_opaque([value for _, value in mi.traverse(scene)])
    image = mi.render(scene, seed=seed % 2**31).torch().cpu().clone()
    # Automatic exposure, with an error of up to a stop.
    return image * float(0.3 * 2 ** rng.uniform(-1.0, 1.0)) / image.mean().clamp_min(1e-6), label


def random_scene(kind: str, rng: np.random.Generator) -> Plugin:
    """Return one shape on a floor in front of a wall, with random camera and light."""
    import mitsuba as mi

    bearing, height = rng.uniform(-0.7, 0.7), rng.uniform(0.8, 2.4)
    distance = rng.uniform(3.4, 4.6)
    origin = [distance * np.sin(bearing), -distance * np.cos(bearing), height]
    target = rng.uniform(-0.25, 0.25, size=3).tolist()
    transform = mi.ScalarTransform4f
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 4},
        "sensor": {
            "type": "perspective",
            "fov": rng.uniform(36, 44),
            "to_world": transform().look_at(origin=origin, target=target, up=[0, 0, 1]),
            "film": {
                "type": "hdrfilm",
                "width": RESOLUTION,
                "height": RESOLUTION,
                "pixel_format": "rgb",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
            "sampler": {"type": "independent", "sample_count": 64},
        },
        "material": _material(rng),
        "floor": _panel(transform().translate([0, 0, -1]).scale(12), rng),
        "wall": _panel(
            transform().translate([0, rng.uniform(1.8, 4.0), 0]).rotate([1, 0, 0], 90).scale(14), rng
        ),
        **_shape(kind, rng),
        **_lights(rng),
    }


def _shape(kind: str, rng: np.random.Generator) -> Plugin:
    """Return the shape; all kinds have about the same size, so that the size does not reveal the class."""
    import mitsuba as mi

    place = mi.ScalarTransform4f()
    # Half of them are upright. The tilt is limited, because a cylinder seen along its axis is a disk.
    if rng.random() < 0.5:
        heading = rng.uniform(0, 2 * np.pi)
        place = place.rotate([np.cos(heading), np.sin(heading), 0], rng.uniform(0, 40))
    place = place.rotate([0, 0, 1], rng.uniform(0, 360)) @ mi.ScalarTransform4f().scale(
        rng.uniform(0.75, 1.0)
    )
    bsdf = {"type": "ref", "id": "material"}
    if kind == "sphere":
        return {"shape": {"type": "sphere", "to_world": place, "bsdf": bsdf}}
    if kind == "cube":
        size = rng.uniform(0.65, 0.95, size=3).tolist()
        return {"shape": {"type": "cube", "to_world": place.scale(size), "bsdf": bsdf}}
    radius, half = rng.uniform(0.55, 0.8), rng.uniform(0.65, 1.0)
    tube = {"type": "cylinder", "p0": [0, 0, -half], "p1": [0, 0, half], "radius": radius}
    caps = {
        f"cap_{name}": {
            "type": "disk",
            "to_world": place.translate([0, 0, z]).rotate([1, 0, 0], turn).scale(radius),
            "bsdf": bsdf,
        }
        for name, z, turn in (("top", half, 0), ("bottom", -half, 180))
    }
    return {"shape": {**tube, "to_world": place, "bsdf": bsdf}, **caps}


def _material(rng: np.random.Generator) -> Plugin:
    inside: Plugin = {
        "type": "principled",
        "base_color": _color(rng, 0.2, 0.9),
        "roughness": rng.uniform(0.25, 0.9),
        "specular": rng.uniform(0.1, 0.6),
    }
    return {"type": "twosided", "id": "material", "bsdf": inside}


def _panel(place: Any, rng: np.random.Generator) -> Plugin:
    bsdf = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": _color(rng, 0.05, 0.7)}}
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf}


def _lights(rng: np.random.Generator) -> Plugin:
    """Return a lamp above the shape, and a sky of random strength, which fills the shadows."""
    import mitsuba as mi

    bearing = rng.uniform(0, 2 * np.pi)
    position = [3 * np.cos(bearing), min(3 * np.sin(bearing), 1.2), rng.uniform(2.0, 5.0)]
    place = mi.ScalarTransform4f().look_at(origin=position, target=[0, 0, 0], up=[0.1, 0.2, 1])
    warmth = rng.uniform(0.75, 1.25)
    lamp = {"type": "rgb", "value": [12 * warmth, 12.0, 12 / warmth]}
    return {
        "lamp": {
            "type": "rectangle",
            "to_world": place.scale(rng.uniform(0.3, 1.0)),
            "emitter": {"type": "area", "radiance": lamp},
        },
        "sky": {
            "type": "constant",
            "radiance": {"type": "rgb", "value": [float(rng.uniform(0.1, 0.45))] * 3},
        },
    }


def _color(rng: np.random.Generator, low: float, high: float) -> Plugin:
    grey = rng.random() < 0.25
    value = np.full(3, rng.uniform(low, high)) if grey else rng.uniform(low, high, size=3)
    return {"type": "rgb", "value": value.tolist()}


def dataset(first_seed: int, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return linear-radiance images ``(count, H, W, 3)`` and their classes."""
    sc.activate()
    pairs = [render_example(first_seed + i) for i in tqdm(range(count), desc="rendering", leave=False)]
    return torch.stack([image for image, _ in pairs]), torch.tensor([label for _, label in pairs])


def draw_sheet(images: torch.Tensor, labels: torch.Tensor, columns: int = 8) -> Figure:
    """Return a figure of the first images of each class, one class in each row."""
    classes = metrics.ShapeClassifier.classes
    figure, grid = plt.subplots(
        len(classes), columns, figsize=(columns, 1.08 * len(classes)), layout="constrained"
    )
    for label, (name, row) in enumerate(zip(classes, grid, strict=True)):
        row[0].set_ylabel(name)
        for axes, image in zip(row, images[labels == label], strict=False):
            axes.imshow(display_image(image))
            axes.set(xticks=[], yticks=[])
            axes.spines[:].set_visible(False)
    return figure


# --- Training -------------------------------------------------------------------------------------


def train(images: torch.Tensor, labels: torch.Tensor, *, epochs: int, seed: int) -> metrics.ShapeClassifier:
    """Return a classifier trained on the images, with data augmentation."""
    torch.manual_seed(seed)
    model = metrics.ShapeClassifier()
    optimizer = torch.optim.AdamW(model.parameters(), lr=4e-3, weight_decay=5e-3)
    batches = -(-len(images) // 64)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 8e-3, total_steps=epochs * batches)
    for _ in tqdm(range(epochs), desc="training", leave=False):
        for chosen in torch.randperm(len(images)).chunk(batches):
            logits = model(preprocess(model, augment(images[chosen])))
            loss = torch.nn.functional.cross_entropy(logits, labels[chosen], label_smoothing=0.05)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    return model.eval()


def augment(images: torch.Tensor) -> torch.Tensor:
    """Return the images with random flips, shifts, exposures and channel permutations."""
    images = torch.where(torch.rand(len(images), 1, 1, 1) < 0.5, images.flip(2), images)
    images = images[..., torch.randperm(3)] * 2 ** torch.empty(len(images), 1, 1, 1).uniform_(-0.6, 0.6)
    down, right = (int(step) for step in torch.randint(-3, 4, (2,)))
    padded = torch.nn.functional.pad(images.movedim(-1, 1), (3, 3, 3, 3), mode="replicate").movedim(1, -1)
    return padded[:, 3 + down : 3 + down + RESOLUTION, 3 + right : 3 + right + RESOLUTION]


def preprocess(model: metrics.ShapeClassifier, images: torch.Tensor) -> torch.Tensor:
    """Return a batch with the same preprocessing as in ``metrics.ClassLogit``."""
    from kornia.color import linear_rgb_to_rgb

    srgb = linear_rgb_to_rgb(images.movedim(-1, 1).clamp(0, 1))
    batch: torch.Tensor = model.preprocess(srgb)
    return batch


def accuracy(model: metrics.ShapeClassifier, images: torch.Tensor, labels: torch.Tensor) -> float:
    """Return the accuracy of the largest logit of ``metrics.ClassLogit``."""
    metric = metrics.ClassLogit(model)
    with torch.no_grad():
        correct = [
            int(metric(image).argmax()) == int(label) for image, label in zip(images, labels, strict=True)
        ]
    return sum(correct) / len(correct)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--images", type=int, default=4000, help="training images (default: %(default)s)")
    parser.add_argument("--held-out", type=int, default=600, help="held-out images (default: %(default)s)")
    parser.add_argument("--epochs", type=int, default=40, help="(default: %(default)s)")
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of weights and order (default: %(default)s)"
    )
    parser.add_argument("--out", type=Path, default=WEIGHTS, help="(default: %(default)s)")
    parser.add_argument("--sheet", type=Path, metavar="FILE", help="also draw some of the training images")
    options = parser.parse_args()

    start = time.perf_counter()
    images, labels = dataset(0, options.images)
    print(f"rendered {len(images)} images in {time.perf_counter() - start:.0f} s", flush=True)
    if options.sheet:
        draw_sheet(images, labels).savefig(options.sheet)
    start = time.perf_counter()
    model = train(images, labels, epochs=options.epochs, seed=options.seed)
    parameters = sum(p.numel() for p in model.parameters())
    print(f"trained {parameters} parameters in {time.perf_counter() - start:.0f} s", flush=True)

    half = {k: v.half() if v.is_floating_point() else v for k, v in model.state_dict().items()}
    torch.save(half, options.out)
    model.load_state_dict(half)  # evaluate the shipped weights, rounding included
    print(f"accuracy on the training images: {accuracy(model, images, labels):.1%}")
    held_out = accuracy(model, *dataset(HELD_OUT, options.held_out))
    print(f"accuracy on {options.held_out} held-out images: {held_out:.1%}")
    print(f"{options.out}: {options.out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
