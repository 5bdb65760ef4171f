"""``scenecaptum optimize``: change a few parameters until a metric is below a goal."""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from ..designs import settings_of
from ..optimize import Optimization, minimize
from ..rendering import SceneRenderer
from . import _arguments
from ._design import add_design, designed_values
from ._files import OutputFormat, Result, figure_writer, print_files, writable, write_files
from ._metrics import add_metric, find_metrics

NOT_REACHED = 1
DESIGN = "design.json"
MOST_NUMBERS = 16  # of a value that is listed


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    parser = commands.add_parser(
        "optimize",
        help="change the parameters that matter most until a metric is below a goal",
        description="Lower a metric below a goal by changing the parameters with the largest effects within their "
        "bounds. A lamp or sky that is off stays off. Exits with 1 if the goal is not reached.",
        epilog="example: scenecaptum optimize office --metric ugr --below 19 --resolution 64x36 --spp 64",
    )
    _arguments.add_scene(parser)
    add_metric(parser)
    add_design(parser)
    parser.add_argument(
        "--below", type=float, required=True, metavar="X", help="the goal, in the metric's unit"
    )
    for name, kind, text in (
        ("top", int, "number of parameters to change"),
        ("change", float, "maximum change of each, as a fraction of its range"),
        ("steps", int, "maximum number of steps"),
    ):
        parser.add_argument(
            f"--{name}",
            type=kind,
            default=_arguments.default_of(minimize, name),
            metavar="N" if kind is int else "X",
            help=f"{text} (default: %(default)s)",
        )
    _arguments.add_output(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    (create,) = find_metrics([options.metric], options).values()
    with writable(options.out):
        renderer = _arguments.make_renderer(options)
        found = minimize(
            renderer,
            create(renderer),
            options.below,
            inputs=designed_values(options, renderer),
            target=options.target,
            top=options.top,
            change=options.change,
            steps=options.steps,
            seed=options.seed,
            show_progress=_arguments.shows_progress(options),
        )
        found = with_design_option(found, options.out)
        formats = [] if found.was_below else _formats(renderer)
        write_files(found, options.out, formats)
    print(json.dumps(optimization_numbers(found, renderer), indent=1) if options.json else found)
    if formats and not options.json:
        print_files(options.out, formats)
    return 0 if found.reached else NOT_REACHED


def optimization_numbers(found: Optimization, renderer: SceneRenderer) -> dict[str, Any]:
    """Return what was reached, and the design, as plain values; with many texels it is in its file alone."""
    measured = {
        name: {"value": side.value, "standard_error": side.error}
        for name, side in (("before", found.before), ("after", found.after))
    }
    numbers = {"metric": found.metric, "below": found.below, "reached": found.reached, **measured}
    values = {**renderer.values, **found.values}
    design = {
        name: {"file": DESIGN, "mean": plain_or_mean(values[name])}
        if name in values and is_large(values[name])
        else setting
        for name, setting in settings_of(renderer, values).items()
    }
    return {**numbers, "design": design}


def is_large(value: torch.Tensor) -> bool:
    """Whether a value has too many numbers to be listed among others: a texture or a map."""
    return value.ndim > 1 and value.numel() > MOST_NUMBERS


def plain_or_mean(value: torch.Tensor) -> Any:
    """Return a value as plain numbers: of a texture or a map, the mean of each channel."""
    return (value.double().flatten(0, -2).mean(0) if is_large(value) else value).tolist()


def with_design_option(found: Optimization, folder: Path) -> Optimization:
    """Return a result whose note on how to rate its design again names the option for that."""
    option = f" (--design {folder / DESIGN})" if found.note and found.reached else ""
    return dataclasses.replace(found, note=f"{found.note}{option}")


def design_format(
    renderer: SceneRenderer, find: Callable[[Result], Optimization], description: str
) -> OutputFormat[Result]:
    """Return the file of the values that a search has found, as ``--design`` reads them."""

    def write(result: Result, path: Path) -> None:
        settings = settings_of(renderer, {**renderer.values, **find(result).values})
        lines = [f"{json.dumps(name)}: {json.dumps(value)}" for name, value in settings.items()]
        path.write_text("{\n " + ",\n ".join(lines) + "\n}\n", encoding="utf-8")

    return OutputFormat(DESIGN, f"{description}, for --design", write)


def _formats(renderer: SceneRenderer) -> list[OutputFormat[Optimization]]:
    return [
        design_format(renderer, lambda found: found, "the changed values"),
        OutputFormat(
            "optimization.png",
            "every step" if renderer.has_grid else "both pictures and every step",
            figure_writer(Optimization.plot),
        ),
    ]
