"""The ranking as a table, for terminals and for notebooks."""

from __future__ import annotations

import html
import shutil
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import NamedTuple

from ..protocols import Attribution, RankedParameter, ResultKind, Scale
from ._effect_notes import light_notes, range_marked, range_notes
from ._figures import first
from ._layout import grid, wrap
from ._notes import (
    baseline_notes,
    caution_groups,
    caution_marks,
    convergence_notes,
    group_notes,
    jump_notes,
    kept_channels,
    marked_doubts,
    pose_notes,
    sampling_notes,
    scene_cautions,
    unit_notes,
    untrusted_groups,
)
from ._numbers import Format, align_decimals, align_with_errors, columns, cut, pad, shorten, with_error
from ._text import axis_label, count_of, hidden_of, method_name, metric_line, pack, rating

DEFAULT_ROWS = 40
_MAX_CHANNELS = 4
_DEFAULT_WIDTH = 100  # without a terminal
_MIN_NAME_WIDTH = 16
_MAX_NAME_WIDTH = 80


class _Row(NamedTuple):
    """One line of the table; the numbers in ``gradient`` are padded to align, or empty in all rows."""

    rank: str
    name: str
    mark: str
    effect: str
    gradient: str


@dataclass(frozen=True)
class _Table:
    heading: list[str]
    columns: _Row
    rows: list[_Row]
    notes: list[str]


def table_text(
    attribution: Attribution,
    top: int | None = DEFAULT_ROWS,
    *,
    scale: Scale | None = None,
    complete: str = ".ranking()",
) -> str:
    """Format the ranking for a terminal, within its width.

    Parameters
    ----------
    attribution
        The result to show.
    top
        Number of parameters; None for all.
    scale
        As for ``SceneAttribution.ranking``.
    complete
        Where all parameters are, for a note below a table of some.
    """
    table = _table(attribution, top, scale, complete)
    width = shutil.get_terminal_size(fallback=(_DEFAULT_WIDTH, 24)).columns
    heading, notes = (
        [part for text in texts for part in wrap(text, width, 3).splitlines()]
        for texts in (pack(table.heading, width), table.notes)
    )
    lines = [*heading, "", *_grid([table.columns, *table.rows], width), *notes]
    return "\n".join(cut(line, width, 0) for line in lines)


def table_html(
    attribution: Attribution, top: int | None = DEFAULT_ROWS, *, scale: Scale | None = None
) -> str:
    """Format the ranking as HTML for a notebook, with the colours of the page.

    Parameters
    ----------
    attribution, top, scale
        As for ``table_text``.
    """
    table = _table(attribution, top, scale)
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


# The class is repeated so that these rules are more specific than the table styles of notebooks.
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
    name = f"{row.name} {row.mark}".rstrip()
    kinds = [("rank", row.rank), ("name", name), ("number", row.effect)]
    kinds += [("number", row.gradient)] if row.gradient else []
    return "".join(f'<{tag} class="{kind}">{html.escape(text)}</{tag}>' for kind, text in kinds)


def _table(
    attribution: Attribution, top: int | None, scale: Scale | None, complete: str = ".ranking()"
) -> _Table:
    ranking = attribution.ranking(scale=scale)
    is_norm = attribution.ranks_by_norm(scale)
    shown = first(ranking, top)
    with_rows = {row.name for row in shown}
    groups = caution_groups(attribution, (row.name for row in ranking))
    markers = caution_marks(groups)
    marks = {name: markers[text] for text, names in groups.items() for name in names}
    untrusted = untrusted_groups(attribution)
    for names in untrusted.values():
        if len(names) < len(attribution):  # no marks if all rows would have one
            marks |= {name: f"{marks.get(name, '')}?" for name in names}
    of_range = range_notes(attribution, scale)
    marks |= {name: f"{marks.get(name, '')}~" for name in range_marked(of_range)}
    textures = {row.name for row in shown if attribution[row.name].ndim > 1}
    repeats = attribution.kind is ResultKind.OCCLUSION or (
        not attribution.kind.is_gradient_per_unit and all(len(row.total) == 1 for row in shown)
    )
    columns = (
        [str(row.rank) for row in shown],
        shorten([row.label for row in shown], _MAX_NAME_WIDTH),
        [f"{'Σ' if row.name in textures else ''}{marks.get(row.name, '')}" for row in shown],
        align_with_errors([(row.saliency, row.saliency_error) for row in shown])
        if is_norm
        else _effects(attribution, shown),
        [""] * len(shown) if repeats else _gradients(attribution, shown),
    )
    vectors = attribution.info.get("vectors", ())
    colors = any(len(row.total) == 3 and row.name not in vectors for row in shown)
    axes = [
        *(["R, G, B"] if colors else []),
        *(["x, y, z"] if any(row.name in vectors for row in shown) else []),
    ]
    channels = f": {' or '.join(axes)}" if axes else ""
    gradient_heading = "" if repeats else f"{attribution.kind.value}{channels}"
    heading = [metric_line(attribution), rating(attribution), method_name(attribution)]
    notes = [f"{'norm' if is_norm else 'effect'}: {axis_label(attribution, scale, width=None)}"]
    notes += unit_notes(attribution, shown, scale) + light_notes(attribution, shown, scale)
    notes += baseline_notes(attribution)
    if len(shown) < len(ranking):
        notes.append(
            f"… and {_rest(ranking[len(shown) :], attribution.ranked_last(scale))}; {complete} lists all"
        )
    notes += group_notes(attribution, with_rows)
    notes += pose_notes(attribution, shown)
    if textures:
        parts = "patches" if attribution.kind is ResultKind.OCCLUSION else "texels, vertices or faces"
        notes.append(f"Σ totals over the {parts}")
    written = [text for column in columns[3:] for cell in column for text in cell.split()]
    if not attribution.kind.has_sign and any(text.startswith("−") for text in written):
        notes.append(
            "below 0: not above the noise of rendering, which is subtracted; more samples would show the value"
        )
    colored = next((row.name for row in shown if len(row.total) > 1), None)
    if attribution.kind is ResultKind.ABLATION and colored is not None:
        # Without surfaces there are no objects to group by.
        of_mapping = f'groups={{"{colored}": "{colored}"}}'
        option = of_mapping if attribution.surfaces is None else 'groups="object" (--groups object)'
        notes.append(
            f"of a colour, the sum of the losses of its channels, each alone: {option} ablates them together"
        )
    for text, names in groups.items():
        notes.append(f"{markers[text].ljust(2)} {text} ({count_of(names, with_rows)})")
    names_shown = [row.name for row in shown]
    notes += marked_doubts(untrusted, attribution.labels, names_shown, len(attribution), "?  ")
    notes += jump_notes(attribution)
    for text, names in of_range.items():
        hidden = hidden_of([name for name in names if name in attribution], with_rows)
        notes.append(f"~  {text} ({hidden})" if hidden else f"~  {text}")
    notes += [f"!  {text}" for text in scene_cautions(attribution)]
    return _Table(
        heading=[*filter(None, heading), *sampling_notes(attribution), *convergence_notes(attribution)],
        columns=_Row("#", "parameter", "", "norm" if is_norm else "effect", gradient_heading),
        rows=[_Row(*cells) for cells in zip(*columns, strict=True)],
        notes=notes,
    )


def _rest(hidden: Sequence[RankedParameter], last: Collection[str]) -> str:
    """Return how many rows are not shown, and how large they are; those that rank last may be larger."""
    smaller = [row for row in hidden if row.name not in last]
    ranked_last = len(hidden) - len(smaller)
    parts = [f"{ranked_last} ranked last"] if ranked_last else []
    if smaller:
        largest = with_error(smaller[0].saliency, smaller[0].saliency_error)[0]
        parts.insert(0, f"{len(smaller)} more of at most {largest}")
    return " and ".join(parts)


def _effects(attribution: Attribution, rows: Sequence[RankedParameter]) -> list[str]:
    numbers = [(row.effect, row.effect_error) for row in rows]
    return align_with_errors(numbers, signed=attribution.kind.has_sign)


def _gradients(attribution: Attribution, rows: Sequence[RankedParameter]) -> list[str]:
    """Format the channels of each row, aligned over the rows; rows with many channels as a range."""
    formatted = [_channels(attribution, row) for row in rows]
    fitting = [row for row in formatted if len(row) <= _MAX_CHANNELS]
    padded = map(align_decimals, zip_longest(*fitting, fillvalue=""))
    lines = iter("  ".join(channels).rstrip() for channels in zip(*padded, strict=True))
    return [
        next(lines) if len(written) <= _MAX_CHANNELS else _range(row, written)
        for row, written in zip(rows, formatted, strict=True)
    ]


def _channels(attribution: Attribution, row: RankedParameter) -> list[str]:
    """Format the channels to the same decimal place, with at most three digits; a dash without a derivative."""
    kept = kept_channels(attribution, row)
    largest = max(abs(value) for value, _ in kept)
    style = Format.of(largest, max((error for _, error in kept if error is not None), default=None))
    style = style.at_most(3, largest)
    numbers = iter([style.write_signed(value) for value, _ in kept])
    mask = attribution.info.get("kept_directions", {}).get(row.name) or [1] * len(row.total)
    return [next(numbers) if is_kept else "–" for is_kept in mask]


def _range(row: RankedParameter, written: Sequence[str]) -> str:
    lowest, highest = (written[row.total.index(limit)] for limit in (min(row.total), max(row.total)))
    return f"{len(written)} numbers, {lowest} to {highest}"


def _grid(rows: Sequence[_Row], width: int) -> list[str]:
    """Format the rows within a width: shorten long names first, then omit the gradients."""
    rank, name, mark, effect, gradient = (max(map(columns, column)) for column in zip(*rows, strict=True))
    fixed = rank + 2 + (mark + 1 if mark else 0) + 2 + effect
    if gradient and width - fixed - 2 - gradient < min(name, _MIN_NAME_WIDTH):
        rows, gradient = [row._replace(gradient="") for row in rows], 0
    name = min(name, max(width - fixed - (gradient + 2 if gradient else 0), 1))
    names = shorten([row.name for row in rows], name)
    headers, *cells = (
        (
            row.rank.rjust(rank),
            f"{pad(short, name)} {row.mark}" if mark else short,
            row.effect,
            row.gradient,
        )
        for row, short in zip(rows, names, strict=True)
    )
    return grid(headers, cells)
