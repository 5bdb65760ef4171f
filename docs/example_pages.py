"""Make a page of each notebook and of each script in examples/, for the Sphinx build.

A notebook is copied with its stored outputs; nothing is run. The page of a script shows its docstring, the
pictures in docs/pictures that it drew, what it printed (docs/outputs), and its source. The titles are those of
the links in examples.md. The pages are written to docs/generated, which is not part of the repository.
"""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parent
EXAMPLES = DOCS.parent / "examples"
GENERATED = DOCS / "generated"

# The figures of each script; the first page that shows one, or its thumbnail, has its alternative text.
DRAWN = {
    "chair_logit": ["chair-logit.png"],
    "desk_lamp": ["desk-lamp.png"],
    "figures": [f"guides/seeing-{name}.webp" for name in ("specificity", "luminance", "ranks")],
    "gaussian_splats": ["thumbnails/gaussian-splats.jpg"],
    "lost_view": ["lost-view.png"],
    "office_glare": ["office-optimized.png"],
    "own_metric": ["own-metric.png"],
    "pixels_or_scene": ["pixels-or-scene.png"],
    "planted_shortcut": ["shortcut-pictures.png", "shortcut-bars.png", "shortcut-trainings.png"],
    "readme_picture": ["office.png"],
    "rooms_study": ["rooms-ugr.png"],
    "specificity": ["specificity-contrast.png"],
    "train_shape_classifier": ["shape-images.webp"],
    "two_designs": ["two-designs.png"],
    "which_lamp": ["lamps-luminance.png", "lamps-ugr.png"],
    "work_plane": ["work-plane.png"],
}

# Alternative texts of pictures that no other page shows.
ALTERNATIVES = {
    "lamps-luminance.png": "Bars of what each lamp adds to the mean luminance: 375 cd/m² from the sky",
    "lamps-ugr.png": "Bars of the effects of each lamp on UGR: the sky raises it by 3.8, others lower it by 0.2",
    "office-optimized.png": "The office before and after the optimization, and the curve of UGR below its goal",
    "shape-images.webp": "Rows of spheres, cubes and cylinders in front of walls, in random colours and lights",
    "specificity-contrast.png": "Bars and maps of the effects on mean luminance, UGR, and the desk's contrast",
}


def write_pages() -> None:
    """Write the pages of all notebooks and scripts."""
    for path in sorted((EXAMPLES / "notebooks").glob("*.ipynb")):
        _write(GENERATED / "notebooks" / path.name, notebook_page(path))
    for name in scripts():
        _write(GENERATED / "scripts" / f"{name}.md", script_page(name))


def scripts() -> list[str]:
    """Return the names of the scripts, without the module of their options."""
    return sorted(path.stem for path in EXAMPLES.glob("*.py") if path.stem[0] != "_")


def linked_to_pages(text: str) -> str:
    """Replace links to notebooks and scripts, which GitHub shows, by links to their pages."""
    text = re.sub(r"\]\(\.\./examples/notebooks/(\w+)\.ipynb\)", r"](generated/notebooks/\1.ipynb)", text)
    return re.sub(r"\]\(\.\./examples/(\w+)\.py\)", r"](generated/scripts/\1.md)", text)


def titles() -> dict[str, str]:
    """Return the titles that examples.md gives to scripts, by name."""
    link = re.compile(r"\*\*([^*]+)\*\*\]\(\.\./examples/(\w+)\.py\)")
    return {name: title for title, name in link.findall((DOCS / "examples.md").read_text())}


def notebook_page(path: Path) -> str:
    """Return a notebook whose links lead to pages, and whose figures have alternative texts."""
    notebook = json.loads(path.read_text())
    heading = path.stem
    for cell in notebook["cells"]:
        if cell["cell_type"] == "markdown":
            cell["source"] = "".join(cell["source"]).replace("](../../docs/", "](../../")
            heading = [heading, *re.findall(r"^#+ (.*)$", cell["source"], re.MULTILINE)][-1]
        elif any("image/png" in output.get("data", {}) for output in cell["outputs"]):
            cell["metadata"]["mystnb"] = {"image": {"alt": _figure(heading, cell)}}
    return json.dumps(notebook)


def _figure(heading: str, cell: dict[str, Any]) -> str:
    """Return the alternative text of a cell's figure: where it is, and which call has drawn it."""
    calls = re.findall(r"[\w.]*\bplot(?:_\w+)?\(.*\)", "".join(cell["source"]))
    return f"Figure: {heading}" + (f", drawn by {calls[-1]}" if calls else "")


def script_page(name: str) -> str:
    """Return the page of a script as Markdown."""
    text = ast.get_docstring(ast.parse((EXAMPLES / f"{name}.py").read_text())) or ""
    parts = [f"# {titles()[name]}", _with_commands(text.replace("``", "`"))]
    guides = [f"[{title}](../../{page})" for page, title in _guides(name)]
    if guides:
        parts.append(f"More about it: {', '.join(guides)}.")
    parts += [f"![{_alternative(one)}](../../pictures/{one})" for one in DRAWN.get(name, ())]
    output = DOCS / "outputs" / f"{name}.txt"
    if output.exists():
        parts += ["## What it prints", f"```text\n{output.read_text().rstrip()}\n```"]
    parts += [
        f"## `examples/{name}.py`",
        f"```{{literalinclude}} ../../../examples/{name}.py\n:start-at: from __future__\n```",
    ]
    return "\n\n".join(parts) + "\n"


def _with_commands(text: str) -> str:
    """Return a docstring as Markdown, in which commands are code."""
    return re.sub(r"^ *(python examples/.*)$", r"```sh\n\1\n```", text, flags=re.MULTILINE)


def _guides(name: str) -> Iterator[tuple[str, str]]:
    """Return the pages that name a script, with their titles."""
    for page in sorted(DOCS.glob("*.md")):
        text = page.read_text()
        if page.name not in ("examples.md", "index.md") and f"examples/{name}.py" in text:
            yield page.name, re.findall(r"^# (.*)$", text, re.MULTILINE)[0]


def _alternative(picture: str) -> str:
    """Return the alternative text of a picture, or that of its thumbnail."""
    if picture in ALTERNATIVES:
        return ALTERNATIVES[picture]
    pages = "\n".join(page.read_text() for page in sorted(DOCS.glob("*.md")))
    place = re.escape(picture.rpartition(".")[0].removeprefix("thumbnails/"))
    return re.findall(rf"!\[([^]]+)\]\(pictures/(?:thumbnails/)?{place}\.", pages)[0]


def _write(path: Path, text: str) -> None:
    """Write a file, unless it has this text already: Sphinx reads again what is newer."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists() or path.read_text() != text:
        path.write_text(text)
