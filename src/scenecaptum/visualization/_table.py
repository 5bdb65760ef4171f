"""The ranking as a table, for terminals and for notebooks."""

from __future__ import annotations

import html
import shutil
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from ._numbers import Format, align_decimals, columns, cut, pad, shorten, with_error
from ._words import (
    caution_groups,
    convergence_words,
    count_words,
    doubt_groups,
    method_name,
    metric_line,
    pack,
    quantity,
    sampling_words,
    scene_cautions,
)

if TYPE_CHECKING:
    from ..attr import Ranked, SceneAttribution

ROWS = 40
_MOST_CHANNELS = 4
_WIDTH = 100  # where there is no terminal
_NARROWEST_NAME = 16
_WIDEST_NAME = 80


class _Row(NamedTuple):
    """One line of the table; ``gradient`` is padded so that its numbers stand below each other."""

    rank: str
    name: str
    mark: str
    saliency: str
    gradient: str


@dataclass(frozen=True)
class _Table:
    heading: list[str]
    columns: _Row
    rows: list[_Row]
    notes: list[str]


def table_text(attribution: SceneAttribution, top: int | None = ROWS) -> str:
    """Lay out the ranking for a terminal, no line wider than it is.

    Parameters
    ----------
    attribution
        What to show.
    top
        How many parameters; None shows all.
    """
    table = _table(attribution, top)
    width = shutil.get_terminal_size(fallback=(_WIDTH, 24)).columns
    lines = [
        part
        for line in pack(table.heading, width)
        for part in textwrap.wrap(line, max(width, 20), subsequent_indent="   ", break_on_hyphens=False)
    ]
    lines += ["", *_grid([table.columns, *table.rows], width)]
    for note in table.notes:
        lines += textwrap.wrap(note, max(width, 20), subsequent_indent="   ", break_on_hyphens=False)
    return "\n".join(cut(line, width, 0) for line in lines)


def table_html(attribution: SceneAttribution, top: int | None = ROWS) -> str:
    """Lay out the ranking for a notebook, light or dark: it borrows the page's colours.

    Parameters
    ----------
    attribution
        What to show.
    top
        How many parameters; None shows all.
    """
    table = _table(attribution, top)
    metric, *rest = (html.escape(part) for part in table.heading)
    rows = "\n".join(f"<tr>{_cells(row, 'td')}</tr>" for row in table.rows)
    notes = "".join(f"<div>{html.escape(note)}</div>" for note in table.notes)
    return (
        f'<div class="scenecaptum">\n{STYLE}\n'
        f"<div><b>{metric}</b>{''.join(f' · {part}' for part in rest)}</div>\n"
        f"<table>\n<thead><tr>{_cells(table.columns, 'th')}</tr></thead>\n"
        f"<tbody>\n{rows}\n</tbody>\n</table>\n"
        f'<div class="notes">{notes}</div>\n</div>'
    )


# Notebooks bring styles of their own for tables; with the class named twice these are specific enough to win.
STYLE = """<style>
.scenecaptum { color: inherit; font-size: 0.9em; }
.scenecaptum table { border-collapse: collapse; border: none; margin: 0.5em 0; width: auto; display: table; }
.scenecaptum.scenecaptum table tr { background: transparent; border: none; }
.scenecaptum.scenecaptum table th, .scenecaptum.scenecaptum table td {
  color: inherit; background: transparent; border: none; padding: 0.1em 0.7em; text-align: left;
  white-space: pre; border-bottom: 1px solid rgba(128, 128, 128, 0.25); }
.scenecaptum.scenecaptum table th { font-weight: 600; border-bottom: 1px solid rgba(128, 128, 128, 0.8); }
.scenecaptum.scenecaptum td.number { font-family: ui-monospace, Menlo, Consolas, monospace; }
.scenecaptum.scenecaptum td.rank { text-align: right; opacity: 0.7; }
.scenecaptum .notes { opacity: 0.75; font-size: 0.9em; max-width: 60em; }
</style>"""


def _cells(row: _Row, tag: str) -> str:
    def cell(text: str, kind: str) -> str:
        return f'<{tag} class="{kind}">{html.escape(text)}</{tag}>'

    name = f"{row.name} {row.mark}".rstrip()
    return (
        cell(row.rank, "rank")
        + cell(name, "name")
        + cell(row.saliency, "number")
        + cell(row.gradient, "number")
    )


def _table(attribution: SceneAttribution, top: int | None) -> _Table:
    ranking = attribution.ranking()
    shown = ranking if top is None else ranking[:top]
    groups = caution_groups(attribution, (row.name for row in ranking))
    markers = {text: f"!{number}" if len(groups) > 1 else "!" for number, text in enumerate(groups, start=1)}
    marks = {name: markers[text] for text, names in groups.items() for name in names}
    doubts = doubt_groups(attribution)
    for names in doubts.values():
        if len(names) < len(attribution):  # what holds for all need not be said of each
            marks |= {name: f"{marks.get(name, '')}?" for name in names}
    textures = {row.name for row in shown if attribution[row.name].ndim > 1}
    names = shorten([row.label for row in shown], _WIDEST_NAME)
    saliency, gradients = _saliency(shown), _gradients(shown)
    return _Table(
        heading=_heading(attribution),
        columns=_Row("#", "parameter", "", "saliency", _gradient_heading(attribution, shown)),
        rows=[
            _Row(
                rank=str(row.rank),
                name=names[index],
                mark=f"{'Σ' if row.name in textures else ''}{marks.get(row.name, '')}",
                saliency=saliency[index],
                gradient=gradients[index],
            )
            for index, row in enumerate(shown)
        ],
        notes=[
            *_hidden(ranking, len(shown)),
            *(["Σ totals over the texels, vertices or faces"] if textures else []),
            *(_caution(markers[text], text, names) for text, names in groups.items()),
            *(_doubt(reason, names, len(attribution)) for reason, names in doubts.items()),
            *(f"!  {text}" for text in scene_cautions(attribution)),
        ],
    )


def _heading(attribution: SceneAttribution) -> list[str]:
    return [
        metric_line(attribution),
        method_name(attribution),
        *sampling_words(attribution),
        *convergence_words(attribution),
    ]


def _gradient_heading(attribution: SceneAttribution, rows: Iterable[Ranked]) -> str:
    colours = any(len(row.total) == 3 for row in rows)
    return f"{quantity(attribution)}{': R, G, B' if colours else ''}"


def _hidden(ranking: Sequence[Ranked], shown: int) -> list[str]:
    if shown >= len(ranking):
        return []
    largest = with_error(ranking[shown].saliency, ranking[shown].saliency_error)[0]
    return [f"… and {len(ranking) - shown} more of at most {largest}; .ranking() lists all"]


def _caution(marker: str, text: str, names: Sequence[str]) -> str:
    return f"{marker.ljust(2)} {text} ({count_words(len(names), 'parameter')})"


def _doubt(reason: str, names: Sequence[str], count: int) -> str:
    whose = "all parameters" if len(names) == count else count_words(len(names), "parameter")
    return f"?  {reason} ({whose})"


def _saliency(rows: Sequence[Ranked]) -> list[str]:
    written = [with_error(row.saliency, row.saliency_error) for row in rows]
    values = align_decimals([value for value, _ in written])
    errors = align_decimals([error for _, error in written])
    return [f"{v} ± {e}" if e.strip() else v for v, e in zip(values, errors, strict=True)]


def _gradients(rows: Sequence[Ranked]) -> list[str]:
    """Write each row's channels below those of the others; a scalar stands in the first channel's place."""
    written = [_channels(row) for row in rows]
    fitting = [row for row in written if len(row) <= _MOST_CHANNELS]
    padded: list[list[str]] = []
    for channel in range(max(map(len, fitting), default=0)):
        padded.append(align_decimals([row[channel] if channel < len(row) else "" for row in fitting]))
    lines = iter("  ".join(channels).rstrip() for channels in zip(*padded, strict=True))
    return [next(lines) if len(row) <= _MOST_CHANNELS else _range(row) for row in written]


def _channels(row: Ranked) -> list[str]:
    """Write the channels to the saliency's place; three digits do, with no error beside them."""
    style = Format.of(row.saliency, row.saliency_error).at_most(3, row.saliency)
    return [style.write_signed(value) for value in row.total]


def _range(numbers: Sequence[str]) -> str:
    ordered = sorted(numbers, key=float)
    return f"{len(numbers)} numbers, {ordered[0]} to {ordered[-1]}"


def _grid(rows: Sequence[_Row], width: int) -> list[str]:
    """Lay out columns; long names give way first, then the gradients are left out."""
    rank, name, mark, saliency, gradient = (max(map(columns, column)) for column in zip(*rows, strict=True))
    taken = rank + 2 + (mark + 1 if mark else 0) + 2 + saliency
    if gradient and width - taken - 2 - gradient < min(name, _NARROWEST_NAME):
        rows, gradient = [row._replace(gradient="") for row in rows], 0
    name = min(name, max(width - taken - (gradient + 2 if gradient else 0), 1))
    lines = []
    for row, short in zip(rows, shorten([row.name for row in rows], name), strict=True):
        named = f"{row.rank:>{rank}}  {pad(short, name)}"
        marked = f"{named} {row.mark:<{mark}}" if mark else named
        lines.append(f"{marked}  {row.saliency:<{saliency}}  {row.gradient}".rstrip())
    return lines
