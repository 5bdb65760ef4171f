"""Assemble the page and write it atomically."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import TYPE_CHECKING, Any

from ..attr import Explanation
from ..files import atomic_write
from ..protocols import Attribution
from ..scene import scene_heading
from ._data import Comparison, check, default_titles, report_data

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SCRIPTS = ("data.js", "picture.js", "table.js", "detail.js", "page.js")


@dataclass(frozen=True)
class Section:
    """Another part of the page, which draws itself with an ES module.

    Attributes
    ----------
    name
        Of its element ``<div id="NAME" data-NAME="recorded">``; its data is in the element ``NAME-data``.
    title
        Its heading.
    style, module
        Its style sheet and its ES module.
    data
        JSON.
    """

    name: str
    title: str
    style: str
    module: str
    data: str


def write_report(
    attributions: Attribution | Explanation | Sequence[Attribution | Explanation],
    path: str | os.PathLike[str],
    titles: Sequence[str] | None = None,
    *,
    title: str | None = None,
    plans: Sequence[Figure | None] | None = None,
    comparison: Comparison | None = None,
    sections: Sequence[Section] = (),
    denoised: bool = True,
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
    title
        The heading of the page; the name of the scene by default.
    plans
        A figure for each result of a sensor grid, such as that of ``visualization.plot_plan``, or None for a
        result with a picture. It stands in place of the picture and has no overlay.
    comparison
        The change from the first of two results of one metric to the second. It stands on top, with the values of
        the parameters that differ.
    sections
        Further parts of the page, such as ``explore.section``.
    denoised
        Show the renders denoised, for the eye; False shows the images on which the metric was evaluated. No number
        depends on it.

    Raises
    ------
    SceneCaptumError
        If a result has no image or no map of the surfaces in it, and no plan, if ``comparison`` is given of other
        than two results of one metric, or if the file cannot be written.
    """
    given = list(attributions) if isinstance(attributions, Sequence) else [attributions]
    explanations = [one if isinstance(one, Explanation) else None for one in given]
    results = [one.attribution if isinstance(one, Explanation) else one for one in given]
    drawn = [None] * len(results) if plans is None else list(plans)
    check(results, titles, drawn, comparison)
    names = default_titles(results) if titles is None else [str(title) for title in titles]
    data = report_data(results, names, explanations, drawn, comparison, denoised=denoised)
    named = (str(one.info["scene"]) for one in results if one.info.get("scene"))
    scenes = list(dict.fromkeys(map(scene_heading, named)))
    heading = title or ", ".join(scenes) or "Scene"
    name = title or " · ".join([*scenes[:2], "scene attribution"])
    _write(path, _page({"heading": heading, **data}, name, sections))


def write_section(section: Section, path: str | os.PathLike[str], scene: str) -> None:
    """Write a section as a page of its own: one self-contained HTML file, which needs no network.

    Example
    -------
    >>> write_section(explore.section(exploration), "what-if.html", "office")  # doctest: +SKIP

    Parameters
    ----------
    section
        What the page shows, such as ``explore.section``.
    path
        The file to write, atomically.
    scene
        The name or path of the scene, for the title of the page.

    Raises
    ------
    SceneCaptumError
        If the file cannot be written.
    """
    parts = {"title": html.escape(f"{scene_heading(scene)} · {section.title}"), "section": _content(section)}
    _write(path, fill_template(_resource("section.html"), parts, [section.style], [section.module]))


def _write(path: str | os.PathLike[str], page: str) -> None:
    with atomic_write(path) as partial:
        partial.write_bytes(page.encode("utf-8", "replace"))


def _page(data: dict[str, Any], title: str, sections: Sequence[Section]) -> str:
    script = "\n".join(map(_resource, _SCRIPTS))
    wrapped = f'"use strict";\n(() => {{\n{script}\n}})();\n'
    parts = {
        "title": html.escape(title),
        "script": wrapped,
        "data": _to_json(data),
        "sections": "\n".join(map(_section, sections)),
    }
    styles = [_resource("report.css"), *(section.style for section in sections)]
    scripts = [wrapped, *(section.module for section in sections)]
    return fill_template(_resource("report.html"), parts, styles, scripts)


def fill_template(
    template: str, parts: Mapping[str, str], styles: Sequence[str], scripts: Sequence[str]
) -> str:
    """Return a page: a template with its ``{{parts}}``, and the head and the style of all pages before its own.

    The content security policy allows only this style and these scripts, so that names in a scene stay text.
    """
    style = "\n".join([_resource("base.css"), *styles])
    hashes = {
        "style": style,
        "style_hash": _hash(style),
        "script_hashes": " ".join(f"'{_hash(script)}'" for script in scripts),
    }
    values = {**parts, **hashes}
    return re.sub(
        r"\{\{(\w+)\}\}", lambda match: values[match[1]], template.replace("{{head}}", _resource("head.html"))
    )


def _section(section: Section) -> str:
    title = html.escape(section.title)
    return f'<section aria-label="{title}"><h2>{title}</h2>{_content(section)}</section>'


def _content(section: Section) -> str:
    name = html.escape(section.name)
    return (
        f'<div id="{name}" data-{name}="recorded"></div>\n'
        f'<script type="application/json" id="{name}-data">{_escaped(section.data)}</script>\n'
        f'<script type="module">{section.module}</script>'
    )


def _resource(name: str) -> str:
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")


def _to_json(data: Any) -> str:
    """Return JSON without characters that an HTML parser could read as markup."""
    return _escaped(json.dumps(data, ensure_ascii=True, allow_nan=False, separators=(",", ":")))


def _escaped(text: str) -> str:
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _hash(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"
