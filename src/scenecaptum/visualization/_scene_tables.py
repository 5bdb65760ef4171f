"""A scene's parameters and the plan of its renderer, for terminals and for notebooks."""

from __future__ import annotations

import html
import os
import shutil
import sys
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from ._numbers import columns, cut, pad, shorten
from ._table import STYLE
from ._words import count_words

if TYPE_CHECKING:
    from ..rendering import RenderPlan
    from ..scene import SceneParameters
    from ..scene._parameters import Parameter

_COLUMNS = ("name", "kind", "shape", "bounds", "owner", "status")
_NARROWEST_NAME, _NARROWEST_OWNER = 30, 12
# What a narrow terminal does without, first to last: the name mostly tells the owner, and the kind the bounds.
_DISPENSABLE = ("owner", "bounds", "shape", "kind")


def parameters_text(parameters: SceneParameters) -> str:
    """Lay out a line for each parameter; in a terminal none is wider than it is, and reasons stand below."""
    rows = {name: _row(parameter) for name, parameter in parameters.items()}
    whole = _grid(_COLUMNS, list(rows.values()))
    width = _terminal_width()
    if width is None or not rows or max(map(columns, whole)) <= width:
        return "\n".join(whole)
    reasons = _groups((p.name, p.problem or p.caution) for p in parameters.values())
    numbers = {text: number for number, text in enumerate(reasons, start=1)}
    short = [[*rows[p.name][:-1], _short_status(p, numbers)] for p in parameters.values()]
    notes = [_note(f"{number:>2}  {text}", width) for text, number in numbers.items()]
    return "\n".join([*_fit(short, width), "", *notes])


def parameters_html(parameters: SceneParameters) -> str:
    """Lay out what can be differentiated as a table, and what cannot, folded up, by the reason why not."""
    good = [parameter for parameter in parameters.values() if not parameter.problem]
    reasons = _groups((parameter.name, parameter.problem) for parameter in parameters.values())
    folded = [
        f"<details><summary>{count_words(len(names), 'parameter')} not differentiable: {html.escape(text)}"
        f"</summary><div>{html.escape(', '.join(names))}</div></details>"
        for text, names in reasons.items()
    ]
    rows = "\n".join(f"<tr>{_cells(_row(parameter), 'td')}</tr>" for parameter in good)
    return (
        f'<div class="scenecaptum">\n{STYLE}\n'
        f"<div><b>{count_words(len(parameters), 'parameter')}</b>, {len(good)} of them differentiable</div>\n"
        f"<table>\n<thead><tr>{_cells(_COLUMNS, 'th')}</tr></thead>\n<tbody>\n{rows}\n</tbody>\n</table>\n"
        f'<div class="notes">{"".join(folded)}</div>\n</div>'
    )


def plan_text(plan: RenderPlan) -> str:
    """Write one decision a line, in a terminal no wider than it is."""
    width, column = _terminal_width(), max(len(decision) for decision, _ in plan.decisions)
    lines = [(f"{decision.ljust(column)}  {reason}", column + 2) for decision, reason in plan.decisions]
    for text, names in _groups(plan.differences).items():
        lines.append((f"finite difference for {', '.join(names)}: {text}", 4))
    for text, names in _groups(plan.cautions).items():
        lines.append((f"caution: {', '.join(names)}: {text}", 4))
    return "\n".join(text if width is None else _note(text, width, indent) for text, indent in lines)


def plan_html(plan: RenderPlan) -> str:
    """Lay out the decisions and their reasons as a table, and below it what each exception is for."""
    rows = "\n".join(f"<tr>{_cells(pair, 'td')}</tr>" for pair in plan.decisions)
    notes = [
        f"<div><b>{html.escape(what)}</b> {html.escape(', '.join(names))}: {html.escape(text)}</div>"
        for what, pairs in (("Finite difference for", plan.differences), ("Caution:", plan.cautions))
        for text, names in _groups(pairs).items()
    ]
    return (
        f'<div class="scenecaptum">\n{STYLE}\n'
        f"<table>\n<thead><tr>{_cells(('decision', 'reason'), 'th')}</tr></thead>\n"
        f'<tbody>\n{rows}\n</tbody>\n</table>\n<div class="notes">{"".join(notes)}</div>\n</div>'
    )


def _row(p: Parameter) -> list[str]:
    shape = "×".join(map(str, p.shape)) or "scalar"
    return [p.name, p.kind, shape, str(p.bounds), ", ".join(p.owners), p.status]


def _short_status(parameter: Parameter, numbers: Mapping[str, int]) -> str:
    if parameter.problem:
        return f"no: {numbers[parameter.problem]}"
    return f"yes, but: {numbers[parameter.caution]}" if parameter.caution else "yes"


def _fit(rows: Sequence[Sequence[str]], width: int) -> list[str]:
    """Shorten names and owners, and leave out columns, until lines are at most so wide."""
    heads = (*_COLUMNS[:-1], "differentiable")
    kept = {head: [head, *column] for head, column in zip(heads, zip(*rows, strict=True), strict=True)}
    kept["owner"] = shorten(kept["owner"], _NARROWEST_OWNER)
    for leaving in (None, *_DISPENSABLE):
        kept.pop(leaving or "", None)
        others = sum(2 + max(map(columns, column)) for head, column in kept.items() if head != "name")
        if width - others >= _NARROWEST_NAME:
            break
    kept["name"] = shorten(kept["name"], max(width - others, 1))
    first, *rest = (list(row) for row in zip(*kept.values(), strict=True))
    return [cut(line, width, 0) for line in _grid(first, rest)]


def _grid(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(map(columns, column)) for column in zip(heads, *rows, strict=True)]
    widths[-1] = 0  # nothing stands beside the last
    return [
        "  ".join(pad(cell, width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in (heads, *rows)
    ]


def _groups(pairs: Iterable[tuple[str, str | None]]) -> dict[str, list[str]]:
    """Group names by what is said of them."""
    groups: dict[str, list[str]] = {}
    for name, text in pairs:
        if text:
            groups.setdefault(text, []).append(name)
    return groups


def _note(text: str, width: int, indent: int = 4) -> str:
    width = max(width, 20)
    indent = min(indent, width // 2)
    return textwrap.fill(text, width, subsequent_indent=" " * indent, break_on_hyphens=False)


def _cells(row: Iterable[str], tag: str) -> str:
    return "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in row)


def _terminal_width() -> int | None:
    """Return the terminal's width; None where output goes elsewhere, to a file or a search, and may be wide."""
    if os.environ.get("COLUMNS", "").isdecimal() or (sys.stdout is not None and sys.stdout.isatty()):
        return shutil.get_terminal_size().columns
    return None
