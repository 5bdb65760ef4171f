"""Sky matrices: gendaymtx, files, standard skies; illuminance against dctimestep."""

from __future__ import annotations

import dataclasses
import importlib.util
import math
import re
import subprocess

import numpy as np
import pytest
import torch
from refusals import message
from seeds import shifted

from scenecaptum import SceneCaptumError
from scenecaptum.daylight import EFFICACY, SkyMatrix, SkyPatches, illuminance, synthetic_weather

from .matrices import write_matrix

WEIGHTS = (0.212671, 0.715160, 0.072169)
TREGENZA = SkyPatches.tregenza()


@pytest.fixture(scope="module")
def skies(radiance, weather) -> dict[str, SkyMatrix]:
    return {sun: SkyMatrix.from_weather(weather, sun=sun) for sun in ("patches", "none", "only")}


def random_coefficients(points: int, patches: SkyPatches = TREGENZA, dtype=torch.float32) -> torch.Tensor:
    generator = torch.Generator().manual_seed(shifted(4))
    scale = patches.projected_solid_angles[:, None] + 1e-3
    values = torch.rand(points, patches.count, 3, generator=generator, dtype=torch.float64) ** 3 * scale * 0.1
    return values.to(dtype)


def test_a_sky_from_weather_is_grey_and_dark_at_night(skies, weather):
    sky = skies["patches"]
    assert sky.radiance.shape == (146, 8760, 3)
    assert sky.radiance.dtype == torch.float32
    assert torch.equal(sky.radiance[..., 0], sky.radiance[..., 2])
    night = weather.diffuse_horizontal + weather.direct_normal == 0
    assert sky.radiance[:, night].abs().max() == 0
    assert (sky.horizontal_illuminance()[~night] > 0).all()


def test_solar_radiance_has_the_irradiance_of_the_weather(radiance, weather, tmp_path):
    done = subprocess.run(
        [str(radiance / "bin" / "gendaymtx"), "-of", "-O1", "-s", "-c", "1", "1", "1"],
        input=weather.to_wea().encode(),
        capture_output=True,
        check=True,
    )
    (tmp_path / "solar.smx").write_bytes(done.stdout)
    solar = SkyMatrix.from_radiance(tmp_path / "solar.smx").radiance[..., 1].double()
    by_center = TREGENZA.solid_angles * TREGENZA.directions[:, 2]
    np.testing.assert_allclose(by_center[1:] @ solar[1:], weather.diffuse_horizontal, rtol=1e-5, atol=1e-5)


def test_illuminances_are_luminous_efficacies_times_the_irradiances_of_the_weather(skies, weather):
    diffuse = weather.diffuse_horizontal > 20
    efficacy = skies["none"].horizontal_illuminance()[diffuse] / weather.diffuse_horizontal[diffuse]
    assert 110 < efficacy.median() < 130  # lm/W of daylight from the sky
    up = weather.sun_directions()[:, 2]
    sunny = (up > 0.3) & (weather.direct_normal > 100)
    direct = skies["only"].horizontal_illuminance()[sunny] / (weather.direct_normal * up)[sunny]
    assert 90 < direct.median() < 115  # and of sunlight


def test_sun_and_sky_add_up(skies):
    both = skies["none"].radiance[1:] + skies["only"].radiance[1:]
    torch.testing.assert_close(both, skies["patches"].radiance[1:], rtol=1e-5, atol=1e-5)
    assert skies["only"].radiance[0].abs().max() == 0
    assert torch.equal(skies["none"].radiance[0], skies["patches"].radiance[0])


def test_the_sun_is_in_the_four_patches_next_to_it(skies, weather):
    sunny = skies["only"].radiance[:, :, 1].sum(0) > 0
    lit = skies["only"].radiance[:, sunny, 1] > 0
    assert (lit.sum(0) == 4).all()
    sun = weather.sun_directions()[sunny]
    angles = torch.rad2deg((TREGENZA.directions @ sun.T).clamp(-1, 1).acos())
    assert angles[lit].max() < 25
    assert angles[:, :].masked_fill(~lit, 180).min(0).values.max() < 9


def test_ground_and_sky_are_tied_by_the_reflectance_of_the_ground(skies, weather):
    up = weather.sun_directions()[:, 2] > 0.05
    by_center = TREGENZA.solid_angles * TREGENZA.directions[:, 2]  # as gendaymtx scales its skies
    total = torch.einsum("ph,p->h", skies["none"].radiance[1:, up, 1].double(), by_center[1:])
    sun = skies["only"].radiance[1:, up, 1].double()
    direct = (sun * TREGENZA.solid_angles[1:, None]).sum(0) * weather.sun_directions()[up, 2]
    expected = 0.2 / math.pi * (total + direct)
    np.testing.assert_allclose(skies["none"].radiance[0, up, 1], expected, rtol=1e-4)


def test_a_finer_sky_has_the_same_illuminance(weather, skies, radiance):
    fine = SkyMatrix.from_weather(weather, SkyPatches.reinhart(), sun="none")
    assert fine.radiance.shape == (578, 8760, 3)
    day = weather.diffuse_horizontal > 20
    ratio = fine.horizontal_illuminance()[day] / skies["none"].horizontal_illuminance()[day]
    # Both are scaled by the centers of patches, which gives 0.55 and 0.14 % too much.
    assert ratio.mean().item() == pytest.approx(1.004, abs=0.001)


@pytest.mark.parametrize("options", [["-of"], ["-od"], []], ids=["float", "double", "ascii"])
def test_files_of_gendaymtx_are_read(radiance, weather, skies, tmp_path, options):
    month = weather.select(weather.month == 5)
    done = subprocess.run(
        [str(radiance / "bin" / "gendaymtx"), "-m", "1", "-c", "1", "1", "1", *options],
        input=month.to_wea().encode(),
        capture_output=True,
        check=True,
    )
    (tmp_path / "may.smx").write_bytes(done.stdout)
    sky = SkyMatrix.from_radiance(tmp_path / "may.smx", month)
    assert sky.patches == TREGENZA
    tolerance = 0 if options else 6e-3  # three digits in ASCII
    torch.testing.assert_close(
        sky.radiance, skies["patches"].radiance[:, weather.month == 5], rtol=tolerance, atol=0
    )


@pytest.mark.parametrize(
    ("form", "big"), [("float", True), ("float", False), ("double", True), ("ascii", False)]
)
def test_files_are_read_in_every_format(tmp_path, form, big):
    values = np.random.default_rng(shifted(5)).random((146, 5, 3)).astype(np.float32)
    write_matrix(tmp_path / "a.smx", values, form, big)
    assert np.array_equal(SkyMatrix.from_radiance(tmp_path / "a.smx").radiance.numpy(), values)
    assert np.array_equal(SkyMatrix.from_radiance(values).radiance.numpy(), values)


BAD = {
    "header": (lambda data: data[1:], "no Radiance header"),
    "size": (lambda data: data.replace(b"NCOLS=2", b"NCOLS=3"), "has 876 values, expected 146 × 3 × 3"),
    "cut": (lambda data: data[:-2], "has 875 values"),
    "columns": (lambda data: data.replace(b"NCOLS=2\n", b""), "needs a line NCOLS="),
    "channels": (lambda data: data.replace(b"NCOMP=3", b"NCOMP=1"), "NCOMP=1, expected 3"),
    "format": (
        lambda data: data.replace(b"FORMAT=float", b"FORMAT=32-bit_rle_rgbe"),
        "FORMAT=32-bit_rle_rgbe",
    ),
    "words": (
        lambda data: data[: data.index(b"FORMAT")] + b"FORMAT=ascii\n\none two",
        "not a matrix of numbers",
    ),
}


@pytest.mark.parametrize("kind", BAD)
def test_a_bad_matrix_is_refused_in_one_line(tmp_path, kind):
    change, expected = BAD[kind]
    path = tmp_path / "bad.smx"
    write_matrix(path, np.ones((146, 2, 3)))
    path.write_bytes(change(path.read_bytes()))
    said = message(lambda: SkyMatrix.from_radiance(path))
    assert expected in said
    assert "\n" not in said
    assert str(path) in said


def test_refusals(weather, tmp_path):
    ones = torch.ones(146, 2, 3)
    assert "cannot be read" in message(lambda: SkyMatrix.from_radiance(tmp_path / "none.smx"))
    assert "145 patches" in message(lambda: SkyMatrix.from_radiance(ones[1:]))
    assert "(146, hours, 3)" in message(lambda: SkyMatrix.from_radiance(ones[..., :2]))
    assert "(P, hours, 3)" in message(lambda: SkyMatrix.from_radiance(torch.tensor(1.0)))
    assert "negative or not finite" in message(lambda: SkyMatrix.from_radiance(-ones))
    assert "negative or not finite" in message(lambda: SkyMatrix.from_radiance(ones / 0))
    assert "2 hours and the weather 8760" in message(lambda: SkyMatrix.from_radiance(ones, weather))
    assert "sun must be" in message(lambda: SkyMatrix.from_weather(weather, sun="all"))
    assert "horizontal_illuminance" in message(lambda: SkyMatrix.uniform(horizontal_illuminance=0))
    assert "ground_reflectance" in message(lambda: SkyMatrix.uniform(ground_reflectance=1.1))
    sky = SkyMatrix.from_radiance(ones)
    assert "(points, 146, 3)" in message(lambda: illuminance(torch.ones(4, 145, 3), sky))
    assert "negative or not finite" in message(lambda: illuminance(-torch.ones(4, 146, 3), sky))
    assert "negative or not finite" in message(lambda: illuminance(torch.ones(4, 146, 3) * math.nan, sky))


def test_without_pyradiance_the_error_says_what_to_install(weather, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert "pip install 'scenecaptum[daylight]'" in message(lambda: SkyMatrix.from_weather(weather))


def test_messages_of_gendaymtx_are_passed_on(radiance, weather):
    wrong = dataclasses.replace(weather, time_zone=-11.0)  # the sun shines at night
    with pytest.warns(UserWarning, match="unusually bright"):
        SkyMatrix.from_weather(wrong)


@pytest.mark.parametrize(
    "patches", [TREGENZA, SkyPatches.reinhart(), SkyPatches(4)], ids=lambda p: str(p.count)
)
@pytest.mark.parametrize("make", [SkyMatrix.cie_overcast, SkyMatrix.uniform])
def test_standard_skies_have_the_illuminance_that_was_asked_for(make, patches):
    sky = make(patches, 12_345.0, ground_reflectance=0.3)
    assert sky.horizontal_illuminance().item() == pytest.approx(12_345, rel=1e-5)
    ground = EFFICACY * (sky.radiance[0, 0] * torch.tensor(WEIGHTS)).sum()
    assert ground.item() == pytest.approx(0.3 * 12_345 / math.pi, rel=1e-6)
    assert sky.ground_reflectance == pytest.approx(0.3, rel=1e-5)


def test_the_overcast_sky_is_three_times_as_bright_at_the_zenith_as_at_the_horizon():
    sky = SkyMatrix.cie_overcast(SkyPatches(8), 10_000)
    sine = sky.patches.directions[1:, 2]
    zenith = 9 / 7 / math.pi * 10_000  # E = 7 π / 9 Lz
    luminance = EFFICACY * sky.radiance[1:, 0] @ torch.tensor(WEIGHTS)
    np.testing.assert_allclose(luminance, zenith * (1 + 2 * sine) / 3, rtol=3e-4)


def test_select(weather, skies):
    part = skies["none"].select(weather.occupied())
    assert part.hours == len(part.weather) == 3650
    assert torch.equal(part.radiance, skies["none"].radiance[:, weather.occupied()])


def test_an_unobstructed_point_has_the_horizontal_illuminance(skies):
    outdoors = TREGENZA.projected_solid_angles.float()[None, :, None].expand(2, -1, 3)
    found = illuminance(outdoors, skies["patches"])
    expected = skies["patches"].horizontal_illuminance()
    torch.testing.assert_close(found, expected.expand(2, -1), rtol=1e-5, atol=1e-2)


def test_illuminance_is_the_sum_of_its_definition():
    generator = np.random.default_rng(shifted(6))
    sky = SkyMatrix.from_radiance(generator.random((146, 3, 3)))
    coefficients = random_coefficients(2)
    found = illuminance(coefficients, sky)
    for point in range(2):
        for hour in range(3):
            total = 0.0
            for patch in range(146):
                for channel, weight in enumerate(WEIGHTS):
                    total += (
                        weight
                        * coefficients[point, patch, channel].item()
                        * sky.radiance[patch, hour, channel].item()
                    )
            assert found[point, hour].item() == pytest.approx(179 * total, rel=1e-5)


def test_a_year_is_that_of_dctimestep(radiance, skies, tmp_path):
    coefficients = random_coefficients(5)
    # Different in each channel, so that a swap of channels would be seen.
    tint = torch.tensor([0.8, 1.0, 1.3])
    sky = SkyMatrix.from_radiance(skies["patches"].radiance * tint)
    write_matrix(tmp_path / "c.mtx", coefficients.numpy())
    write_matrix(tmp_path / "s.smx", sky.radiance.numpy())
    done = subprocess.run(
        [str(radiance / "bin" / "dctimestep"), "-of", str(tmp_path / "c.mtx"), str(tmp_path / "s.smx")],
        capture_output=True,
        check=True,
    )
    head, _, body = done.stdout.partition(b"\n\n")
    assert re.search(rb"NROWS=5\n.*NCOLS=8760\n", head, re.DOTALL)
    theirs = 179 * np.frombuffer(body, "<f4").reshape(5, 8760, 3).astype(float) @ np.array(WEIGHTS)
    np.testing.assert_allclose(illuminance(coefficients, sky), theirs, rtol=1e-4, atol=1e-6)


def test_illuminance_has_the_gradient_of_a_linear_function(skies):
    coefficients = random_coefficients(3, dtype=torch.float64).requires_grad_()
    sky = skies["patches"].select(skies["patches"].weather.month == 6)
    illuminance(coefficients, sky).sum().backward()
    per_channel = sky.radiance.double().sum(1) * 179 * torch.tensor(WEIGHTS)
    torch.testing.assert_close(coefficients.grad, per_channel.expand(3, -1, -1))


def test_a_year_of_many_points_fits_into_little_memory(skies):
    coefficients = random_coefficients(100).requires_grad_()
    sizes: list[int] = []

    def pack(tensor: torch.Tensor) -> torch.Tensor:
        sizes.append(tensor.untyped_storage().nbytes())
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        found = illuminance(coefficients, skies["patches"])
    assert found.shape == (100, 8760)
    assert max(sizes) <= skies["patches"].radiance.numel() * 4  # not points × patches × hours


def test_a_room_whose_y_axis_points_east_has_the_sun_at_noon_on_its_right(radiance):
    """South is to the right of east."""
    weather = synthetic_weather()
    noon = weather.select(torch.as_tensor(weather.hour) == 12)
    patches = SkyPatches.tregenza()

    def towards(north: float) -> torch.Tensor:
        sun = SkyMatrix.from_weather(noon, patches, sun="only", north=north).radiance[..., 1].double().mean(1)
        return sun @ patches.directions

    (x, y, z), (right, ahead, up) = towards(0.0).tolist(), towards(90.0).tolist()
    assert y < -2 * abs(x)
    # Rotated by 7.5 patches of the lower rows: the sun is spread over other patches.
    assert right == pytest.approx(-y, rel=0.02)
    assert ahead == pytest.approx(x, abs=0.02 * abs(y))
    assert up == pytest.approx(z, rel=0.02)


def test_a_bearing_that_is_no_angle_is_one_clear_line(radiance):
    with pytest.raises(SceneCaptumError, match="north must be an angle"):
        SkyMatrix.from_weather(synthetic_weather(), north=math.nan)
