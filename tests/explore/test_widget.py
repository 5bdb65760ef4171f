"""The page as a widget in a real Jupyter kernel, as a file of its own, and as a section of a report."""

from __future__ import annotations

import base64
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from chance import allowed, together
from nbclient import NotebookClient
from nbformat.v4 import new_code_cell, new_notebook
from seeds import shifted

from scenecaptum import SceneRenderer, cli, metrics
from scenecaptum.errors import SceneCaptumError
from scenecaptum.explore import Exploration, section, widget
from scenecaptum.report import write_report

from .windows import REPLICATES, number, run, wait_for

LAMP = "light.emitter.radiance.value"
CODE = """
from scenecaptum import SceneRenderer, metrics
from scenecaptum.explore import Exploration, widget
renderer = SceneRenderer("cornell-box", inputs="emitters", resolution=(16, 16), max_depth=3)
exploration = Exploration(renderer, metrics.MeanLuminance(), spp=16)
shown = widget(exploration)
shown
"""
OWN = """
class Red:
    def __call__(self, image):
        return image[..., 0].mean()


def blue(image):
    return image[..., 2].mean()
"""
# What a notebook does with the module: a model whose messages go to the kernel and come from it.
FRONTEND = """async (source) => {
    const module = await import(URL.createObjectURL(new Blob([source], { type: "text/javascript" })));
    const listeners = [];
    window.deliver = (content, buffers) => {
        const bytes = buffers.map((text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)));
        listeners.forEach((listener) => listener(content, bytes.map((one) => new DataView(one.buffer))));
    };
    const on = (_, listener) => listeners.push(listener);
    const model = { on, off: () => {}, send: (content) => window.toKernel(content) };
    window.end = module.default.render({ model, el: document.body.appendChild(document.createElement("div")) });
}"""


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch) -> Iterator[NotebookClient]:
    made = NotebookClient(new_notebook(cells=[new_code_cell(CODE)]), timeout=120)
    monkeypatch.setenv("PYTHONPATH", str(Path(cli.__file__).parents[2]))
    with made.setup_kernel():
        yield made


def test_the_widget_explores_in_a_kernel(client, browser):
    pytest.importorskip("anywidget", reason="anywidget is not installed")
    cell = client.execute_cell(client.nb.cells[0], 0)
    view = cell.outputs[-1]["data"]["application/vnd.jupyter.widget-view+json"]
    state = client.widget_state[view["model_id"]]
    page = browser.new_page()
    complaints: list[str] = []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("console", lambda message: complaints.append(message.text))

    def to_kernel(content: Any) -> None:
        data = {"method": "custom", "content": content}
        message = client.kc.session.msg("comm_msg", {"comm_id": view["model_id"], "data": data})
        client.kc.shell_channel.send(message)

    def deliver() -> None:
        """Pass on what the kernel has sent."""
        from jupyter_core.utils import run_sync

        while True:
            try:
                message = run_sync(client.kc.get_iopub_msg)(timeout=0.05)
            except Exception:  # queue.Empty: nothing has come
                return
            if message["msg_type"] == "comm_msg" and message["content"]["data"].get("method") == "custom":
                buffers = [base64.b64encode(buffer).decode() for buffer in message["buffers"]]
                page.evaluate(
                    "([c, b]) => window.deliver(c, b)", [message["content"]["data"]["content"], buffers]
                )

    def heard(condition: Any) -> Any:
        return wait_for(lambda: deliver() or condition())

    page.expose_function("toKernel", to_kernel)
    page.evaluate(FRONTEND, state["_esm"])
    page.add_style_tag(content=state["_css"])
    slider = page.locator(f'.explore-slider[data-name="{LAMP}"]:not([data-waiting]) input')
    heard(slider.count)
    slider.fill("0.5")
    change = page.locator(".explore-change")
    heard(lambda: "predicted" in change.inner_text())
    heard(lambda: "rendered" in change.inner_text())
    page.evaluate("window.end()")
    assert complaints == []
    page.close()


def test_anywidget_is_asked_for_where_it_is_missing(tiny, monkeypatch):
    monkeypatch.setitem(sys.modules, "anywidget", None)
    with pytest.raises(SceneCaptumError, match=re.escape("scenecaptum[explore]")):
        widget(Exploration(tiny, metrics.MeanLuminance()))


def test_a_file_predicts_without_a_server(browser, tmp_path, capsys):
    path, own = tmp_path / "explore.html", tmp_path / "own.py"
    own.write_text(OWN)
    words = (
        f"explore cornell-box --metric luminance --metric {own}:Red --metric {own}:blue "
        "--resolution 16x16 --spp 16 --max-depth 3 --inputs emitters"
    )
    assert cli.main([*words.split(), "--to", str(path)]) == 0
    assert str(path) in capsys.readouterr().out
    page = browser.new_page()
    complaints: list[str] = []
    requests: list[str] = []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("console", lambda message: complaints.append(message.text))
    page.on("request", lambda request: requests.append(request.url))
    page.goto(path.as_uri())
    slider = page.locator(f'.explore-slider[data-name="{LAMP}"]:not([data-waiting]) input')
    wait_for(slider.count)
    value, _ = number(page.locator(".explore-value").first.inner_text())
    slider.fill("0.5")
    wait_for(lambda: page.locator(".explore-badge").inner_text() == "Predicted")
    halved, error = number(page.locator(".explore-value").first.inner_text())
    assert halved == pytest.approx(value / 2, rel=0.02)  # as far as its digits go
    page.get_by_role("button", name="Copy as Python").click()
    printed = run(page.get_by_label("Code").input_value())
    assert [text.split(" = ")[0].split()[-1] for text in printed] == ["luminance", "Red", "blue"]
    again, its_error = number(printed[0])
    assert abs(again - halved) < allowed(REPLICATES) * together(error, its_error)
    page.get_by_role("button", name="Copy as command line").click()
    assert page.get_by_label("Code").input_value().count("--metric ") == len(printed)
    page.get_by_label("Name of this design").fill("half")
    page.get_by_role("button", name="Save").click()
    wait_for(lambda: "half" in page.locator(".explore-saved").inner_text())
    assert not page.get_by_role("button", name="Take this as the new start").is_visible()
    assert complaints == []
    assert [url for url in requests if not url.startswith(("data:", "blob:"))] == [path.as_uri()]
    page.close()


@pytest.fixture(scope="module")
def few(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file with two sliders of a scene that has many."""
    path: Path = tmp_path_factory.mktemp("few") / "few.html"
    words = "explore cornell-box --metric luminance --resolution 16x16 --spp 16 --max-depth 3 --top 2"
    assert (
        cli.main([*words.split(), "--inputs", "emitters", "--inputs", "reflectance", "--to", str(path)]) == 0
    )
    return path


def test_a_file_offers_of_an_object_what_it_can_predict(browser, few):
    page = browser.new_page()
    page.goto(few.as_uri())
    rows = page.locator(".explore-slider:not([data-waiting])")
    wait_for(lambda: rows.count() == 2)
    listed = {row.get_attribute("aria-label") for row in rows.all()}
    chooser = page.get_by_label("Object, to get its parameters")
    wait_for(lambda: chooser.locator("option").count() > 2)
    offered = set()
    for option in chooser.locator("option").all()[1:]:
        chooser.select_option(label=option.inner_text())
        buttons = page.locator(".explore-chosen").get_by_role("button").all()
        offered |= {button.inner_text() for button in buttons}
        assert (
            "only for the parameters with a slider" in page.locator(".explore-chosen").inner_text()
        )  # of poses
        for button in buttons:
            button.click()
            focused = page.evaluate("document.activeElement.closest('.explore-slider').ariaLabel")
            assert focused == button.inner_text()
    assert offered == listed
    page.close()


def open_designs(page: Any, path: Path) -> Any:
    """Open a file, and return its list of designs once it has sliders."""
    page.goto(path.as_uri())
    wait_for(page.locator(".explore-slider:not([data-waiting])").count)
    return page.locator(".explore-saved")


def save_design(page: Any, name: str) -> None:
    page.locator(".explore-slider input[type=range]").first.fill("0.5")
    page.get_by_label("Name of this design").fill(name)
    page.get_by_role("button", name="Save").click()
    wait_for(lambda: name in page.locator(".explore-saved").inner_text())


def test_designs_of_a_file_stay_in_the_browser_and_apart_from_those_of_others(browser, few, tmp_path):
    other, same = tmp_path / "other.html", tmp_path / "same.html"
    text = few.read_text()
    same.write_text(text)
    other.write_text(text.replace("--resolution 16x16", "--resolution 16x17"))
    assert other.read_text() != text
    page = browser.new_page()
    open_designs(page, few)
    save_design(page, "half")
    save_design(page, "also")
    saved = open_designs(page, few)
    wait_for(lambda: saved.locator("li").count() == 2)
    saved.locator("li", has_text="half").get_by_role("button", name="Show").click()
    assert page.locator(".explore-slider input[type=range]").first.input_value() == "0.5"
    page.get_by_role("button", name="Forget also").click()
    wait_for(lambda: saved.locator("li").count() == 1)
    saved = open_designs(page, other)
    save_design(page, "third")
    assert saved.locator("li").count() == 1
    saved = open_designs(page, same)
    wait_for(lambda: "half" in saved.inner_text())
    assert saved.locator("li").count() == 1
    assert "last until" not in page.locator(".explore-designs").inner_text()
    page.close()


@pytest.mark.parametrize(
    "refusal",
    [
        "Object.defineProperty(window, 'localStorage', { get() { throw new DOMException(); } })",
        "Storage.prototype.setItem = () => { throw new DOMException(); }",
    ],
    ids=["none", "full"],
)
def test_designs_of_a_file_last_until_it_is_closed_where_the_browser_stores_nothing(browser, few, refusal):
    page = browser.new_page()
    complaints: list[str] = []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.add_init_script(refusal)
    saved = open_designs(page, few)
    save_design(page, "half")
    save_design(page, "also")
    assert saved.locator("li").count() == 2
    assert "Designs last until this page is closed" in page.locator(".explore-designs").inner_text()
    assert complaints == []
    page.close()


def test_a_section_of_a_report_predicts(browser, tmp_path):
    renderer = SceneRenderer("cornell-box", inputs="emitters", resolution=(16, 16), max_depth=3)
    exploration = Exploration(renderer, metrics.MeanLuminance(), seed=shifted(), spp=16)
    path = tmp_path / "report.html"
    with pytest.raises(SceneCaptumError, match=r"call exploration\.linearize\(\) first"):
        section(exploration)
    write_report(exploration.linearize().attributions, path, sections=[section(exploration)])
    page = browser.new_page()
    complaints: list[str] = []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("console", lambda message: complaints.append(message.text))
    page.goto(path.as_uri())
    slider = page.locator(f'.explore-slider[data-name="{LAMP}"]:not([data-waiting]) input')
    wait_for(slider.count)
    slider.fill("0.5")
    wait_for(lambda: page.locator(".explore-badge").inner_text() == "Predicted")
    assert "predicted to first order, not rendered" in page.locator(".explore-change").inner_text()
    assert "noise of the prediction only" in page.locator(".explore-unrendered").inner_text()
    assert page.get_by_role("heading", name="What if").is_visible()
    assert complaints == []
    page.close()
