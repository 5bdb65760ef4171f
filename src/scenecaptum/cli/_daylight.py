"""``scenecaptum daylight``: how much daylight a room gets, and what would change it, in sentences."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from ..attr import Explanation
from ..daylight import BY_NAME
from ..estimation import Metric
from ..rendering import SceneRenderer
from ..report import write_report
from . import _arguments
from ._attribute import folder_name
from ._design import add_design, designed_values
from ._explain import REPORT, add_changes, explained, explanation_formats, explanation_numbers
from ._files import print_files, writable, write_files
from ._messages import warnings_after_checks
from ._metrics import create_of_daylight
from ._plan import plan_of
from ._points import Coefficients, add_points, check_grid, check_options, coefficients_of, read_weather

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DEFAULT = "sda"
CHOICES = ("reflectance", "opacity")  # the kinds of parameters that a designer chooses


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    parser = commands.add_parser(
        "daylight",
        help="say how much daylight a room gets in a year, what limits it, and which changes would matter",
        description="Render the daylight coefficients of points above a floor, compute metrics of a year of "
        "weather, and say in sentences which surfaces and panes they depend on, which rows of points decide, and "
        "what a few changes would do. The scene needs a constant emitter as its sky; its lamps do not count.",
        epilog="example: scenecaptum daylight classroom --metric sda --metric daylight-factor --spp 64",
    )
    _arguments.add_file(parser)
    _arguments.add_objects(parser)
    _arguments.add_samples(parser)
    _arguments.add_inputs(
        parser, "what a designer chooses: reflectances, of panes transmittances, and opacities"
    )
    parser.add_argument(
        "--metric",
        action="append",
        choices=BY_NAME,
        dest="metrics",
        metavar="METRIC",
        help=f"{_arguments.describe(BY_NAME)}; may be repeated (default: {DEFAULT})",
    )
    add_points(parser)
    add_design(parser)
    add_changes(parser)
    _arguments.add_output(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    names = list(dict.fromkeys(options.metrics or [DEFAULT]))
    check_options(names, options)
    weather = read_weather(options)  # a bad file is an error before the scene is loaded
    needed = {name: coefficients_of(name, options) for name in names}
    with writable(options.out):
        with warnings_after_checks():
            renderers = {one: _renderer(options, one) for one in dict.fromkeys(needed.values())}
            for renderer in renderers.values():
                check_grid(renderer)
            # All of them before the first run, which takes long.
            metrics = {
                name: create_of_daylight(name, weather, options.north, renderers[needed[name]])
                for name in names
            }
        finished = []
        for name, metric in metrics.items():
            folder = options.out if len(names) == 1 else options.out / folder_name(name)
            finished.append(_explain(renderers[needed[name]], metric, folder, options))
        if options.report:
            said, plans = zip(*finished, strict=True)
            write_report(said, options.out / REPORT, title=options.title, plans=plans)
    if options.json:
        numbers = [
            explanation_numbers(explanation, renderers[needed[name]])
            for name, (explanation, _) in zip(metrics, finished, strict=True)
        ]
        print(json.dumps(numbers, indent=1, ensure_ascii=False))
        return 0
    if options.report:
        print(f"{options.out / REPORT}  interactive page with all results")
    for renderer in renderers.values():
        _arguments.print_resumed(renderer)
    return 0


def _explain(
    renderer: SceneRenderer, metric: Metric, folder: Path, options: argparse.Namespace
) -> tuple[Explanation, Figure | None]:
    """Explain a metric, write its files and print it; return it with its plan."""
    said = explained(renderer, metric, _values(renderer, options), options)
    formats = explanation_formats(renderer, metric)
    write_files(said, folder, formats)
    if not options.json:
        print(said)
        print_files(folder, formats)
        print()
    return said, plan_of(said.picture, renderer, metric, said.attribution.info)


def _renderer(options: argparse.Namespace, coefficients: Coefficients | None) -> SceneRenderer:
    """Create a renderer; what the design sets and a designer does not choose is fixed in its scene."""
    renderer = _arguments.make_renderer(options, coefficients)
    own, chosen = renderer.inputs, _chosen(renderer, options)
    fixed = {
        name: value
        for name, value in (designed_values(options, renderer) or {}).items()
        if name not in chosen and not torch.equal(value, own[name])
    }
    if not fixed:
        return renderer
    return _arguments.make_renderer(options, coefficients, {**renderer.values, **fixed})


def _chosen(renderer: SceneRenderer, options: argparse.Namespace) -> list[str]:
    """Return the inputs that were selected, or that a designer chooses."""
    names = list(renderer.inputs)
    chosen = [] if options.inputs else [one for one in names if renderer.parameters[one].kind in CHOICES]
    return chosen or names


def _values(renderer: SceneRenderer, options: argparse.Namespace) -> Mapping[str, torch.Tensor]:
    """Return the chosen inputs with the values of a design."""
    values = designed_values(options, renderer) or renderer.inputs
    return {name: values[name] for name in _chosen(renderer, options)}
