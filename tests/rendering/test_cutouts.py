"""Masks whose texels are exactly 0 and 1, where path replay samples one lobe only."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from chance import allowed
from seeds import seeds, shifted

from scenecaptum import SceneRenderer, VanillaSceneGradient, metrics
from scenecaptum.estimation import mean_and_error

OPACITY, WALL = "leaf_shape.bsdf.opacity.data", "wall_shape.bsdf.reflectance.value"
CUTOUT = np.repeat([[0.0, 1.0]], 4, axis=1).repeat(8, axis=0)
CUT, KEPT = CUTOUT < 0.5, CUTOUT > 0.5
LOOK = {"origin": [0, 0, 4], "target": [0, 0, 0], "up": [0, 1, 0]}


def scene(mi: Any) -> dict[str, Any]:
    """A leaf that is half cut away, before a wall: both are seen, and light each other."""
    transform = mi.ScalarTransform4f
    texels = mi.TensorXf(CUTOUT[..., None].astype(np.float32))
    opacity = {"type": "bitmap", "raw": True, "format": "variant", "filter_type": "nearest", "data": texels}
    leaf = {"type": "twosided", "nested": {"type": "diffuse", "reflectance": 0.2}}
    film = {"type": "hdrfilm", "width": 24, "height": 24, "rfilter": {"type": "box"}}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 4, "rr_depth": 99},
        "sensor": {"type": "perspective", "fov": 40, "to_world": transform().look_at(**LOOK), "film": film},
        "sky": {"type": "constant"},
        "wall_shape": {
            "type": "rectangle",
            "to_world": transform().translate([0, 0, -1]).scale(3),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.8}},
        },
        "leaf_shape": {
            "type": "rectangle",
            "bsdf": {"type": "mask", "opacity": opacity, "nested": leaf},
        },
    }


def by_part(gradient: torch.Tensor) -> list[float]:
    """Return the sums over what is cut away, and over what is not."""
    texels = gradient.reshape(CUTOUT.shape).double()
    return [texels[torch.tensor(part)].sum().item() for part in (CUT, KEPT)]


@pytest.fixture(scope="module")
def differences(mi: Any) -> list[tuple[float, float]]:
    """Mean and error of Mitsuba's own one-sided differences, with common random numbers."""
    step, found = 0.05, []
    loaded = mi.load_dict(scene(mi), optimize=False)
    params = mi.traverse(loaded)
    (key,) = [key for key in params.keys() if key.endswith("opacity.data")]  # noqa: SIM118 -- not a mapping
    for part, sign in ((CUT, 1), (KEPT, -1)):
        rows = []
        for seed in seeds(1000, 1008):
            values = []
            for moved in (0.0, step):
                params[key] = mi.TensorXf((CUTOUT + sign * moved * part)[..., None].astype(np.float32))
                params.update()
                values.append(float(np.array(mi.render(loaded, seed=seed, spp=64)).mean()))
            rows.append(sign * (values[1] - values[0]) / step)
        found.append(mean_and_error(torch.tensor(rows)))
    return found


def test_a_mask_of_zeros_and_ones_has_the_derivative_of_renders(mi: Any, differences: Any) -> None:
    renderer = SceneRenderer(scene(mi), OPACITY, spp=64)
    metric = metrics.MeanLuminance(efficacy=1)
    rows = [
        by_part(VanillaSceneGradient(renderer, metric).attribute(seed=seed, replicates=2)[OPACITY])
        for seed in seeds(0, 8)
    ]
    for part, (expected, error) in zip(torch.tensor(rows).T, differences, strict=True):
        mean, own = mean_and_error(part)
        assert abs(mean - expected) < allowed(8) * np.hypot(own, error) < abs(expected)
        assert abs(mean - expected) < 0.2 * abs(expected)


@pytest.mark.long
def test_so_has_a_backward_pass_of_torch_and_a_forward_one(mi: Any, differences: Any) -> None:
    renderer = SceneRenderer(scene(mi), OPACITY, spp=256)
    own = renderer.inputs[OPACITY]
    value = own.clone().requires_grad_()
    renderer({OPACITY: value}, seed=shifted()).mean().backward()
    whole = sum(expected for expected, _ in differences)
    assert sum(by_part(value.grad)) == pytest.approx(whole, rel=0.25)
    _, tangent = torch.func.jvp(
        lambda value: renderer({OPACITY: value}, seed=shifted()).mean(), (own,), (torch.ones_like(own),)
    )
    assert tangent.item() == pytest.approx(whole, rel=0.25)


@pytest.mark.long
def test_other_derivatives_are_those_of_the_mask_itself(mi: Any) -> None:
    """A mask that let a little light pass would make the wall behind it matter more."""
    metric = metrics.MeanLuminance(efficacy=1)
    found = [
        VanillaSceneGradient(SceneRenderer(scene(mi), names, spp=64), metric).attribute(seed=shifted())[WALL]
        for names in (WALL, [WALL, OPACITY])
    ]
    torch.testing.assert_close(found[0], found[1], rtol=1e-4, atol=0)
