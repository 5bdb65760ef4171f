"""The report of a study: an index with summaries, figures and all cells, and a page for each cell."""

from __future__ import annotations

import contextlib
import dataclasses
import html
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from tqdm import tqdm

from ..attr import Explanation, SceneAttribution, versions
from ..errors import SceneCaptumError
from ..explanation import FACTOR
from ..files import atomic_write, write_error
from ..report import encode_figure, fill_template, write_report
from ..visualization import Format, findings, format_with_error, pluralize, rounded
from ._cell_effects import CellResults, Group
from ._figures import MIN_GROUPS, plot_effect_by_room, plot_gallery, plot_rank_stability
from ._notes import columns_of, count_of_cautions, mark_of, notes_of
from ._recipe import Cell
from ._summary import GroupEffect, Summary, heading, summarize_effects, table_columns

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INDEX, PAGES = "index.html", "cells"
RELATIVE = f"at {FACTOR:g} × the mean"  # the other threshold of a glare rating
CSS_INCH = 96  # pixels of a page
MAX_EFFECTS = 4  # figures for each metric, design and method

_AXES = {
    "scene": "room",
    "camera": "camera",
    "metric": "metric",
    "design": "design",
    "method": "method",
    "seed": "seed",
}


class Reported(CellResults, Protocol):
    """What the report knows of a ``StudyResult``, beside its cells."""

    @property
    def folder(self) -> Path:
        """The folder of the study."""


def write_study_report(
    result: Reported,
    path: str | os.PathLike[str],
    group: Group = "kind",
    *,
    pages: bool = True,
    show_progress: bool = False,
) -> Path:
    """Write the report of a study, and return the path of its index; see ``StudyResult.write_report``."""
    index = Path(path) if Path(path).suffix in (".html", ".htm") else Path(path, INDEX)
    try:
        (index.parent / PAGES).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(index, error) from error
    if pages:
        for cell, key in tqdm(result.cells.items(), disable=not show_progress, unit="page"):
            _write_page(result, cell, _page_of(index, key))
    text = _index(result, index, group)
    with atomic_write(index) as partial:
        partial.write_bytes(text.encode("utf-8", "replace"))
    return index


def _page_of(index: Path, key: str) -> Path:
    return index.parent / PAGES / f"{key}.html"


def _write_page(result: Reported, cell: Cell, path: Path) -> None:
    """Write the page of a cell, unless it has no picture, as with a sensor grid or a value alone."""
    if not result.numbers(cell)["rows"]:
        return
    attribution = result.attribution(cell)
    if _has_picture(attribution):
        notes = tuple(result.numbers(cell).get("notes", ()))
        shown = Explanation(attribution, premises=notes, count=0) if notes else attribution
        write_report(shown, path, titles=[str(cell)])


def _has_picture(attribution: SceneAttribution) -> bool:
    surfaces, image = attribution.surfaces, attribution.image
    return surfaces is not None and image is not None and tuple(image.shape) == (*surfaces.shape, 3)


def _index(result: Reported, index: Path, group: Group) -> str:
    """Return the text of the index."""
    has_effects = any(result.numbers(cell)["rows"] for cell in result.cells)
    summary = summarize_effects(result, group) if has_effects else None
    axes = [axis for axis in _AXES if axis in ("scene", "metric") or len(_names(result, axis)) > 1]
    is_relative = any("relative_rating" in result.numbers(cell) for cell in result.cells)
    values = ["value", *([RELATIVE] if is_relative else [])]
    is_marked = any(mark_of(result.numbers(cell)) for cell in result.cells)
    marks = ["caution"] if is_marked else []
    columns = [*(_AXES[axis] for axis in axes), *values, "verdict", *marks, "seconds", "status"]
    numeric = (*values, "seconds", "seed")
    script = _resource("index.js")
    rows = [*_rows(result, index, axes, values, marks)]
    notes = notes_of(result, result.cells, with_advice=False)
    if summary is None and (count := count_of_cautions(result, result.cells)):
        notes = [count, *notes]
    name = html.escape(result.folder.resolve().name or str(result.folder))
    parts = {
        "title": f"{name} · study",
        "name": name,
        "counts": html.escape(_counts(result)),
        "summary": "" if summary is None else _summary(summary),
        "figures": "" if summary is None else _figures(result, summary, group),
        "columns": "".join(
            f'<th scope="col"{_class("number" if name in numeric else "")}>{name}</th>' for name in columns
        ),
        "rows": "\n".join(rows),
        "notes": "".join(f"<p>{html.escape(note)}</p>" for note in notes),
        "cell_count": str(len(rows)),
        "facts": html.escape(", ".join(f"{name} {version}" for name, version in versions().items())),
        "script": script,
    }
    return fill_template(_resource("index.html"), parts, [_resource("index.css")], [script])


def _resource(name: str) -> str:
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")


def _names(result: Reported, axis: str) -> list[str]:
    cells = [*result.cells, *result.failures, *result.missing]
    return list(dict.fromkeys(str(getattr(cell, axis)) for cell in cells))


def _counts(result: Reported) -> str:
    """Return the cells by their state, and the sizes of the axes."""
    states = {"finished": result.cells, "failed": result.failures, "missing": result.missing}
    cells = [f"{len(found)} {state}" for state, found in states.items() if found or state == "finished"]
    axes = [pluralize(len(_names(result, axis)), name) for axis, name in _AXES.items()]
    return f"{', '.join(cells)} · {', '.join(axes)}"


def _summary(summary: Summary) -> str:
    tables = "\n".join(_table(rows, f"summary-{n}") for n, (_, rows) in enumerate(summary.by_question()))
    # What the values take for granted stands below the table that has them.
    shown = findings(dataclasses.replace(summary, premises=()).notes())
    notes = "".join(f"<p>{html.escape(note)}</p>" for note in shown)
    return (
        f'<section aria-labelledby="summary-heading"><h2 id="summary-heading">Over all rooms</h2>\n{tables}\n'
        f'<div class="notes">{notes}</div></section>'
    )


def _table(rows: Sequence[GroupEffect], name: str) -> str:
    """Return the table of one metric, design and method; ``name`` is the id of its heading."""
    columns = table_columns(rows)
    head = "".join(f'<th scope="col"{_class(_kind(name))}>{html.escape(name)}</th>' for name in columns)
    lines = []
    for cells in zip(*columns.values(), strict=True):
        first, *others = (html.escape(cell.strip()) for cell in cells)
        written = "".join(
            f"<td{_class(_kind(name))}>{cell}</td>" for name, cell in zip([*columns][1:], others, strict=True)
        )
        lines.append(f'<tr><th scope="row" class="name">{first}</th>{written}</tr>')
    body = "\n".join(lines)
    return (
        f'<h3 id="{name}">{html.escape(heading(rows))}</h3>'
        f'<div class="wide" role="region" tabindex="0" aria-labelledby="{name}">'
        f'<table aria-labelledby="{name}">\n<thead><tr>{head}</tr></thead>\n'
        f"<tbody>\n{body}\n</tbody></table></div>"
    )


def _kind(column: str) -> str:
    return "name" if column == "group" else "number"


def _class(names: str) -> str:
    return f' class="{names}"' if names else ""


def _figures(result: Reported, summary: Summary, group: Group) -> str:
    """Return the figures of each metric, design and method, and that of the rankings."""
    parts = []
    for (metric, design, method), rows in summary.by_question():
        draws = [
            partial(plot_effect_by_room, summary, row.group, metric=metric, design=design, method=method)
            for row in rows[:MAX_EFFECTS]
        ]
        drawn = list(map(_figure, draws))
        with contextlib.suppress(SceneCaptumError):  # points of a sensor grid are no picture
            drawn.append(_image(plot_gallery(result, metric=metric, design=design, method=method)))
        parts.append(_section(heading(rows), drawn))
    return "\n".join([*parts, _rankings(result, group)])


def _rankings(result: Reported, group: Group) -> str:
    """Return the section on rankings: of the groups or, where too few are in common, of single parameters."""
    title = "How stable the rankings are"
    of_parameters = (
        f"How stable the rankings of single parameters are (fewer than {MIN_GROUPS} groups in common)"
    )
    for text, one in ((title, group), (of_parameters, None)):
        with contextlib.suppress(SceneCaptumError):
            return _section(text, [_image(plot_rank_stability(result, one))])
    return _section(title, [_figure(partial(plot_rank_stability, result, None))])


def _section(title: str, figures: Iterable[str]) -> str:
    text, drawn = html.escape(title), "\n".join(figures)
    return f'<section aria-label="{text}"><h2>{text}</h2>\n<div class="drawn">{drawn}</div></section>'


def _figure(draw: Callable[[], Figure]) -> str:
    """Return a figure, or the reason why there is none."""
    try:
        return _image(draw())
    except SceneCaptumError as error:
        return f'<p class="muted">{html.escape(str(error))}</p>'


def _image(figure: Figure) -> str:
    """Return a figure with its title as alternative text."""
    source, _ = encode_figure(figure)
    # Its own size in inches: the page shows the letters of all figures alike.
    width, height = (round(CSS_INCH * side) for side in figure.get_size_inches())
    titles = [figure.get_suptitle(), *(ax.get_title(loc="left") for ax in figure.axes)]
    text = html.escape(" ".join(next(filter(None, titles), "figure").split()))
    return f'<figure><img src="{source}" alt="{text}" width="{width}" height="{height}"></figure>'


def _rows(
    result: Reported, index: Path, axes: Sequence[str], values: Sequence[str], marks: Sequence[str]
) -> Iterator[str]:
    """Yield a row of the table for each cell, those with an error first.

    ``values`` are columns of numbers, and ``marks`` that of the cautions, if there are any.
    """
    unknown = "<td></td>" * len(values)
    no_words = "<td></td>" * (1 + len(marks))
    for cell, error in result.failures.items():
        yield _row(
            cell,
            axes,
            unknown,
            no_words,
            "",
            f'<td class="words failed" data-key="failed">failed: {html.escape(error)}</td>',
        )
    for cell, key in result.cells.items():
        numbers = result.numbers(cell)
        number = numbers["value"], numbers["standard_error"]
        value = f"{format_with_error(*number)} {numbers['unit']}".strip()
        relative = numbers.get("relative_rating")
        beside = "" if relative is None else Format.of(*number).write(relative)
        written = [(numbers["value"], value), (relative, beside)]
        yield _row(
            cell,
            axes,
            "".join(_number(*one) for one in written[: len(values)]),
            f'<td class="words">{html.escape(numbers["verdict"])}</td>' + (_mark(numbers) if marks else ""),
            rounded(numbers["seconds"], 2),
            "<td>finished</td>",
            f"{PAGES}/{key}.html" if _page_of(index, key).is_file() else "",
        )
    for cell in result.missing:
        yield _row(cell, axes, unknown, no_words, "", "<td>missing</td>")


def _mark(numbers: Mapping[str, Any]) -> str:
    """Return the cell of the table that says what puts a value or its effects in doubt."""
    words = mark_of(numbers)
    if not words:
        return "<td></td>"
    full = "; ".join(filter(None, [columns_of(numbers)["caution"], numbers.get("convergence_note")]))
    return f'<td class="words marked" title="{html.escape(full)}">! {html.escape(words)}</td>'


def _number(number: float | None, written: str) -> str:
    """Return a cell of the table that is sorted by its number."""
    key = "" if number is None else repr(number)
    return f'<td class="number" data-key="{key}">{html.escape(written)}</td>'


def _row(
    cell: Cell, axes: Sequence[str], values: str, words: str, seconds: str, status: str, link: str = ""
) -> str:
    """Return a row; ``values``, ``words`` and ``status`` are cells, the others text."""
    names = [html.escape(str(getattr(cell, axis))) for axis in axes]
    first = f'<a href="{link}">{names[0]}</a>' if link else names[0]
    others = "".join(
        f"<td{_class('number' if axis == 'seed' else 'name')}>{name}</td>"
        for axis, name in zip(axes[1:], names[1:], strict=True)
    )
    return (
        f'<tr><th scope="row" class="name">{first}</th>{others}{values}{words}'
        f'<td class="number">{seconds}</td>{status}</tr>'
    )
