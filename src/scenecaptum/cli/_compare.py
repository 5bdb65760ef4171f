"""``scenecaptum compare``: two scenes, two designs, or two saved results."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

import torch

from ..attr import SceneAttribution, VanillaSceneGradient
from ..errors import SceneCaptumError
from ..report import write_report
from ..visualization import format_with_error, grid, metric_line, metric_unit, rounded, signed_with_error
from . import _arguments
from ._design import add_design, designed_values
from ._files import print_files, writable
from ._metrics import add_metric, find_metrics

REPORT = "comparison.html"
ROWS = 10
SIGNIFICANT = 2.0  # standard errors


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    parser = commands.add_parser(
        "compare",
        help="compare two scenes, a scene with a design of it, or two saved results",
        description="Compare a metric and its causes in two scenes or two saved results (attribution.npz). With "
        "--set or --design, B is the design of A. Both use the same random numbers, so that the noise of the "
        "difference is small.",
        epilog="example: scenecaptum compare office --set desk.base_color.value=0.8 --metric ugr --spp 64",
    )
    _arguments.add_scene(parser)
    parser.add_argument("other", nargs="?", metavar="B", help="another scene or saved result")
    add_metric(parser)
    add_design(parser)
    parser.add_argument("--titles", nargs=2, metavar=("A", "B"), help="names of the two in the output")
    _arguments.add_output(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    titles = options.titles or _titles(options)
    with writable(options.out):
        before, after = _results(options)
        write_report([before, after], options.out / REPORT, titles=titles)
    print("\n".join(lines(before, after, titles)))
    print_files(options.out, [])
    print(f"{options.out / REPORT}  both results, with their pictures side by side")
    return 0


def _titles(options: argparse.Namespace) -> list[str]:
    if options.other is None:
        return ["as it is", options.design.stem if options.design else "the design"]
    return [_name(options.scene), _name(options.other)]


def _name(given: str) -> str:
    path = Path(given)
    return path.parent.name if path.stem in ("scene", "attribution") and path.parent.name else path.stem


def _results(options: argparse.Namespace) -> tuple[SceneAttribution, SceneAttribution]:
    designed = bool(options.settings or options.design)
    if (options.other is None) != designed:
        raise SceneCaptumError(
            "Give either a second scene or saved result, or the values of a design with --set or --design."
        )
    if designed:
        method, renderer = _method(options, options.scene)
        values = designed_values(options, renderer)
        return method.attribute(seed=options.seed), method.attribute(values, seed=options.seed)
    before, after = (
        SceneAttribution.load(given)
        if given.endswith(".npz")
        else _method(options, given)[0].attribute(seed=options.seed)
        for given in (options.scene, options.other)
    )
    return before, after


def _method(options: argparse.Namespace, scene: str) -> tuple[VanillaSceneGradient, Any]:
    (create,) = find_metrics([options.metric], options).values()
    renderer = _arguments.make_renderer(argparse.Namespace(**{**vars(options), "scene": scene}))
    return VanillaSceneGradient(renderer, create(renderer)), renderer


def lines(before: SceneAttribution, after: SceneAttribution, titles: list[str]) -> list[str]:
    """Return the comparison as text: the metric, the values that differ, and the effects that changed."""
    unit = metric_unit(before)
    suffix = f" {unit}" if unit else ""
    change = after.metric_value - before.metric_value
    error = _hypot(before.metric_standard_error, after.metric_standard_error)
    text = [
        f"{titles[0]}: {metric_line(before)}",
        f"{titles[1]}: {metric_line(after)}",
        f"change: {signed_with_error(change, error)}{suffix}",
    ]
    moved = [
        (before.labels.get(name, name), _values(value), _values(after.parameter_values[name]))
        for name, value in before.parameter_values.items()
        if name in after.parameter_values and not torch.equal(value, after.parameter_values[name])
    ]
    if moved:
        text += ["", *grid(("parameter", titles[0], titles[1]), moved[:ROWS])]
    if set(before) != set(after):
        only = len(set(before) ^ set(after))
        return [*text, "", f"{only} parameters are only in one of the two; effects are not compared."]
    effects, others = before.effects(), after.effects()
    rows = [
        row
        for row in (after - before).ranking()
        if abs(row.effect) > SIGNIFICANT * (row.effect_error or math.inf)
    ]
    table = [
        (
            row.label,
            format_with_error(effects[row.name], None),
            format_with_error(others[row.name], None),
            signed_with_error(row.effect, row.effect_error),
        )
        for row in rows[:ROWS]
    ]
    if table:
        text += ["", *grid(("effect of", titles[0], titles[1], f"change{suffix}"), table)]
    return text


def _hypot(a: float | None, b: float | None) -> float | None:
    return None if a is None or b is None else math.hypot(a, b)


def _values(value: torch.Tensor) -> str:
    return " ".join(rounded(number) for number in value.flatten().tolist())
