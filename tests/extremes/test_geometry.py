"""Geometry at the extremes: degenerate, coplanar, huge, tiny, far away, around the camera, and none."""

from __future__ import annotations

import hypothesis
import numpy as np
import pytest
import torch
from chance import allowed
from hypothesis import given, settings
from hypothesis import strategies as st
from seeds import shifted

from scenecaptum import SceneCaptumError, SceneRenderer
from scenecaptum.projection import heatmap

from .scenes import GREY, attribute, camera, coverage, in_the_sky, rgb, room, total, z

BALL = "ball.bsdf.reflectance.value"


def mesh(mi, path, vertices, faces):
    made = mi.Mesh("mesh", len(vertices), len(faces))
    parameters = mi.traverse(made)
    parameters["vertex_positions"] = np.asarray(vertices, np.float32).ravel()
    parameters["faces"] = np.asarray(faces, np.uint32).ravel()
    parameters.update()
    made.write_ply(str(path))
    return {"type": "ply", "filename": str(path), "face_normals": True, "bsdf": GREY}


def test_camera_inside_glass(mi):
    """Inside, radiance 1 becomes η²: M = η², and its derivative 2η."""
    glass = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
    scene = in_the_sky(mi, glass, depth=16)
    scene["camera"] = camera(mi, [0.1, 0, 0], [0, 1, 0])
    found = attribute(scene, ["ior", "emitters"], spp=64)
    assert found.metric_value == pytest.approx(2.25, rel=1e-3)
    assert total(found, "sky.radiance.value")[0] == pytest.approx(2.25, rel=1e-3)
    assert abs(z(total(found, "ball.bsdf.eta"), 3.0, 5e-3)) < allowed(8)


def test_camera_inside_a_dark_ball(mi):
    scene = room(mi)
    scene["camera"] = camera(mi, [0, 0, 0], [0, 1, 0])
    found = attribute(scene)
    assert found.metric_value == 0
    assert set(found.saliency().values()) == {0.0}
    assert torch.equal(heatmap(found), torch.zeros(8, 8))


def test_empty_view(mi):
    """Nothing in view: everything is due to the sky, nothing to what is behind the camera."""
    scene = in_the_sky(mi, GREY)
    scene["camera"] = camera(mi, [0, -4, 0], [0, -8, 0])
    found = attribute(scene)
    assert found.metric_value == pytest.approx(1.0, rel=1e-6)
    assert total(found, "sky.radiance.value")[0] == pytest.approx(1.0, rel=1e-5)
    assert found.saliency()[BALL] == 0
    assert torch.isfinite(heatmap(found)).all()


def test_coplanar_faces(mi):
    """Which of two floors a ray hits is undefined, but it is one of them: they share the derivative."""
    plane = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(9)}
    scene = in_the_sky(mi, GREY)
    del scene["ball"]
    scene["camera"] = camera(mi, [0, -1, 4], [0, 0, 0])
    scene |= {"one": {**plane, "bsdf": GREY}, "other": {**plane, "bsdf": {**GREY, "reflectance": rgb(0.1)}}}
    found = attribute(scene, "reflectance", spp=64)
    (one, error), (other, other_error) = (
        total(found, f"{name}.bsdf.reflectance.value") for name in ("one", "other")
    )
    assert abs(one + other - 1) < allowed(8) * (error + other_error) + 1e-5
    assert found.metric_value == pytest.approx(0.5 * one + 0.1 * other, rel=0.05)


def test_faces_without_area(mi, tmp_path):
    """They change neither the picture nor a derivative."""
    vertices = [[-1, 0, -1], [1, 0, -1], [0, 0, 1], [0, 0, 0], [0.5, 0, 0], [1, 0, 0]]
    sound = mesh(mi, tmp_path / "sound.ply", vertices, [[0, 1, 2]])
    torn = mesh(mi, tmp_path / "torn.ply", vertices, [[3, 3, 3], [0, 1, 2], [3, 4, 5], [2, 2, 0]])
    found = [attribute(in_the_sky(mi, GREY, ball=one), spp=64) for one in (sound, torn)]
    for name in found[0]:
        assert torch.isfinite(found[1][name]).all()
        (a, one), (b, other) = (total(each, name) for each in found)
        assert abs(a - b) < allowed(8) * (one + other) + 1e-5
    assert found[0].saliency()[BALL] > 0.01


@pytest.mark.long
def test_light_without_area(mi):
    """A lamp of size zero gives no light, and no NaN."""
    scene = room(mi)
    scene["lamp"]["radius"] = 0.0
    found = attribute(scene)
    assert found.metric_value == 0
    assert all(torch.isfinite(value).all() for value in found.values())


def test_an_object_one_pixel_wide(mi):
    """A ball that covers half a pixel: M = 1 − c + c·r, with c of a few thousandths."""
    scene = in_the_sky(mi, GREY)
    scene["ball"]["radius"] = 0.18
    renderer = SceneRenderer(scene, inputs="reflectance")
    assert 0.2 < 64 * coverage(renderer) < 2
    found = attribute(scene, "reflectance", spp=1024)
    value, error = total(found, BALL)
    lost = 2 * (1 - found.metric_value)
    assert abs(value - lost) < allowed(8) * (error + 2 * found.metric_standard_error)
    assert value > 10 * error


@hypothesis.seed(shifted())
@settings(max_examples=2, deadline=None, database=None)
@given(exponent=st.integers(-1, 6))
def test_scale_does_not_matter(mi, reference, exponent):
    found = attribute(room(mi, scale=10.0**exponent))
    for name in found:
        torch.testing.assert_close(
            found[name], reference[name], rtol=0.02, atol=4 * float(reference.standard_error[name].max())
        )


@pytest.fixture(scope="module")
def reference(mi):
    return attribute(room(mi))


@pytest.mark.parametrize(
    ("where", "fix"), [({"scale": 1e-6}, "Scale it"), ({"shift": 1e6}, "Move it to the origin")]
)
def test_scenes_that_rays_cannot_follow_are_refused(mi, where, fix):
    """Mitsuba renders either without a warning, 4 to 5 times too dark."""
    with pytest.raises(SceneCaptumError, match=rf"units across.* off a surface.*{fix}"):
        SceneRenderer(room(mi, **where))


@pytest.mark.long
def test_a_million_triangles(mi, tmp_path):
    """A ball of a million triangles is a ball: its derivative is its coverage."""
    rows, columns = 500, 1000
    polar, around = np.meshgrid(
        np.linspace(1e-3, np.pi - 1e-3, rows + 1), np.linspace(0, 2 * np.pi, columns + 1), indexing="ij"
    )
    vertices = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], -1)
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    upper = np.stack([corner, corner + columns + 1, corner + 1], -1)
    lower = np.stack([corner + 1, corner + columns + 1, corner + columns + 2], -1)
    ball = mesh(mi, tmp_path / "ball.ply", vertices.reshape(-1, 3), np.concatenate([upper, lower]))
    assert len(upper) + len(lower) == 1_000_000
    scene = in_the_sky(mi, GREY, ball=ball)
    covered = coverage(SceneRenderer(in_the_sky(mi, GREY), inputs="reflectance"))
    assert abs(z(total(attribute(scene, "reflectance", spp=64), BALL), covered, 3e-3)) < allowed(8)
