"""``scenecaptum tradeoff``: what accuracy costs on a scene and a metric, and which settings to use."""

from __future__ import annotations

import argparse
import json
import math
from functools import partial
from pathlib import Path
from typing import Any

from ..errors import SceneCaptumError
from ..tradeoff import Tradeoff, measure
from ..tradeoff._result import TOLERANCE
from ..tradeoff._settings import KEYS
from . import _arguments
from ._files import writable, write_each

CONTENTS = {
    "tradeoff.csv": "the settings as a table",
    "tradeoff.png": "relative error against seconds",
}


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    parser = commands.add_parser(
        "tradeoff",
        help="measure how samples, depth and resolution trade time for accuracy, and recommend settings",
        description="Attribute a metric at several settings, several times each, and compare time, error, bias "
        "and ranking with a reference of many more samples.",
        epilog="example: scenecaptum tradeoff office --metric luminance --resolution 160x90 --spp 64 "
        "--vary spp=16,256 --vary max_depth=2,4,12",
    )
    _arguments.add_scene(parser)
    _arguments.add_metric(parser)
    parser.add_argument(
        "--vary",
        action="append",
        type=_varied,
        metavar="WHAT=VALUES",
        help=f"what is varied and to which values, separated by commas: {', '.join(KEYS)} (to prb); may be "
        "repeated (default: all of them)",
    )
    parser.add_argument(
        "--reference-spp",
        type=int,
        metavar="N",
        help="samples per pixel of the reference (default: 32 × --spp)",
    )
    parser.add_argument("--runs", type=int, default=8, metavar="N", help="runs of each setting (default: 8)")
    parser.add_argument(
        "--tolerance",
        type=float,
        default=TOLERANCE,
        metavar="X",
        help=f"relative error that the recommendation is for (default: {TOLERANCE})",
    )
    _arguments.add_output(parser)
    parser.set_defaults(run=tradeoff)


def tradeoff(options: argparse.Namespace) -> int:
    """Run the command."""
    if not options.tolerance > 0:
        raise SceneCaptumError(f"--tolerance must be a relative error above 0, not {options.tolerance}.")
    create = _arguments.find_metrics([options.metric], options.threshold_factor)[options.metric]
    with writable(options.out):
        renderer = _arguments.make_renderer(options)
        found = measure(
            renderer,
            create(renderer),
            options.target,
            vary=None if options.vary is None else _together(options.vary),
            metric_for=create,
            reference_spp=options.reference_spp,
            runs=options.runs,
            seed=options.seed,
            show_progress=_arguments.shows_progress(options),
        )
        write_each(options.out, CONTENTS, partial(_write_file, found))
        if options.json:
            print(_json(found, options.tolerance))
            return 0
        print(found.text(options.tolerance))
        print()
        for name, content in CONTENTS.items():
            print(f"{options.out / name}  {content}")
        _arguments.say_resumed(renderer)
    return 0


def _varied(text: str) -> tuple[str, list[Any]]:
    key, separator, values = text.partition("=")
    if not (separator and values):
        raise argparse.ArgumentTypeError(f"{text!r} is not WHAT=VALUES, such as spp=16,256")
    return key, [_value(key, one) for one in values.split(",")]


def _together(pairs: list[tuple[str, list[Any]]]) -> dict[str, list[Any]]:
    found: dict[str, list[Any]] = {}
    for key, values in pairs:
        found.setdefault(key, []).extend(values)
    return found


def _value(key: str, text: str) -> Any:
    if key == "resolution":
        return _arguments.resolution(text)
    try:
        return int(text)
    except ValueError:
        return text


def _write_file(found: Tradeoff, _: str, path: Path) -> None:
    if path.suffix == ".csv":
        found.to_csv(path)
    else:
        found.plot().savefig(path, dpi=150)


def _json(found: Tradeoff, tolerance: float) -> str:
    settings = [
        {key: None if isinstance(v, float) and not math.isfinite(v) else v for key, v in record.items()}
        for record in found.records()
    ]
    numbers = {
        "scene": found.scene,
        "metric": found.metric,
        "settings": settings,
        "recommendation": found.recommendation(tolerance),
    }
    return json.dumps(numbers, indent=1, ensure_ascii=False, allow_nan=False)
