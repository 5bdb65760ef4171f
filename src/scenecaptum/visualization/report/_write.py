"""Putting the page together, and writing it whole or not at all."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import os
import re
from collections.abc import Sequence
from importlib import resources
from typing import TYPE_CHECKING, Any

from ..._writing import whole_file
from ._data import check, default_titles, report_data

if TYPE_CHECKING:
    from ...attr import SceneAttribution

_SCRIPTS = ("data.js", "picture.js", "table.js", "detail.js", "page.js")


def write_report(
    attributions: Sequence[SceneAttribution],
    path: str | os.PathLike[str],
    titles: Sequence[str] | None = None,
) -> None:
    """Write results as one HTML file to explore in a browser: it needs no network and no installation.

    It shows the render under an overlay of saliency, every object's parameters with their values and
    attributions, a table to sort and filter, the numbers for download, and how they were computed.

    Example
    -------
    >>> write_report([luminance, glare], "report.html", titles=["Brightness", "Glare"])  # doctest: +SKIP

    Parameters
    ----------
    attributions
        One or more results, of any metrics, cameras and designs.
    path
        Where to write it; the file appears whole or not at all.
    titles
        A name for each result; its metric by default.

    Raises
    ------
    SceneCaptumError
        Where a result has no picture or does not know what its pixels show, or the file cannot be written.
    """
    attributions = list(attributions)
    check(attributions, titles)
    names = default_titles(attributions) if titles is None else [str(title) for title in titles]
    page = _page(report_data(attributions, names))
    with whole_file(path) as partial:
        partial.write_bytes(page.encode("utf-8", "replace"))


def _page(data: dict[str, Any]) -> str:
    style, script = _resource("report.css"), "\n".join(map(_resource, _SCRIPTS))
    scenes = list(dict.fromkeys(str(one["info"].get("scene", "")) for one in data["results"]))
    parts = {
        "title": html.escape(" · ".join(filter(None, [*scenes[:2], "scene attribution"]))),
        "style": style,
        "script": f'"use strict";\n(() => {{\n{script}\n}})();\n',
        "data": _embedded(data),
    }
    # The page may run this script and use this style, and nothing else: what a scene's names say stays text.
    parts |= {f"{one}_hash": _hash(parts[one]) for one in ("style", "script")}
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], _resource("report.html"))


def _resource(name: str) -> str:
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")


def _embedded(data: Any) -> str:
    """Write JSON that no HTML parser reads as markup, whatever the strings in it."""
    text = json.dumps(data, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _hash(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"
