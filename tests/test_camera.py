from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from scenecaptum import Camera, SceneCaptumError


def frustum(width: int, height: int, fov_x: float) -> float:
    a = math.tan(math.radians(fov_x) / 2)
    b = a * height / width
    return 4 * math.atan(a * b / math.sqrt(1 + a * a + b * b))


@pytest.mark.parametrize(("width", "height"), [(1, 1), (7, 4), (64, 64), (320, 180), (101, 300)])
@pytest.mark.parametrize("fov", [0.1, 20.0, 60.0, 120.0, 179.0])
def test_solid_angles_of_a_perspective_view_add_up_to_its_frustum(width, height, fov):
    total = Camera.perspective(width, height, fov).solid_angles.sum().item()
    assert total == pytest.approx(frustum(width, height, fov), rel=1e-9)


@pytest.mark.parametrize(
    ("width", "height"), [(3, 3), (8, 8), (63, 63), (64, 64), (120, 90), (65, 128), (512, 512)]
)
@pytest.mark.parametrize("fov", [20.0, 120.0, 180.0, 220.0, 360.0])
def test_solid_angles_of_a_fisheye_add_up_to_its_cap(width, height, fov):
    total = Camera.fisheye(width, height, fov).solid_angles.sum().item()
    assert total == pytest.approx(2 * math.pi * (1 - math.cos(math.radians(fov) / 2)), rel=1e-4)


def test_a_pixel_on_the_circle_counts_with_its_part_inside():
    fine = Camera.fisheye(8 * 64, 8 * 64).solid_angles.reshape(8, 64, 8, 64).sum(dim=(1, 3))
    torch.testing.assert_close(Camera.fisheye(8, 8).solid_angles, fine, rtol=1e-4, atol=1e-6)


def test_projected_solid_angle_of_a_hemisphere_is_pi():
    camera = Camera.fisheye(128, 128)
    cosine = camera.directions[..., 2].clamp(min=0)
    assert (camera.solid_angles * cosine).sum().item() == pytest.approx(math.pi, rel=1e-4)


@pytest.mark.parametrize(
    "camera", [Camera.perspective(6, 4, 70), Camera.fisheye(6, 4), Camera.fisheye(5, 5, 300)]
)
def test_directions_are_unit_vectors_with_x_right_y_up_and_z_forward(camera):
    d = camera.directions
    assert d.shape == (camera.height, camera.width, 3)
    torch.testing.assert_close(d.norm(dim=-1), torch.ones(d.shape[:2], dtype=d.dtype))
    inside = camera.solid_angles > 0
    right, top = camera.width - camera.width // 2, camera.height // 2
    assert (d[:, right:, 0][inside[:, right:]] > 0).all()
    assert (d[:top, :, 1][inside[:top]] > 0).all()
    assert d[camera.height // 2, camera.width // 2, 2] > 0.8
    torch.testing.assert_close(d.flip(0)[..., 1], -d[..., 1])
    torch.testing.assert_close(d.flip(1)[..., 0], -d[..., 0])


def test_the_field_of_view_reaches_the_edges():
    camera = Camera.perspective(1001, 3, 90)
    edge = math.degrees(math.atan2(*camera.directions[1, -1, [0, 2]].tolist()))
    assert edge == pytest.approx(45, abs=0.06)
    fisheye = Camera.fisheye(1001, 1001)
    angle = math.degrees(math.acos(fisheye.directions[500, -1, 2].item()))
    assert angle == pytest.approx(90, abs=0.1)
    assert fisheye.directions[500, 750, 2].item() == pytest.approx(math.cos(math.radians(45)), abs=2e-3)


def test_the_axis_may_lie_off_centre():
    plain, shifted = (
        Camera.perspective(8, 4, 60),
        Camera.perspective(8, 4, 60, principal_point_offset=(0.25, 0.25)),
    )
    torch.testing.assert_close(shifted.directions[1:, 2:], plain.directions[:3, :6])
    torch.testing.assert_close(shifted.solid_angles[1:, 2:], plain.solid_angles[:3, :6])


def test_pixels_outside_the_circle_have_no_solid_angle():
    solid_angles = Camera.fisheye(40, 20).solid_angles
    assert (solid_angles[:, :10] == 0).all()
    assert (solid_angles[:, 30:] == 0).all()
    assert solid_angles[0, 10] == 0


def test_only_a_fisheye_of_180_degrees_sees_the_hemisphere():
    assert Camera.fisheye(8, 8).sees_hemisphere
    assert Camera.fisheye(8, 8, 200).sees_hemisphere
    assert not Camera.fisheye(8, 8, 170).sees_hemisphere
    assert not Camera.perspective(8, 8, 170).sees_hemisphere


def test_a_camera_is_immutable():
    camera = Camera.perspective(4, 3, 50)
    assert (camera.width, camera.height, camera.projection, camera.fov) == (4, 3, "perspective", 50.0)
    with pytest.raises(dataclasses.FrozenInstanceError):
        camera.width = 5  # type: ignore[misc]


@pytest.mark.parametrize("fov", [0, -10, 180, math.nan, "60"])
def test_an_impossible_field_of_view_is_refused(fov):
    with pytest.raises(SceneCaptumError, match="fov_x of a perspective camera must be above 0 and below 180"):
        Camera.perspective(4, 4, fov)


def test_an_impossible_fisheye_or_size_is_refused():
    with pytest.raises(SceneCaptumError, match="at most 360 degrees, not 361"):
        Camera.fisheye(4, 4, 361)
    with pytest.raises(SceneCaptumError, match="width must be a whole number"):
        Camera.fisheye(0, 4)
