"""Plant a shortcut in the training pictures of a classifier, and find it by scene attribution.

Two networks learn to tell spheres from cubes. In the training pictures of the first, the desk lamp is always warm
where there is a sphere, and always white where there is a cube. For the second, its colour says nothing about the
class. Then both see a cube under a warm desk lamp, in a room that differs from a grey room with white lamps in
every surface and lamp. Integrated gradients tell which of these differences moves the decision.

Prints a table of all trainings, and draws training pictures, one result with and one without the shortcut, and the
effect of the lamp in all trainings.

    python examples/planted_shortcut.py [--out out/shortcut] [--trainings 10] [--first-seed 0]
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from tqdm import tqdm
from train_shape_classifier import preprocess

import scenecaptum as sc
from scenecaptum import (
    IntegratedGradientsScene,
    SceneAttribution,
    SceneRenderer,
    VanillaSceneGradient,
    metrics,
)
from scenecaptum.estimation import student_t

Plugin = dict[str, Any]

CLASSES = ("sphere", "cube")
RESOLUTION = 32
HELD_OUT = 1_000_000  # the first seed of the held-out rooms; training seeds start at 0
ATTRIBUTED = 2_000_000  # the first seed of the rooms that are attributed

SURFACES = {name: f"{name}.bsdf.reflectance.value" for name in ("object", "rug", "floor", "wall")}
LAMPS = {name: f"{name}.emitter.radiance.value" for name in ("desk_lamp", "ceiling_lamp", "window")}
RADIANCE = {"desk_lamp": 50.0, "ceiling_lamp": 14.0, "window": 6.0}  # each about a third of the light
PLANTED = LAMPS["desk_lamp"]
WARM = torch.tensor([1.5, 0.95, 0.4])  # a warm light with the luminance of white
GREY = 0.4  # the reflectance of the surfaces in the grey room

EXPOSED = 0.25  # mean radiance of a picture after exposure
GRAIN = 0.3  # standard deviation of the logarithm of a pixel, as in a picture taken in dim light


# --- Rooms ----------------------------------------------------------------------------------------


def random_room(kind: str, rng: np.random.Generator) -> Plugin:
    """Return a sphere or a cube on a rug, in a room with three lamps that are off."""
    import mitsuba as mi

    transform = mi.ScalarTransform4f
    bearing, height, distance = rng.uniform(-0.4, 0.4), rng.uniform(0.8, 2.0), rng.uniform(3.6, 4.6)
    origin = [distance * np.sin(bearing), -distance * np.cos(bearing), height]
    target = [*rng.uniform(-0.3, 0.3, size=2), rng.uniform(-0.8, -0.3)]
    half = rng.uniform(0.35, 0.5) * (1.15 if kind == "sphere" else 1.0)  # of about the same size in the picture
    centre = [*rng.uniform(-0.25, 0.25, size=2), half - 1]
    upright = transform().rotate([0, 0, 1], rng.uniform(0, 90))
    flat = transform().translate([0, 0, -0.99]).rotate([0, 0, 1], rng.uniform(0, 90))
    wall = transform().translate([0, rng.uniform(1.8, 3.0), 0]).rotate([1, 0, 0], 90)
    places = {
        "object": transform().translate(centre) @ upright.scale(half),
        "rug": flat.scale(0.9),
        "floor": transform().translate([0, 0, -1]).scale(8),
        "wall": wall.scale(8),
    }
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 4},
        "sensor": {
            "type": "perspective",
            "fov": 40,
            "to_world": transform().look_at(origin=origin, target=target, up=[0, 0, 1]),
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
        **{
            name: {
                "type": kind if name == "object" else "rectangle",
                "to_world": place,
                "bsdf": _diffuse(rng.uniform(0.08, 0.8) * rng.uniform(0.9, 1.1, size=3)),
            }
            for name, place in places.items()
        },
        "desk_lamp": _lamp([-2.4, -1.2, 0.6], 0.25),
        "ceiling_lamp": _lamp([0.3, -0.5, 4.0], 0.8),
        "window": _lamp([4.5, -1.5, 1.5], 1.5),
    }


def _lamp(origin: list[float], half: float) -> Plugin:
    """Return a square that faces the object. It is black, so that lamps do not reflect each other's light."""
    import mitsuba as mi

    place = mi.ScalarTransform4f().look_at(origin=origin, target=[0, 0, -0.6], up=[0.1, 0.2, 1])
    return {"type": "rectangle", "to_world": place.scale(half), "bsdf": _diffuse(np.zeros(3))}


def _diffuse(color: np.ndarray) -> Plugin:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": color.tolist()}}


def lit(room: Plugin, radiances: Mapping[str, torch.Tensor]) -> Plugin:
    """Return the room with lamps that emit these radiances, ``(3,)``."""
    on = {
        lamp: {"type": "area", "radiance": {"type": "rgb", "value": radiance.tolist()}}
        for lamp, radiance in radiances.items()
    }
    return {**room, **{lamp: {**room[lamp], "emitter": emitter} for lamp, emitter in on.items()}}


class Rooms(NamedTuple):
    """Renders of rooms under each lamp alone, ``(N, lamps, H, W, 3)``, and the classes of their objects.

    Light is linear: one set of renders serves all trainings, in any mixture of the lamps.
    """

    by_lamp: torch.Tensor
    labels: torch.Tensor

    @classmethod
    def render(cls, first_seed: int, count: int) -> Rooms:
        """Return rooms that are determined by their seeds."""
        mi = sc.activate()
        import drjit as dr

        pictures, labels = [], [seed % len(CLASSES) for seed in range(first_seed, first_seed + count)]
        for seed, label in enumerate(tqdm(labels, desc="rendering", leave=False), start=first_seed):
            room = random_room(CLASSES[label], np.random.default_rng(seed))
            for lamp, radiance in RADIANCE.items():
                scene = mi.load_dict(lit(room, {lamp: torch.full((3,), radiance)}))
                # Opaque values are not compiled into the kernel, so that one kernel serves thousands of scenes.
                dr.make_opaque([value for _, value in mi.traverse(scene)])
                pictures.append(mi.render(scene, seed=seed).torch().cpu().clone())
        return cls(torch.stack(pictures).unflatten(0, (count, len(RADIANCE))), torch.tensor(labels))

    def photograph(self, generator: torch.Generator, *, shortcut: bool) -> torch.Tensor:
        """Return a picture of each room, ``(N, H, W, 3)``, with random lamps, exposures and grain."""
        count = len(self.labels)

        def uniform(low: float, high: float, *shape: int) -> torch.Tensor:
            return low + (high - low) * torch.rand(count, *shape, generator=generator)

        by_chance = uniform(0, 1) < 0.5
        warm = self.labels == CLASSES.index("sphere") if shortcut else by_chance
        warmth = torch.where(warm, uniform(0.7, 1.0), uniform(0.0, 0.15))
        power = 2 ** uniform(-1, 1, len(RADIANCE), 1) * 2 ** uniform(-0.1, 0.1, len(RADIANCE), 3)
        power[:, list(RADIANCE).index("desk_lamp")] *= WARM ** warmth[:, None]
        pictures = (self.by_lamp * power[:, :, None, None]).sum(1)
        exposure = EXPOSED / pictures.mean((1, 2, 3)) * 2 ** uniform(-0.6, 0.6)
        grain = (GRAIN * torch.randn(pictures.shape[:3], generator=generator)).exp()
        return pictures * exposure[:, None, None, None] * grain[..., None]


# --- Training -------------------------------------------------------------------------------------


def train(rooms: Rooms, *, shortcut: bool, epochs: int, seed: int) -> metrics.ShapeClassifier:
    """Return a network with 12 thousand parameters, trained with new lamps in every epoch."""
    torch.manual_seed(seed)
    network = metrics.ShapeClassifier()
    network.classes = CLASSES
    network.preprocess = metrics.ResizeCropNormalize(
        RESOLUTION, RESOLUTION, mean=(0.5, 0.5, 0.5), std=(0.25, 0.25, 0.25)
    )
    network.head = torch.nn.Linear(network.head.in_features, len(CLASSES))
    generator = torch.Generator().manual_seed(seed)
    batches = -(-len(rooms.labels) // 64)
    optimizer = torch.optim.AdamW(network.parameters(), weight_decay=5e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 8e-3, total_steps=epochs * batches)
    for _ in range(epochs):
        pictures = rooms.photograph(generator, shortcut=shortcut)
        for chosen in torch.randperm(len(pictures), generator=generator).chunk(batches):
            logits = network(preprocess(network, pictures[chosen]))
            loss = torch.nn.functional.cross_entropy(logits, rooms.labels[chosen], label_smoothing=0.05)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    return network.eval()


def accuracy(network: metrics.ShapeClassifier, rooms: Rooms, *, shortcut: bool, seed: int) -> float:
    """Return the accuracy on pictures with or without the shortcut."""
    pictures = rooms.photograph(torch.Generator().manual_seed(seed), shortcut=shortcut)
    with torch.no_grad():
        answers = network(preprocess(network, pictures)).argmax(1)
    return (answers == rooms.labels).float().mean().item()


# --- Attribution ----------------------------------------------------------------------------------


def cube_under_a_warm_lamp(seed: int, spp: int) -> tuple[SceneRenderer, dict[str, torch.Tensor]]:
    """Return a renderer of a random room, and the values of a grey room with white lamps of the same shapes."""
    sc.activate()
    rng = np.random.default_rng(ATTRIBUTED + seed)
    room = random_room("cube", rng)
    colors = {
        lamp: WARM if lamp == "desk_lamp" else torch.tensor(2 ** rng.uniform(-0.5, 0.5) * np.ones(3))
        for lamp in RADIANCE
    }
    radiances = {lamp: radiance * colors[lamp] for lamp, radiance in RADIANCE.items()}
    inputs = [*SURFACES.values(), *LAMPS.values()]
    renderer = SceneRenderer(lit(room, radiances), inputs, spp=spp)
    white = {LAMPS[lamp]: torch.full((3,), radiance) for lamp, radiance in RADIANCE.items()}
    return renderer, {name: torch.full((3,), GREY) for name in SURFACES.values()} | white


class Finding(NamedTuple):
    """What is found about the planted lamp: its rank, its effect on sphere against cube, and the half-width."""

    rank: int
    effect: float
    half_width: float

    @classmethod
    def of(cls, attribution: SceneAttribution) -> Finding:
        row = next(row for row in attribution.ranking() if row.name == PLANTED)
        return cls(row.rank, row.effect, half_width(attribution, row.effect_error or math.inf))

    @property
    def is_first_and_clear(self) -> bool:
        """Whether the lamp is ranked first, with a 95 % interval that leaves out 0."""
        return self.rank == 1 and abs(self.effect) > self.half_width


def half_width(attribution: SceneAttribution, error: float) -> float:
    """Return the half-width of a 95 % confidence interval."""
    info = attribution.info
    return error * student_t(0.95, info.get("degrees_of_freedom", info["replicates"] - 1))


@dataclass(frozen=True)
class Training:
    """A trained network: its accuracy on held-out rooms, and what moves its decision."""

    seed: int
    shortcut: bool
    accuracy_with: float
    accuracy_without: float
    attribution: SceneAttribution
    gradient_rank: int  # of the lamp by the plain gradient

    @property
    def finding(self) -> Finding:
        """What the attribution says of the planted lamp."""
        return Finding.of(self.attribution)

    def __str__(self) -> str:
        """Return a row of the table."""
        found = self.finding
        error = self.attribution.effects_error()
        return " | ".join([
            f"| {self.seed:4d}",
            f"{'yes' if self.shortcut else 'no':8s}",
            f"{self.accuracy_with:8.1%}",
            f"{self.accuracy_without:8.1%}",
            f"{found.rank:4d}",
            f"{found.effect:+.2f} ± {error[PLANTED] if error else math.nan:.2f}",
            f"{found.effect - found.half_width:+.2f} to {found.effect + found.half_width:+.2f}",
            f"{self.gradient_rank:4d} |",
        ])


def run(rooms: Rooms, held_out: Rooms, *, seed: int, shortcut: bool, epochs: int, spp: int) -> Training:
    """Train a network, and attribute its decision in a room of its own."""
    network = train(rooms, shortcut=shortcut, epochs=epochs, seed=seed)
    renderer, grey_room = cube_under_a_warm_lamp(seed, spp)
    exposure = EXPOSED / renderer(seed=seed).mean().item()
    metric = metrics.ClassLogit(network, "sphere", against="cube", exposure=exposure, smoothing=0.3)
    method = IntegratedGradientsScene(renderer, metric)
    gradient = VanillaSceneGradient(renderer, metric).attribute(seed=seed, spp=spp // 4)
    return Training(
        seed,
        shortcut,
        accuracy(network, held_out, shortcut=True, seed=seed),
        accuracy(network, held_out, shortcut=False, seed=seed),
        method.attribute(baselines=grey_room, n_steps=16, seed=seed),
        Finding.of(gradient).rank,
    )


if __name__ == "__main__":
    import time
    torch.set_num_threads(1)
    n, epochs, trainings, first = 1600, 25, 10, 0
    t = time.time()
    rooms = Rooms.render(0, n)
    held = Rooms.render(HELD_OUT, 400)
    print(rooms.by_lamp.mean((0, 2, 3, 4)), f"render {time.time()-t:.0f} s", flush=True)
    torch.save([tuple(rooms), tuple(held)], f"/tmp/w/rooms{n}.pt")
    for seed in range(first, first + trainings):
        for shortcut in (False, True) if seed < 3 else (False,):
            t = time.time()
            a = run(rooms, held, seed=seed, shortcut=shortcut, epochs=epochs, spp=1024)
            print(a, f"{time.time()-t:.0f} s", a.attribution.info["convergence"], f"{a.attribution.metric_value:.2f}")
            a = a.attribution
            print("   ", "  ".join(f"{r.label.split(':')[0]} {r.effect:+.2f}±{half_width(a, r.effect_error):.2f}" for r in a.ranking()), flush=True)
