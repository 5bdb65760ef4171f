"""Tables of scene parameters and of the render plan, for terminals and notebooks."""

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
from ._text import pluralize

if TYPE_CHECKING:
    from ..rendering import RenderPlan
    from ..scene import SceneParameters
    from ..scene._parameters import Parameter

_COLUMNS = ("name", "kind", "shape", "bounds", "owner", "status")
_MIN_NAME_WIDTH, _OWNER_WIDTH = 30, 12
# Columns that are omitted in narrow terminals, in this order.
_OPTIONAL_COLUMNS = ("owner", "bounds", "shape", "kind")


def parameters_text(parameters: SceneParameters) -> str:
    """Format one line per parameter; in a terminal within its width, with the reasons as footnotes."""
    rows = {name: _row(parameter) for name, parameter in parameters.items()}
    full = _grid(_COLUMNS, list(rows.values()))
    width = _terminal_width()
    if width is None or not rows or max(map(columns, full)) <= width:
        return "\n".join(full)
    reasons = _groups((p.name, p.problem or p.caution) for p in parameters.values())
    numbers = {text: number for number, text in enumerate(reasons, start=1)}
    short = [[*rows[p.name][:-1], _short_status(p, numbers)] for p in parameters.values()]
    notes = [_note(f"{number:>2}  {text}", width) for text, number in numbers.items()]
    return "\n".join([*_fit(short, width), "", *notes])


def parameters_html(parameters: SceneParameters) -> str:
    """Format the differentiable parameters as a table, and the others in collapsed lists, grouped by reason."""
    differentiable = [parameter for parameter in parameters.values() if not parameter.problem]
    reasons = _groups((parameter.name, parameter.problem) for parameter in parameters.values())
    collapsed = [
        f"<details><summary>{pluralize(len(names), 'parameter')} not differentiable: {html.escape(text)}"
        f"</summary><div>{html.escape(', '.join(names))}</div></details>"
        for text, names in reasons.items()
    ]
    rows = "\n".join(f"<tr>{_cells(_row(parameter), 'td')}</tr>" for parameter in differentiable)
    return (
        f'<div class="scenecaptum">\n{STYLE}\n'
        f"<div><b>{pluralize(len(parameters), 'parameter')}</b>, {len(differentiable)} of them differentiable"
        "</div>\n"
        f"<table>\n<thead><tr>{_cells(_COLUMNS, 'th')}</tr></thead>\n<tbody>\n{rows}\n</tbody>\n</table>\n"
        f'<div class="notes">{"".join(collapsed)}</div>\n</div>'
    )


def plan_text(plan: RenderPlan) -> str:
    """Format one decision per line; in a terminal within its width."""
    width, column = _terminal_width(), max(len(decision) for decision, _ in plan.decisions)
    lines = [(f"{decision.ljust(column)}  {reason}", column + 2) for decision, reason in plan.decisions]
    for text, names in _groups(plan.differences).items():
        lines.append((f"finite difference for {', '.join(names)}: {text}", 4))
    for text, names in _groups(plan.cautions).items():
        lines.append((f"caution: {', '.join(names)}: {text}", 4))
    return "\n".join(text if width is None else _note(text, width, indent) for text, indent in lines)


def plan_html(plan: RenderPlan) -> str:
    """Format the decisions and their reasons as a table, with finite differences and cautions below it."""
    rows = "\n".join(f"<tr>{_cells(pair, 'td')}</tr>" for pair in plan.decisions)
    notes = [
        f"<div><b>{html.escape(title)}</b> {html.escape(', '.join(names))}: {html.escape(text)}</div>"
        for title, pairs in (("Finite difference for", plan.differences), ("Caution:", plan.cautions))
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
    """Shorten names and owners, and omit columns, until lines fit into the width."""
    headers = (*_COLUMNS[:-1], "differentiable")
    kept = {
        header: [header, *column] for header, column in zip(headers, zip(*rows, strict=True), strict=True)
    }
    kept["owner"] = shorten(kept["owner"], _OWNER_WIDTH)
    for omitted in (None, *_OPTIONAL_COLUMNS):
        kept.pop(omitted or "", None)
        others = sum(2 + max(map(columns, column)) for header, column in kept.items() if header != "name")
        if width - others >= _MIN_NAME_WIDTH:
            break
    kept["name"] = shorten(kept["name"], max(width - others, 1))
    first, *rest = (list(row) for row in zip(*kept.values(), strict=True))
    return [cut(line, width, 0) for line in _grid(first, rest)]


def _grid(headers: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(map(columns, column)) for column in zip(headers, *rows, strict=True)]
    widths[-1] = 0  # no padding after the last column
    return [
        "  ".join(pad(cell, width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in (headers, *rows)
    ]


def _groups(pairs: Iterable[tuple[str, str | None]]) -> dict[str, list[str]]:
    """Group names by their text, without those that have none."""
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
    """Return the terminal's width; None if the output goes to a file or a pipe."""
    if os.environ.get("COLUMNS", "").isdecimal() or (sys.stdout is not None and sys.stdout.isatty()):
        return shutil.get_terminal_size().columns
    return None
