"""Draw the pictures of the guides from the examples above them, rendered finer than in the tests.

A picture in docs/pictures/guides shows what the last statement of the example above it returns: a figure, or an
image of linear radiance. Here, the examples of a page run with more pixels and samples; the tests run them as they
are written. The style is that of docs/matplotlibrc.

    python docs/guide_pictures.py [PAGE ...]
"""

from __future__ import annotations

import argparse
import ast
import doctest
import re
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib as mpl
import torch
from PIL import Image

from scenecaptum.visualization import display_image

DOCS = Path(__file__).parent
PARTS = re.compile(
    r"^```python\n(?P<code>.*?)^```$|^!\[[^]]*\]\((?P<picture>pictures/guides/[\w-]+\.webp)\)$",
    re.DOTALL | re.MULTILINE,
)
PIXELS, SAMPLES = 5, 2  # times as many along each side, and in each pixel
QUALITY = 90


def steps(page: Path) -> Iterator[tuple[str, str | None]]:
    """Yield the code of each example of a page, with the picture that follows it before the next one."""
    code = None
    for part in PARTS.finditer(page.read_text()):
        if part["code"] is not None:
            if code is not None:
                yield code, None
            examples = doctest.DocTestParser().get_examples(part["code"])
            code = "".join(example.source for example in examples if not example.exc_msg)
        elif code is None:
            raise SystemExit(f"{page.name}: no example is directly above {part['picture']}.")
        else:
            yield code, part["picture"]
            code = None
    if code is not None:
        yield code, None


def finer(code: str) -> str:
    """Return code that renders more pixels and samples."""

    def pixels(match: re.Match[str]) -> str:
        return f"resolution=({PIXELS * int(match[1])}, {PIXELS * int(match[2])})"

    code = re.sub(r"\bresolution=\((\d+), (\d+)\)", pixels, code)
    return re.sub(r"\bspp=(\d+)\b", lambda match: f"spp={SAMPLES * int(match[1])}", code)


def run(code: str, names: dict[str, Any]) -> Any:
    """Run code, and return what its last statement assigns or returns."""
    *others, last = ast.parse(code).body
    exec(compile(ast.Module(others, []), "<example>", "exec"), names)
    if isinstance(last, ast.Expr):
        return eval(compile(ast.Expression(last.value), "<example>", "eval"), names)
    exec(compile(ast.Module([last], []), "<example>", "exec"), names)
    return names[ast.unparse(last.targets[0])] if isinstance(last, ast.Assign) else None


def draw(page: Path) -> None:
    """Run a page's examples, up to that of its last picture, and write its pictures."""
    parts = list(steps(page))
    while parts and parts[-1][1] is None:
        parts.pop()
    names: dict[str, Any] = {"__name__": "__main__"}
    for code, picture in parts:
        value = run(finer(code), names)
        if picture is not None:
            began = time.perf_counter()
            save(value, DOCS / picture)
            print(f"{picture}: {time.perf_counter() - began:.1f} s", flush=True)


def save(value: Any, path: Path) -> None:
    """Write a figure, or an image of linear radiance, as WebP: a tenth of the size of a PNG, with transparency."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(value, torch.Tensor):
        pixels = (display_image(value) * 255).round().to(torch.uint8)
        Image.fromarray(pixels.numpy(force=True)).save(path, quality=QUALITY, method=6)
    else:
        value.savefig(path, pil_kwargs={"quality": QUALITY, "method": 6})


def main() -> None:
    """Draw the pictures of the named pages, or of all that have some."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("pages", nargs="*", metavar="PAGE", help="such as getting-started")
    names = parser.parse_args().pages
    mpl.rc_file(DOCS / "matplotlibrc")
    pages = [DOCS / f"{name}.md" for name in names] or sorted(DOCS.glob("*.md"))
    for page in pages:
        if "](pictures/guides/" in page.read_text():
            draw(page)
        elif names:
            sys.exit(f"{page.name} has no picture in pictures/guides.")


if __name__ == "__main__":
    main()
