"""Assemble the page and write it atomically."""

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

from ..attr import Explanation
from ..files import atomic_write
from ..protocols import Attribution
from ._data import check, default_titles, report_data

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SCRIPTS = ("data.js", "picture.js", "table.js", "detail.js", "page.js")


def write_report(
    attributions: Attribution | Explanation | Sequence[Attribution | Explanation],
    path: str | os.PathLike[str],
    titles: Sequence[str] | None = None,
    *,
    plans: Sequence[Figure | None] | None = None,
) -> None:
    """Write results as one self-contained HTML file to explore in a browser; it needs no network.

    It shows the render with an overlay of saliency, the parameters of every object with their values and
    attributions, a table to sort and filter, the numbers for download, and all settings.

    Example
    -------
    >>> write_report([luminance, glare], "report.html", titles=["Brightness", "Glare"])  # doctest: +SKIP

    Parameters
    ----------
    attributions
        A result or several, of any metrics, cameras and designs; or explanations, whose sentences stand on top.
    path
        The file to write, atomically.
    titles
        A title for each result; its metric by default.
    plans
        A figure for each result of a sensor grid, such as that of ``visualization.plot_plan``, or None for a
        result with a picture. It stands in place of the picture and has no overlay.

    Raises
    ------
    SceneCaptumError
        If a result has no image or no map of the surfaces in it, and no plan, or the file cannot be written.
    """
    given = list(attributions) if isinstance(attributions, Sequence) else [attributions]
    explanations = [one if isinstance(one, Explanation) else None for one in given]
    results = [one.attribution if isinstance(one, Explanation) else one for one in given]
    drawn = [None] * len(results) if plans is None else list(plans)
    check(results, titles, drawn)
    names = default_titles(results) if titles is None else [str(title) for title in titles]
    page = _page(report_data(results, names, explanations, drawn))
    with atomic_write(path) as partial:
        partial.write_bytes(page.encode("utf-8", "replace"))


def _page(data: dict[str, Any]) -> str:
    style, script = _resource("report.css"), "\n".join(map(_resource, _SCRIPTS))
    scenes = list(dict.fromkeys(str(result["info"].get("scene", "")) for result in data["results"]))
    parts = {
        "title": html.escape(" · ".join(filter(None, [*scenes[:2], "scene attribution"]))),
        "style": style,
        "script": f'"use strict";\n(() => {{\n{script}\n}})();\n',
        "data": _to_json(data),
    }
    # The content security policy allows only this script and this style, so names in a scene stay text.
    parts |= {f"{name}_hash": _hash(parts[name]) for name in ("style", "script")}
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], _resource("report.html"))


def _resource(name: str) -> str:
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")


def _to_json(data: Any) -> str:
    """Return JSON without characters that an HTML parser could read as markup."""
    text = json.dumps(data, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _hash(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"
