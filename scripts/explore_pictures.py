"""Take pictures of the page of ``scenecaptum explore``: the office with its sky dimmed, once that is rendered.

    python scripts/explore_pictures.py FOLDER

``explore.png`` is the one of the documentation; the page in the dark and on a phone are to look at.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

from playwright.sync_api import sync_playwright

COMMAND = "explore office --metric ugr --resolution 320x180 --no-browser"
DIMMER = '.explore-slider[data-form="dimmer"] input'
PATIENCE = 600_000  # ms
PHONE = {
    "viewport": {"width": 390, "height": 844},
    "device_scale_factor": 2,
    "is_mobile": True,
    "has_touch": True,
}
VIEWS: dict[str, dict[str, Any]] = {
    "explore": {"viewport": {"width": 1180, "height": 740}},
    "explore-dark": {"viewport": {"width": 1280, "height": 1250}, "color_scheme": "dark"},
    "explore-phone": PHONE,
}


def main() -> None:
    """Take the pictures from a server that runs meanwhile."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    command = [sys.executable, "-u", "-m", "scenecaptum.cli", *COMMAND.split()]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        found = re.search(r"http://\S+", server.stdout.readline())
        if found is None:
            raise SystemExit("The server printed no address.")
        take(found[0], folder)
    finally:
        server.send_signal(signal.SIGINT)
        server.wait()


def take(address: str, folder: Path) -> None:
    """Dim the sky on the page at this address, and write a picture of each view."""
    with sync_playwright() as playwright:
        chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
        sandbox = ["--no-sandbox"] if os.geteuid() == 0 else []
        browser = playwright.chromium.launch(executable_path=chromium, args=sandbox)
        for name, view in VIEWS.items():
            page = browser.new_page(**view)
            page.set_default_timeout(PATIENCE)
            page.goto(address)
            page.wait_for_selector(DIMMER)
            page.wait_for_selector(".explore:not([data-busy]):not(:has([data-waiting]))")
            page.locator(DIMMER).first.fill("0.6")
            page.locator(DIMMER).first.blur()
            page.get_by_text("Rendered", exact=True).wait_for()
            page.screenshot(path=folder / f"{name}.png")
            print(folder / f"{name}.png")
            page.close()


if __name__ == "__main__":
    main()
