"""Sliders, and a scene to first order against renders of it."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from chance import allowed, together
from seeds import seeds, shifted

from scenecaptum import SceneRenderer, metrics
from scenecaptum.errors import SceneCaptumError
from scenecaptum.linearization import Designs, Linearization, Measured, Slider
from scenecaptum.linearization._designs import REPLICATES
from scenecaptum.linearization._linearization import _denoise_signed

LAMP = "light.emitter.radiance.value"
WALL = "left_wall.reflectance.value"
SKY = "sky.emitter.radiance.value"
POSE = "tall_box_shape.pose.translation"
THRESHOLD = 0.3  # of the pixels of the Cornell box: twice their mean


@pytest.fixture(scope="module")
def about(cornell: Any) -> Linearization:
    designs = Designs(cornell, [metrics.MeanLuminance()], seed=shifted(), spp=256)
    found = Linearization(designs, designs.measure({}))
    found.rank()
    for name in (LAMP, WALL, POSE):
        found.derive(designs.sliders[name])
    return found


@pytest.mark.parametrize("place", [0.0, 0.6, 2.0])
def test_a_lamp_is_predicted_exactly_within_the_noise(about, place):
    measured = about.designs.measure({LAMP: (place,)})
    picture, [(change, error)] = about.predict({LAMP: (place,)})
    rendered, rendered_error = measured.change(0, about.start)
    off = (rendered - change) / together(error, rendered_error)
    assert abs(off) < allowed(REPLICATES), f"{rendered} ± {rendered_error} against {change} ± {error}"
    # The only lamp: the same picture, and the same noise in it, times a factor.
    assert torch.allclose(picture, about.designs.denoised(measured.image, {}), rtol=1e-2, atol=1e-4)


def test_a_bias_is_part_of_the_error():
    """Of four replicates with a single bright pixel each, the means of three agree, and that of all is far off."""
    pseudo = torch.full((4, 1), -132.0, dtype=torch.float64)
    found = Measured({}, torch.zeros(4, 2, 2, 3), torch.tensor([-33.0], dtype=torch.float64), pseudo)
    assert found.value(0) == (-33.0, 99.0)
    assert found.change(0, found) == (0.0, 0.0)


@pytest.mark.parametrize(("name", "step"), [(WALL, (0.03, 0.03, 0.03)), (POSE, (0.02, 0.0, 0.0))])
def test_other_changes_are_predicted_to_first_order(about, name, step):
    slider = about.designs.sliders[name]
    # The mean of both directions has no curvature.
    ends = [tuple(n + sign * s for n, s in zip(slider.start, step, strict=True)) for sign in (1, -1)]
    up, down = (about.designs.measure({name: place}).values[:, 0] for place in ends)
    slope = (up - down) / 2
    rendered, rendered_error = slope.mean().item(), slope.std().item() / math.sqrt(REPLICATES)
    _, [(change, error)] = about.predict({name: ends[0]})
    off = (rendered - change) / together(error, rendered_error)
    assert abs(off) < allowed(REPLICATES), f"{rendered} ± {rendered_error} against {change} ± {error}"


def _bright_share(image: torch.Tensor) -> torch.Tensor:
    """Return the share of bright pixels, with a soft threshold: its adjoint has the noise of the picture."""
    return torch.sigmoid(40 * (image.mean(-1) - THRESHOLD)).mean()


def test_effects_at_rest_have_the_noise_of_the_picture():
    renderer = SceneRenderer("cornell-box", inputs="reflectance", resolution=(16, 16), spp=16, max_depth=4)
    effects, variances = [], []
    for seed in seeds(100, 106):
        designs = Designs(renderer, [_bright_share], seed=seed, spp=16, denoise=False)
        about = Linearization(designs, designs.measure({}))
        about.rank()
        [attribution] = about.attributions
        effects.append(list(attribution.effects().values()))
        variances.append([error**2 for error in (attribution.effects_error() or {}).values()])
    spread = torch.tensor(effects).std(0)
    claimed = torch.tensor(variances).mean(0).sqrt()
    # Of 6 seeds, the spread is more than 2.5 times the true one in one of 100 000 cases.
    assert (spread < 2.5 * claimed).all(), f"{spread.tolist()} against {claimed.tolist()}"


def test_the_errors_of_a_linear_metric_need_no_more_renders(about, monkeypatch):
    def refuse(*_: Any) -> None:
        pytest.fail("the adjoint of a linear metric has no noise")

    monkeypatch.setattr(Linearization, "_with_picture_noise", refuse)
    again = Linearization(about.designs, about.start)
    again.rank()
    assert again.attributions[0].metric_value == about.attributions[0].metric_value


def test_the_leading_parameters_are_those_with_the_largest_effects(about):
    [attribution] = about.attributions
    assert about.leading(3) == [row.name for row in attribution.ranking(3)]
    assert about.leading(1) == [LAMP]
    assert attribution.metric_value == pytest.approx(about.start.value(0)[0])


def test_a_prediction_at_another_start_changes_nothing_there(about):
    designs = about.designs
    start = {WALL: (0.3, 0.1, 0.1)}
    other = Linearization(designs, designs.measure(start))
    other.rank()
    other.derive(designs.sliders[WALL])
    picture, [change] = other.predict(start)
    assert torch.equal(picture, designs.denoised(other.start.image, start))
    assert change == (0.0, 0.0)


# ------------------------------------------------------------------------------------------------------ sliders


@pytest.fixture(scope="module")
def sliders() -> dict[str, Slider]:
    renderer = SceneRenderer("office", inputs="all", resolution=(8, 8), spp=1)
    return Designs(renderer, [metrics.MeanLuminance()]).sliders


@pytest.mark.parametrize(
    ("name", "form"),
    [
        ("sky.emitter.radiance.value", "dimmer"),
        ("wall_left.reflectance.value", "color"),
        ("floor.reflectance.data", "offset"),
        ("desk.roughness.value", "scalar"),
        ("metal_legs.k.value", "channels"),
        ("desk.pose.translation", "vector"),
        ("camera.fov", "scalar"),
    ],
)
def test_a_slider_starts_at_the_scene_and_stays_physical(sliders, name, form):
    slider = sliders[name]
    assert slider.form == form
    assert torch.allclose(slider.tensor(slider.start), slider.value)
    low, high = slider.bounds
    for end in (slider.low, slider.high):
        value = slider.tensor(tuple(end for _ in slider.start))
        assert value.shape == slider.value.shape
        assert low <= value.min()
        assert value.max() <= high
    for step in slider.steps(slider.start):
        slider.checked(
            [n + d for n, d in zip(slider.start, step, strict=True)]
        )  # which raises beyond the ends


@pytest.mark.parametrize(
    "numbers",
    [
        *(None, 3, "abc", [], [0.1], [0.1, 0.2, 0.3, 0.4], [0.1, 0.2, 1.5], [-0.1, 0.2, 0.3], [[0.1]] * 3),
        *([True] * 3, ["0.1"] * 3, [0.1, 0.2, math.nan], [0.1, 0.2, math.inf], [10**400, 0, 0]),
        {"a": 1, "b": 2, "c": 3},
    ],
    ids=lambda value: repr(value)[:20],
)
def test_what_is_no_place_is_refused(sliders, numbers):
    with pytest.raises(SceneCaptumError, match="wall_left"):
        sliders["wall_left.reflectance.value"].checked(numbers)


@pytest.fixture(scope="module")
def evening() -> Designs:
    """The office without its sky, and a metric that is not linear in the light."""
    renderer = SceneRenderer("office", inputs="emitters", resolution=(16, 9), spp=4, max_depth=3)
    off = {**renderer.inputs, SKY: torch.zeros(3)}
    return Designs(renderer, [_bright_share, metrics.MeanLuminance()], inputs=off, denoise=False)


def test_the_slider_of_a_light_that_is_off_reaches_twice_its_value_in_the_scene(evening, sliders):
    slider, own = evening.sliders[SKY], sliders[SKY].value
    assert slider.start == (0.0, 0.0, 0.0)
    assert (slider.low, slider.high) == (0.0, pytest.approx(2 * own.max().item()))
    assert torch.equal(slider.tensor(slider.checked(own.tolist())), own)


def test_a_light_that_is_off_leads_only_where_the_metric_is_linear_in_it(evening):
    about = Linearization(evening, evening.measure({}))
    about.rank()
    bright, luminance = about.attributions
    assert bright.ranked_last() == {SKY}
    assert luminance.ranked_last() == set()
    assert SKY in about.leading(2)  # it leads for the luminance
    about.attributions = [bright]
    assert about.leading(9)[-1] == SKY


def test_a_derivative_keeps_its_sign_and_its_mean_when_it_is_denoised(cornell):
    generator = torch.Generator().manual_seed(shifted())
    noise = torch.randn(32, 32, 3, generator=generator)
    found = _denoise_signed(noise - 0.5, cornell.guides)
    assert found.std() < 0.5 * noise.std()
    assert abs(found.mean() + 0.5) < 4 / math.sqrt(noise.numel())


def test_a_renderer_without_one_picture_is_refused():
    renderer = SceneRenderer("cornell-box", resolution=(8, 8), spp=1, sensor=[0, "fisheye"])
    with pytest.raises(SceneCaptumError, match="one camera"):
        Designs(renderer, [metrics.MeanLuminance()])
