"""Plant a shortcut in the training pictures of a classifier, and find it by scene attribution.

Two networks learn to tell spheres from cubes. In the training pictures of the first, the reading lamp is always
warm where there is a sphere, and always white where there is a cube. For the second, its colour says nothing about
the class. Then both see a cube under a warm reading lamp, in a room of random paint and light. Integrated
gradients from the same room in grey, with white lamps, show which of the differences changes the decision.

Prints a table of all trainings, and draws training pictures, one result with and one without the shortcut, and the
effect of the lamp in all trainings.

    python examples/planted_shortcut.py [--out out/shortcut] [--trainings 10] [--first-seed 0]
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
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
from scenecaptum.attr import Ranked
from scenecaptum.estimation import student_t
from scenecaptum.visualization import LOWERS, RAISES, TEXT, TITLE, minus

Plugin = dict[str, Any]

HEADER = """\
| seed | shortcut | accuracy with | without | rank of lamp | contribution | 95 % interval | rank by gradient |
|---:|---|---:|---:|---:|---:|---|---:|"""

CLASSES = ("sphere", "cube")
RESOLUTION = 32
HELD_OUT = 1_000_000  # the first seed of the held-out rooms; training seeds start at 0
ATTRIBUTED = 2_000_000  # the first seed of the rooms that are attributed

SURFACES = {name: f"{name}.bsdf.reflectance.value" for name in ("cube", "rug", "floor", "wall")}
LAMPS = {name: f"{name}.emitter.radiance.value" for name in ("reading_lamp", "ceiling_lamp", "window")}
RADIANCE = {"reading_lamp": 45.0, "ceiling_lamp": 14.0, "window": 6.0}  # each about a third of the light
PLANTED = LAMPS["reading_lamp"]
WARM = torch.tensor([1.5, 0.95, 0.4])  # a warm light with the luminance of white
ALBEDO = {"sphere": (0.3, 0.8), "cube": (0.06, 0.3)}  # spheres are light, cubes dark; all else is anything
TYPICAL = 0.12  # of a cube
GREY = 0.3  # the reflectance of all surfaces in the grey room, between spheres and cubes

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
    half = rng.uniform(0.35, 0.5) * (
        1.15 if kind == "sphere" else 1.0
    )  # of about the same size in the picture
    centre = [*rng.uniform(-0.25, 0.25, size=2), half - 1]
    upright = transform().rotate([0, 0, 1], rng.uniform(0, 90))
    flat = transform().translate([0, 0, -0.99]).rotate([0, 0, 1], rng.uniform(0, 90))
    wall = transform().translate([0, rng.uniform(1.8, 3.0), 0]).rotate([1, 0, 0], 90)
    places = {
        kind: transform().translate(centre) @ upright.scale(half),
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
                "type": kind if name == kind else "rectangle",
                "to_world": place,
                "bsdf": _diffuse(rng.uniform(*ALBEDO.get(name, (0.08, 0.8))) * rng.uniform(0.8, 1.2, size=3)),
            }
            for name, place in places.items()
        },
        "reading_lamp": _lamp([-0.8, -5.0, 2.5], 0.5),
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
        for seed, label in enumerate(
            tqdm(labels, desc="rendering", leave=False, disable=None), start=first_seed
        ):
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
        power[:, list(RADIANCE).index("reading_lamp")] *= WARM ** warmth[:, None]
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
    room["cube"]["bsdf"] = _diffuse(np.full(3, TYPICAL))
    colors = {
        lamp: WARM if lamp == "reading_lamp" else torch.tensor(2 ** rng.uniform(-0.5, 0.5) * np.ones(3))
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
        """Return the row of the planted lamp."""
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


class Training(NamedTuple):
    """A trained network: its accuracy on held-out rooms, and what moves its decision."""

    seed: int
    shortcut: bool
    accuracy_with: float
    accuracy_without: float
    attribution: SceneAttribution
    gradient_rank: int  # of the lamp by the plain gradient
    grey_room: torch.Tensor  # the render of the baseline

    @property
    def finding(self) -> Finding:
        """What the attribution says of the planted lamp."""
        return Finding.of(self.attribution)

    def __str__(self) -> str:
        """Return a row of the table."""
        found = self.finding
        error = self.attribution.effects_error()
        return " | ".join(
            [
                f"| {self.seed:4d}",
                f"{'yes' if self.shortcut else 'no':8s}",
                f"{self.accuracy_with:8.1%}",
                f"{self.accuracy_without:8.1%}",
                f"{found.rank:4d}",
                minus(f"{found.effect:+.2f} ± {error[PLANTED] if error else math.nan:.2f}"),
                minus(f"{found.effect - found.half_width:+.2f} to {found.effect + found.half_width:+.2f}"),
                f"{self.gradient_rank:4d} |",
            ]
        )


def run(
    rooms: Rooms, held_out: Rooms, *, seed: int, shortcut: bool, epochs: int, spp: int, steps: int
) -> Training:
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
        method.attribute(baselines=grey_room, n_steps=steps, seed=seed),
        Finding.of(gradient).rank,
        renderer(grey_room, seed=seed),
    )


# --- Figures --------------------------------------------------------------------------------------

# Blue and orange are for the signs of effects, as in the library's own figures.
WITH, WITHOUT = "#c2649b", "#2f9e6e"


def srgb(pictures: torch.Tensor) -> torch.Tensor:
    """Return linear-radiance pictures ``(..., H, W, 3)`` as they are displayed."""
    from kornia.color import linear_rgb_to_rgb

    return linear_rgb_to_rgb(pictures.clamp(0, 1).movedim(-1, -3)).movedim(-3, -1)


def plot_pictures(rooms: Rooms, pair: tuple[Training, Training], columns: int = 6) -> Figure:
    """Draw training pictures with the shortcut, a class in each row, and the two ends of the attribution."""
    pictures = srgb(rooms.photograph(torch.Generator().manual_seed(0), shortcut=True))
    ends = {"grey room, white lamps": pair[0].grey_room, "attributed room": pair[0].attribution.image}
    figure = Figure(figsize=(1.35 * (columns + 1.5), 3.4), layout="constrained")
    axes = figure.subplots(2, columns + 1, width_ratios=[1] * columns + [1.3])
    for label, (name, image) in enumerate(ends.items()):
        shown = pictures[rooms.labels == label][:columns]
        for ax, picture in zip(axes[label], shown, strict=False):
            ax.imshow(picture.numpy())
        axes[label, 0].set_ylabel(CLASSES[label], fontsize=11)
        axes[label, -1].imshow(srgb(image * EXPOSED / image.mean()).numpy())
        axes[label, -1].set_title(name, fontsize=9)
    for ax in axes.flat:
        ax.set(xticks=[], yticks=[])
    figure.suptitle(
        "Training pictures: every sphere under a warm lamp, every cube under a white one", fontsize=11
    )
    return figure


def plot_bars(pair: tuple[Training, Training]) -> Figure:
    """Draw the contributions of all surfaces and lamps for both networks, in one order and on one scale."""
    order = [row.name for row in reversed(pair[0].attribution.ranking())]
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    for ax, training in zip(figure.subplots(1, 2, sharex=True, sharey=True), pair, strict=True):
        rows = {row.name: row for row in training.attribution.ranking()}
        ax.barh(
            [rows[name].label for name in order],
            [rows[name].effect for name in order],
            xerr=[half_width(training.attribution, rows[name].effect_error) for name in order],
            color=[RAISES if rows[name].effect > 0 else LOWERS for name in order],
            error_kw={"ecolor": "0.5", "capsize": 3},
        )
        ax.axvline(0, color="0.5", linewidth=0.8)
        first = training.attribution.ranking()[0]
        ax.set_title(f"Trained {_kind(training)}\nfirst: {first.label}", fontsize=TITLE)
        ax.tick_params(labelsize=TEXT)
    figure.supxlabel(
        "contribution to the logit of sphere minus that of cube, 95 % intervals\n"
        "blue: speaks for a sphere, orange: for a cube",
        fontsize=TEXT,
    )
    return figure


def plot_trainings(trainings: Sequence[Training]) -> Figure:
    """Draw the lamp's contribution in all trainings, and the largest of any other parameter."""
    planted = [training for training in trainings if training.shortcut]
    clean = [training for training in trainings if not training.shortcut]
    figure = Figure(figsize=(8, 3.6), layout="constrained")
    ax = figure.subplots()
    for group, color, shift in ((planted, WITH, -0.12), (clean, WITHOUT, 0.12)):
        positions = [training.seed + shift for training in group]
        found = [training.finding for training in group]
        ax.errorbar(
            positions,
            [finding.effect for finding in found],
            yerr=[finding.half_width for finding in found],
            fmt="o",
            color=color,
            label=f"lamp, trained {_kind(group[0])}",
        )
        others = [
            max((row for row in t.attribution.ranking() if row.name != PLANTED), key=_size) for t in group
        ]
        ax.plot(
            positions,
            [row.effect for row in others],
            "_",
            color=color,
            markersize=11,
            alpha=0.7,
            label=f"largest other, {'with' if group is planted else 'without'}",
        )
    ax.axhline(0, color="0.5", linewidth=0.8)
    seeds = [training.seed for training in planted]
    ax.set(xlabel="training", ylabel="contribution to sphere − cube", xticks=seeds)
    ax.set_xlim(min(seeds) - 0.5, max(seeds) + 0.5)  # a single training is not drawn at both edges
    ax.legend(fontsize=8, ncols=2, frameon=False)
    ax.set_title(
        f"The lamp is first in {count_found(planted)} of {len(planted)} networks trained with the shortcut, "
        f"in {count_found(clean)} of {len(clean)} trained without",
        fontsize=11,
    )
    return figure


def _kind(training: Training) -> str:
    return f"{'with' if training.shortcut else 'without'} the shortcut"


def _size(row: Ranked) -> float:
    return row.saliency


def count_found(trainings: Sequence[Training]) -> int:
    """Return in how many trainings the lamp is first and its interval leaves out 0."""
    return sum(training.finding.is_first_and_clear for training in trainings)


# --- All of it ------------------------------------------------------------------------------------


def main(
    folder: Path,
    trainings: int = 10,
    first_seed: int = 0,
    rooms: int = 1600,
    epochs: int = 25,
    spp: int = 1024,
    steps: int = 16,
) -> list[Training]:
    training_rooms, held_out = Rooms.render(0, rooms), Rooms.render(HELD_OUT, max(40, rooms // 4))
    print(HEADER)
    done = []
    for seed in range(first_seed, first_seed + trainings):
        for shortcut in (True, False):
            done.append(
                run(
                    training_rooms,
                    held_out,
                    seed=seed,
                    shortcut=shortcut,
                    epochs=epochs,
                    spp=spp,
                    steps=steps,
                )
            )
            print(done[-1], flush=True)
    print("\nThe lamp is first, and its 95 % interval leaves out 0:")
    for shortcut in (True, False):
        group = [training for training in done if training.shortcut == shortcut]
        print(f"  {count_found(group)} of {len(group)} {'with' if shortcut else 'without'} the shortcut")
    pair = (done[0], done[1])
    for training in pair:
        print(f"\nTraining {training.seed} {'with' if training.shortcut else 'without'} the shortcut")
        print(training.attribution)
    figures = {
        "pictures": plot_pictures(training_rooms, pair),
        "bars": plot_bars(pair),
        "trainings": plot_trainings(done),
    }
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in figures.items():
        figure.savefig(folder / f"{name}.png", dpi=110)
        print(folder / f"{name}.png")
    return done


if __name__ == "__main__":
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--out", type=Path, default=Path("out/shortcut"), help="output folder")
    options.add_argument(
        "--trainings", type=int, default=10, help="with and without the shortcut each (default: %(default)s)"
    )
    options.add_argument("--first-seed", type=int, default=0, help="of the trainings (default: %(default)s)")
    options.add_argument("--rooms", type=int, default=1600, help="of the training (default: %(default)s)")
    options.add_argument("--epochs", type=int, default=25, help="(default: %(default)s)")
    options.add_argument(
        "--spp", type=int, default=1024, help="samples per pixel of an attribution (default: %(default)s)"
    )
    chosen = options.parse_args()
    torch.set_num_threads(1)  # the network is so small that threads would mostly wait for each other
    main(chosen.out, chosen.trainings, chosen.first_seed, chosen.rooms, chosen.epochs, chosen.spp)
