"""``SceneRenderer(values=…)``: the scene as if it had been loaded with other values."""

from __future__ import annotations

import math
import pickle
from pathlib import Path
from typing import Any

import pytest
import torch
from chance import allowed
from refusals import message
from seeds import shifted

from scenecaptum import SceneRenderer, VanillaSceneGradient, metrics

VALUES = {
    "short_box_shape.pose.translation": torch.tensor([0.1, 0.0, 0.1]),
    "camera.pose.rotation": torch.tensor([0.0, 0.1, 0.0]),
    "camera.fov": torch.tensor(30.0),
    "left_wall.reflectance.value": torch.tensor([0.2, 0.4, 0.6]),
    "light.emitter.radiance.value": torch.tensor([5.0, 6.0, 7.0]),
}
OPTIONS: dict[str, Any] = {"resolution": (16, 16), "spp": 16, "max_depth": 3}


@pytest.fixture(scope="module")
def plain() -> SceneRenderer:
    return SceneRenderer("cornell-box", "emitters", **OPTIONS)


@pytest.fixture(scope="module")
def changed() -> SceneRenderer:
    return SceneRenderer("cornell-box", "emitters", values=VALUES, **OPTIONS)


def test_the_picture_is_that_of_the_values(plain, changed):
    seed = shifted(3)
    torch.testing.assert_close(changed(seed=seed), plain(VALUES, seed=seed), rtol=1e-5, atol=1e-6)
    assert not torch.allclose(changed(seed=seed), plain(seed=seed))


def test_only_the_inputs_are_attributed_at_the_values(plain, changed):
    found = VanillaSceneGradient(changed, metrics.MeanLuminance()).attribute(seed=shifted(0))
    together = VanillaSceneGradient(plain, metrics.MeanLuminance()).attribute(VALUES, seed=shifted(0))
    (lamp,) = found
    assert found.metric_value == pytest.approx(together.metric_value, rel=1e-5)
    errors = [one.effects_error()[lamp] for one in (found, together)]
    effect, expected = found.effects()[lamp], together.effects()[lamp]
    assert effect == pytest.approx(expected, abs=allowed(8) * math.hypot(*errors))
    torch.testing.assert_close(found.parameter_values[lamp], VALUES[lamp])


def test_everything_is_where_the_poses_have_moved_it(plain, changed):
    assert changed.info["sensor"] == plain.info_of(VALUES)["sensor"]
    assert changed.info["values"]["camera.fov"] == 30.0
    assert not changed.own_value("camera.pose.rotation").any()
    box = "short_box_shape.pose.translation"
    shown, at = changed.shown_moves([box])[box][0], plain.shown_moves([box], VALUES)[box][0]
    assert shown == pytest.approx(at, abs=1e-3)
    torch.testing.assert_close(changed.guides.normal, plain.guides_of(VALUES).normal)


def test_it_is_the_same_in_another_process_and_at_another_depth(changed):
    again = pickle.loads(pickle.dumps(changed.recipe))()
    assert torch.equal(again(seed=shifted(3)), changed(seed=shifted(3)))
    assert changed.replace(max_depth=2).own_value("camera.fov") == 30.0


def test_a_checkpoint_tells_the_values_apart(plain, changed, tmp_path: Path):
    for renderer in (plain, changed):
        kept = renderer.with_checkpoint(tmp_path)
        kept(seed=shifted(3))
        assert kept.checkpoint.reused == 0


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("left_wal.reflectance.value", torch.ones(3), "no parameter"),
        ("left_wall.reflectance.value", torch.full((3,), 1.5), "outside the physical range"),
        ("left_wall.reflectance.value", torch.ones(2), "expects (3,)"),
    ],
)
def test_values_that_cannot_be_set_are_refused(name, value, words):
    assert words in message(lambda: SceneRenderer("cornell-box", values={name: value}, **OPTIONS))


def test_a_scene_of_the_caller_is_not_changed(mi):
    scene = mi.load_dict(mi.cornell_box())
    assert "belongs to you" in message(lambda: SceneRenderer(scene, values=VALUES, **OPTIONS))
