"""The page in a real browser, on a server that renders."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from chance import allowed, together
from seeds import shifted

from scenecaptum import SceneRenderer, cli, explore, metrics
from scenecaptum.attr import Explanation
from scenecaptum.explanation import definition_of
from scenecaptum.explore import Exploration, Server
from scenecaptum.explore._session import RECIPE
from scenecaptum.metrics import Band, Measure
from scenecaptum.visualization import automatic_exposure, display_image, format_with_error, signed_with_error

from .windows import REPLICATES, Window, last_render, number, run, served, wait_for

LAMP = "light.emitter.radiance.value"
WALL = "left_wall.reflectance.value"
SKY = "sky.emitter.radiance.value"
LEFT = "luminaire_left.emitter.radiance.value"
BOX = "tall_box_shape.pose.translation"


@pytest.fixture(scope="module")
def shared(browser: Any, server: Server) -> Iterator[Window]:
    opened = Window(browser, server).ready()
    yield opened
    opened.close()


@pytest.fixture
def window(shared: Window) -> Window:
    return shared.ready()


def confirmed(window: Window) -> dict[str, Any]:
    """Wait until the render of what the page shows is there, and return it."""
    wait_for(lambda: window.all("picture").get_attribute("aria-busy") == "false")
    return last_render(window.exploration)


def test_a_lamp_is_predicted_at_once_and_confirmed(window):
    before = number(window.text("value"))[0]
    window.drag(LAMP, 0.25, steps=5)
    predicted = number(window.text("change"))
    assert "predicted" in window.text("change")
    described = confirmed(window)["metrics"][0]
    rendered, error = described["change"]
    assert abs(rendered - predicted[0]) < allowed(REPLICATES) * together(error, predicted[1])
    assert "rendered" in window.text("change")
    assert number(window.text("value"))[0] == pytest.approx(before + rendered, rel=0.01)


def test_the_predicted_picture_is_that_of_the_library(window):
    """The page adds up derivatives and tone-maps as Python does: pixels differ by rounding alone."""
    shown = np.array(window.predicted(WALL, 0.4)).reshape(24, 24, 4)[..., :3]
    about = window.exploration.about
    base = about.designs.denoised(about.start.image, {})
    picture, _ = about.predict({WALL: confirmed(window)["design"][WALL]})
    expected = display_image(picture, automatic_exposure(base)) * 255
    assert np.abs(shown - expected.numpy()).max() < 1.5


@pytest.mark.parametrize("name", [LAMP, WALL, "floor.reflectance.value"])
def test_every_kind_of_slider_can_be_dragged(window, name):
    window.drag(name, 0.1, steps=4)
    assert window.text("badge") != "Rendered" or window.all("slider[data-moved]").count()
    assert window.slider(name).get_attribute("data-moved") is not None
    assert set(confirmed(window)["design"]) == {name}


def test_a_colour_is_chosen_as_a_colour(window):
    window.slider(WALL).locator("input[type=color]").fill("#80ff40")
    design = confirmed(window)["design"][WALL]
    assert design == pytest.approx((0.2159, 1.0, 0.0513), abs=1e-3)  # in linear light
    assert float(window.range(WALL).input_value()) == pytest.approx(1.0)


def test_a_pose_is_searched_and_added(window):
    window.page.get_by_label("Add a parameter by its name").fill(BOX)
    window.page.keyboard.press("Enter")
    wait_for(lambda: window.slider(BOX).count() and window.slider(BOX).get_attribute("data-waiting") is None)
    window.drag(BOX, 0.6, steps=3, index=0)
    predicted = number(window.slider(BOX).locator(".explore-effect").inner_text())
    assert predicted[1] > 0
    assert confirmed(window)["design"][BOX][1:] == (0.0, 0.0)


def test_many_fast_drags_take_few_renders_and_end_at_the_last_value(window):
    rendered = []
    exploration = window.exploration
    measure = exploration.designs.measure
    exploration.designs.measure = lambda design: rendered.append(design) or measure(design)
    try:
        window.page.evaluate(
            """async ([selector, count]) => {
                const slider = document.querySelector(selector);
                for (let step = 0; step < count; step += 1) {
                    slider.value = 0.5 + (step % 50) / 100;
                    slider.dispatchEvent(new Event("input", { bubbles: true }));
                    await new Promise((done) => setTimeout(done, 10));
                }
                slider.value = 0.77;
                slider.dispatchEvent(new Event("input", { bubbles: true }));
                slider.dispatchEvent(new Event("change", { bubbles: true }));
            }""",
            [f'.explore-slider[data-name="{LAMP}"] input', 199],
        )
        described = confirmed(window)
    finally:
        exploration.designs.measure = measure
    assert described["design"] == {LAMP: (0.77,)}
    assert 1 <= len(rendered) <= 5


def test_a_render_far_from_its_prediction_says_by_how_much(window):
    for name in (
        WALL,
        "right_wall.reflectance.value",
        "floor.reflectance.value",
        "back_wall.reflectance.value",
    ):
        window.set(name, 1.0)
    described = confirmed(window)["metrics"][0]
    note = window.all("warning").first
    wait_for(note.is_visible)
    off, errors = re.search(r"off by ([−+][\d.]+), ([\d.]+) standard errors", note.inner_text()).groups()
    assert float(errors) > 2
    _, [(change, _), _] = window.exploration.about.predict(last_render(window.exploration)["design"])
    assert float(off.replace("−", "-")) == pytest.approx(described["change"][0] - change, rel=0.1)


def test_undo_redo_and_reset(window):
    window.set(LAMP, 0.5)
    window.set(WALL, 0.2)
    window.page.get_by_role("button", name="Undo").click()
    assert float(window.range(WALL).input_value()) == pytest.approx(0.57, abs=0.01)
    window.page.get_by_role("button", name="Undo").click()
    assert float(window.range(LAMP).input_value()) == 1.0
    # Nothing is left to undo: a frame later, a disabled button has lost its focus.
    window.page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    window.page.keyboard.press("Control+Shift+z")
    assert float(window.range(LAMP).input_value()) == 0.5
    window.page.keyboard.press("Control+z")
    assert float(window.range(LAMP).input_value()) == 1.0
    for _ in range(2):
        window.page.get_by_role("button", name="Redo").click()
    assert (float(window.range(LAMP).input_value()), float(window.range(WALL).input_value())) == (0.5, 0.2)
    window.slider(WALL).get_by_role("button", name="Reset").click()
    assert set(confirmed(window)["design"]) == {LAMP}
    window.page.get_by_role("button", name="Reset", exact=True).click()
    wait_for(lambda: not window.all("slider[data-moved]").count())


def test_the_picture_before_is_shown_while_a_key_is_held(window):
    before = window.pixels()
    window.set(LAMP, 0.3)
    wait_for(lambda: window.pixels() != before)
    window.range(LAMP).focus()
    window.page.keyboard.down("b")
    wait_for(lambda: window.text("badge") == "Before")
    assert window.pixels() == before
    window.page.keyboard.up("b")
    wait_for(lambda: window.text("badge") != "Before")
    assert window.pixels() != before


def test_designs_are_saved_shown_and_compared_in_all_tabs(window, browser, server):
    window.set(LAMP, 0.4)
    dim = confirmed(window) and window.pixels()
    window.page.get_by_label("Name of this design").fill("dim <b>")
    window.page.get_by_role("button", name="Save").click()
    other = Window(browser, server)
    wait_for(lambda: "dim <b>" in other.all("saved").inner_text())
    value, error = last_render(window.exploration)["metrics"][0]["value"], 0
    saved = other.all("saved").locator("> *", has_text="dim <b>")  # others may be there, of other tests
    assert number(saved.inner_text())[0] == pytest.approx(value + error, rel=0.01)
    wait_for(lambda: other.slider(LAMP).count() and float(other.range(LAMP).input_value()) == 0.4)
    window.page.get_by_role("button", name="Reset", exact=True).click()
    wait_for(lambda: float(other.range(LAMP).input_value()) == 1.0)
    saved.get_by_role("button", name="Compare").click()
    other.page.get_by_role("button", name="Undo").focus()
    other.page.keyboard.down("b")
    wait_for(lambda: other.text("badge") == "dim <b>")
    assert np.abs(np.subtract(other.pixels(), dim)).max() <= 6
    other.page.keyboard.up("b")
    saved.get_by_role("button", name="Show").click()
    wait_for(lambda: float(window.range(LAMP).input_value()) == 0.4)
    other.page.get_by_role("button", name="Forget dim <b>").click()
    wait_for(lambda: "dim <b>" not in window.all("saved").inner_text())
    other.close()


def test_an_object_in_the_picture_has_its_parameters(window):
    box = window.all("picture").bounding_box()
    window.all("picture").click(position={"x": 0.06 * box["width"], "y": 0.4 * box["height"]})
    wait_for(lambda: "left_wall" in window.text("chosen"))
    window.all("chosen").get_by_role("button", name="left_wall: reflectance").click()
    focused = window.page.evaluate("document.activeElement.closest('.explore-slider').dataset.name")
    assert focused == WALL
    window.page.get_by_label("Object, to get its parameters").select_option(label="tall_box_shape")
    assert "tall_box: reflectance" in window.text("chosen")
    assert "tall_box_shape: translation" in window.text("chosen")


@pytest.mark.parametrize("kind", ["signed", "magnitude"])
def test_a_map_of_effects_lies_over_the_picture(window, kind):
    window.page.get_by_label("Map over the picture").select_option(kind)
    painted = window.pixels("overlay")
    assert len({tuple(painted[at : at + 3]) for at in range(0, len(painted), 4)}) > 3
    assert ("orange" in window.text("left")) == (kind == "signed")
    window.page.get_by_label("Map over the picture").select_option("off")
    assert not window.all("overlay").is_visible()


def test_several_metrics_are_shown_and_one_ranks(window):
    first = window.slider(LAMP).locator(".explore-effect").inner_text()
    window.page.get_by_label("95th percentile").check(force=True)
    wait_for(lambda: window.slider(LAMP).locator(".explore-effect").inner_text() != first)
    window.page.get_by_label("mean luminance").check(force=True)
    wait_for(lambda: window.slider(LAMP).locator(".explore-effect").inner_text() == first)


def test_what_the_chosen_metric_takes_for_granted_stands_below_it(window):
    said = "valid if the scene's lights are in W/(m² sr)"
    assert window.text("premises").startswith(said)
    window.predicted(LAMP, 0.7)
    confirmed(window)
    wait_for(lambda: window.text("premises").startswith(said))
    shown = window.all("premises").first.evaluate(
        """async (premises) => {
            const slider = document.querySelector(`[data-name="light.emitter.radiance.value"] input[type=range]`);
            slider.value = 0.4;
            slider.dispatchEvent(new Event("input", { bubbles: true }));
            await new Promise(requestAnimationFrame);
            return premises.innerText;
        }"""
    )
    assert shown.startswith(f"at the start: {said}"), "a prediction has no picture to say it of"


def test_a_glare_rating_has_the_cautions_of_an_explanation() -> None:
    renderer = SceneRenderer("office", "emitters", resolution=(32, 18), spp=16, max_depth=3)
    exploration = Exploration(renderer, metrics.UnifiedGlareRating(renderer.camera), top=1, spp=16)
    exploration.linearize()
    [rated] = exploration.channel.message("base")["metrics"]
    assert any("UGR and its limits are for luminaires" in one for one in rated["premises"])
    assert any("with a threshold of 5 times the mean luminance, UGR is" in one for one in rated["premises"])
    assert re.match(r"[\d.]+ ± [\d.]+ by the definition: above [\d.]+, ", rated["verdict"])
    assert rated["relaxed"].startswith("predictions need")


def test_a_threshold_that_is_not_the_usual_one_is_stated(mi) -> None:
    renderer = SceneRenderer("cornell-box", "emitters", resolution=(8, 8), spp=4, max_depth=2)
    rating = metrics.UnifiedGlareRating(renderer.camera, threshold_factor=5)
    [about] = Exploration(renderer, rating, top=1, spp=4).channel.message("scene")["metrics"]
    assert about["definition"] == "UGR: threshold 5 times the mean luminance"


@pytest.mark.long
def test_a_class_of_the_start_and_of_a_render_is_as_sure_as_that_of_an_explanation() -> None:
    renderer = SceneRenderer("office", "emitters", resolution=(32, 18), spp=16, max_depth=3)
    rating = metrics.UnifiedGlareRating(renderer.camera)
    exploration = Exploration(renderer, rating, top=1, spp=16, seed=shifted())
    exploration.channel.listen()
    start = exploration.designs.measure({}).images
    metric = exploration.designs.metrics[0]
    first = definition_of(metric, start)
    close, far = first.value + first.error, first.value + 9 * first.error
    for limit, end in ((close, f"; too close to {close:g} to be sure"), (far, "dim (a standard)")):
        rating.measure = Measure("glare", bands=(Band(limit, "dim"),), above="bright", source="a standard")
        about = exploration.linearize()
        [rated] = exploration.channel.message("base")["metrics"]
        exact = definition_of(metric, start)
        said = Explanation(about.attributions[0], definition=exact).rating()
        assert rated["verdict"] == f"{format_with_error(exact.value, exact.error)} by the definition: {said}"
        assert said.endswith(end)
    exploration.receive({"type": "design", "design": {"sky.emitter.radiance.value": [0.99]}})
    exploration._confirm()
    [rated] = last_render(exploration)["metrics"]
    assert re.match(r"[\d.]+ ± [\d.]+ by the definition: dim", rated["verdict"])


def test_a_slider_that_leads_for_another_metric_and_a_relaxed_rating_say_so(browser):
    renderer = SceneRenderer("office", "emitters", resolution=(32, 18), spp=16, max_depth=3)
    named = {
        "glare": metrics.UnifiedGlareRating(renderer.camera),
        "constant": lambda image: 1 + 0 * image.mean(),
    }
    with served(Exploration(renderer, named, top=2, spp=16, seed=shifted())) as server:
        window = Window(browser, server)
        wait_for(lambda: window.all("slider").count() >= 1 and not window.all("slider[data-waiting]").count())
        wait_for(lambda: window.text("status") == "")
        sky = window.slider("sky.emitter.radiance.value")
        assert "leads for" not in sky.inner_text()
        values = window.all("value")
        assert values.nth(0).inner_text().endswith(" relaxed")
        assert "predictions need" in values.nth(0).locator("span").get_attribute("title")
        assert "by the definition: " in window.text("verdict")
        predicted = window.range("sky.emitter.radiance.value").evaluate(
            """async (slider) => {
                slider.value = 0.5;
                slider.dispatchEvent(new Event("input", { bubbles: true }));
                await new Promise(requestAnimationFrame);
                return [...document.querySelectorAll(".explore-verdict")].map((one) => one.innerText);
            }"""
        )
        assert predicted == ["class unknown: not yet rendered", ""]
        assert "relaxed" not in values.nth(1).inner_text()
        window.page.get_by_label("constant").check(force=True)
        wait_for(lambda: "leads for unified glare rating" in sky.inner_text())
        window.page.set_viewport_size({"width": 390, "height": 844})
        name = sky.get_by_text("sky: radiance", exact=True).bounding_box()
        note = sky.get_by_text("leads for unified glare rating").bounding_box()
        assert name["width"] > 150
        assert note["y"] >= name["y"] + name["height"] - 1, "the note stands below the name"
        assert name["height"] < 1.5 * note["height"], "the name is on one line"
        window.close()


def test_the_design_as_python_gives_the_same_metric(window):
    window.set(LAMP, 0.6)
    window.slider(WALL).locator("input[type=color]").fill("#ffff00")  # of whole numbers: 1, 1, 0
    described = confirmed(window)["metrics"]
    window.page.get_by_role("button", name="Copy as Python").click()
    script = window.page.evaluate("navigator.clipboard.readText()")
    assert script == window.page.get_by_label("Code").input_value()
    for printed, one in zip(run(script), described, strict=True):
        value, error = number(printed)
        assert abs(value - one["value"]) < allowed(REPLICATES, len(described)) * together(error, one["error"])

    assert window.page.get_by_label("Code").is_visible()
    window.set(LAMP, 0.9)
    assert window.page.get_by_label("Code").is_hidden(), "the code is that of the design before"


def test_the_design_as_a_command_gives_the_same_metric(window, capsys, tmp_path):
    window.set(LAMP, 0.6)
    described = confirmed(window)["metrics"]
    window.page.get_by_role("button", name="Copy as command line").click()
    program, *words = shlex.split(window.page.get_by_label("Code").input_value().replace("\\\n", ""))
    assert program == "scenecaptum"
    assert cli.main([*words, "--spp", "64", "--json", "--format", "json", "--out", str(tmp_path)]) == 0
    printed = re.split(r"(?<=^})\n", capsys.readouterr().out.strip(), flags=re.MULTILINE)
    for text, one in zip(printed, described, strict=True):
        metric = json.loads(text)["metric"]
        errors = together(metric["standard_error"], one["error"])
        assert abs(metric["value"] - one["value"]) < allowed(REPLICATES, len(described)) * errors


def test_no_number_is_a_negative_zero(window):
    code = (Path(explore.__file__).parent / "page" / "explore.js").read_text(encoding="utf-8")
    functions = code[code.index("const minus") : code.index("const short")]
    numbers = [(-0.01, 1.6), (0.01, 1.6), (-1.2, 1.6), (-1e-9, 1000.0), (-0.07, 0.6)]
    numbers += [(1.8e-9, 1.3e-9), (-4.56e-6, 3e-8), (-2e-12, 1.3e-9), (-1.2e-5, 3e-6)]
    write = "([value, error]) => withError(value, error, true)"
    written = window.page.evaluate(
        f"numbers => {{ {functions} return numbers.map({write}); }}",
        numbers,
    )
    assert written == [signed_with_error(*one) for one in numbers]
    assert written[0] == "0.0 ± 1.6"


def test_what_a_light_that_is_off_does_to_a_rating_is_in_doubt(browser):
    renderer = SceneRenderer("office", "emitters", resolution=(32, 18), spp=16, max_depth=3)
    evening = {**renderer.inputs, SKY: torch.zeros(3)}
    named = {"glare": metrics.UnifiedGlareRating(renderer.camera), "brightness": metrics.MeanLuminance()}
    given = [
        {"name": SKY, "operator": "", "numbers": [0.0]},
        {"name": LEFT, "operator": "*", "numbers": [0.5]},
    ]
    recipe = dict(RECIPE, settings=given, changed=[SKY, LEFT], inputs=["emitters"])
    options = {"inputs": evening, "recipe": recipe, "spp": 16, "seed": shifted(), "top": 1}
    with served(Exploration(renderer, named, **options)) as server:
        window = Window(browser, server)
        wait_for(lambda: window.all("slider").count() >= 2 and not window.all("slider[data-waiting]").count())
        wait_for(lambda: window.text("status") == "")
        assert "~ off, and UGR is not linear in the light" in window.slider(SKY).inner_text()
        window.page.get_by_role("button", name="Copy as command line").click()
        assert window.page.get_by_label("Code").input_value().count("--inputs") == 1
        (rating, glare), (_, brightness) = window.range(SKY).evaluate(  # before any render
            """async (slider) => {
                slider.value = slider.max;
                slider.dispatchEvent(new Event("input", { bubbles: true }));
                await new Promise(requestAnimationFrame);
                const text = (card, part) => card.querySelector(`[data-part=${part}]`).textContent;
                const cards = [...document.querySelectorAll(".explore-card")];
                return cards.map((card) => [text(card, "value"), text(card, "change")]);
            }"""
        )
        assert glare.endswith("predicted ~ may be far off")
        assert re.match(r"0(\.0+)? ± ", rating), f"{rating}: no rating is negative"
        assert brightness.endswith("predicted")
        window.set(LEFT, 0.5)
        window.page.get_by_role("button", name="Copy as command line").click()
        copied = window.page.get_by_label("Code").input_value()
        assert re.findall(r"--set '(.*)'", copied) == [f"{SKY}=44,0,0", f"{LEFT}*=0.25"]
        window.close()


def test_a_new_start_is_taken(window):
    window.set(LAMP, 0.5)
    value = confirmed(window)["metrics"][0]["value"]
    window.page.get_by_role("button", name="Take this as the new start").click()
    wait_for(lambda: window.exploration.channel.message("base")["design"] == {LAMP: (0.5,)})
    wait_for(lambda: window.text("status") == "")
    assert window.exploration.about.start.value(0)[0] == value
    wait_for(lambda: not window.all("slider[data-moved]").count())
    window.page.get_by_role("button", name="Reset", exact=True).click()
    wait_for(lambda: window.exploration.channel.message("rendered")["design"] == {})
    window.page.get_by_role("button", name="Take this as the new start").click()
    wait_for(lambda: window.exploration.channel.message("base")["design"] == {})


def test_a_scene_that_cannot_be_rendered_keeps_the_last_picture(window):
    def fail(_: Any) -> Any:
        raise RuntimeError("the kernel\nis gone")

    exploration, picture = window.exploration, window.pixels()
    measure, roughly = exploration.designs.measure, exploration.designs.render_roughly
    exploration.designs.measure = exploration.designs.render_roughly = fail
    try:
        window.set(LAMP, 0.9)
        wait_for(lambda: window.all("problem").is_visible())
        assert window.text("problem") == "RuntimeError: the kernel is gone"
    finally:
        exploration.designs.measure, exploration.designs.render_roughly = measure, roughly
    window.set(LAMP, 1.0)
    wait_for(lambda: window.pixels() == picture)
    window.set(LAMP, 0.8)
    confirmed(window)
    wait_for(lambda: not window.all("problem").is_visible())


def test_a_closed_tab_ends_the_work_and_another_takes_it_up(tiny, browser):
    exploration = Exploration(tiny, metrics.MeanLuminance(), seed=shifted(), spp=16)
    with served(exploration) as server:
        first = Window(browser, server).ready()
        first.close()
        wait_for(lambda: not exploration.channel.listeners)
        exploration.receive({"type": "design", "design": {LAMP: [0.35]}})
        assert exploration.channel.message("rendered") == {}
        second = Window(browser, server)
        wait_for(lambda: last_render(exploration).get("design") == {LAMP: (0.35,)})
        second.close()


@pytest.mark.parametrize(
    "options",
    [
        {"viewport": {"width": 360, "height": 740}, "is_mobile": True, "has_touch": True},
        {"color_scheme": "dark"},
    ],
    ids=["phone", "dark"],
)
def test_a_phone_and_the_dark(browser, server, options):
    window = Window(browser, server, **options).ready()
    assert window.page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    background, ink = window.page.locator(".explore").evaluate(
        "one => [getComputedStyle(one).backgroundColor, getComputedStyle(one).color]"
    )
    lightness = [sum(map(int, re.findall(r"\d+", color)[:3])) for color in (background, ink)]
    assert (lightness[0] < lightness[1]) == ("color_scheme" in options)
    window.close()


def test_everything_has_a_name_for_screen_readers(window):
    nameless = window.page.evaluate(
        """() => [...document.querySelectorAll('.explore :is(input, button, select, textarea)')]
            .filter((one) => !one.labels?.length && !one.getAttribute('aria-label') && !one.innerText)
            .map((one) => one.outerHTML)"""
    )
    assert nameless == []


@pytest.mark.long
def test_a_slider_says_where_its_effect_does_not_hold_over_its_range(browser, monkeypatch):
    monkeypatch.setattr(
        "scenecaptum.explore._session.range_notes",
        lambda attribution, among: {f"{attribution.labels[name]}: it bends": [name] for name in among},
    )
    renderer = SceneRenderer("cornell-box", "emitters", resolution=(16, 16), spp=16, max_depth=2)
    with served(Exploration(renderer, metrics.MeanLuminance(), spp=16, seed=shifted())) as server:
        window = Window(browser, server)
        wait_for(lambda: "~ it bends" in window.slider(LAMP).inner_text())
        window.close()
