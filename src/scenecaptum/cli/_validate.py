"""``scenecaptum validate``: the ablation test."""

from __future__ import annotations

import argparse
import csv
import dataclasses
import json
from pathlib import Path
from typing import Any

from ..validation import Ablated, AblationTest, ablation_test
from . import _arguments
from ._design import add_design, designed_values
from ._files import OutputFormat, figure_writer, print_files, writable, write_files
from ._messages import warnings_after_checks
from ._metrics import add_metric, find_metrics
from ._points import check_grid, needed_coefficients, premises

NOT_CONFIRMED = 1


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    parser = commands.add_parser(
        "validate",
        help="check whether the metric changes as the gradients predict when parameters are moved",
        description="Attribute a metric, move each of the most salient parameters separately along its gradient, "
        "render again, and compare the change of the metric with the prediction. Exits with 1 if they differ.",
        epilog="example: scenecaptum validate office --metric luminance --spp 256 --out out",
    )
    _arguments.add_scene(parser)
    add_metric(parser, of_daylight=True)
    add_design(parser)
    parser.add_argument(
        "--top",
        type=int,
        default=_arguments.default_of(ablation_test, "top"),
        metavar="N",
        help="number of most salient parameters to test (default: %(default)s)",
    )
    _arguments.add_output(parser)
    parser.set_defaults(run=validate)


def validate(options: argparse.Namespace) -> int:
    """Run the command."""
    (create,) = find_metrics([options.metric], options).values()
    with writable(options.out):
        with warnings_after_checks():
            renderer = _arguments.make_renderer(options, needed_coefficients([options.metric], options))
            check_grid(renderer)
            metric = create(renderer)
        test = ablation_test(
            renderer,
            metric,
            target=options.target,
            inputs=designed_values(options, renderer),
            top=options.top,
            seed=options.seed,
            show_progress=_arguments.shows_progress(options),
        )
        # First the answer: nothing that goes wrong with a file may hide it.
        print(_json(test) if options.json else "\n".join([str(test), *premises(metric, options)]), flush=True)
        write_files(test, options.out, FORMATS)
    if not options.json:
        print_files(options.out, FORMATS)
        _arguments.print_resumed(renderer)
    return 0 if test.is_confirmed else NOT_CONFIRMED


def _write_json(test: AblationTest, path: Path) -> None:
    path.write_text(_json(test) + "\n", encoding="utf-8")


def _write_csv(test: AblationTest, path: Path) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, ["rank", *(field.name for field in dataclasses.fields(Ablated))])
        writer.writeheader()
        writer.writerows({"rank": rank, **dataclasses.asdict(row)} for rank, row in enumerate(test.rows, 1))


def _json(test: AblationTest) -> str:
    numbers = {
        "metric": test.metric,
        "confirmed": test.is_confirmed,
        "verdict": test.verdict,
        "kendall_tau": test.kendall_tau,
        "jumps": dict(test.jumps),
        "left_out": dict(test.left_out),
        "parameters": [dataclasses.asdict(row) for row in test.rows],
    }
    return json.dumps(numbers, indent=1, ensure_ascii=False, allow_nan=False)


FORMATS = (
    OutputFormat("validation.json", "numbers and verdict", _write_json),
    OutputFormat("validation.csv", "table of the numbers", _write_csv),
    OutputFormat(
        "validation.png",
        "prediction, measurement and noise of each parameter",
        figure_writer(AblationTest.plot),
    ),
)
