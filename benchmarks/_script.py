"""The script that a careful Mitsuba user would write by hand: the other side of the benchmarks."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import torch

from scenecaptum import activate
from scenecaptum.scene.bundled import BUNDLED

SCENES = Path(os.environ.get("SCENECAPTUM_SCENES", Path(__file__).parents[2] / "shared" / "scenes"))

# What moves visibility; stock path replay does not differentiate it.
GEOMETRY = (
    "vertex_positions",
    "vertex_normals",
    "vertex_texcoords",
    "to_world",
    "faces",
    "bbox_min",
    "bbox_max",
)


def scene_of(room: str) -> str:
    """Return the path of a room; the name of a bundled one and a path stay as they are."""
    path = SCENES / room / "scene.xml"
    return str(path) if path.exists() else room


def _load(path: str) -> Any:
    """Load a scene file with differentiable textures, where it uses a parameter for their format."""
    used = "$texture_format" in Path(path).read_text(encoding="utf-8")
    options = {"texture_format": "variant"} if used else {}
    return activate().load_file(path, optimize=False, **options)


def hand_written(
    scene: str,
    metric: torch.nn.Module,
    size: tuple[int, int],
    spp: int,
    depth: int,
    *,
    left_out: Collection[str] = (),
) -> tuple[Callable[[int], float], list[str]]:
    """Return the script as a function of the seed, and the parameters that it tracks.

    It renders ``(width, height)`` pixels once, differentiates a torch metric, and calls ``render_backward`` of
    ``prb`` once, for every parameter of materials and lights that Mitsuba can track, but those in ``left_out``.
    """
    mi = activate()
    import drjit as dr

    loaded = mi.load_dict(BUNDLED[scene](), optimize=False) if scene in BUNDLED else _load(scene)
    film = mi.traverse(loaded.sensors()[0])
    film["film.size"] = list(size)
    film.update()
    integrator = mi.load_dict({"type": "prb", "max_depth": depth, "rr_depth": depth + 1})

    params = mi.traverse(loaded)
    names = [
        name
        for name in params.keys()  # noqa: SIM118 -- not a dictionary
        if name not in left_out
        and not params.flags(name) & mi.ParamFlags.NonDifferentiable
        and name.rpartition(".")[2] not in GEOMETRY
        and dr.is_jit_v(params[name])
        and dr.is_float_v(params[name])
    ]
    params.keep(names)
    for name in names:
        dr.enable_grad(params[name])
    params.update()

    def run(seed: int) -> float:
        with dr.suspend_grad():
            image = integrator.render(loaded, 0, seed=seed, spp=spp).torch().requires_grad_()
        value = metric(image)
        value.backward()
        integrator.render_backward(loaded, params, mi.TensorXf(image.grad), 0, seed=seed + 1, spp=spp)
        gradients = {name: dr.grad(params[name]) for name in names}
        dr.eval(gradients)
        dr.sync_thread()
        for name in names:
            dr.clear_grad(params[name])
        return value.item()

    return run, names
