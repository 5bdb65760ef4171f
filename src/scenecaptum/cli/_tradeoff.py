"""``scenecaptum tradeoff``: measure cost and accuracy of settings, and recommend one."""

from __future__ import annotations

import argparse
import json
import math
from typing import Any

from ..errors import SceneCaptumError
from ..tradeoff import KEYS, TOLERANCE, Tradeoff, measure
from . import _arguments
from ._design import add_design, designed_values
from ._files import OutputFormat, figure_writer, print_files, writable, write_files
from ._metrics import add_metric, find_metrics

FORMATS = (
    OutputFormat("tradeoff.csv", "table of the settings", Tradeoff.to_csv),
    OutputFormat("tradeoff.png", "relative error over time", figure_writer(Tradeoff.plot)),
)


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    parser = commands.add_parser(
        "tradeoff",
        help="measure how samples, depth and resolution trade time for accuracy, and recommend a setting",
        description="Attribute a metric several times at several settings, and compare time, error, bias and "
        "ranking with a reference of many more samples.",
        epilog="example: scenecaptum tradeoff office --metric luminance --resolution 160x90 --spp 64 "
        "--vary spp=16,256 --vary max_depth=2,4,12",
    )
    _arguments.add_scene(parser)
    add_metric(parser)
    add_design(parser)
    parser.add_argument(
        "--vary",
        action="append",
        type=_varied,
        metavar="OPTION=VALUES",
        help=f"option to vary and its values, separated by commas: {', '.join(KEYS)} (only prb; "
        "smoothing is the strength of noise of the picture); may be repeated (default: all but smoothing)",
    )
    parser.add_argument(
        "--reference-spp",
        type=int,
        metavar="N",
        help="samples per pixel of the reference (default: 32 × --spp)",
    )
    parser.add_argument(
        "--runs",
        type=int,
        default=_arguments.default_of(measure, "runs"),
        metavar="N",
        help="runs of each setting (default: %(default)s)",
    )
    parser.add_argument(
        "--tolerance",
        type=float,
        default=TOLERANCE,
        metavar="X",
        help="target relative error of the recommendation (default: %(default)s)",
    )
    _arguments.add_output(parser)
    parser.set_defaults(run=tradeoff)


def tradeoff(options: argparse.Namespace) -> int:
    """Run the command."""
    if not options.tolerance > 0:
        raise SceneCaptumError(f"--tolerance must be a relative error above 0, not {options.tolerance}.")
    create = find_metrics([options.metric], options)[options.metric]
    with writable(options.out):
        renderer = _arguments.make_renderer(options)
        result = measure(
            renderer,
            create(renderer),
            options.target,
            inputs=designed_values(options, renderer),
            vary=None if options.vary is None else _merge(options.vary),
            metric_for=create,
            reference_spp=options.reference_spp,
            runs=options.runs,
            seed=options.seed,
            show_progress=_arguments.shows_progress(options),
        )
        write_files(result, options.out, FORMATS)
        if options.json:
            print(_json(result, options.tolerance))
            return 0
        print(result.text(options.tolerance))
        print_files(options.out, FORMATS)
        _arguments.print_resumed(renderer)
    return 0


def _varied(text: str) -> tuple[str, list[Any]]:
    key, separator, values = text.partition("=")
    if not (separator and values):
        raise argparse.ArgumentTypeError(f"{text!r} is not OPTION=VALUES, such as spp=16,256")
    return key, [_value(key, value) for value in values.split(",")]


def _merge(pairs: list[tuple[str, list[Any]]]) -> dict[str, list[Any]]:
    merged: dict[str, list[Any]] = {}
    for key, values in pairs:
        merged.setdefault(key, []).extend(values)
    return merged


def _value(key: str, text: str) -> Any:
    if key == "resolution":
        return _arguments.resolution(text)
    for number in (int, float):
        try:
            return number(text)
        except ValueError:
            continue
    return text


def _json(result: Tradeoff, tolerance: float) -> str:
    settings = [
        {key: None if isinstance(v, float) and not math.isfinite(v) else v for key, v in record.items()}
        for record in result.records()
    ]
    numbers = {
        "scene": result.scene,
        "metric": result.metric,
        "settings": settings,
        "recommendation": result.recommendation(tolerance),
    }
    return json.dumps(numbers, indent=1, ensure_ascii=False, allow_nan=False)
