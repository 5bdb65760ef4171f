"""Check and time the derivatives of poses.

``differences`` compares them with central differences of Mitsuba's own renders, which are moved by code of this
script, with other seeds and two steps: in the office, in the Cornell box, and in a Cornell box with meshes that
have face or vertex normals, instances and small lamps. ``coverage`` counts how often the 95 % intervals hold the
result of long runs. ``cost`` times the poses of 30 objects of the office to a stable top 5, with and without
leaving out the objects that cannot reach it. ``camera`` times the rotation and the field of view of the camera
beside a plain attribution, in turns.

    python benchmarks/poses.py differences [--scene office|cornell-box|meshes] [--seeds 8]
    python benchmarks/poses.py coverage [--seeds 100] [--metric UGR]
    python benchmarks/poses.py cost
    python benchmarks/poses.py camera [--turns 5]
"""

from __future__ import annotations

import argparse
import atexit
import math
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from scenecaptum import SceneAttribution, SceneRenderer, VanillaSceneGradient, activate, metrics
from scenecaptum.scene import BUNDLED, SceneGraph, find_objects, load_scene

SIZE, DEPTH = (64, 36), 4
FEW = 64  # samples per pixel of what is extrapolated
SMALL_STEP = 0.005  # radians, a tenth of a pixel
OBJECTS = {
    "office": [
        "desk",
        "chair",
        "lamp",
        "screen",
        "keyboard",
        "book",
        "mug",
        "plant",
        "pot",
        "cabinet",
        "mirror",
        "picture",
    ],
    "cornell-box": ["tall_box_shape", "short_box_shape"],
    "meshes": ["faceted", "smooth", "vase", "bowl"],
}
LAMPS = {
    "office": ["luminaire_left", "luminaire_right", "luminaire_back", "bulb", "sky"],
    "cornell-box": ["light"],
    "meshes": ["panel", "point", "spot"],
}
GROUPS = {"office": {"lamp": ["lamp_*"]}, "cornell-box": {}, "meshes": {}}


def bumpy_sphere(folder: Path, name: str, *, face_normals: bool) -> dict[str, Any]:
    """Return a mesh of a sphere with bumps, written to a file and loaded from it."""
    mi = activate()
    rows, columns = 12, 16
    down, across = np.meshgrid(
        np.linspace(0.02, np.pi - 0.02, rows + 1), np.arange(columns) * 2 * np.pi / columns, indexing="ij"
    )
    radius = 0.25 * (1 + 0.15 * np.sin(3 * across) * np.sin(2 * down))
    points = radius[..., None] * np.stack(
        [np.sin(down) * np.cos(across), np.sin(down) * np.sin(across), np.cos(down)], -1
    )
    index = np.arange((rows + 1) * columns).reshape(rows + 1, columns)
    here, right = index, np.roll(index, -1, 1)
    quads = np.stack([here[:-1], here[1:], right[1:], right[:-1]], -1).reshape(-1, 4)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    mesh = mi.Mesh(name, points[..., 0].size, len(faces), has_vertex_normals=not face_normals)
    params = mi.traverse(mesh)
    params["vertex_positions"] = points.ravel().astype(np.float32)
    params["faces"] = faces.ravel().astype(np.uint32)
    params.update()
    path = folder / f"{name}.ply"
    mesh.write_ply(str(path))
    return {"type": "ply", "filename": str(path), "face_normals": face_normals}


def meshes(folder: Path) -> dict[str, Any]:
    """Return the Cornell box with two meshes and two instances in place of its boxes, and three small lamps."""
    place = activate().ScalarTransform4f
    scene = {
        key: value for key, value in BUNDLED["cornell-box"]().items() if "box" not in key and key != "light"
    }

    def grey(value: float) -> dict[str, Any]:
        return {"type": "diffuse", "reflectance": {"type": "rgb", "value": value}}

    group = {
        "type": "shapegroup",
        "part": bumpy_sphere(folder, "part", face_normals=False) | {"bsdf": grey(0.6)},
    }
    faceted, smooth = (
        bumpy_sphere(folder, name, face_normals=name == "faceted") for name in ("faceted", "smooth")
    )
    reference = {"type": "ref", "id": "group"}
    panel = {
        "type": "rectangle",
        "to_world": place().translate([0.2, 0.1, 0.7]).rotate([1, 0, 0], 180).scale(0.2),
    }
    return scene | {
        "faceted": faceted | {"to_world": place().translate([-0.5, 0.1, -0.5]), "bsdf": grey(0.7)},
        "smooth": smooth | {"to_world": place().translate([0.45, -0.2, -0.45]), "bsdf": grey(0.5)},
        "group": group,
        "vase": {"type": "instance", "shapes": reference, "to_world": place().translate([-0.1, 0.5, 0.1])},
        "bowl": {
            "type": "instance",
            "shapes": reference,
            "to_world": place().translate([0.5, 0.4, 0.2]).scale(0.7),
        },
        "panel": panel | {"emitter": {"type": "area", "radiance": {"type": "rgb", "value": 12.0}}},
        "point": {"type": "point", "position": [-0.5, -0.4, 0.4], "intensity": {"type": "rgb", "value": 0.6}},
        "spot": {
            "type": "spot",
            "to_world": place().look_at(origin=[0.6, -0.7, 0.6], target=[0.0, 0.3, -1.0], up=[0, 0, 1]),
            "intensity": {"type": "rgb", "value": 4.0},
            "cutoff_angle": 30.0,
        },
    }


def scene_of(name: str) -> Any:
    """Return a bundled scene or the one with meshes, as a dict that loads the same at each call."""
    activate()
    if name != "meshes":
        return BUNDLED[name]()
    folder = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, folder)
    return meshes(folder)


class Stock:
    """Mitsuba's own renders of a scene in which objects and the camera are moved."""

    def __init__(self, scene: Any, size: tuple[int, int], groups: Mapping[str, Any]) -> None:
        mi = activate()
        self.scene = mi.load_dict(scene, optimize=False)
        self.params = mi.traverse(self.scene)
        film = mi.traverse(self.scene.sensors()[0])
        film["film.size"] = list(size)
        film.update()
        self.integrator = mi.load_dict({"type": "path", "max_depth": DEPTH, "rr_depth": DEPTH + 1})
        found = {one.name: one for one in find_objects(SceneGraph(load_scene(scene)), groups)}
        self.keys = {name: one.keys for name, one in found.items()}
        self.pivots = {name: np.array(one.pivot) for name, one in found.items()}
        (sensor,) = (key.removesuffix(".x_fov") for key in self.params.properties if key.endswith(".x_fov"))
        self.keys["camera"] = (f"{sensor}.to_world",)
        self.pivots["camera"] = np.array(self.params[f"{sensor}.to_world"].matrix).reshape(4, 4, -1)[:3, 3, 0]
        self.base: dict[str, Any] = {}

    def place(self, name: str, component: str, axis: int, amount: float) -> None:
        """Move an object by an amount along or about an axis, from where it was loaded."""
        mi = activate()
        unit, pivot = [float(axis == k) for k in range(3)], self.pivots[name]
        place = mi.ScalarTransform4f()
        if component == "translation":
            place = place.translate([amount * x for x in unit])
        else:
            about = place.translate(pivot.tolist())
            about = (
                about.rotate(unit, math.degrees(amount))
                if component == "rotation"
                else about.scale(1 + amount)
            )
            place = about.translate((-pivot).tolist())
        matrix = np.array(place.matrix)
        for key in self.keys[name]:
            if key not in self.base:
                self.base[key] = type(self.params[key])(self.params[key])
            base = self.base[key]
            if key.endswith("to_world"):
                own = np.array(base.matrix).reshape(4, 4, -1)[..., 0]
                self.params[key] = mi.ScalarTransform4f((matrix @ own).tolist())
            elif key.endswith(".position"):
                self.params[key] = mi.Point3f(*(matrix @ [*np.array(base).ravel(), 1.0])[:3].tolist())
            else:
                points = np.array(base).reshape(-1, 3)
                shift = matrix[:3, 3] if key.endswith("positions") else 0.0
                self.params[key] = (points @ matrix[:3, :3].T + shift).ravel().astype(np.float32)
        self.params.update()

    def render(self, seed: int, spp: int) -> torch.Tensor:
        """Render with Mitsuba's path tracer."""
        mi = activate()
        with torch.no_grad():
            return (
                mi.render(self.scene, integrator=self.integrator, seed=seed, spp=spp).torch()[..., :3].cpu()
            )


def weights() -> torch.Tensor:
    """Return the weights of the pixels in the metric, which differ, so that more than the mean matters."""
    down, across = torch.meshgrid(torch.linspace(0, 1, SIZE[1]), torch.linspace(0, 1, SIZE[0]), indexing="ij")
    return (1 + torch.sin(5 * across) * torch.cos(4 * down))[..., None]


def metric(image: torch.Tensor) -> torch.Tensor:
    return (weights().to(image) * image).mean()


def differences(options: argparse.Namespace) -> None:
    """Compare with differences of stock renders; print each z-score and their distribution."""
    groups = GROUPS[options.scene]
    scene = scene_of(options.scene)
    stock = Stock(scene, SIZE, groups)
    names = [f"{one}.pose.{kind}" for one in OBJECTS[options.scene] for kind in ("translation", "rotation")]
    names += [f"{one}.pose.translation" for one in LAMPS[options.scene]]
    names += ["spot.pose.rotation"] if options.scene == "meshes" else []
    names += ["camera.pose.translation", "camera.pose.rotation"]
    renderer = SceneRenderer(scene, names, objects=groups, resolution=SIZE, spp=512, max_depth=DEPTH)
    found = VanillaSceneGradient(renderer, metric).attribute(seed=1, replicates=16)
    scores: list[float] = []
    for name in names:
        one, _, kind = name.split(".")
        low, high = renderer.ranges[name]
        # The derivative with respect to the camera's rotation is that at a point, not a mean over a range.
        step = SMALL_STEP if name == "camera.pose.rotation" else (high - low) / 2
        for axis in range(3):
            parts = []
            for h in (step, step / 2):
                slopes = []
                for seed in range(1000, 1000 + options.seeds):
                    ends = []
                    for sign in (1, -1):
                        stock.place(one, kind, axis, sign * h)
                        ends.append(metric(stock.render(seed, 64)).item())
                    slopes.append((ends[0] - ends[1]) / (2 * h))
                mean, error = np.mean(slopes), np.std(slopes, ddof=1) / math.sqrt(len(slopes))
                own = found.standard_error[name][axis].item()
                z = (found[name][axis].item() - mean) / math.hypot(error, own)
                parts.append(f"h {h:.3g}: {mean:+.4f} ± {error:.4f}, z {z:+.1f}")
                if h == step and name not in found.info["jumps"]:
                    scores.append(z)
            stock.place(one, kind, axis, 0.0)
            mark = " (marked)" if name in found.info["jumps"] else ""
            own_text = f"{found[name][axis]:+.4f} ± {found.standard_error[name][axis]:.4f}"
            print(f"{name} {'xyz'[axis]}: {own_text}; {'; '.join(parts)}{mark}", flush=True)
    far = sum(abs(z) > 2 for z in scores)
    print(
        f"{len(scores)} numbers: rms z {np.sqrt(np.mean(np.square(scores))):.2f}, {far} beyond 2, "
        f"largest {max(map(abs, scores)):.1f}"
    )


POSES = [
    "desk.pose.translation",
    "chair.pose.rotation",
    "luminaire_left.pose.scale",
    "screen.pose.rotation",
    "camera.pose.rotation",
]


def coverage(options: argparse.Namespace) -> None:
    """Count how often intervals hold the result of long runs."""
    renderer = SceneRenderer("office", POSES, resolution=SIZE, spp=64, max_depth=DEPTH)
    known = {"luminance": metrics.MeanLuminance(), "UGR": metrics.UnifiedGlareRating(renderer.camera)}
    for name, chosen in known.items():
        if options.metric not in (None, name):
            continue
        method = VanillaSceneGradient(renderer, chosen)
        long = [method.attribute(seed=10_000 + seed, spp=512) for seed in range(8)]
        truth = {pose: torch.stack([run[pose] for run in long]) for pose in POSES}
        held: dict[str, list[float]] = {pose: [] for pose in POSES}
        for seed in range(options.seeds):
            if seed and seed % 20 == 0:
                print(
                    f"{name}, {seed} runs: {100 * np.mean([np.mean(h) for h in held.values()]):.1f} %",
                    flush=True,
                )
            run = method.attribute(seed=seed)
            for pose, (low, high) in run.interval().items():
                mean = truth[pose].mean(0)
                held[pose].append(((low <= mean) & (mean <= high)).float().mean().item())
        for pose in POSES:
            print(f"{name}, {pose}: {100 * np.mean(held[pose]):.1f} % held", flush=True)
        print(f"{name}: {100 * np.mean([np.mean(h) for h in held.values()]):.1f} % of all", flush=True)


def timed(run: Callable[[], SceneAttribution]) -> tuple[SceneAttribution, float]:
    start = time.perf_counter()
    found = run()
    return found, time.perf_counter() - start


def cost(options: argparse.Namespace) -> None:
    """Time a stable top 5 of 30 objects."""
    books = {f"book_{k}": f"book_{k}" for k in range(5)} | {"curtain_left": "curtain_[0-6]"}
    renderer = SceneRenderer(
        "office",
        ["*.pose.translation", "*.pose.rotation"],
        objects=books,
        resolution=(160, 90),
        spp=64,
        max_depth=DEPTH,
    )
    names = [name for name in renderer.inputs if not name.startswith("camera")]
    values = {name: renderer.inputs[name] for name in names}
    print(f"{len(names)} poses of {len({name.split('.')[0] for name in names})} objects", flush=True)
    method = VanillaSceneGradient(renderer, metrics.MeanLuminance())
    found, seconds = timed(lambda: method.attribute(values, top=5, tolerance=0.2, seed=0))
    plan = found.info["planner"]
    top = [row.name for row in found.ranking(top=5)]
    print(
        f"racing: {seconds:.0f} s, reached {plan['reached']}, settled {len(plan['settled'])}; {top}",
        flush=True,
    )
    for one in plan["rounds"]:
        print(f"  {one}")
    samples = sum(one["replicates"] * one["spp_per_replicate"] for one in plan["rounds"])
    _, alike = timed(lambda: method.attribute(values, spp=FEW, seed=0))
    alike *= samples / FEW  # with the check of the steps, which takes samples in the same proportion
    print(
        f"alike for all objects, extrapolated from {FEW} to {samples} spp: {alike:.0f} s, "
        f"{alike / seconds:.1f} times as long",
        flush=True,
    )


def camera(options: argparse.Namespace) -> None:
    """Time the rotation and the field of view of the camera beside materials alone, in turns."""
    turning = ["materials", "camera.pose.rotation", "camera.fov"]
    methods = [
        VanillaSceneGradient(
            SceneRenderer("office", inputs, resolution=(160, 90), spp=64, max_depth=DEPTH),
            metrics.MeanLuminance(),
        )
        for inputs in ("materials", turning)
    ]
    for method in methods:
        method.attribute(seed=0)  # warm-up
    turns = [
        [timed(lambda method=method, k=k: method.attribute(seed=k))[1] for method in methods]
        for k in range(1, options.turns + 1)
    ]
    plain, with_camera = np.median(turns, axis=0)
    ratio = np.median([after / before for before, after in turns])
    print(f"materials: {plain:.2f} s; with the camera: {with_camera:.2f} s; ratio {ratio:.2f}")


SECTIONS = {"differences": differences, "coverage": coverage, "cost": cost, "camera": camera}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("section", choices=SECTIONS)
    parser.add_argument("--scene", default="office", choices=list(OBJECTS))
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--metric", choices=("luminance", "UGR"), help="of coverage (default: both)")
    parser.add_argument("--turns", type=int, default=5, help="of camera (default: %(default)s)")
    options = parser.parse_args()
    SECTIONS[options.section](options)


if __name__ == "__main__":
    main()
