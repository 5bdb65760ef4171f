"""``scenecaptum explain``: the answer in sentences."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ..attr import Explanation
from ..explanation import explain
from ..report import write_report
from . import _arguments
from ._design import add_design, designed_values
from ._files import OutputFormat, print_files, writable, write_files
from ._metrics import add_metric, find_metrics

REPORT = "report.html"


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    parser = commands.add_parser(
        "explain",
        help="say what a metric depends on, and which changes of the scene would matter",
        description="Attribute a metric, say in sentences what its value means and what it depends on, and render "
        "the few changes that matter. Only effects that are clear of the noise are stated.",
        epilog="example: scenecaptum explain office --metric ugr --spp 64 --resolution 160x90",
    )
    _arguments.add_scene(parser)
    add_metric(parser)
    add_design(parser)
    parser.add_argument(
        "--below", type=float, metavar="X", help="also search for changes that bring the metric below X"
    )
    parser.add_argument(
        "--changes",
        type=int,
        default=_arguments.default_of(explain, "changes"),
        metavar="N",
        help="number of changes to render (default: %(default)s)",
    )
    parser.add_argument("--report", action="store_true", help="also write report.html, an interactive page")
    _arguments.add_output(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    (create,) = find_metrics([options.metric], options).values()
    with writable(options.out):
        renderer = _arguments.make_renderer(options)
        explanation = explain(
            renderer,
            create(renderer),
            designed_values(options, renderer),
            target=options.target,
            below=options.below,
            changes=options.changes,
            seed=options.seed,
            show_progress=_arguments.shows_progress(options),
        )
        write_files(explanation, options.out, FORMATS)
        if options.report:
            write_report(explanation, options.out / REPORT)
    print(explanation)
    print_files(options.out, FORMATS)
    if options.report:
        print(f"{options.out / REPORT}  interactive page")
    _arguments.print_resumed(renderer)
    return 0


def _write_markdown(explanation: Explanation, path: Path) -> None:
    path.write_text(explanation.markdown(), encoding="utf-8")


FORMATS = [OutputFormat("explanation.md", "the sentences in Markdown", _write_markdown)]
