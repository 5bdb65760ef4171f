"""Attributions whose replicates are computed in other processes: the same numbers, whatever their number."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import pytest
import torch
from refusals import message
from seeds import shifted
from toy import ToyRenderer

from scenecaptum import (
    FeatureAblationScene,
    IntegratedGradientsScene,
    SceneRenderer,
    VanillaSceneGradient,
    metrics,
)
from scenecaptum.executors import process_pool

SMALL: dict[str, Any] = {"resolution": (16, 16), "spp": 16, "max_depth": 3}


@pytest.fixture(scope="module")
def pool() -> Iterator[Executor]:
    with process_pool(2) as executor:
        yield executor


def glare(renderer: SceneRenderer) -> Any:
    return metrics.UnifiedGlareRating(renderer.camera, threshold_factor=2)


@pytest.mark.parametrize(
    ("method", "options"),
    [
        (VanillaSceneGradient, {}),
        (VanillaSceneGradient, {"top": 1}),
        (IntegratedGradientsScene, {"n_steps": 2}),
        (FeatureAblationScene, {"replicates": 2}),
    ],
)
def test_the_numbers_are_those_of_this_process(
    method: Any, options: Mapping[str, Any], pool: Executor, mi: Any
) -> None:
    renderer = SceneRenderer("cornell-box", ["*_wall.reflectance.value", "light.*"], **SMALL)
    here = method(renderer, glare(renderer)).attribute(seed=shifted(), **options)
    there = method(renderer, glare(renderer)).attribute(seed=shifted(), executor=pool, **options)
    assert there.metric_value == pytest.approx(here.metric_value, rel=1e-5)
    for name, value in here.items():
        # The glare rating of few samples is steep, and sums in another order differ in their last bits.
        assert torch.allclose(there[name], value, rtol=1e-3, atol=1e-3 * value.abs().max().item())
    usage = there.info["checkpoint"]
    assert usage["reused"] == usage["passes"] > 0  # this process has computed nothing itself


def test_other_settings_and_values_reach_the_workers(pool: Executor, mi: Any, tmp_path: Path) -> None:
    renderer = SceneRenderer("cornell-box", "reflectance", **SMALL).replace(max_depth=2, resolution=(8, 8))
    dark = {name: 0.5 * value for name, value in renderer.inputs.items()}
    method = VanillaSceneGradient(renderer, metrics.MeanLuminance())
    options = {"seed": shifted(), "replicates": 2}
    here = method.attribute(dark, **options)
    there = method.attribute(dark, executor=pool, checkpoint=tmp_path, **options)
    assert there.metric_value == pytest.approx(here.metric_value, rel=1e-5)
    assert there.info["checkpoint"]["reused"] == there.info["checkpoint"]["passes"] > 0
    assert list(tmp_path.glob("*.pass"))


def test_what_cannot_be_spread(pool: Executor, mi: Any) -> None:
    toy = VanillaSceneGradient(ToyRenderer(), lambda image: image.mean())
    assert "give it an attribute recipe" in message(
        lambda: toy.attribute({"x": torch.tensor(0.5)}, executor=pool)
    )
    renderer = SceneRenderer(mi.load_dict(mi.cornell_box()), "reflectance", resolution=(8, 8), spp=4)
    method = VanillaSceneGradient(renderer, metrics.MeanLuminance())
    assert "not a Scene" in message(lambda: method.attribute(executor=pool))
    method = VanillaSceneGradient(SceneRenderer("cornell-box", **SMALL), metrics.MeanLuminance())
    assert "leave out executor=" in message(lambda: method.attribute(executor=pool, time_limit=1.0))


def test_errors_of_workers_are_those_of_a_render(pool: Executor, mi: Any) -> None:
    renderer = SceneRenderer("cornell-box", "reflectance", **SMALL)
    bad = {name: value + 2 for name, value in renderer.inputs.items()}
    method = VanillaSceneGradient(renderer, metrics.MeanLuminance())
    assert "outside the physical range" in message(lambda: method.attribute(bad, executor=pool))
