"""The page of an exploration in a browser window."""

from __future__ import annotations

import contextlib
import re
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import urlsplit

from scenecaptum.explore import Exploration, Server

# From a copy, because Chromium warns of pages that read their own canvases often.
READ = """const read = (canvas) => {
    const context = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d");
    context.drawImage(canvas, 0, 0);
    return [...context.getImageData(0, 0, canvas.width, canvas.height).data];
};"""
REPLICATES = 4  # of a design
PATIENCE = 60.0  # seconds for what takes less than one on a machine that has nothing else to do


def wait_for(condition: Callable[[], Any]) -> Any:
    """Wait until a condition holds, and return what it returned."""
    end = time.monotonic() + PATIENCE
    while not (found := condition()):
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.02)
    return found


@contextlib.contextmanager
def served(exploration: Exploration) -> Iterator[Server]:
    """Serve an exploration, and end both."""
    exploration.start()
    with Server(exploration) as server:
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True).start()
        yield server
        server.shutdown()
    assert exploration.close(timeout=PATIENCE)


class Window:
    """A browser window with the page of a server; it records every console message and request."""

    def __init__(self, browser: Any, server: Server, **options: Any) -> None:
        self.server, self.exploration = server, server.exploration
        self.context = browser.new_context(**{"viewport": {"width": 1280, "height": 900}, **options})
        self.context.grant_permissions(["clipboard-read", "clipboard-write"])
        self.context.set_default_timeout(30000)
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self.page = self.context.new_page()
        self.page.on("console", lambda message: self.complaints.append(message.text))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(server.address)

    def ready(self) -> Window:
        """Wait until all sliders can be moved, and the scene is as it was."""
        wait_for(lambda: self.all("slider").count() >= 9 and not self.all("slider[data-waiting]").count())
        wait_for(lambda: self.text("status") == "")
        if self.page.get_by_role("button", name="Reset", exact=True).is_enabled():
            self.page.get_by_role("button", name="Reset", exact=True).click()
        wait_for(lambda: self.all("picture").get_attribute("aria-busy") == "false")
        return self

    def all(self, part: str) -> Any:
        return self.page.locator(f".explore-{part}")

    def text(self, part: str) -> str:
        found: str = self.all(part).first.inner_text()
        return found

    def slider(self, name: str) -> Any:
        return self.page.locator(f'.explore-slider[data-name="{name}"]')

    def range(self, name: str, index: int = 0) -> Any:
        return self.slider(name).locator("input[type=range]").nth(index)

    def set(self, name: str, value: float, index: int = 0) -> None:
        """Move a slider as a drag does that ends there."""
        self.range(name, index).fill(str(value))

    def drag(self, name: str, share: float, steps: int, index: int = 0) -> None:
        """Drag the thumb with the mouse to a share of the slider's length."""
        self.range(name, index).scroll_into_view_if_needed()
        box = self.range(name, index).bounding_box()
        low, high = (float(self.range(name, index).get_attribute(end)) for end in ("min", "max"))
        now = float(self.range(name, index).input_value())
        thumb = 16.0

        def place(part: float) -> tuple[float, float]:
            return box["x"] + thumb / 2 + part * (box["width"] - thumb), box["y"] + box["height"] / 2

        self.page.mouse.move(*place((now - low) / (high - low)))
        self.page.mouse.down()
        self.page.mouse.move(*place(share), steps=steps)
        self.page.mouse.up()

    def pixels(self, canvas: str = "render") -> list[int]:
        """The pixels of the picture as they are shown, or of the map over it."""
        found: list[int] = self.all(canvas).evaluate(f"canvas => {{ {READ} return read(canvas); }}")
        return found

    def predicted(self, name: str, value: float) -> list[int]:
        """Move a slider, and return the pixels of the picture that the next frame shows, before any render."""
        move = f"""async (slider, value) => {{
            {READ}
            slider.value = value;
            slider.dispatchEvent(new Event("input", {{ bubbles: true }}));
            await new Promise(requestAnimationFrame);
            const shown = [read(document.querySelector(".explore-render"))];
            shown.push(document.querySelector(".explore-badge").innerText);
            slider.dispatchEvent(new Event("change", {{ bubbles: true }}));
            return shown;
        }}"""
        pixels, badge = self.range(name).evaluate(move, value)
        assert badge == "Predicted"
        found: list[int] = pixels
        return found

    def close(self) -> None:
        """Close it, and check that it complained of nothing and asked nobody else."""
        self.context.close()
        assert not self.complaints, self.complaints
        asked = {urlsplit(url).netloc for url in self.requests if not url.startswith(("data:", "blob:"))}
        assert asked == {self.server.hosts[0]}


def number(text: str) -> tuple[float, float]:
    """Read a value with its error."""
    found = re.search(r"([−+]?[\d.]+) ± ([\d.]+)", text)
    assert found is not None, text
    return float(found[1].replace("−", "-")), float(found[2])


def run(script: str) -> list[str]:
    """Run a script in this process, whose kernels are compiled, and return what it prints."""
    printed: list[str] = []
    exec(script, {"print": lambda result: printed.append(str(result))})
    return printed


def last_render(exploration: Exploration) -> dict[str, Any]:
    """The last design that has been rendered well, as it was sent to pages."""
    message = exploration.channel.message("rendered")
    return message if message and not message["rough"] else {}
