"""Maps over renders, luminance, rank comparisons and metric specificity, by the contents of the figures."""

from __future__ import annotations

import dataclasses
import importlib.util
import itertools
import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from results import CASES, all_text, make, outside, surfaces

from scenecaptum import Camera, SceneAttribution, SceneCaptumError, metrics
from scenecaptum.projection import TexelMap
from scenecaptum.protocols import ResultKind
from scenecaptum.visualization import (
    LOWERS,
    RAISES,
    UNCLEAR,
    diverging,
    plot_bars,
    plot_heatmap,
    plot_overlay,
    plot_rank_comparison,
    plot_specificity,
    table_text,
)
from scenecaptum.visualization._finding import finding

VARIANCE = "variance of the gradient per unit"


def hexes(colors: Any) -> list[str]:
    from matplotlib.colors import to_hex

    return [to_hex(color).upper() for color in colors]


# -- bars ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("quantity", "said", "not_said"),
    [
        ("gradient per unit", "raising it lowers the metric", "takes from"),
        ("effect over the range", "raising it lowers the metric", "takes from"),
        ("mean gradient per unit", "raising it lowers the metric", "takes from"),
        ("effect per relative change", "takes from the metric", "raising"),
        ("input × gradient", "takes from the metric", "raising"),
        ("contribution", "takes from the metric", "raising"),
        ("effect of ablation", "takes from the metric", "raising"),
        ("effect of occlusion", "takes from the metric", "raising"),
        ("Shapley value", "takes from the metric", "raising"),
    ],
)
def test_the_legend_says_what_a_sign_means(quantity: str, said: str, not_said: str) -> None:
    text = all_text(plot_bars(make(quantity=quantity)))
    assert said in text
    assert not_said not in text


def test_contributions_without_a_named_quantity_add_or_take() -> None:
    text = all_text(plot_bars(dataclasses.replace(make(), convergence_delta=0.01)))
    assert "adds to the metric" in text
    assert "contribution to Glare" in text


@pytest.mark.parametrize("quantity", ["mean squared gradient per unit", "variance of the gradient per unit"])
def test_squares_and_variances_have_no_sign(quantity: str) -> None:
    figure = plot_bars(make(quantity=quantity))
    assert set(hexes(bar.get_facecolor() for bar in figure.axes[0].patches)) == {UNCLEAR}
    assert "it has no sign" in all_text(figure)
    assert "+" not in all_text(figure)


def test_a_difference_is_not_called_the_metric() -> None:
    text = all_text(plot_bars(make(metric="A − B", minus={"metric": "B"})))
    assert "raising it lowers the difference" in text
    assert "the metric" not in text


def test_bars_of_zeros_are_labelled_and_have_no_sign() -> None:
    still = make()
    zero = dataclasses.replace(
        still,
        attributions={name: 0 * value for name, value in still.items()},
        covariance={name: 0 * value for name, value in still.covariance.items()},
    )
    figure = plot_bars(zero)
    text = all_text(figure)
    assert "all effects are 0" in text
    assert "raises" not in text
    assert "lost in the noise" not in text
    assert figure.axes[0].get_xlim() == (0, 1)


LONG = {name: f"{name}_{'very_' * 30}long" for name, *_ in CASES}


def lengthy() -> SceneAttribution:
    cautions = dict.fromkeys(LONG, "the plugin's tables are outside the derivative graph: its size is off")
    return dataclasses.replace(
        make(metric="a_metric_of_somebody_with_a_long.name_in_a_module", cautions=cautions), labels=LONG
    )


@pytest.mark.parametrize("top", [1, 3, None])
def test_no_text_of_the_bars_is_cut_off(top: int | None) -> None:
    assert outside(plot_bars(lengthy(), top=top)) == []
    assert outside(plot_bars(make(), top=top)) == []


def test_the_bars_keep_their_height_under_long_text() -> None:
    figure = plot_bars(lengthy())
    figure.canvas.draw()
    bars = figure.axes[0].patches
    points = [bar.get_window_extent().height * 72 / figure.dpi for bar in bars]
    assert min(points) > 8  # as tall as the names beside them


# -- maps ------------------------------------------------------------------------------------------------


def test_the_overlay_is_a_map_over_a_grey_render() -> None:
    attribution = make()
    figure = attribution.plot_overlay(alpha=0.6)
    picture, bar = figure.axes
    below, above = picture.images
    assert below.get_array().ndim == 2
    assert below.get_cmap().name == "gray"
    heat = attribution.heatmap().numpy()
    np.testing.assert_allclose(above.get_array(), heat)
    opacity = np.broadcast_to(above.get_alpha(), heat.shape)
    assert opacity.max() <= 0.6
    order = np.argsort(heat.ravel())
    assert (np.diff(opacity.ravel()[order]) >= -1e-6).all()
    assert opacity.max() > opacity.min()
    # The legend is opaque, even if the map is transparent.
    assert bar.collections[-1].get_alpha() is None
    assert "relative to the largest" in all_text(figure)


def test_invalid_overlays_are_refused() -> None:
    with pytest.raises(SceneCaptumError, match="alpha"):
        plot_overlay(make(), alpha=1.5)
    with pytest.raises(SceneCaptumError, match="no picture"):
        plot_overlay(dataclasses.replace(make(), image=None))
    with pytest.raises(SceneCaptumError, match="norm must be one of 'sqrt', 'linear', 'log', not 'cubic'"):
        plot_overlay(make(), norm="cubic")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("norm", "place_of"),
    [("sqrt", np.sqrt), ("linear", np.asarray), ("log", lambda x: 1 + np.log10(np.maximum(x, 1e-3)) / 3)],
)
def test_scales_map_values_and_label_the_legend(norm: Any, place_of: Any) -> None:
    figure = plot_heatmap(make(), norm=norm)
    relative = make().heatmap(norm="linear").numpy()
    np.testing.assert_allclose(figure.axes[1].images[0].get_array(), place_of(relative), rtol=1e-5)
    assert figure.axes[1].images[0].get_clim() == (0, 1)
    labels = [float(label.get_text()) for label in figure.axes[2].get_yticklabels()]
    np.testing.assert_allclose(figure.axes[2].get_yticks(), place_of(np.array(labels)), atol=1e-9)
    assert (min(labels), max(labels)) == (0.001 if norm == "log" else 0, 1)


def test_maps_draw_into_given_axes() -> None:
    from matplotlib.figure import Figure

    figure = Figure(layout="constrained")
    left, right = figure.subplots(1, 2)
    assert plot_heatmap(make(), ax=left) is figure
    assert plot_overlay(make(), ax=right) is figure
    assert len(left.images) == 1
    assert len(right.images) == 2
    for panel in (left, right):
        (bar,) = panel.child_axes
        assert bar.bbox.y0 == pytest.approx(panel.bbox.y0)
        assert bar.bbox.y1 == pytest.approx(panel.bbox.y1)


def test_titles_say_what_the_metric_depends_on() -> None:
    first, second, third, *_ = make().ranking()
    assert f"depends most on {first.label}\n" in all_text(plot_bars(make()))
    apart = {name: 0 * value for name, value in make().items()}
    assert "depends on none of these" in all_text(plot_bars(dataclasses.replace(make(), attributions=apart)))
    # The first is clear of its error, and the second and the third are within that of the difference.
    covariance = {**make().covariance, first.name: 35**2 * make().covariance[first.name]}
    covariance[third.name] = 13**2 * covariance[third.name]
    text = all_text(plot_bars(dataclasses.replace(make(), covariance=covariance)))
    assert f"depends most on {first.label}, {second.label} and others\n" in text
    noisy = {name: 1e6 * value for name, value in make().covariance.items()}
    # Within the noise, but with two standard errors still below the first.
    covariance[second.name] = 43**2 * covariance[second.name]
    text = all_text(plot_bars(dataclasses.replace(make(), covariance=covariance)))
    assert f"depends most on {first.label} and others\n" in text, (
        "names an effect lost in the noise, or one below"
    )
    covariance[third.name] = 5**2 * covariance[third.name]
    text = all_text(plot_bars(dataclasses.replace(make(), covariance=covariance)))
    assert f"depends most on {first.label}\n" in text, "names an effect lost in the noise"
    text = all_text(plot_bars(dataclasses.replace(make(), covariance=noisy)))
    assert "no effect is clear enough to rank\n" in text


def test_titles_of_squares_and_variances_do_not_say_what_the_metric_depends_on() -> None:
    zeros = {name: 0 * value for name, value in make().items()}
    for quantity, said, of_none in (
        (VARIANCE, "the gradient of Glare varies most with lamp", "varies with none"),
        (
            "mean squared gradient per unit",
            "the mean squared gradient of Glare is largest for lamp",
            "none of",
        ),
    ):
        result = make(quantity=quantity)
        assert finding(result) == said
        assert said in " ".join(all_text(plot_bars(result)).split())
        assert of_none in finding(dataclasses.replace(result, attributions=zeros))


def test_a_difference_of_one_metric_says_what_its_results_differ_in() -> None:
    first, others = make(method="first"), make(method="second")
    lower = dataclasses.replace(others, attributions={name: value / 2 for name, value in others.items()})
    assert finding(first - lower) == "the two results differ most in lamp"
    assert finding(first - others) == "the two results differ in none of these parameters"
    other_metric = dataclasses.replace(lower, info={**lower.info, "metric": "Light"})
    assert finding(first - other_metric) == "Glare − Light depends most on lamp"


def test_ranks_per_unit_of_several_kinds_have_a_note() -> None:
    note = "per unit: compare parameters of one kind only"
    labels = {"lamp": "lamp: radiance", "rough": "desk: roughness"}
    ranged = dataclasses.replace(
        make(),
        labels=labels,
        extents={
            name: torch.full((value.shape[-1] if value.ndim else 1,), 1.0) for name, value in make().items()
        },
    )
    mixed = dataclasses.replace(ranged, extents={**ranged.extents, "lamp": torch.full((3,), 40.0)})
    assert note in all_text(plot_bars(mixed, scale="unit"))
    assert note in table_text(mixed, scale="unit")
    assert note in all_text(plot_bars(dataclasses.replace(mixed, info={**mixed.info, "quantity": VARIANCE})))
    one_kind = dataclasses.replace(mixed, labels={"lamp": "lamp: radiance", "rough": "bulb: radiance"})
    for result, scale in ((mixed, "range"), (ranged, "unit"), (one_kind, "unit")):
        assert note not in all_text(plot_bars(result, scale=scale))
        assert note not in table_text(result, scale=scale)


def test_titles_do_not_conclude_where_an_effect_lost_in_the_noise_may_be_the_largest() -> None:
    _, second, third, _, _, noisy, *_ = make().ranking()
    covariance = dict(make().covariance)
    # The errors become 30, 3 and 2: the one that reaches furthest is named first.
    for row, said in (
        (second, f"the error of {second.label} is too large"),
        (noisy, f"the errors of {noisy.label} and {second.label} are too large"),
        (third, f"the errors of {noisy.label} and 2 others are too large"),
    ):
        covariance[row.name] = 1e6 * covariance[row.name]
        found = finding(dataclasses.replace(make(), covariance=covariance))
        assert found == f"Glare: which effect is largest is uncertain; {said}"


def of_effects(*effects: tuple[float, float]) -> SceneAttribution:
    """Return a result of single numbers with these effects and standard errors, by 8 replicates."""
    names = ["wall", "lamp", "floor", *(f"other {number}" for number in range(len(effects)))][: len(effects)]
    return dataclasses.replace(
        make(replicates=8),
        attributions={name: torch.tensor(effect) for name, (effect, _) in zip(names, effects, strict=True)},
        covariance={
            name: torch.tensor([[error**2]]) for name, (_, error) in zip(names, effects, strict=True)
        },
        labels={},
    )


@pytest.mark.parametrize(
    ("effects", "said"),
    [
        (
            [(2.34, 0.25), (1.82, 0.06), (-1.7, 0.6), (0.2, 0.04), (0.1, 0.02), (0.05, 0.01)],
            "Glare: which effect is largest is uncertain; the error of floor is too large",
        ),
        ([(-8.3, 3.1), (2.2, 1.0), (2.1, 2.2)], "Glare: no effect is clear enough to rank"),
        # The floor may be the largest, and the lamp, which is above it, is not.
        ([(10.0, 0.1), (9.0, 0.05), (8.9, 1.0)], "Glare depends most on wall, lamp and others"),
        ([(10.0, 0.1), (9.0, 0.05), (1.0, 0.3)], "Glare depends most on wall"),
    ],
    ids=str,
)
def test_titles_name_what_an_explanation_ranks_and_none_below_an_unnamed_one(
    effects: list[tuple[float, float]], said: str
) -> None:
    assert finding(of_effects(*effects)) == said


def test_a_render_is_denoised_where_the_metric_image_was() -> None:
    figure = plot_heatmap(make())
    assert "render" in figure.axes[0].get_title()
    denoised = plot_heatmap(make(picture={"denoised": True}))
    for_the_eye = plot_heatmap(make(), denoised=True)
    for other in (denoised, for_the_eye):
        assert other.axes[0].get_title() == "render, denoised"
        assert not np.allclose(other.axes[0].images[0].get_array(), figure.axes[0].images[0].get_array())
    for index in (1, 2):  # the map and its colours are the same
        assert all_text(for_the_eye.axes[index]) == all_text(figure.axes[index])
    assert np.array_equal(for_the_eye.axes[1].images[0].get_array(), figure.axes[1].images[0].get_array())


@pytest.mark.parametrize("draw", [plot_heatmap, plot_overlay])
@pytest.mark.parametrize("signed", [False, True])
def test_maps_say_of_a_rough_gradient_what_bars_say(draw: Any, signed: bool) -> None:
    def text(**info: Any) -> str:
        found = make(gradient_note="a rough gradient", advice="smooth it", **info)
        wide = {name: 1e4 * covariance for name, covariance in (found.covariance or {}).items()}
        return all_text(draw(dataclasses.replace(found, covariance=wide), signed=signed))

    assert "a rough gradient" in text()
    assert "the errors are large: smooth it" in text()
    assert "rough gradient" not in text(quantity=ResultKind.ABLATION.value)


def test_maps_of_zeros_are_labelled() -> None:
    zero = dataclasses.replace(make(), attributions={name: 0 * value for name, value in make().items()})
    assert "all effects are 0" in all_text(plot_heatmap(zero))
    assert "all effects are 0" not in all_text(plot_heatmap(make()))


def test_maps_say_what_a_texel_shows_and_a_given_maximum_has_its_unit() -> None:
    base, texel = make(measure={"name": "mean luminance", "unit": "cd/m²"}), np.arange(24, dtype=np.int32)
    texels = TexelMap(entry=texel, texel=texel % 4, weight=np.ones(24, np.float32))
    textured = dataclasses.replace(
        base,
        surfaces=dataclasses.replace(surfaces("rough", "floor"), texels={"floor": texels}),
        extents={name: torch.ones(max(value.shape[-1:], default=1)) for name, value in base.items()},
    )
    text = all_text(plot_heatmap(textured, parameter="floor", texels=True, maximum=0.5)).replace("\n", " ")
    change = "first-order change of the metric over the range of the parameter, relative to"
    assert f"floor: magnitude of the {change} 0.5 cd/m²" in text
    signed = all_text(plot_heatmap(textured, signed=True)).replace("\n", " ")
    assert change in signed
    noisy = {name: 1e6 * value for name, value in textured.covariance.items()}
    only = dataclasses.replace(textured, attributions={"floor": textured["floor"]}, covariance=noisy)
    for texels, said in (
        (True, "the sum over the texels of floor is not clear of its noise"),
        (False, "no effect is clear enough to rank"),
    ):
        title = all_text(plot_overlay(only, texels=texels)).replace("\n", " ")
        assert said in title, title
    assert "magnitude" not in signed
    assert "each texel: effect of a whole texture that acts like it" in text
    assert "each texel" not in all_text(plot_heatmap(textured, parameter="floor"))


def sized(height: int, width: int, base: SceneAttribution) -> SceneAttribution:
    pixel = np.arange(height * width, dtype=np.int32)
    shown = dataclasses.replace(
        surfaces("rough", "floor"),
        shape=(height, width),
        pixel=pixel,
        object_index=(pixel % width >= width // 2).astype(np.int32),
        fraction=np.ones(height * width, np.float32),
    )
    return dataclasses.replace(base, image=torch.ones(height, width, 3), surfaces=shown)


@pytest.mark.parametrize("shape", [(9, 16), (16, 16), (16, 9)], ids=str)
def test_no_text_of_a_map_is_cut_off(shape: tuple[int, int]) -> None:
    for attribution in (make(), lengthy()):
        for figure in (plot_heatmap(sized(*shape, attribution)), plot_overlay(sized(*shape, attribution))):
            assert outside(figure) == []
            assert figure.get_figwidth() < 7.3


def test_signed_maps_diverge_from_white_to_the_colours_of_the_bars() -> None:
    from matplotlib.colors import to_rgb

    attribution = make()
    figure = plot_heatmap(attribution, signed=True)
    mapped = figure.axes[1].images[0]
    np.testing.assert_allclose(mapped.get_array(), attribution.heatmap(signed=True))
    assert mapped.get_array().min() < 0
    np.testing.assert_allclose(mapped.norm([-1, -0.5, 0, 0.5, 1]), [0, 0.25, 0.5, 0.75, 1])
    low, middle, high = (np.array(mapped.cmap(x)[:3]) for x in (1 / 6, 0.5, 5 / 6))
    assert middle.min() > 0.95
    # The map has 256 colours, and the nearest to a sixth is not exactly there.
    np.testing.assert_allclose([low, high], [to_rgb(LOWERS), to_rgb(RAISES)], atol=0.02)


@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize("plot", [plot_heatmap, plot_overlay])
def test_maps_say_which_errors_may_be_too_small(
    monkeypatch: pytest.MonkeyPatch, plot: Any, signed: bool
) -> None:
    monkeypatch.setattr(SceneAttribution, "untrusted_errors", lambda _: {"rough": "few", "lamp": "none"})
    figure = plot(sized(9, 16, make()), signed=signed)
    assert "errors may be too small: few (desk: roughness)" in all_text(figure)
    assert "errors may be too small: none (lamp)" in all_text(figure)
    assert "?" not in all_text(figure), "no object has a mark"
    assert outside(figure) == []
    for selected in ("rough", "rou*"):
        one = all_text(plot(make(), signed=signed, parameter=selected))
        assert "too small: few (desk: roughness)" in one
        assert "too small: none" not in one
    monkeypatch.setattr(
        SceneAttribution, "untrusted_errors", lambda _: dict.fromkeys(["tiny", "rough", "lamp"], "few")
    )
    assert "few (lamp; desk: roughness; tiny)" in all_text(plot(make(), signed=signed)), "the largest first"


def test_a_signed_map_says_what_its_colours_mean() -> None:
    assert "blue raises the metric, orange lowers it" in all_text(plot_overlay(make(), signed=True))


def test_lightness_of_colour_maps_follows_the_magnitude() -> None:
    from kornia.color import rgb_to_lab

    def lightness(colors: Any, at: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        rgb = torch.tensor(colors(at)[:, :3], dtype=torch.float32).T.reshape(3, 1, -1)
        return rgb_to_lab(rgb)[0, 0].numpy()

    magnitude = plot_heatmap(make()).axes[1].images[0].cmap
    assert (np.diff(lightness(magnitude, np.linspace(0, 1, 40))) > 0).all()
    negative = lightness(diverging(), np.linspace(0, 0.5, 20))
    positive = lightness(diverging(), np.linspace(1, 0.5, 20))
    assert (np.diff(negative) > 0).all()
    assert (np.diff(positive) > 0).all()
    assert np.abs(negative - positive).max() < 12  # neither sign looks stronger


# -- luminance -------------------------------------------------------------------------------------------


def glaring() -> tuple[torch.Tensor, metrics.UnifiedGlareRating]:
    """A dim grey picture with two lamps, the smaller one brighter."""
    image = torch.full((24, 36, 3), 0.1)
    image[4:8, 5:15] = 20.0
    image[16:18, 28:31] = 60.0
    camera = Camera.perspective(36, 24, 60.0)
    return image, metrics.UnifiedGlareRating(camera, threshold=1000.0, relaxation=0.0)


def test_luminance_is_in_candela_on_a_logarithmic_scale() -> None:
    from matplotlib.colors import LogNorm

    image, _ = glaring()
    figure = metrics.plot_luminance(image)
    picture, bar = figure.axes
    (shown,) = picture.images
    np.testing.assert_allclose(shown.get_array(), 179 * metrics.luminance(image), rtol=1e-5)
    assert isinstance(shown.norm, LogNorm)
    assert (shown.norm.vmin, shown.norm.vmax) == (10, 20000)
    assert "luminance in cd/m²" in all_text(figure)
    figure.canvas.draw()
    written = [label.get_text() for label in bar.get_yticklabels()]
    assert "1\u202f000" in written
    assert f"{179 * float(metrics.luminance(image).mean()):.4g} cd/m²" in all_text(figure)


def test_an_efficacy_and_limits_can_be_given() -> None:
    figure = metrics.plot_luminance(torch.ones(4, 6, 3), efficacy=100.0, limits=(1.0, 1000.0))
    (shown,) = figure.axes[0].images
    np.testing.assert_allclose(shown.get_array(), 100.0, rtol=1e-5)
    assert (shown.norm.vmin, shown.norm.vmax) == (1, 1000)
    for limits in ((0.0, 1.0), (2.0, 1.0), (1.0, math.inf)):
        with pytest.raises(SceneCaptumError, match="limits must be two increasing positive luminances"):
            metrics.plot_luminance(torch.ones(4, 6, 3), limits=limits)


@pytest.mark.parametrize("fill", [0.0, 1e-30, 5.0, 1e30])
def test_any_image_has_a_scale(fill: float) -> None:
    figure = metrics.plot_luminance(torch.full((4, 6, 3), fill))
    figure.canvas.draw()
    norm = figure.axes[0].images[0].norm
    assert 0 < norm.vmin < norm.vmax < math.inf


def test_black_is_dark_and_nan_is_grey() -> None:
    image = torch.full((4, 6, 3), 1.0)
    image[0, 0], image[1, 1] = 0.0, math.nan
    (shown,) = metrics.plot_luminance(image).axes[0].images
    array = shown.get_array()
    assert array.mask.sum() == 1
    assert array.mask[1, 1]
    assert array[0, 0] < shown.norm.vmin


def test_sources_are_outlined_numbered_and_listed() -> None:
    from matplotlib.collections import LineCollection

    image, rating = glaring()
    figure = metrics.plot_luminance(image, rating)
    picture = figure.axes[0]
    lines = [one for one in picture.collections if isinstance(one, LineCollection)]
    assert len(lines) == 2  # white on black
    for drawn in lines:
        # Each edge of each pixel at a border: twice (4 + 10) of the large lamp and (2 + 3) of the small one.
        segments = np.array(drawn.get_segments())
        assert len(segments) == 2 * (4 + 10) + 2 * (2 + 3)
        large = segments[segments[..., 0].max(1) < 20].reshape(-1, 2)
        assert (large.min(0).tolist(), large.max(0).tolist()) == ([4.5, 3.5], [14.5, 7.5])
    first, second = rating.sources(image)
    placed = {text.get_text(): text.xy for text in picture.texts if text.get_text() in ("1", "2")}
    assert placed["1"] == pytest.approx((29, 16.5), abs=0.3)
    assert placed["2"] == pytest.approx((9.5, 5.5), abs=0.3)
    text = all_text(figure)
    assert f"UGR = {float(rating(image)):.4g}" in text
    assert "2 glare sources" in text
    assert f"1   10\u202f740 cd/m², {first.solid_angle:.3g} sr" in text
    assert f"2   3\u202f580 cd/m², {second.solid_angle:.3g} sr" in text
    assert outside(figure) == []


def test_one_source_none_and_many() -> None:
    image, rating = glaring()
    image[16:18, 28:31] = 0.1
    assert "1 glare source," in all_text(metrics.plot_luminance(image, rating))
    assert "no glare source" in all_text(metrics.plot_luminance(image / 1000, rating))
    pixels = metrics.UnifiedGlareRating(rating.camera, threshold=1000.0, grouping="pixel", relaxation=0.0)
    figure = metrics.plot_luminance(image, pixels)
    assert "40 glare sources" in all_text(figure)
    assert "each pixel above the threshold is a separate source" in all_text(figure)
    assert {text.get_text() for text in figure.axes[0].texts}.isdisjoint("12345678")
    # Neighbours are not outlined against each other.
    assert len(figure.axes[0].collections[0].get_segments()) == 2 * (4 + 10)


def test_pixels_outside_a_fisheye_are_grey() -> None:
    camera = Camera.fisheye(16, 16)
    (shown,) = metrics.plot_luminance(torch.ones(16, 16, 3), camera).axes[0].images
    unseen = (camera.solid_angles == 0).numpy()
    assert unseen.any()
    np.testing.assert_array_equal(np.ma.getmaskarray(shown.get_array()), unseen)


def test_an_image_of_another_camera_is_refused() -> None:
    _, rating = glaring()
    with pytest.raises(SceneCaptumError, match=r"\(5, 7\).*\(24, 36\)"):
        metrics.plot_luminance(torch.ones(5, 7, 3), rating)


# -- rank comparison -------------------------------------------------------------------------------------


def ranked(order: str, **info: Any) -> SceneAttribution:
    """Attribute to one-letter parameters, the first the most salient."""
    values = {name: torch.tensor(float(len(order) - place)) for place, name in enumerate(order)}
    return SceneAttribution({name: values[name] for name in sorted(order)}, None, 1.0, info=info)


def ends(figure: Any) -> dict[str, tuple[float, float]]:
    """Return each line's left and right rank, by its label."""
    axes = figure.axes[0]
    written = [text for text in axes.texts if text.xy[0] == 0 and text.get_text() in "abcdefgh"]
    names = {text.xy[1]: text.get_text() for text in written}
    lines = [line for line in axes.lines if line.get_marker() == "o"]
    return {names[line.get_ydata()[0]]: tuple(line.get_ydata()) for line in lines}


def test_lines_show_which_parameters_rise_and_fall() -> None:
    figure = plot_rank_comparison(ranked("abcde", metric="First"), ranked("cabed", metric="Second"))
    assert ends(figure) == {"a": (1, 2), "b": (2, 3), "c": (3, 1), "d": (4, 5), "e": (5, 4)}
    lines = [line for line in figure.axes[0].lines if line.get_marker() == "o"]
    assert hexes(line.get_color() for line in lines) == [LOWERS, LOWERS, RAISES, LOWERS, RAISES]
    assert "Kendall's τ = 0.40" in all_text(figure)  # 7 pairs alike, 3 not
    assert {"First", "Second"} <= set(all_text(figure).splitlines())
    same = plot_rank_comparison(ranked("ab", metric="First"), ranked("ab", metric="Second"))
    assert hexes(line.get_color() for line in same.axes[0].lines) == [UNCLEAR, UNCLEAR]
    differences = [f"smoothed logit of {shape} minus that of cone" for shape in ("cube", "ball")]
    alike = plot_rank_comparison(*(ranked("ab", metric=name) for name in differences))
    headers = {text.get_text() for text in alike.axes[0].texts if text.get_fontweight() == "bold"}
    assert len(headers) == 2


def test_the_top_of_either_ranking_is_shown_with_its_ranks() -> None:
    figure = plot_rank_comparison(ranked("abcdefgh"), ranked("hbacdefg"), top=2)
    assert ends(figure) == {"a": (1, 3), "b": (2, 2), "h": (3, 1)}
    written = {(text.xy, text.get_text()) for text in figure.axes[0].texts}
    assert ((0, 3), "8") in written
    assert ((1, 3), "3") in written
    dashed = [line for line in figure.axes[0].lines if line.get_marker() != "o"]
    assert [line.get_ydata()[0] for line in dashed] == [2.5]
    assert "5 parameters not shown" in all_text(figure)


def test_rank_changes_within_the_noise_are_dashed() -> None:
    def measured(values: dict[str, float], error: float) -> SceneAttribution:
        tensors = {name: torch.tensor(value) for name, value in values.items()}
        return SceneAttribution(
            tensors, None, 1.0, covariance={name: torch.tensor([[error**2]]) for name in values}
        )

    a = {"a": 4.0, "b": 3.0, "c": 2.9, "d": 1.0}
    b = {"a": 1.0, "b": 2.9, "c": 3.0, "d": 4.0}
    figure = plot_rank_comparison(measured(a, 0.1), measured(b, 0.1))
    lines = {
        line.get_ydata()[0]: line.is_dashed() for line in figure.axes[0].lines if line.get_marker() == "o"
    }
    # b and c swap places within the noise; a and d far beyond it.
    assert lines == {1: False, 2: True, 3: True, 4: False}
    assert "within the noise" in all_text(figure)
    figure = plot_rank_comparison(measured(a, 0.001), measured(b, 0.001))
    assert not any(line.is_dashed() for line in figure.axes[0].lines)
    assert "within the noise" not in all_text(figure)


def test_labels_of_many_parameters_do_not_overlap() -> None:
    letters = "abcdefghijklmnopqrstuvwxyzåäö"
    labels = {name: f"{name * 30}: reflectance" for name in letters}
    a, b = (dataclasses.replace(ranked(order), labels=labels) for order in (letters, letters[::-1]))
    figure = plot_rank_comparison(a, b, top=29)
    assert outside(figure) == []
    for x in (0, 1):
        boxes = [t.get_window_extent() for t in figure.axes[0].texts if t.xy[0] == x and "…" in t.get_text()]
        assert len(boxes) == 29
        boxes.sort(key=lambda box: box.y0)
        assert all(low.y1 <= high.y0 + 1 for low, high in itertools.pairwise(boxes))


def test_columns_are_named_by_what_differs() -> None:
    text = all_text(plot_rank_comparison(ranked("ab", method="Vanilla"), ranked("ba", method="Shapley")))
    assert {"Vanilla", "Shapley"} <= set(text.splitlines())
    text = all_text(plot_rank_comparison(ranked("ab", metric="First"), ranked("ba", metric="First")))
    assert {"First (first)", "First (second)"} <= set(text.splitlines())


def test_comparisons_need_parameters_in_common() -> None:
    with pytest.raises(SceneCaptumError, match=r"at least two parameters .* share 1"):
        plot_rank_comparison(ranked("ab"), ranked("bc"))
    with pytest.raises(SceneCaptumError, match="top must be a whole number of at least 1"):
        plot_rank_comparison(ranked("ab"), ranked("ba"), top=0)
    assert "2 parameters that only one" in all_text(plot_rank_comparison(ranked("abc"), ranked("bcd")))


def test_an_undefined_rank_correlation_is_noted() -> None:
    alike = dataclasses.replace(ranked("ab"), attributions={n: torch.tensor(0.0) for n in "ab"})
    assert "not defined" in all_text(plot_rank_comparison(alike, ranked("ab")))


# -- metric specificity ----------------------------------------------------------------------------------


def test_specificity_sets_bars_above_maps() -> None:
    a = make()
    b = dataclasses.replace(make(metric="Luminance"), attributions={n: -v for n, v in make().items()})
    figure = plot_specificity([a, b], top=3)
    left, right, under_left, under_right, _ = figure.axes
    figure.canvas.draw()
    for axes, one in ((left, a), (right, b)):
        assert [bar.get_width() for bar in axes.patches] == [row.saliency for row in one.ranking(3)]
    assert hexes(bar.get_facecolor() for bar in left.patches) == [RAISES, UNCLEAR, LOWERS]
    assert hexes(bar.get_facecolor() for bar in right.patches) == [LOWERS, UNCLEAR, RAISES]
    np.testing.assert_allclose(under_left.images[0].get_array(), a.heatmap())
    np.testing.assert_allclose(under_right.images[0].get_array(), b.heatmap())
    for above, below in ((left, under_left), (right, under_right)):
        assert above.get_window_extent().y0 > below.get_window_extent().y1
    assert under_left.get_window_extent().x1 < under_right.get_window_extent().x0
    text = all_text(figure)
    assert "Glare = 2.3369 ± 0.0005" in text
    assert "Luminance = 2.3369 ± 0.0005" in text
    assert "in each" in text
    assert outside(figure) == []


def test_specificity_names_the_methods_where_they_differ() -> None:
    methods = ["VanillaSceneGradient", "IntegratedGradientsScene", "FeatureAblationScene"]
    figure = plot_specificity([make(method=method) for method in methods])
    titles = [axes.texts[-1].get_text() for axes in figure.axes[:3]]
    assert [title.split("\n")[0] for title in titles] == methods
    assert outside(figure) == []
    assert methods[0] not in all_text(plot_specificity([make(), make(metric="Luminance")]))


def test_specificity_names_a_shared_metric_once_and_gives_each_bar_its_height() -> None:
    name = "unified glare rating of the reading room"
    columns = [
        make(method="VanillaSceneGradient", measure={"name": name}),
        make(method="IntegratedGradientsScene", measure={"name": name}, quantity="contribution"),
        make(method="FeatureAblationScene", measure={"name": name}, quantity="effect of ablation"),
    ]
    figure = plot_specificity(columns, signed=True)
    assert all_text(figure).count("unified glare rating") == 1
    assert f"{name} = 2.3369 ± 0.0005" in all_text(figure)
    assert "the metric depends most on lamp" in " ".join(all_text(figure).split())
    assert outside(figure) == []
    for shown in (figure, plot_specificity(columns[:1]), plot_specificity([make(), lengthy(), make()])):
        inches = shown.axes[0].get_window_extent().height / shown.dpi
        assert inches / len(CASES) > 0.15
    # Of one metric with two values, each column has its own.
    other = dataclasses.replace(columns[0], metric_value=3.0)
    text = " ".join(all_text(plot_specificity([columns[0], other])).split())
    assert text.count("unified glare rating") == 1
    assert "the metric depends most on lamp 2.3369 ± 0.0005" in text
    assert "the metric depends most on lamp 3.0000 ± 0.0005" in text


def test_specificity_takes_one_attribution_or_a_figure_and_marks_doubt() -> None:
    from matplotlib.figure import Figure

    own = Figure(figsize=(6, 6), layout="constrained")
    part = own.subfigures(1, 2)[0]
    assert plot_specificity([make(cautions={"lamp": "off"})], figure=part) is own
    assert "! known to be inaccurate" in all_text(own)
    with pytest.raises(SceneCaptumError, match="at least one"):
        plot_specificity([])


def test_specificity_has_the_cautions_of_its_columns() -> None:
    caution = {"caution": "the picture is noisy"}
    good = {"convergence": "adds up", "explained": 1.0}
    bad = dataclasses.replace(
        make(metric="Luminance", convergence="does not add up", explained=1.0, picture=caution),
        convergence_delta=0.2,
        convergence_delta_error=0.01,
    )
    fine = dataclasses.replace(
        make(picture=caution, **good), convergence_delta=0.0, convergence_delta_error=0.01
    )

    def text_of(*columns: SceneAttribution) -> str:
        figure = plot_specificity(columns, top=3)
        assert outside(figure) == []
        return " ".join(all_text(figure).split())

    text = text_of(fine, bad)
    assert text.count("error bars: ± 1 standard error") == 1
    assert text.count("caution: the picture is noisy") == 1
    assert "Luminance: caution" not in text
    assert "Luminance: does not add up: delta 0.200 ± 0.010 of 1.00" in text
    assert " adds up" not in text
    # Only one of them has error bars, or is of a noisy picture; and of one metric by two methods, or by one.
    assert "Glare: error bars: ± 1" in text_of(make(), make(barred=False, metric="Luminance"))
    assert "Other: caution: the picture" in text_of(make(), make(method="Other", picture=caution))
    assert "column 2: caution: the picture" in text_of(make(), make(picture=caution))
    assert "column 1, column 3: caution: the picture" in text_of(fine, make(), fine)
    assert "standard error" not in text_of(make(barred=False), make(barred=False))


def test_specificity_says_of_each_column_what_its_gradient_is_and_which_errors_are_unreliable(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rough = make(metric="Logit", gradient_note="effects of a rough gradient", advice="smooth it")
    rough = dataclasses.replace(rough, covariance={n: 100 * v for n, v in rough.covariance.items()})
    few = {"Glare": {"lamp": "few samples"}, "Logit": {"lamp": "few samples", "floor": "none"}}
    monkeypatch.setattr(SceneAttribution, "untrusted_errors", lambda one: few[one.info["metric"]])
    text = " ".join(all_text(plot_specificity([make(), rough], top=5)).split())
    assert "Logit: effects of a rough gradient" in text
    assert "Logit: the errors are large: smooth it" in text
    assert "Glare: " not in text
    assert text.count("? few samples (lamp)") == 1, "of both"
    assert "Logit: ? none (floor)" in text
    assert "? none (floor)" in " ".join(all_text(plot_specificity([rough], top=5)).split())


def test_specificity_says_which_derivatives_are_known_to_be_wrong() -> None:
    cautioned = make(cautions={"rough": "its size is off", "tiny": "its sign is off"})
    text = " ".join(all_text(plot_specificity([cautioned, make(metric="Luminance")], top=5)).split())
    assert text.count("! its size is off (desk: roughness)") == 1
    assert "its sign is off" not in text, "it is not shown"


def test_no_text_of_many_columns_is_cut_off() -> None:
    assert outside(plot_specificity([make(), lengthy(), make(barred=False)])) == []


def test_maps_can_share_a_scale() -> None:
    weak = dataclasses.replace(make(), attributions={n: v / 4 for n, v in make().items()})
    figure = plot_specificity([make(), weak], shared=True)
    strong_map, weak_map = (axes.images[0].get_array() for axes in figure.axes[2:4])
    np.testing.assert_allclose(weak_map, strong_map / 2, rtol=1e-5)  # the square root of a quarter
    assert "of all" in all_text(figure)


def test_figures_leave_global_state_alone() -> None:
    import matplotlib
    from matplotlib._pylab_helpers import Gcf

    before, managed = dict(matplotlib.rcParams), len(Gcf.figs)
    image, rating = glaring()
    for figure in (
        plot_overlay(make()),
        metrics.plot_luminance(image, rating),
        plot_rank_comparison(ranked("ab"), ranked("ba")),
        plot_specificity([make()]),
    ):
        assert figure._repr_png_().startswith(b"\x89PNG")  # type: ignore[attr-defined]
    assert dict(matplotlib.rcParams) == before
    assert len(Gcf.figs) == managed


def test_the_example_draws_every_figure(mi: Any, tmp_path: Path) -> None:
    from PIL import Image

    path = Path(__file__).parents[2] / "examples" / "figures.py"
    spec = importlib.util.spec_from_file_location("figures", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.main(tmp_path / "new", resolution=(32, 18), spp=16)
    drawn = sorted(picture.stem for picture in (tmp_path / "new").iterdir())
    assert drawn == ["bars", "heatmap", "luminance", "overlay", "ranks", "specificity"]
    for picture in (tmp_path / "new").iterdir():
        with Image.open(picture) as shown:
            assert shown.format == "PNG"
            assert 1000 < shown.width < 1300


# ---------------------------------------------------------------------------------------- sizes and labels


def test_a_figure_has_the_size_that_is_asked_for() -> None:
    from scenecaptum.visualization import plot_bars, plot_heatmap

    attribution = make()
    assert plot_bars(attribution, figsize=(5.0, 3.0)).get_size_inches().tolist() == [5.0, 3.0]
    small, large = (plot_heatmap(attribution, figsize=(width, 8.0)) for width in (5.0, 12.0))
    assert small.get_figwidth() <= 5.0 + 1e-6
    assert 5.0 < large.get_figwidth() <= 12.0 + 1e-6


def test_a_map_whose_scale_is_the_effect_of_a_camera_says_so() -> None:
    """No pixel shows the camera, so that all of the map may be dark."""
    moved = torch.tensor(100.0)
    of_camera = dataclasses.replace(make(False), attributions={**make(False), "camera.x_fov": moved})
    note = "the largest, that of camera.x_fov, which no pixel shows"
    assert note in " ".join(all_text(plot_overlay(of_camera)).split())
    for other in (plot_overlay(make(False)), plot_overlay(of_camera, parameter="floor")):
        assert "no pixel shows" not in " ".join(all_text(other).split())


@pytest.mark.parametrize("plot", [plot_bars, plot_heatmap, plot_overlay])
def test_a_figure_in_which_its_texts_do_not_fit_is_refused(plot) -> None:
    with pytest.raises(SceneCaptumError, match=r"3\.4 inches is too narrow .* at least 4\.5"):
        plot(make(), figsize=(3.4, 3.0))


@pytest.mark.parametrize("top", [1, None])
def test_bars_that_the_texts_would_cover_are_refused(top: int | None) -> None:
    with pytest.raises(SceneCaptumError, match="is too low for its texts") as refused:
        plot_bars(make(), top, figsize=(6.0, 0.5))
    least = float(str(refused.value).split("at least ")[1].split()[0])
    figure = plot_bars(make(), top, figsize=(6.0, least))
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # of a layout that gives up
        figure.draw_without_rendering()
    (height,) = {ax.get_position().height * least for ax in figure.axes}
    assert height > 0.1


def test_axes_of_the_caller_that_are_too_low_or_cut_texts_off_warn() -> None:
    from matplotlib.figure import Figure

    with pytest.warns(UserWarning, match="height of .* too little for what they show"):
        plot_bars(make(), ax=Figure(figsize=(7.0, 1.0)).add_subplot())
    with pytest.warns(UserWarning, match="Use layout='constrained'"):
        plot_bars(make(), ax=Figure(figsize=(7.0, 2.5)).add_subplot())
    with pytest.warns(UserWarning, match="height of .* Use a larger figure, or a smaller top="):
        plot_specificity([make(), make(method="Other")], figure=Figure(figsize=(12, 3), layout="constrained"))
    first, second = Figure(figsize=(7.0, 5.0), layout="constrained").subplots(2, 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plot_bars(make(), ax=first)
    with pytest.warns(UserWarning, match="too little for what they show"):  # the first, beside the second
        plot_bars(make(), 1, ax=second)
    left, _ = Figure(figsize=(2.4, 7.0), layout="constrained").subplots(1, 2)
    with pytest.warns(UserWarning, match=r"width of .* needs 0\.8\. Use a larger figure, or a smaller top="):
        plot_bars(make(), ax=left, captions=False)
    left, _ = Figure(figsize=(3.0, 3.5), layout="constrained").subplots(1, 2)
    with pytest.warns(UserWarning, match="Use a larger figure, or captions=False, or a smaller top="):
        plot_bars(make(), ax=left)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plot_bars(make(), ax=Figure(figsize=(7.0, 5.0), layout="constrained").add_subplot())


def test_bars_beside_each_other_on_a_page_have_room_for_their_names_and_signs() -> None:
    """Long names and texts leave less than half of a panel to its bars only where it is very narrow."""
    from matplotlib.figure import Figure

    signed = make()
    labels = {name: f"a long name of a panel: {name} reflectance" for name in signed}
    signed = dataclasses.replace(signed, labels=labels)
    page = Figure(figsize=(7.0, 6.0), layout="constrained")
    panels = page.subplots(2, 2).flatten()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for ax in panels:
            plot_bars(signed, ax=ax, captions=False)
    page.draw_without_rendering()
    for ax in panels:
        assert ax.bbox.width / page.dpi > 1.2
        left_of_bars = max(label.get_window_extent().x1 for label in ax.get_yticklabels())
        assert all(
            text.get_window_extent().x0 > left_of_bars for text in ax.texts if text.get_text() in "+−±"
        )


@pytest.mark.parametrize("plot", [plot_bars, plot_heatmap, plot_overlay])
def test_captions_are_left_to_the_text_around_the_figure(plot) -> None:
    from matplotlib.figure import Figure

    def titles(figure: Figure) -> list[str]:
        return [ax.get_title(side) for ax in figure.axes for side in ("left", "center")]

    page = Figure(figsize=(7.0, 3.0), layout="constrained")
    own, other = page.subplots(1, 2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert plot(make(), ax=own, captions=False) is page
        plot_bars(make(), ax=other, captions=False)
    assert not any(titles(page))
    figure = plot(make(), captions=False)
    assert not any(text.get_text() for text in figure.texts)
    assert {*titles(figure)} <= {"", "render", "render, denoised"}
    assert "VanillaSceneGradient" in all_text(plot(make()))
    assert "VanillaSceneGradient" not in all_text(figure)


@pytest.mark.parametrize("before", [True, False])
def test_a_panel_without_captions_keeps_the_title_of_its_caller(before) -> None:
    """Nothing stands where the title is, whether the caller writes it before the plot or after it."""
    from matplotlib.figure import Figure

    page = Figure(figsize=(7.0, 3.0), layout="constrained")
    plots = dict(zip((plot_bars, plot_overlay, plot_heatmap), page.subplots(1, 3), strict=True))
    if before:
        for plot, ax in plots.items():
            ax.set_title(plot.__name__)
    for plot, ax in plots.items():
        plot(make(), ax=ax, captions=False)
    if not before:
        for plot, ax in plots.items():
            ax.set_title(plot.__name__)
    page.draw_without_rendering()
    assert [ax.get_title() for ax in plots.values()] == [plot.__name__ for plot in plots]
    legend = plots[plot_bars].get_legend().get_window_extent()
    assert legend.y1 < plots[plot_bars].xaxis.label.get_window_extent().y0
    assert page.bbox.x0 <= legend.x0
    assert page.bbox.y0 <= legend.y0


@pytest.mark.parametrize("figsize", [(7.0, 3.0), (6.0, 3.0), (5.0, 3.0), (3.5, 3.0)])
def test_the_caption_of_a_map_alone_on_a_low_page_is_whole(figsize) -> None:
    from matplotlib.figure import Figure

    page = Figure(figsize=figsize, layout="constrained")
    ax = page.add_subplot()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plot_overlay(make(), ax=ax, signed=True)
        page.draw_without_rendering()
    caption = ax.title.get_window_extent()
    assert page.bbox.x0 <= caption.x0
    assert caption.x1 <= page.bbox.x1
    assert caption.y1 <= page.bbox.y1
    assert caption.y0 >= ax.bbox.y1
    assert ax.bbox.height > 0.4 * page.bbox.height


@pytest.mark.parametrize("ratios", [(1, 1), (3, 1)])
def test_the_title_of_a_map_in_a_column_of_a_page_stays_in_it(ratios: tuple[int, int]) -> None:
    from matplotlib.figure import Figure

    page = Figure(figsize=(9.0, 4.0), layout="constrained")
    left, right = page.subplots(1, 2, width_ratios=ratios)
    plot_bars(make(), ax=left)
    plot_heatmap(make(), ax=right, signed=True)
    page.draw_without_rendering()
    title = right.title.get_window_extent()
    assert left.bbox.x1 < title.x0 < title.x1 <= page.bbox.x1


@pytest.mark.parametrize("high", [0.12, 0.3, 0.6, 2.0, 30.0, 5e3, 1e6])
def test_labels_of_a_logarithmic_axis_do_not_overlap(high: float) -> None:
    from scenecaptum.visualization import SMALL, log_axis, new_figure

    figure = new_figure(3.6, 2.0)
    ax = figure.add_subplot()
    ax.tick_params(labelsize=SMALL)
    log_axis(ax, "x", 0.1, high)
    figure.canvas.draw()
    low, top = ax.get_xlim()
    labels = [
        label
        for label, place in zip(ax.get_xticklabels(), ax.get_xticks(), strict=True)
        if low <= place <= top
    ]
    boxes = [label.get_window_extent() for label in labels if label.get_text()]
    assert len(boxes) >= 2
    assert not any(left.overlaps(right) for left, right in itertools.pairwise(boxes))
    assert all("10^" not in label.get_text() for label in labels)
