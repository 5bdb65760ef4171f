"""Tables, figures and tone mapping, on results made by hand: nothing is rendered."""

from __future__ import annotations

import dataclasses
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from results import CASES, NASTY, all_text, make, surfaces
from seeds import shifted

from scenecaptum import SceneAttribution, SceneCaptumError
from scenecaptum.visualization import (
    display_image,
    plot_bars,
    plot_heatmap,
    save_render,
    table_html,
    table_text,
)
from scenecaptum.visualization._numbers import align_decimals, shorten, with_error


@pytest.fixture(autouse=True)
def terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "100")


def row_of(name: str, text: str) -> str:
    (line,) = [line for line in text.splitlines() if re.match(rf" *\d+  {re.escape(name)}", line)]
    return line


# -- numbers ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "error", "written"),
    [
        (0.09784, 0.00079, ("0.0978", "0.0008")),
        (0.09784, 0.00012, ("0.09784", "0.00012")),
        (0.5, 0.00097, ("0.5000", "0.0010")),
        (-3.14159, 0.2, ("-3.14", "0.20")),
        (1.25e-7, 2e-8, ("1.25e-7", "0.20e-7")),
        (1234567.0, 4000.0, ("1.235e6", "0.004e6")),
        (12345.6, 720.0, ("12300", "700")),
        (0.0, 0.0, ("0", "0")),
        (0.0, 0.002, ("0", "0.0020")),
        (0.2, 0.0, ("0.2000", "0")),
        (1 / 3, None, ("0.3333", "")),
        (0.99999, None, ("1.000", "")),
        (float("nan"), 0.12, ("nan", "0.12")),
        (2.0, float("inf"), ("2.000", "inf")),
        (float("inf"), None, ("inf", "")),
    ],
)
def test_digits_follow_the_error(value: float, error: float | None, written: tuple[str, str]) -> None:
    assert with_error(value, error) == written


def test_decimal_points_stand_in_one_column() -> None:
    aligned = align_decimals(["-12.5", "0.0978", "3e-7", "0"])
    assert len({len(number) for number in aligned}) == 1
    assert aligned[0].index(".") == aligned[1].index(".") == aligned[2].index("e")


def test_shortened_names_stay_different() -> None:
    names = ["luminaire_left: radiance", "luminaire_right: radiance", "sky"]
    short = shorten(names, 15)
    assert len(set(short)) == 3
    assert max(map(len, short)) <= 15
    assert all(one.startswith("lum") and one.endswith("nce") for one in short[:2])
    assert "…" in short[0]
    assert short[2] == "sky"
    assert shorten(["a\nb\x1b[2J"], 20) == ["a�b�[2J"]


# -- tables ----------------------------------------------------------------------------------------------


def test_table_says_what_was_measured_and_how() -> None:
    heading = table_text(make()).splitlines()[0]
    assert heading == "Glare = 2.336942 ± 0.000533 · VanillaSceneGradient · 64 spp in 8 replicates"


def test_table_ranks_with_sign_error_and_channels() -> None:
    text = table_text(make())
    names = re.findall(r"^ *\d+  (\S+)", text, flags=re.MULTILINE)
    assert names == ["lamp", "two_minds", "floor", "desk:", "wall", "noisy", "tiny", NASTY]
    assert re.search(r"0\.0978 +± 0\.0008 +-0\.0978$", row_of("desk: roughness", text))
    assert re.search(r"± 0\.0030 .*\+0\.100 +-0\.200 +\+0\.010$", row_of("two_minds", text))
    assert re.search(r"1\.25e-7 ± 0\.20e-7 +\+1\.25e-7$", row_of("tiny", text))
    points = {row_of(name, text).index(".") for name in ("lamp", "two_minds", "wall", "tiny")}
    assert len(points) == 1


def test_texture_shows_totals_and_says_so() -> None:
    text = table_text(make())
    assert re.search(r"Σ .*-0\.080 +-0\.120 +-0\.160$", row_of("floor", text))
    assert "Σ totals over the texels" in text
    plain = dataclasses.replace(make(), attributions={"rough": torch.tensor(1.0)})
    assert "texel" not in table_text(plain)


def test_missing_error_bars_are_said_and_explained() -> None:
    text = table_text(make(barred=False))
    assert "no error bars: 1 replicate" in text
    assert "±" not in text
    assert "no error bars" not in table_text(make())


def test_interruption_is_said() -> None:
    text = table_text(make(interrupted=True, replicates=3))
    assert "interrupted after 3 replicates" in text
    assert "in 3 replicates" not in text


def test_what_is_left_out_for_its_value_is_named_in_every_form() -> None:
    said = "knob.eta.value is left out: it is -0.0485"
    left_out = make(left_out={"knob.eta.value": "it is -0.0485"})
    assert f"! {said}" in " ".join(table_text(left_out).split())
    assert said in " ".join(table_html(left_out).split())
    assert f"! {said}" in " ".join(all_text(plot_bars(left_out)).split())
    many = make(left_out={f"knob{n}": "it is nan" for n in range(9)})
    assert "4 more are left out; renderer.plan lists all" in " ".join(table_text(many).split())


def test_cautions_are_grouped() -> None:
    text = table_text(make(cautions={"rough": "size is off", "wall": "size is off", "lamp": "sign is off"}))
    assert text.count("size is off") == 1
    assert "!2 size is off (2 parameters)" in text
    assert "!1 sign is off (1 parameter)" in text
    assert " !2 " in row_of("desk: roughness", text)
    assert " !2 " in row_of("wall", text)
    assert " !1 " in row_of("lamp", text)
    assert "!" not in row_of("noisy", text)
    assert "! off" in " ".join(table_text(make(cautions={"rough": "off"})).split())


@pytest.mark.parametrize("columns", [30, 50, 80, 120])
def test_no_line_is_wider_than_the_terminal(columns: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    long = {name: f"{name}_{'very_' * 30}long" for name, *_ in CASES}
    cautions = {"rough": "the plugin's tables are outside the derivative graph: its size is off"}
    text = table_text(dataclasses.replace(make(cautions=cautions), labels=long))
    assert max(map(len, text.splitlines())) <= columns
    assert "…" in text
    if columns >= 80:
        assert "-0.200" in text


def test_long_rankings_end_with_what_is_left_out() -> None:
    text = table_text(make(), top=2)
    assert "… and 6 more of at most 0.215" in text
    assert "desk" not in text
    assert "more of at most" not in table_text(make(), top=None)


def test_many_channels_are_summarised() -> None:
    spectrum = {"spectrum": torch.tensor([0.1, -0.3, 0.2, 0.0]).repeat(4)}
    text = table_text(SceneAttribution(spectrum, None, 1.0))
    assert "16 numbers, -0.300 to +0.200" in text


def test_contributions_are_not_called_gradients() -> None:
    text = table_text(dataclasses.replace(make(), convergence_delta=0.00123))
    assert "contribution" in text
    assert "gradient" not in text.replace("VanillaSceneGradient", "")
    assert "convergence delta 0.0012" in text


def test_html_is_escaped_and_complete() -> None:
    text = table_html(make(metric="<b>", cautions={"rough": "a < b"}))
    assert "<script" not in text
    assert "&lt;script&gt;" in text
    assert "<b>&lt;b&gt; = 2.336942 ± 0.000533</b>" in text
    assert "a &lt; b" in text
    assert text.count("<tr>") == 1 + len(CASES)
    assert "0.0978 " in text


# -- figures ---------------------------------------------------------------------------------------------


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


def test_bars_left_out_and_missing_whiskers_are_said() -> None:
    figure = plot_bars(make(barred=False), top=3)
    (axes,) = figure.axes
    assert len(axes.patches) == 3
    assert whiskers(axes) == []
    assert "5 less salient parameters not shown" in all_text(figure)
    assert "no error bars: 1 replicate" in all_text(figure)
    assert "not shown" not in all_text(plot_bars(make(), top=None))


def test_bars_of_doubtful_derivatives_are_hatched() -> None:
    figure = plot_bars(make(cautions={"rough": "its size is off"}))
    hatched = [bool(bar.get_hatch()) for bar in figure.axes[0].patches]
    assert hatched == [name == "rough" for name, *_ in CASES]
    assert "! desk: roughness" in all_text(figure)
    assert "its size is off" in all_text(figure)


def test_bars_draw_into_given_axes_and_names_are_not_formulas() -> None:
    from matplotlib.figure import Figure

    figure = Figure()
    axes = figure.subplots(1, 2)
    odd = dataclasses.replace(make(metric=r"$\oops{$"), labels={"lamp": r"$\frac{$"})
    assert plot_bars(odd, ax=axes[1]) is figure
    assert len(axes[1].patches) == len(CASES)
    assert not axes[0].patches
    figure.canvas.draw()


def test_bars_refuse_a_count_that_shows_nothing() -> None:
    with pytest.raises(SceneCaptumError, match="top must be a whole number of at least 1"):
        plot_bars(make(), top=0)


def test_heatmap_sets_the_saliency_beside_the_render() -> None:
    attribution = make()
    figure = plot_heatmap(attribution)
    left, right, bar = figure.axes
    np.testing.assert_allclose(left.images[0].get_array(), display_image(attribution.image))
    np.testing.assert_allclose(right.images[0].get_array(), attribution.heatmap())
    figure.canvas.draw()
    assert left.get_window_extent().size == pytest.approx(right.get_window_extent().size)
    assert bar.get_window_extent().height == pytest.approx(right.get_window_extent().height)
    assert "Glare = 2.336942 ± 0.000533" in all_text(figure)
    assert "VanillaSceneGradient" in all_text(figure)


def test_heatmap_names_what_matters_out_of_sight() -> None:
    assert "not in the picture: lamp, #1" in all_text(plot_heatmap(make()))
    seen = dataclasses.replace(make(), surfaces=surfaces("lamp", "two_minds"))
    assert "not in the picture: floor, #3" in all_text(plot_heatmap(seen))
    # What no pixel shows but is not among the first three is not worth a line.
    weak = {name: value for name, value in make().items() if name in ("lamp", "two_minds", "noisy")}
    first = dataclasses.replace(seen, attributions={**weak, "third": torch.tensor(0.2)}, covariance=None)
    shown = dataclasses.replace(first.surfaces, parameters=(("lamp", "third"), ("two_minds",), ()))
    assert "not in the picture" not in all_text(plot_heatmap(dataclasses.replace(first, surfaces=shown)))
    # A group is in the picture where one of its members is.
    grouped = make(groups={"lamp": ["bulb", "rough"], "two_minds": ["elsewhere"]})
    assert "not in the picture: two_minds, #2" in all_text(plot_heatmap(grouped))


def test_heatmap_needs_to_know_what_pixels_show() -> None:
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


# -- tone mapping ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "fill", [0.0, 1e-38, 1e-6, 1.0, 1e8, 3e38, float("inf"), float("nan"), -1.0], ids=str
)
@pytest.mark.parametrize("exposure", [None, 1.0, 1e30])
def test_display_is_finite_and_in_range(fill: float, exposure: float | None) -> None:
    image = torch.full((3, 4, 3), fill)
    image[0, 0] = 0.5
    shown = display_image(image, exposure)
    assert shown.shape == (3, 4, 3)
    assert torch.isfinite(shown).all()
    assert shown.min() >= 0
    assert shown.max() <= 1


def test_display_is_monotone_and_smooth_at_the_knee() -> None:
    grey = torch.logspace(-6, 4, 4000)[None, :, None].expand(1, -1, 3)
    steps = display_image(grey, exposure=1.0)[0, :, 0].diff()
    assert (steps >= 0).all()
    assert steps.max() < 0.01  # 0.6 % brighter: no jump anywhere


def test_display_keeps_the_hue_of_lamps() -> None:
    import kornia

    lamp = torch.tensor([30.0, 20.0, 5.0])
    shown = display_image(lamp.expand(2, 2, 3), exposure=1.0)
    linear = kornia.color.rgb_to_linear_rgb(shown.permute(2, 0, 1)).permute(1, 2, 0)[0, 0]
    torch.testing.assert_close(linear / linear.max(), lamp / lamp.max(), atol=1e-4, rtol=1e-4)
    assert 0.95 < linear.max() < 1


def test_exposure_is_one_factor_and_the_dark_is_srgb() -> None:
    image = torch.tensor([0.0, 0.1, 0.5]).expand(1, 1, 3)
    torch.testing.assert_close(display_image(image / 4, exposure=4.0), display_image(image, exposure=1.0))
    expected = torch.tensor([0.0, 0.349190, 0.735357])  # IEC 61966-2-1
    torch.testing.assert_close(display_image(image, exposure=1.0)[0, 0], expected, atol=1e-5, rtol=0)


def test_automatic_exposure_ignores_borders_and_scale() -> None:
    room = 0.02 + torch.rand(20, 20, 3, generator=torch.Generator().manual_seed(shifted(1)))
    black, dim = torch.zeros(100, 100, 3), torch.full((22, 22, 3), 1e-7)
    for border in (black, dim):  # black ones may be most of the picture
        border[1:21, 1:21] = room
        inside = display_image(border)[1:21, 1:21]
        torch.testing.assert_close(inside, display_image(room), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(display_image(1e4 * room), display_image(room), atol=1e-5, rtol=1e-5)
    assert 0.3 < display_image(room).mean() < 0.65


def test_automatic_exposure_does_not_let_windows_burn_out() -> None:
    room = torch.full((10, 10, 3), 0.01)
    room[:2], room[2:4] = 5.0, 2.5
    shown = display_image(room)[:, 0, 0]
    assert shown[9] < display_image(torch.full((10, 10, 3), 0.01))[9, 0, 0]
    assert shown[0] - shown[2] > 2 / 255  # what the window shows can still be told apart


@pytest.mark.parametrize("shape", [(3, 4), (3, 8, 8), (2, 4, 4, 3)])
def test_display_refuses_other_shapes(shape: tuple[int, ...]) -> None:
    with pytest.raises(SceneCaptumError, match=r"\(H, W, 3\)"):
        display_image(torch.zeros(shape))


def test_display_refuses_a_negative_exposure() -> None:
    with pytest.raises(SceneCaptumError, match="exposure"):
        display_image(torch.zeros(2, 2, 3), exposure=-1.0)


def test_saved_render_has_its_own_size_and_values(tmp_path: Path) -> None:
    from PIL import Image

    image = torch.rand(7, 13, 3, requires_grad=True)
    save_render(image, tmp_path / "render.png", exposure=0.8)
    with Image.open(tmp_path / "render.png") as saved:
        assert (saved.format, saved.size, saved.mode) == ("PNG", (13, 7), "RGB")
        expected = (display_image(image, 0.8) * 255).round()
        np.testing.assert_array_equal(np.asarray(saved), expected.numpy())


def test_save_render_says_where_it_cannot_write(tmp_path: Path) -> None:
    with pytest.raises(SceneCaptumError, match="cannot be written"):
        save_render(torch.zeros(2, 2, 3), tmp_path / "missing" / "render.png")
