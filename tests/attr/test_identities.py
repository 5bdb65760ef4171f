"""Identities that every attribution method fulfils on any scene: on the Cornell box and the office."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from chance import allowed
from seeds import shifted

import scenecaptum as sc
from scenecaptum import SceneAttribution, SceneRenderer, metrics
from scenecaptum.scene.bundled import BUNDLED

SIZES = {"cornell-box": (12, 12), "office": (16, 9)}
METHODS: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "vanilla": (sc.VanillaSceneGradient, {}),
    "input x gradient": (sc.InputXGradientScene, {}),
    "integrated": (sc.IntegratedGradientsScene, {"n_steps": 4, "replicates": 16}),
    "smoothgrad": (sc.SmoothGradScene, {"nt_samples": 16, "stdevs": 0.05}),
    "gradient shap": (sc.GradientShapScene, {"n_samples": 16, "baselines": ["black", "grey"]}),
    "ablation": (sc.FeatureAblationScene, {"groups": "material"}),
    "shapley": (sc.ShapleyValueScene, {"groups": "kind", "n_samples": 4, "replicates": 4}),
}


def quickly(*methods: str) -> list[Any]:
    """Return all methods, of which only these are in the default half."""
    return [pytest.param(one, marks=() if one in methods else pytest.mark.long) for one in METHODS]


# Each method on the Cornell box, and a gradient, an integral and a game in the office.
in_each_room = pytest.mark.parametrize(
    ("renderer", "method"),
    [
        *(("cornell-box", method) for method in METHODS),
        *(
            pytest.param("office", *one.values, marks=one.marks)
            for one in quickly("vanilla", "integrated", "shapley")
        ),
    ],
    indirect=["renderer"],
    scope="module",
)
mean_luminance = metrics.MeanLuminance()


def log_luminance(image: torch.Tensor) -> torch.Tensor:
    return torch.log(mean_luminance(image) + 0.01)


LUMINANCES = {"linear": mean_luminance, "log": log_luminance}


def attribute(
    renderer: SceneRenderer, method: str, metric=mean_luminance, **settings: Any
) -> SceneAttribution:
    make, usual = METHODS[method]
    found: SceneAttribution = make(renderer, metric).attribute(**usual | settings)
    return found


def hidden(scene: dict[str, Any], mi: Any) -> dict[str, Any]:
    """Add a ball with a separate material inside a distant black box."""
    transform = mi.ScalarTransform4f
    black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.0, 0.0, 0.0]}}
    return scene | {
        "secret": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.4, 0.5, 0.6]}},
        "secret_ball": {"type": "sphere", "center": [50, 50, 50], "bsdf": {"type": "ref", "id": "secret"}},
        "cage": {"type": "cube", "to_world": transform().translate([50, 50, 50]).scale(2), "bsdf": black},
    }


@pytest.fixture(scope="module", params=list(SIZES))
def renderer(request: pytest.FixtureRequest, mi: Any) -> SceneRenderer:
    scene = hidden(BUNDLED[request.param](), mi)
    names = ["*wall*", "*ceiling*", "*floor*", "emitters", "secret*"]
    return SceneRenderer(scene, names, resolution=SIZES[request.param], spp=32, max_depth=4)


@in_each_room
def test_a_parameter_without_effect_gets_zero(renderer, method):
    found = attribute(renderer, method, groups="material")
    assert found.saliency()["secret"] <= allowed(8) * found.saliency_error()["secret"]
    assert max(found.saliency().values()) > 0


@in_each_room
def test_attributions_are_linear_in_the_metric(renderer, method):
    """Within their errors: the pixels that a backward pass samples depend on the metric."""

    def upper(image: torch.Tensor) -> torch.Tensor:
        return image[:4].mean()

    first, second, both = (
        attribute(renderer, method, metric, seed=shifted(3))
        for metric in (mean_luminance, upper, lambda image: 2 * mean_luminance(image) - 3 * upper(image))
    )
    for name, value in both.items():
        error = 2 * first.standard_error[name] + 3 * second.standard_error[name] + both.standard_error[name]
        distance = (value - 2 * first[name] + 3 * second[name]).abs()
        assert (distance <= allowed(8, len(both)) * error + 1e-6).all(), f"{name}: {distance} of {error}"


@pytest.mark.parametrize(
    ("renderer", "method", "metric"),
    [
        *(
            pytest.param("cornell-box", method, metric, id=f"cornell-box-{method}-{name}")
            for method in ("integrated", "gradient shap")
            for name, metric in LUMINANCES.items()
        ),
        pytest.param("office", "integrated", log_luminance, id="office-integrated-log"),
        pytest.param(
            "office", "integrated", mean_luminance, id="office-integrated-linear", marks=pytest.mark.long
        ),
        pytest.param(
            "office", "gradient shap", log_luminance, id="office-gradient shap-log", marks=pytest.mark.long
        ),
        pytest.param(
            "office",
            "gradient shap",
            mean_luminance,
            id="office-gradient shap-linear",
            marks=pytest.mark.long,
        ),
    ],
    indirect=["renderer"],
    scope="module",
)
def test_integrated_gradients_add_up(renderer, method, metric):
    found = attribute(renderer, method, metric, **({"n_steps": 8} if method == "integrated" else {}))
    assert abs(found.convergence_delta) < allowed(8) * found.convergence_delta_error


def test_shapley_values_add_up(renderer):
    found = attribute(renderer, "shapley", log_luminance)
    assert abs(found.convergence_delta) < 1e-5


def assert_agree(first: SceneAttribution, second: SceneAttribution, names: dict[str, str]) -> None:
    for name, other in names.items():
        error = torch.hypot(first.standard_error[name], second.standard_error[other])
        z = (first[name] - second[other]).abs() / error.clamp_min(1e-12)
        assert z.max() < allowed(15, 3 * len(names)), (
            f"{name}: {first[name]} against {second[other]}, z = {z}"
        )


@pytest.mark.parametrize("method", quickly("vanilla", "integrated", "ablation", "shapley"))
def test_equivalent_descriptions_of_a_scene_give_equal_results(mi, method):
    """The floor's material is inline or referenced, one-sided or two-sided: the same room."""
    plain = BUNDLED["cornell-box"]()
    other = dict(plain)
    other["floor_shape"] = plain["floor_shape"] | {"bsdf": {"type": "twosided", "bsdf": plain["floor"]}}
    del other["floor"]
    settings = {"resolution": (12, 12), "spp": 32, "max_depth": 4}
    inputs = ["reflectance", "emitters"]
    ungrouped = (
        {"groups": None} if method != "shapley" else {}
    )  # two players get exact values with accurate errors
    one, two = (
        attribute(SceneRenderer(scene, inputs, **settings), method, seed=shifted(seed), **ungrouped)
        for seed, scene in enumerate((plain, other))
    )
    if method == "shapley":
        assert_agree(one, two, {name: name for name in one})
        return
    floor = next(name for name in two if "floor" in name)
    same = {name: name for name in one if name in two}
    assert len(same) == len(one) - 1
    assert_agree(one, two, same | {"floor.reflectance.value": floor})


def lamps(mi: Any, centres: list[float], width: float) -> dict[str, Any]:
    """Lamps in a row over a floor; symmetric if the centres are."""
    transform = mi.ScalarTransform4f
    scene = {
        "type": "scene",
        "camera": {
            "type": "perspective",
            "to_world": transform().look_at(origin=[0, -4, 1], target=[0, 0, 1], up=[0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": "box"}},
        },
        "floor": {"type": "rectangle", "to_world": transform().scale(3)},
    }
    for index, centre in enumerate(centres):
        scene[f"lamp_{index}"] = {
            "type": "rectangle",
            "to_world": transform().translate([centre, 0, 2]).rotate([1, 0, 0], 180).scale([width, 0.5, 1]),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [4.0, 3.0, 2.0]}},
        }
    return scene


def of_lamps(mi: Any, method: str, centres: list[float], width: float) -> dict[str, torch.Tensor]:
    """Return the attribution of each lamp, ``(replicates,)`` with the mean and error of their mean."""
    renderer = SceneRenderer(lamps(mi, centres, width), "emitters", spp=256, max_depth=3)
    settings = {} if method != "gradient shap" else {"baselines": "dark"}
    found = attribute(renderer, method, groups="object", **settings)
    return {name: found.replicates[name][:, 0] for name in found if name.startswith("lamp")}


def mean_and_error(replicates: torch.Tensor) -> tuple[float, float]:
    return replicates.mean().item(), (replicates.std() / math.sqrt(len(replicates))).item()


@pytest.mark.parametrize("method", quickly("vanilla", "integrated", "ablation")[:-1])
def test_equal_lamps_count_alike_and_half_lamps_share(mi, method):
    halves = of_lamps(mi, method, [-0.5, 0.5], 0.5)
    assert len(halves) == 2
    difference, error = mean_and_error(halves["lamp_0"] - halves["lamp_1"])
    assert abs(difference) < allowed(8) * error

    (whole,) = of_lamps(mi, method, [0.0], 1.0).values()
    together, error = mean_and_error(halves["lamp_0"] + halves["lamp_1"])
    alone, other = mean_and_error(whole)
    assert together > 10 * error
    assert abs(together - alone) < allowed(15) * math.hypot(error, other)
