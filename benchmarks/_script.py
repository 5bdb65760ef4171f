"""The script that a careful Mitsuba user would write by hand: the other side of the benchmarks."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import torch

from scenecaptum import activate

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


def hand_written(
    path: Path, metric: torch.nn.Module, size: tuple[int, int], spp: int, depth: int
) -> tuple[Callable[[int], float], list[str]]:
    """Return the script as a function of the seed, and the parameters that it tracks.

    It renders ``(width, height)`` pixels once, differentiates a torch metric, and calls ``render_backward`` of
    ``prb`` once, for every parameter of materials and lights that Mitsuba can track.
    """
    mi = activate()
    import drjit as dr

    declared = re.findall(r'<default\s+name="(\w+)"', path.read_text(encoding="utf-8"))
    wanted = {"texture_format": "variant", "integrator": "prb"}
    scene = mi.load_file(
        str(path), optimize=False, **{name: value for name, value in wanted.items() if name in declared}
    )
    film = mi.traverse(scene.sensors()[0])
    film["film.size"] = list(size)
    film.update()
    integrator = mi.load_dict({"type": "prb", "max_depth": depth, "rr_depth": depth + 1})

    params = mi.traverse(scene)
    names = [
        name
        for name in params.keys()  # noqa: SIM118 -- not a dictionary
        if not params.flags(name) & mi.ParamFlags.NonDifferentiable
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
            image = integrator.render(scene, 0, seed=seed, spp=spp).torch().requires_grad_()
        value = metric(image)
        value.backward()
        integrator.render_backward(scene, params, mi.TensorXf(image.grad), 0, seed=seed + 1, spp=spp)
        gradients = {name: dr.grad(params[name]) for name in names}
        dr.eval(gradients)
        dr.sync_thread()
        for name in names:
            dr.clear_grad(params[name])
        return value.item()

    return run, names
