"""Open every page of the documentation in headless Chromium, and report what a reader would stumble over.

Each page of `docs/_build` (build it first: `make docs`) is opened at the width of a desktop and of a phone, light
and dark. Errors are: a message of the console or a request that fails, a picture that is missing or has no
alternative text, a link within the documentation that leads nowhere, anything that is wider than the page, or
the frame, and does not scroll by itself, and a picture that is shown smaller than it is and that Enter does not
open in its full size, or Escape does not close. The exit status is 1 if there is one. All pages take some minutes.

    python scripts/check_docs.py [--built docs/_build] [--only 'concepts*'] [--shots FOLDER]
"""

from __future__ import annotations

import argparse
import fnmatch
import functools
import http.server
import os
import re
import shutil
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

ROOT = Path(__file__).resolve().parents[1]
WIDTHS = {"desktop": 1280, "phone": 390}
SCHEMES = ("light", "dark")
NAMES = ("chromium", "chromium-browser", "google-chrome")

# What is wider than the window, unless it scrolls by itself, as wide tables and code do.
CLIPPED = """() => {
  const width = document.documentElement.clientWidth, found = [];
  const scrolls = element => ['auto', 'scroll'].includes(getComputedStyle(element).overflowX);
  if (document.scrollingElement.scrollWidth > width + 1)
    found.push(`the page is ${document.scrollingElement.scrollWidth} pixels wide, the window ${width}`);
  for (const element of document.querySelectorAll('[role=main] *')) {
    const box = element.getBoundingClientRect();
    if (!box.width || box.right <= width + 1) continue;
    let parent = element;
    while (!parent.matches('[role=main]') && !scrolls(parent)) parent = parent.parentElement;
    if (parent.matches('[role=main]'))
      found.push(`<${element.tagName.toLowerCase()}> ends at ${Math.round(box.right)} of ${width}`);
  }
  return found.slice(0, 3);
}"""

PICTURES = """() => [...document.querySelectorAll('[role=main] img')].flatMap(image => [
  ...(image.complete && image.naturalWidth ? [] : [`${image.src} is missing`]),
  ...(image.alt.trim().length > 10 ? [] : [`${image.src} has no alternative text`]),
])"""

ENLARGED = "document.querySelector('dialog.enlarged[open] img')?.clientWidth ?? 0"

# Pages in frames are loaded once they come into view.
FRAMES = """() => Promise.all([...document.querySelectorAll('iframe')].map(frame => new Promise(done => {
  frame.addEventListener('load', done);
  frame.loading = 'eager';
  const inner = frame.contentDocument;
  if (inner.readyState === 'complete' && inner.URL !== 'about:blank') done();
})))"""
WIDE = """() => document.scrollingElement.scrollWidth > document.documentElement.clientWidth + 1
  ? [`${document.title} is ${document.scrollingElement.scrollWidth} pixels wide in its frame`] : []"""

LINKS = """() => [...document.querySelectorAll('a[href]')].map(link => link.href.split('?')[0])"""
ANCHORS = """() => [...document.querySelectorAll('[id], a[name]')].map(one => one.id || one.name)"""


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve a folder on this machine, and give its address."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: Any) -> None:
            """Print nothing."""

    server = http.server.ThreadingHTTPServer(
        ("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder))
    )
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/"
    finally:
        server.shutdown()
        server.server_close()


def check_pages(browser: Any, address: str, names: list[str], shots: Path | None) -> list[str]:
    """Return one line for each error on these pages."""
    found: list[str] = []
    links: dict[str, set[str]] = {}
    anchors: dict[str, set[str]] = {}
    for view, width in WIDTHS.items():
        for scheme in SCHEMES:
            context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
            page = context.new_page()
            messages: list[str] = []
            page.on("console", lambda one, to=messages: to.extend(errors(one)))
            page.on("pageerror", lambda error, to=messages: to.append(str(error)))
            page.on("requestfailed", lambda request, to=messages: to.append(f"{request.url} failed"))
            for name in names:
                messages.clear()
                page.goto(address + name, wait_until="load")
                page.evaluate(FRAMES)
                framed = [text for frame in page.frames[1:] for text in frame.evaluate(WIDE)]
                here = [
                    *page.evaluate(PICTURES),
                    *page.evaluate(CLIPPED),
                    *framed,
                    *not_enlarged(page),
                    *messages,
                ]
                found += [f"{name} ({view}, {scheme}): {text}" for text in here]
                if name not in links:
                    links[name] = {one for one in page.evaluate(LINKS) if one.startswith(address)}
                    anchors[name] = set(page.evaluate(ANCHORS))
                if shots:
                    shots.mkdir(parents=True, exist_ok=True)
                    path = shots / f"{name.replace('/', '-').removesuffix('.html')}-{view}-{scheme}.png"
                    page.screenshot(path=path, full_page=True)
            context.close()
    return found + broken(address, links, anchors)


def not_enlarged(page: Any) -> list[str]:
    """Return a line if the first picture shown smaller than it is does not open and close by the keyboard."""
    picture = page.locator("img.enlarges").first
    if not page.locator("img.enlarges").count():
        return []
    width = picture.evaluate("picture => picture.clientWidth")
    picture.press("Enter")
    opened = page.evaluate(ENLARGED)
    page.keyboard.press("Escape")
    if opened > width and not page.evaluate(ENLARGED):
        picture.evaluate("picture => { picture.blur(); scrollTo(0, 0); }")  # as before, for the screenshot
        return []
    return [f"{picture.get_attribute('src')} is {width} pixels wide, opened {opened}, or does not close"]


def errors(message: Any) -> list[str]:
    """Return the text of a message of the console if it is an error; a browser asks for an icon by itself."""
    address = message.location.get("url", "")
    if message.type != "error" or address.endswith("/favicon.ico"):
        return []
    return [f"{message.text} ({address})"]


def broken(address: str, links: dict[str, set[str]], anchors: dict[str, set[str]]) -> list[str]:
    """Return one line for each link to an anchor that does not exist, among the pages that were opened."""
    found = []
    for name, targets in links.items():
        for target in sorted(targets):
            path, _, anchor = target.removeprefix(address).partition("#")
            path = path or "index.html"
            if path in anchors and anchor and anchor not in anchors[path]:
                found.append(f"{name}: no anchor #{anchor} in {path}")
    return found


def missing_files(built: Path, names: list[str]) -> list[str]:
    """Return one line for each link to a file that does not exist."""
    found = []
    for name in names:
        for link in set(re.findall(r'(?:href|src)="([^"]+)"', (built / name).read_text())):
            parts = urlsplit(link)
            target = (built / name).parent / unquote(parts.path)
            if not parts.scheme and not parts.netloc and parts.path and not target.exists():
                found.append(f"{name}: {link} does not exist")
    return found


def main() -> None:
    """Check the pages, and print the errors."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--built", type=Path, default=ROOT / "docs" / "_build", help="folder of the HTML")
    parser.add_argument("--only", default="*", metavar="GLOB", help="the pages to open, such as 'concepts*'")
    parser.add_argument(
        "--shots", type=Path, metavar="FOLDER", help="where to write a screenshot of each view"
    )
    options = parser.parse_args()
    names = sorted(
        str(path.relative_to(options.built))
        for path in options.built.rglob("*.html")
        if fnmatch.fnmatch(str(path.relative_to(options.built)), options.only)
    )
    program = next(filter(None, map(shutil.which, NAMES)), None)
    if not names or program is None:
        sys.exit("no pages: run `make docs`" if not names else f"no browser: none of {', '.join(NAMES)}")
    from playwright.sync_api import sync_playwright

    sandbox = ["--no-sandbox"] if os.geteuid() == 0 else []
    with served(options.built) as address, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=sandbox)
        found = check_pages(browser, address, names, options.shots) + missing_files(options.built, names)
        browser.close()
    print("\n".join(found))
    print(f"{len(names)} pages, {len(WIDTHS) * len(SCHEMES)} views of each: {len(found)} errors")
    sys.exit(bool(found))


if __name__ == "__main__":
    main()
