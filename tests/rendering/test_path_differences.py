"""Differences of single paths agree with differences of renders, which are independent of them."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from scenecaptum import SceneRenderer

SPP, REPLICATES = 64, 12


@pytest.fixture(scope="module")
def room(mi: Any) -> dict[str, Any]:
    """Glass and two principled materials, each with several lobes that are off, before a wall and a lamp."""
    transform = mi.ScalarTransform4f
    glass = {"type": "dielectric", "int_ior": 1.3, "specular_transmittance": 0.9}
    gloss = {"type": "principled", "roughness": 0.4, "base_color": {"type": "rgb", "value": [0.6, 0.4, 0.2]}}
    metal = {"type": "principled", "roughness": 0.5, "metallic": 1.0, "specular": 0.5}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 6},
        "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 16, "height": 16}},
        "sky": {"type": "constant", "radiance": 0.5},
        "wall": {
            "type": "rectangle",
            "to_world": transform().translate([0, 0, 6]).rotate([0, 1, 0], 180).scale(3),
            "bsdf": {"type": "diffuse"},
        },
        "lamp": {
            "type": "sphere",
            "center": [2, 2, 3],
            "radius": 0.5,
            "emitter": {"type": "area", "radiance": 8.0},
        },
        "glass": {"type": "sphere", "center": [-0.8, 0, 4], "radius": 0.7, "bsdf": glass},
        "gloss": {"type": "sphere", "center": [0.8, 0.4, 4], "radius": 0.6, "bsdf": gloss},
        "metal": {"type": "sphere", "center": [0.5, -1, 4], "radius": 0.6, "bsdf": metal},
    }


NAMES = [
    "glass.bsdf.eta",
    "gloss.bsdf.spec_trans.value",
    "metal.bsdf.metallic.value",
    "metal.bsdf.sheen.value",
]


def gradients(renderer: SceneRenderer) -> torch.Tensor:
    """Return one row for each seed and one column for each input."""
    weights = torch.linspace(0.5, 1.5, 16)[:, None, None]
    rows = []
    for seed in range(REPLICATES):
        leaves = renderer.leaves()
        (renderer(leaves, seed=seed, seed_grad=1000 + seed) * weights).mean().backward()
        rows.append(torch.stack([leaf.grad for leaf in leaves.values()]))
    return torch.stack(rows).double()


def test_they_agree_with_differences_of_renders(
    room: dict[str, Any], monkeypatch: pytest.MonkeyPatch, record_property: Any
) -> None:
    from scenecaptum.rendering import _engine

    renderer = SceneRenderer(room, NAMES, spp=SPP)
    assert len(renderer.plan.differences) == len(NAMES)
    primal_calls = []
    primal = _engine.Engine.primal
    monkeypatch.setattr(
        _engine.Engine, "primal", lambda *arguments: primal_calls.append(1) or primal(*arguments)
    )
    paths = gradients(renderer)
    # No render but the image itself.
    assert len(primal_calls) == REPLICATES

    monkeypatch.setattr(_engine, "batches", lambda names, parameters: [])
    renders = gradients(renderer)
    assert len(primal_calls) > 5 * REPLICATES
    # Sheen has no effect on metal: rounding is left of it, which no spread of replicates covers.
    rounding = 1e-6 * paths.mean(0).abs().max()
    z = (paths.mean(0) - renders.mean(0)) / (
        (paths.var(0) + renders.var(0)) / REPLICATES + rounding**2
    ).sqrt()
    record_property("z", z.tolist())
    # 6e-5 in Student's t with 11 degrees of freedom.
    assert (z.abs() < 6.2).all(), dict(zip(NAMES, z.tolist(), strict=True))
    # Those of the weights are far from their noise. That of the index is 2 to 4 errors from 0: which pixels are
    # chosen depends on the rounding of a machine.
    resolved = paths.mean(0).abs() > 3 * (paths.var(0) / REPLICATES).sqrt()
    assert resolved[1:3].all()


def test_materials_beyond_the_bits_of_a_number_get_a_batch_of_their_own(mi: Any) -> None:
    from scenecaptum.rendering._moved_materials import MovedParameter, batches

    materials = [object() for _ in range(40)]
    parameters = {f"{k}.{name}": MovedParameter(materials[k], ()) for name in "ab" for k in range(40)}
    found = list(batches(parameters, parameters))
    assert [len(names) for names in found] == [64, 16]
    assert {name for names in found for name in names} == parameters.keys()
    for names in found:
        in_order = [parameters[name].material for name in names]
        assert in_order == sorted(in_order, key=in_order.index)


def test_copies_of_a_material_leave_the_names_of_its_textures(mi: Any, room: dict[str, Any]) -> None:
    """Mitsuba names the objects of a dict after their keys, also those that are in the scene."""
    color = {"type": "bitmap", "bitmap": mi.Bitmap(torch.full((4, 4, 3), 0.4).numpy()), "raw": True}
    gloss = {"type": "principled", "base_color": {"type": "ref", "id": "wood"}}
    scene = {"wood": color, **room, "gloss": {"type": "sphere", "bsdf": gloss}}
    renderer = SceneRenderer(scene, spp=2)
    inputs = {name: value.requires_grad_() for name, value in renderer.inputs.items()}
    renderer(inputs, seed=1).mean().backward()
    assert "wood.data" in list(mi.traverse(renderer._graph.scene).keys())
    assert renderer.surfaces is not None
