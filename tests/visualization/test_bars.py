"""Bars, and saliency maps beside the render, on results made by hand: nothing is rendered."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch
from results import CASES, all_text, make, outside, surfaces

from scenecaptum import SceneAttribution, SceneCaptumError
from scenecaptum.projection import objects_of_unclear_sign
from scenecaptum.visualization import (
    LOWERS,
    RAISES,
    UNCLEAR,
    color_of,
    display_image,
    light_notes,
    plot_bars,
    plot_heatmap,
    plot_overlay,
    plot_specificity,
)
from scenecaptum.visualization._finding import finding


def whiskers(axes: Any) -> list[float]:
    """The half-lengths of the whiskers, by bar."""
    from matplotlib.container import ErrorbarContainer

    lengths = []
    for container in axes.containers:
        if isinstance(container, ErrorbarContainer):
            (lines,) = container.lines[2]
            lengths += [float(segment[1, 0] - segment[0, 0]) / 2 for segment in lines.get_segments()]
    return lengths


def test_bars_show_order_sign_and_error() -> None:
    from matplotlib.colors import to_hex
    from matplotlib.figure import Figure

    attribution = make()
    figure = plot_bars(attribution)
    assert isinstance(figure, Figure)
    (axes,) = figure.axes
    ranking = attribution.ranking()
    assert [bar.get_width() for bar in axes.patches] == [row.saliency for row in ranking]
    assert axes.yaxis.get_inverted()  # the first bar, at 0, is on top
    assert [to_hex(bar.get_facecolor()).upper() for bar in axes.patches] == [c for *_, c in CASES]
    assert whiskers(axes) == pytest.approx([row.saliency_error for row in ranking], rel=1e-4, abs=1e-9)
    text = all_text(figure)
    for said in ("Glare", "VanillaSceneGradient", "per unit of the parameter", "lowers", "raises"):
        assert said in text


def test_omitted_bars_and_missing_whiskers_are_noted() -> None:
    figure = plot_bars(make(barred=False), top=3)
    (axes,) = figure.axes
    assert len(axes.patches) == 3
    assert whiskers(axes) == []
    assert "5 parameters with smaller effects not shown" in all_text(figure)
    assert "no error bars: 1 replicate" in all_text(figure)
    assert "not shown" not in all_text(plot_bars(make(), top=None))


def test_effects_of_a_relaxed_value_are_called_so() -> None:
    found = make()
    relaxed = dataclasses.replace(found, info={**found.info, "relaxed": True})
    for one, is_said in ((relaxed, True), (found, False)):
        for text in (str(one), all_text(plot_bars(one))):
            assert ("change of relaxed" in " ".join(text.split())) is is_said


def test_a_light_that_is_off_has_its_number_in_place_of_a_bar() -> None:
    rows = [("lamp", -50.0, 0.0), ("desk", 1.0, 0.5), ("wall", -0.5, 0.5)]
    on = of_values(*rows, errors=0.1)
    off = dataclasses.replace(on, info={**on.info, "lights_off": ["lamp"]})
    figure = plot_bars(off)
    (axes,) = figure.axes
    assert [bar.get_width() for bar in axes.patches] == [1.0, -0.5, 0.0]
    assert whiskers(axes)[-1] == 0
    assert [label.get_text() for label in axes.get_yticklabels()] == ["desk", "wall", "~ lamp"]
    text = " ".join(all_text(figure).split())
    assert "−50.00 ± 0.10" in text
    assert "Glare depends most on desk" in text
    assert "so ranked last, without a bar or a colour" in text
    assert outside(figure) == []
    first = " ".join(all_text(plot_bars(off, top=1)).split())
    assert "1 parameter with smaller effects not shown" in first
    assert "so ranked last" in first
    assert plot_bars(on).axes[0].patches[0].get_width() == -50


def test_bars_of_lights_have_the_note_of_a_metric_that_is_not_linear_in_the_light() -> None:
    note = "effects of lights are to first order: Glare is not linear in the light"
    found = of_values(("lamp", -50.0, 0.0), ("desk", 1.0, 0.5), errors=0.1)
    lit = dataclasses.replace(found, info={**found.info, "lights_on": ["lamp"]})
    figure = plot_bars(lit)
    assert note in " ".join(all_text(figure).split())
    assert outside(figure) == []
    for seen, groups in ((lit.surfaces, "object"), (None, "material")):
        (line,) = light_notes(dataclasses.replace(lit, surfaces=seen), lit.ranking())
        assert f'groups="{groups}"' in line, "a sensor grid has no objects to group by"
    with_sky = of_values(("sky", -900.0, 0.0), ("lamp", -50.0, 0.0), errors=0.1)
    dark = {**with_sky.info, "lights_on": ["lamp"], "lights_off": ["sky"]}
    assert note in " ".join(all_text(plot_bars(dataclasses.replace(with_sky, info=dark))).split())
    linear = dataclasses.replace(lit, info={**lit.info, "linear_in_light": True})
    for other in (found, linear):
        assert note not in " ".join(all_text(plot_bars(other)).split())
    for two in (lit - 0.5 * found, lit + lit):
        assert "effects of lights are to first order" in " ".join(all_text(plot_bars(two)).split()), (
            "of a difference or a mean, too"
        )


def test_bars_of_doubtful_derivatives_are_hatched() -> None:
    figure = plot_bars(make(cautions={"rough": "its size is off"}))
    hatched = [bool(bar.get_hatch()) for bar in figure.axes[0].patches]
    assert hatched == [name == "rough" for name, *_ in CASES]
    assert "! desk: roughness" in all_text(figure)
    assert "its size is off" in all_text(figure)


def test_bars_name_their_unreliable_errors_if_they_are_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    doubts = {"rough": "few samples", "wall": "none", "tiny": "none", "noisy": "not shown at all"}
    monkeypatch.setattr(SceneAttribution, "untrusted_errors", lambda _: doubts)
    figure = plot_bars(make(), top=5)
    text = " ".join(all_text(figure).split())
    assert "? few samples (desk: roughness)" in text
    assert "? none (wall; tiny, 1 of them not shown)" in text
    assert "not shown at all" not in text
    names = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert names == ["lamp", "two_minds", "floor", "? desk: roughness", "? wall"]
    assert outside(figure) == []
    both = " ".join(all_text(plot_specificity([make(), make(method="Other")], top=5)).split())
    assert both.count("? few samples (desk: roughness)") == 1
    # If all are, it is said once.
    monkeypatch.setattr(SceneAttribution, "untrusted_errors", lambda one: dict.fromkeys(one, "few"))
    figure = plot_bars(make(), top=5)
    assert "all parameters: few" in all_text(figure)
    assert "?" not in all_text(figure)
    both = all_text(plot_specificity([make(), make(method="Other")], top=5))
    assert "all parameters: few" in both
    assert "?" not in both


def of_values(*rows: tuple[str, float, float], errors: float = 0.01) -> SceneAttribution:
    """A result with the effect and the value of each row; one of a low roughness has a note."""
    base = make()
    return dataclasses.replace(
        base,
        attributions={name: torch.tensor(effect) for name, effect, _ in rows},
        covariance={name: torch.tensor([[errors**2]]) for name, *_ in rows},
        standard_error={name: torch.tensor(errors) for name, *_ in rows},
        parameter_values={name: torch.tensor(value) for name, _, value in rows},
        extents={name: torch.ones(1) for name, *_ in rows},
        labels={},
        surfaces=surfaces(rows[0][0], rows[-1][0]),
    )


METAL, DESK = ("metal.alpha", 3.0, 0.02), ("desk.reflectance", 1.0, 0.5)
NOTE = "~ metal.alpha: a small roughness often acts most near 0"


@pytest.mark.parametrize("draw", [plot_bars, plot_heatmap, plot_overlay])
def test_no_title_names_an_effect_that_may_be_far_off(draw: Any) -> None:
    text = all_text(draw(of_values(METAL, DESK)))
    joined = " ".join(text.split())
    assert "Glare depends most on desk.reflectance, effects marked ~ aside" in joined
    assert NOTE in joined
    assert "may be far off" in joined
    rough = " ".join(all_text(draw(of_values(("metal.alpha", 3.0, 0.5), DESK))).split())
    assert "Glare depends most on metal.alpha" in rough
    assert "~" not in rough
    smaller = " ".join(all_text(draw(of_values(METAL, ("desk.reflectance", 4.0, 0.5)))).split())
    assert "Glare depends most on desk.reflectance" in smaller
    assert "aside" not in smaller
    assert ("~" in smaller) == (draw is plot_bars), "a map has no marks"


def test_a_clear_effect_with_a_mark_is_not_called_uncertain() -> None:
    """The largest is clear, though it may be far off; of the others one in the noise may be the largest."""
    result = of_values(METAL, ("desk.reflectance", 1.0, 0.5), ("wall.reflectance", 0.8, 0.5))
    covariance = {**result.covariance, "wall.reflectance": torch.tensor([[2.0**2]])}
    said = finding(dataclasses.replace(result, covariance=covariance))
    aside = "effects marked ~ aside, which is largest is uncertain"
    assert said == f"Glare: {aside}; the error of wall.reflectance is too large"


def test_a_mark_on_an_effect_that_may_be_the_largest_is_in_the_title() -> None:
    result = of_values(METAL, ("desk.reflectance", 4.0, 0.1))
    assert finding(result) == "Glare depends most on desk.reflectance"
    noisy = dataclasses.replace(
        result,
        covariance={**result.covariance, METAL[0]: torch.tensor([[2.0**2]])},
        info={**result.info, "noisy_roughness": [METAL[0]]},
    )
    assert finding(noisy) == "Glare depends most on desk.reflectance, effects marked ~ aside"


@pytest.mark.parametrize("draw", [plot_heatmap, plot_overlay])
def test_a_map_says_which_derivatives_are_known_to_be_wrong(draw: Any) -> None:
    figure = draw(make(cautions={"rough": "its size is off", "tiny": "its size is off"}))
    text = " ".join(all_text(figure).split())
    assert "its size is off (desk: roughness; tiny)" in text
    assert "!" not in text, "no object has a mark"
    assert outside(figure) == []
    other = draw(make(cautions={"rough": "its size is off"}), parameter="floor")
    assert "!" not in all_text(other)
    assert "!" not in all_text(draw(make()))


@pytest.mark.parametrize(
    "rows", [[METAL], [METAL, ("desk.reflectance", 0.01, 0.5)], [("metal.alpha", 0.0, 0.0)]]
)
def test_a_title_names_nothing_where_every_clear_effect_has_a_note(rows: Any) -> None:
    title = plot_bars(of_values(*rows)).axes[0].get_title(loc="left")
    assert "depends" not in title
    assert title.startswith("Glare: see the notes on the effects marked ~")


def test_columns_say_which_of_them_has_a_pose_without_a_derivative() -> None:
    both = [make(), make(metric="Other", jumps={"lamp": "it jumps"})]
    assert "Other: lamp is not ranked: it jumps; no derivative" in all_text(plot_specificity(both))


def test_bars_with_a_note_have_its_mark_in_every_figure() -> None:
    for figure in (plot_bars(of_values(METAL, DESK)), plot_specificity([of_values(METAL, DESK)])):
        assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == [
            "~ metal.alpha",
            "desk.reflectance",
        ]
        assert NOTE in " ".join(all_text(figure).split())
        assert outside(figure) == []
    both = of_values(METAL, DESK)
    both = dataclasses.replace(both, info={**both.info, "cautions": {"metal.alpha": "its size is off"}})
    assert "!~ metal.alpha" in all_text(plot_bars(both))
    assert "~" not in all_text(plot_bars(both, scale="unit"))


@pytest.mark.parametrize(
    ("info", "is_clear"),
    [
        ({"replicates": 8}, True),
        ({"replicates": 2}, False),
        ({"replicates": 8, "degrees_of_freedom": 1}, False),
        ({"replicates": 4}, False),  # the interval is ± 3.18 standard errors
    ],
)
def test_no_sign_is_called_known_that_the_interval_leaves_open(info: Any, is_clear: bool) -> None:
    lit, desk = ("lamp.radiance", 0.41, 0.5), ("desk.reflectance", -0.41, 0.5)
    result = of_values(lit, desk, errors=0.14)
    result = dataclasses.replace(result, info={**result.info, **info})
    low, high = result.interval(0.95)["lamp.radiance"]
    assert is_clear == (low > 0 or high < 0)
    colors = [color_of(row, result) for row in result.ranking()]
    assert colors == ([RAISES, LOWERS] if is_clear else [UNCLEAR, UNCLEAR])
    axes = plot_bars(result).axes[0]
    signs = {text.get_text() for text in axes.texts} & {"+", "−", "±"}
    assert signs == ({"+", "−"} if is_clear else {"±"})
    title = axes.get_title(loc="left")
    assert ("depends most on" in title) == is_clear
    assert ("no effect is clear enough to rank" in title) != is_clear
    assert bool(result.heatmap(signed=True).any()) == is_clear
    unclear = objects_of_unclear_sign(result)
    assert unclear == ([] if is_clear else ["left", "right"])


def test_bars_draw_into_given_axes_and_names_are_not_formulas() -> None:
    from matplotlib.figure import Figure

    figure = Figure(layout="constrained")
    axes = figure.subplots(1, 2)
    odd = dataclasses.replace(make(metric=r"$\oops{$"), labels={"lamp": r"$\frac{$"})
    assert plot_bars(odd, ax=axes[1]) is figure
    assert len(axes[1].patches) == len(CASES)
    assert not axes[0].patches
    figure.canvas.draw()


def test_bars_refuse_a_count_of_zero() -> None:
    with pytest.raises(SceneCaptumError, match="top must be a whole number of at least 1"):
        plot_bars(make(), top=0)


def test_heatmap_shows_the_saliency_beside_the_render() -> None:
    attribution = make()
    figure = plot_heatmap(attribution)
    left, right, bar = figure.axes
    np.testing.assert_allclose(left.images[0].get_array(), display_image(attribution.image))
    np.testing.assert_allclose(right.images[0].get_array(), attribution.heatmap())
    figure.canvas.draw()
    assert left.get_window_extent().size == pytest.approx(right.get_window_extent().size)
    assert bar.get_window_extent().height == pytest.approx(right.get_window_extent().height)
    assert "Glare = 2.3369 ± 0.0005" in all_text(figure)
    assert "VanillaSceneGradient" in all_text(figure)


def test_a_signed_map_counts_the_objects_whose_sign_is_lost_in_the_noise() -> None:
    def text(left: str, right: str, **options: Any) -> str:
        seen = dataclasses.replace(make(), surfaces=surfaces(left, right))
        return all_text(plot_heatmap(seen, **options)) + all_text(plot_overlay(seen, **options))

    assert "1 object in white: sign lost in the noise" in text("noisy", "floor", signed=True)
    assert "1 object without colour: sign lost in the noise" in text("noisy", "floor", signed=True)
    assert "lost in the noise" not in text("noisy", "floor")
    assert "lost in the noise" not in text("rough", "floor", signed=True)
    assert "lost in the noise" not in text("noisy", "floor", signed=True, parameter="floor")


def test_heatmap_names_salient_invisible_parameters() -> None:
    assert "not in the picture: lamp, #1" in all_text(plot_heatmap(make()))
    seen = dataclasses.replace(make(), surfaces=surfaces("lamp", "two_minds"))
    assert "not in the picture: floor, #3" in all_text(plot_heatmap(seen))
    # Invisible parameters below the first three are not listed.
    weak = {name: value for name, value in make().items() if name in ("lamp", "two_minds", "noisy")}
    first = dataclasses.replace(seen, attributions={**weak, "third": torch.tensor(0.2)}, covariance=None)
    shown = dataclasses.replace(first.surfaces, parameters=(("lamp", "third"), ("two_minds",), ()))
    assert "not in the picture" not in all_text(plot_heatmap(dataclasses.replace(first, surfaces=shown)))
    # Several are listed, and those below the first three are counted, unless their effects are negligible.
    every = dataclasses.replace(make(), surfaces=surfaces("rough", "elsewhere"))
    text = " ".join(all_text(plot_heatmap(every)).split())
    assert "#1 with an effect of +0.700 ± 0.007; two_minds, #2" in text
    assert "; floor, #3 with an effect of −0.3600 ± 0.0035; and 1 more" in text
    # A group is visible where one of its members is.
    grouped = make(groups={"lamp": ["bulb", "rough"], "two_minds": ["elsewhere"]})
    assert "not in the picture: two_minds, #2" in all_text(plot_heatmap(grouped))


def test_maps_name_what_is_seen_only_behind_glass_and_leave_out() -> None:
    """Also a noisy effect: a window that is neutral on the map may still have the largest."""
    behind = make(seen_through=["lamp", "tiny", "floor"])
    left_out = "not on the map, seen only behind glass or mirrored: lamp, #1 with an effect of +0.700 ± 0.007"
    for text in (all_text(plot(behind)).replace("\n", " ") for plot in (plot_heatmap, plot_overlay)):
        assert left_out in text
        assert "floor, #3" not in text  # also seen directly
        assert "tiny" not in text
        assert "not in the picture: two_minds, #2" in text
    assert "not on the map" not in all_text(plot_heatmap(behind, parameter="fl*"))
    assert left_out in all_text(plot_heatmap(behind, parameter="la*")).replace("\n", " ")
    through = surfaces("lamp", "floor")  # that of ``renderer.see_through()``
    assert "not on the map" not in all_text(plot_heatmap(behind, surfaces=through))
    assert behind.covariance is not None
    noisy = dataclasses.replace(behind, covariance={**behind.covariance, "lamp": 0.1 * torch.eye(3)})
    assert "behind glass or mirrored: lamp, #1" in all_text(plot_heatmap(noisy)).replace("\n", " ")


def test_the_camera_is_in_no_picture() -> None:
    result = make()
    by_name = {
        field.name: {{"lamp": "camera.pose.rotation"}.get(key, key): one for key, one in value.items()}
        for field in dataclasses.fields(result)
        if isinstance(value := getattr(result, field.name), dict) and "lamp" in value
    }
    turned = all_text(plot_heatmap(dataclasses.replace(result, **by_name)))
    assert "not in the picture: camera" not in turned
    assert "not in the picture: two_minds, #2" in turned


def test_heatmap_needs_a_surface_map() -> None:
    with pytest.raises(SceneCaptumError, match="which object each pixel shows"):
        plot_heatmap(dataclasses.replace(make(), surfaces=None))
    with pytest.raises(SceneCaptumError, match="no picture"):
        plot_heatmap(dataclasses.replace(make(), image=None))


def test_figures_leave_global_state_alone_and_show_in_notebooks() -> None:
    import matplotlib
    from matplotlib._pylab_helpers import Gcf

    before, managed = dict(matplotlib.rcParams), len(Gcf.figs)
    for figure in (plot_bars(make()), plot_heatmap(make())):
        assert figure._repr_png_().startswith(b"\x89PNG")  # type: ignore[attr-defined]
    assert dict(matplotlib.rcParams) == before
    assert len(Gcf.figs) == managed


def test_importing_and_printing_load_no_matplotlib() -> None:
    code = (
        "import sys, torch, scenecaptum.visualization as v, scenecaptum as sc\n"
        "print(sc.SceneAttribution({'a': torch.tensor(1.0)}, None, 1.0))\n"
        "assert not {'matplotlib', 'kornia', 'PIL'} & set(sys.modules), sorted(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
