"""Plant a shortcut in the training pictures of a classifier, and find it by scene attribution."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np
import torch
from train_shape_classifier import preprocess

import scenecaptum as sc
from scenecaptum import SceneAttribution, SceneRenderer, VanillaSceneGradient, metrics
from scenecaptum.estimation import student_t

Plugin = dict[str, Any]

CLASSES = ("sphere", "cube")
SURFACES = ("object", "rug", "floor", "wall")
LAMPS = {"desk_lamp": 60.0, "ceiling_lamp": 14.0, "window": 6.0}  # radiance
SHORTCUT = "desk_lamp.emitter.radiance.value"
WARM = torch.tensor([1.5, 0.95, 0.4])  # the luminance of white
RESOLUTION = 32
EXPOSED = 0.25
GRAIN = 0.3
HELD_OUT = 1_000_000
ATTRIBUTED = 2_000_000


def random_room(kind: str, rng: np.random.Generator) -> Plugin:
    """Return a sphere or a cube in a room whose lamps are off."""
    import mitsuba as mi

    transform = mi.ScalarTransform4f
    bearing, height, distance = rng.uniform(-0.4, 0.4), rng.uniform(0.8, 2.0), rng.uniform(3.6, 4.6)
    origin = [distance * np.sin(bearing), -distance * np.cos(bearing), height]
    half = rng.uniform(0.35, 0.5) * (1.15 if kind == "sphere" else 1.0)
    middle = [rng.uniform(-0.25, 0.25), rng.uniform(-0.25, 0.25), half - 1]
    place = transform().translate(middle).rotate([0, 0, 1], rng.uniform(0, 90)).scale(half)
    rug = transform().translate([0, 0, -0.99]).rotate([0, 0, 1], rng.uniform(0, 90)).scale(0.9)
    wall = transform().translate([0, rng.uniform(1.8, 3.0), 0]).rotate([1, 0, 0], 90).scale(8)
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 4},
        "sensor": {
            "type": "perspective",
            "fov": 40,
            "to_world": transform().look_at(
                origin=origin, target=[*rng.uniform(-0.3, 0.3, 2), rng.uniform(-0.8, -0.3)], up=[0, 0, 1]
            ),
            "film": {
                "type": "hdrfilm",
                "width": RESOLUTION,
                "height": RESOLUTION,
                "pixel_format": "rgb",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
            "sampler": {"type": "independent", "sample_count": 32},
        },
        "object": {"type": kind, "to_world": place, "bsdf": _paint(rng)},
        "rug": {"type": "rectangle", "to_world": rug, "bsdf": _paint(rng)},
        "floor": {
            "type": "rectangle",
            "to_world": transform().translate([0, 0, -1]).scale(8),
            "bsdf": _paint(rng),
        },
        "wall": {"type": "rectangle", "to_world": wall, "bsdf": _paint(rng)},
        "desk_lamp": _lamp([-2.4, -1.2, 0.6], 0.25),
        "ceiling_lamp": _lamp([0.3, -0.5, 4.0], 0.8),
        "window": _lamp([4.5, -1.5, 1.5], 1.5),
    }


def _paint(rng: np.random.Generator) -> Plugin:
    value = rng.uniform(0.2, 0.7) * rng.uniform(0.9, 1.1, 3)
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": value.tolist()}}


def _lamp(origin: list[float], half: float) -> Plugin:
    """Return a square that faces the object and reflects nothing."""
    import mitsuba as mi

    place = mi.ScalarTransform4f().look_at(origin=origin, target=[0, 0, -0.6], up=[0.1, 0.2, 1])
    black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.0] * 3}}
    return {"type": "rectangle", "to_world": place.scale(half), "bsdf": black}


def lit(room: Plugin, radiances: dict[str, list[float]]) -> Plugin:
    """Return the room with lamps that emit these radiances."""
    on = {
        lamp: {**room[lamp], "emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance}}}
        for lamp, radiance in radiances.items()
    }
    return {**room, **on}


class Rooms(NamedTuple):
    """Pictures of rooms under each lamp alone, ``(N, lamps, H, W, 3)``, and the classes of their objects."""

    by_lamp: torch.Tensor
    labels: torch.Tensor

    @classmethod
    def render(cls, first_seed: int, count: int) -> Rooms:
        import drjit as dr
        mi = sc.activate()
        pictures, labels = [], []
        for seed in range(first_seed, first_seed + count):
            label = seed % 2
            room = random_room(CLASSES[label], np.random.default_rng(seed))
            for lamp, radiance in LAMPS.items():
                scene = mi.load_dict(lit(room, {lamp: [radiance] * 3}))
                dr.make_opaque([value for _, value in mi.traverse(scene)])
                pictures.append(mi.render(scene, seed=seed).torch().cpu().clone())
            labels.append(label)
        by_lamp = torch.stack(pictures).unflatten(0, (count, len(LAMPS)))
        return cls(by_lamp, torch.tensor(labels))

    def light(self, shortcut: float, generator: torch.Generator) -> torch.Tensor:
        """Return pictures with random lamps.

        In a share ``shortcut`` of the pictures the desk lamp is warm for spheres and white for cubes; in the others
        at random.
        """
        n = len(self.labels)
        def uniform(low, high, *shape):
            return low + (high - low) * torch.rand(*shape, generator=generator)
        planted = uniform(0, 1, n) < shortcut
        warm = torch.where(planted, self.labels == 0, uniform(0, 1, n) < 0.5)
        warmth = torch.where(warm, uniform(0.7, 1.0, n), uniform(0.0, 0.15, n))
        tint = 2 ** uniform(-0.1, 0.1, n, len(LAMPS), 3)
        tint[:, 0] *= WARM ** warmth[:, None]
        power = 2 ** uniform(-1, 1, n, len(LAMPS), 1)
        pictures = (self.by_lamp * (power * tint)[:, :, None, None]).sum(1)
        exposure = EXPOSED * 2 ** uniform(-0.6, 0.6, n, 1, 1, 1)
        grain = GRAIN * torch.randn(pictures.shape[:3], generator=generator)[..., None]
        return pictures * grain.exp() * exposure / pictures.mean((1, 2, 3), keepdim=True)


def train(rooms: Rooms, shortcut: float, *, epochs: int, seed: int) -> metrics.ShapeClassifier:
    torch.manual_seed(seed)
    network = metrics.ShapeClassifier()
    network.classes = CLASSES
    network.preprocess = metrics.ResizeCropNormalize(RESOLUTION, RESOLUTION, mean=(0.5,) * 3, std=(0.25,) * 3)
    network.head = torch.nn.Linear(network.head.in_features, 2)
    generator = torch.Generator().manual_seed(seed)
    batches = -(-len(rooms.labels) // 64)
    optimizer = torch.optim.AdamW(network.parameters(), weight_decay=5e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 8e-3, total_steps=epochs * batches)
    for _ in range(epochs):
        pictures = rooms.light(shortcut, generator)
        for chosen in torch.randperm(len(pictures), generator=generator).chunk(batches):
            logits = network(preprocess(network, pictures[chosen]))
            loss = torch.nn.functional.cross_entropy(logits, rooms.labels[chosen], label_smoothing=0.05)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    return network.eval()


def accuracy(network, rooms, shortcut, seed):
    pictures = rooms.light(shortcut, torch.Generator().manual_seed(seed))
    with torch.no_grad():
        return (network(preprocess(network, pictures)).argmax(1) == rooms.labels).float().mean().item()


def attribute(network, *, seed, spp=512):
    room = random_room("cube", np.random.default_rng(ATTRIBUTED + seed))
    radiances = {lamp: [r] * 3 for lamp, r in LAMPS.items()}
    radiances["desk_lamp"] = (LAMPS["desk_lamp"] * WARM).tolist()
    inputs = [f"{s}.bsdf.reflectance.value" for s in SURFACES] + [f"{l}.emitter.radiance.value" for l in LAMPS]
    renderer = SceneRenderer(lit(room, radiances), inputs, spp=spp)
    exposure = EXPOSED / renderer(seed=seed, spp=256).mean().item()
    metric = metrics.ClassLogit(network, "sphere", against="cube", exposure=exposure, smoothing=0.3)
    return VanillaSceneGradient(renderer, metric).attribute(seed=seed)


if __name__ == "__main__":
    import sys
    torch.set_num_threads(1)
    n, epochs, trainings, first = map(int, sys.argv[1:5])
    t = time.time()
    rooms = Rooms.render(0, n)
    held = Rooms.render(HELD_OUT, 400)
    print(rooms.by_lamp.mean((0, 2, 3, 4)), f"render {time.time()-t:.0f} s", flush=True)
    torch.save([tuple(rooms), tuple(held)], f"/tmp/w/rooms{n}.pt")
    for seed in range(first, first + trainings):
        for shortcut in (1.0, 0.0):
            t = time.time()
            network = train(rooms, shortcut, epochs=epochs, seed=seed)
            t1 = time.time()
            acc = [accuracy(network, held, s, seed) for s in (1.0, 0.0)]
            a = attribute(network, seed=seed)
            print(shortcut, seed, acc, f"{t1-t:.0f} {time.time()-t1:.0f} s", f"{a.metric_value:.2f}")
            q = student_t(0.95, a.info["degrees_of_freedom"])
            print("   ", "  ".join(f"{r.label.split(':')[0]} {r.effect:+.2f}±{q*r.effect_error:.2f}" for r in a.ranking()), flush=True)
