"""Count the frames a second that the page of an exploration draws while sliders move, in headless Chromium.

The offline page predicts only, so no render competes with it. A frame moves the first range of one slider, or of
all of them, and the page draws it. Script milliseconds are those of the page's own work in a frame: its answers
to the moves, and its drawing; unlike the frames a second, they hardly depend on what else the machine does.

    python benchmarks/explore_frames.py [SCENE] [--metric ugr] [--resolution 640x360] [--sliders 12] [--seconds 5]
"""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
from pathlib import Path

from playwright.sync_api import Browser, sync_playwright

from scenecaptum import cli

# Before the page: measure what it does in each frame.
WATCH = """
window.frame = window.requestAnimationFrame.bind(window);
window.drawing = [];
window.requestAnimationFrame = (draw) => window.frame((now) => {
    const start = performance.now();
    draw(now);
    window.drawing.push(performance.now() - start);
});
"""
MOVE = """async ([count, seconds]) => {
    const rows = [...document.querySelectorAll(".explore-slider")].slice(0, count);
    const ranges = rows.map((row) => row.querySelector("input[type=range]"));
    const handling = [];
    window.drawing = [];
    const start = performance.now();
    for (let step = 0; performance.now() < start + 1000 * seconds; step += 1) {
        await new Promise(window.frame);
        const before = performance.now();
        for (const [index, range] of ranges.entries()) {
            const share = 0.5 + 0.4 * Math.sin(step / 20 + index);
            range.value = Number(range.min) + share * (range.max - range.min);
            range.dispatchEvent(new Event("input", { bubbles: true }));
        }
        handling.push(performance.now() - before);
    }
    const middle = (numbers) => numbers.sort((a, b) => a - b)[Math.floor(numbers.length / 2)];
    const rate = (1000 * window.drawing.length) / (performance.now() - start);
    return [ranges.length, rate, middle(handling), middle(window.drawing)];
}"""
READY = "count => document.querySelectorAll('.explore-slider:not([data-waiting])').length >= count"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", nargs="?", default="office")
    parser.add_argument("--metric", action="append", help="default: ugr")
    parser.add_argument("--resolution", default="640x360")
    parser.add_argument("--sliders", type=int, default=12)
    parser.add_argument("--seconds", type=float, default=5.0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "explore.html"
        words = ["explore", options.scene, "--resolution", options.resolution, "--top", str(options.sliders)]
        words += [word for name in options.metric or ["ugr"] for word in ("--metric", name)]
        if cli.main([*words, "--spp", "4", "--to", str(page)]):
            raise SystemExit(1)
        with sync_playwright() as playwright:
            found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
            sandbox = ["--no-sandbox"] if os.geteuid() == 0 else []
            browser = playwright.chromium.launch(executable_path=found, args=sandbox)
            print(f"{options.scene} at {options.resolution}, Chromium {browser.version}")
            for count in (1, options.sliders):
                measure(browser, page, count, options)
            browser.close()


def measure(browser: Browser, path: Path, count: int, options: argparse.Namespace) -> None:
    """Move as many sliders in every frame, and print what it takes."""
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.add_init_script(WATCH)
    page.goto(path.as_uri())
    page.wait_for_function(READY, arg=options.sliders)
    page.evaluate(MOVE, [count, 1.0])  # compiles
    moved, rate, handling, drawing = page.evaluate(MOVE, [count, options.seconds])
    print(
        f"{moved:2d} sliders: {rate:5.1f} frames a second, {handling + drawing:5.1f} ms of script in a frame "
        f"({handling:.1f} for the moves, {drawing:.1f} to draw)"
    )
    page.close()


if __name__ == "__main__":
    main()
