"""``scenecaptum explain``: the answer in sentences."""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from ..attr import Change, Definition, Explanation, SceneAttribution, VanillaSceneGradient
from ..designs import change_of_texture
from ..estimation import Metric, TargetedMetric
from ..explanation import (
    AT_THE_GOAL,
    class_by_definition,
    depth_premises,
    explain,
    grid_premises,
    photometric_premises,
)
from ..optimize import Measured, Optimization
from ..rendering import SceneRenderer
from ..report import Comparison, write_report
from ..visualization import format_with_error, metric_name, metric_unit, verdict
from . import _arguments
from ._design import add_design, designed_values
from ._files import OutputFormat, print_files, writable, write_files
from ._messages import warnings_after_checks
from ._metrics import add_metric, find_metrics
from ._optimize import (
    NOT_REACHED,
    design_format,
    is_large,
    optimization_numbers,
    plain_or_mean,
    with_design_option,
)
from ._plan import plan_format, plans_of
from ._points import check_grid, check_report, needed_coefficients, premises, with_settings

REPORT = "report.html"
SEPARATE = (
    "Both values of this change, {} and {}, come from renders apart from those of the search. Every other number "
    "below is of other renders, and can differ by about its error."
)


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    parser = commands.add_parser(
        "explain",
        help="say what a metric depends on, and which changes of the scene would matter",
        description="Attribute a metric, say in sentences what its value means and what it depends on, and render "
        "the few changes that matter. Only effects that are clear of the noise are stated. Exits with 1 if the "
        "goal of --below is not reached.",
        epilog="example: scenecaptum explain office --metric ugr --spp 64 --resolution 160x90",
    )
    _arguments.add_scene(parser)
    add_metric(parser, of_daylight=True)
    add_design(parser)
    parser.add_argument(
        "--below", type=float, metavar="X", help="also search for changes that bring the metric below X"
    )
    add_changes(parser)
    _arguments.add_output(parser)
    parser.set_defaults(run=run)


def add_changes(parser: argparse.ArgumentParser) -> None:
    """Add the number of changes to render, and the report."""
    parser.add_argument(
        "--changes",
        type=int,
        default=_arguments.default_of(explain, "changes"),
        metavar="N",
        help="number of changes to render (default: %(default)s)",
    )
    _arguments.add_report(parser, "an interactive page")


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    (create,) = find_metrics([options.metric], options).values()
    coefficients = needed_coefficients([options.metric], options)
    with writable(options.out):
        with warnings_after_checks():
            renderer = _arguments.make_renderer(options, coefficients)
            check_grid(renderer)
            if options.report:
                check_report(renderer)
            metric = create(renderer)
        values = designed_values(options, renderer)
        explanation = explained(renderer, metric, values, options, target=options.target, below=options.below)
        formats = explanation_formats(renderer, metric)
        if explanation.goal is not None and not explanation.goal.was_below:
            tried = "the values of the goal" if explanation.goal.reached else "the values that were tried"
            formats = [*formats, design_format(renderer, _goal, tried)]
        write_files(explanation, options.out, formats)
        if options.report:
            _write_report(explanation, renderer, metric, options)
    missed = explanation.goal is not None and not explanation.goal.reached
    status = NOT_REACHED if missed else 0
    if options.json:
        print(_json(explanation, renderer))
        return status
    if explanation.goal is not None:
        explanation = dataclasses.replace(explanation, goal=with_design_option(explanation.goal, options.out))
    print(explanation)
    print_files(options.out, formats)
    if options.report:
        print(f"{options.out / REPORT}  interactive page")
    _arguments.print_resumed(renderer)
    return status


def _write_report(
    explanation: Explanation, renderer: SceneRenderer, metric: Metric, options: argparse.Namespace
) -> None:
    """Write the page: the sentences, and if a goal was reached, the scene before and after on a slider."""
    # What is said of the goal belongs to its own card.
    own = tuple(text for text in explanation.premises if not text.startswith(f"{AT_THE_GOAL}: "))
    missing = depth_premises(renderer)
    results = [dataclasses.replace(explanation, premises=own + missing)]
    titles = comparison = None
    if (goal := explanation.goal) is not None and goal.reached and not goal.was_below:
        progress = _arguments.shows_progress(options)
        method = VanillaSceneGradient(renderer, metric)
        reached = method.attribute(
            goal.values, target=options.target, seed=options.seed, show_progress=progress
        )
        stated = explanation.definition is not None
        shown = _with_value(reached, goal.after, TargetedMetric(metric, options.target), stated=stated)
        after = goal.after
        of_picture = photometric_premises(
            metric, after.image, after.value, after.error, renderer=renderer, values=goal.values
        )
        notes = of_picture + premises(metric, options) + grid_premises(renderer) + missing
        results.append(dataclasses.replace(shown, premises=notes))
        titles = ["as it is", f"below {goal.below:g}"]
        change = goal.after.value - goal.before.value
        values = [format_with_error(one.value, one.error) for one in (goal.before, goal.after)]
        error = math.hypot(goal.after.error, goal.before.error)
        comparison = Comparison(change, error, [SEPARATE.format(*values)])
    write_report(
        results,
        options.out / REPORT,
        titles,
        title=options.title,
        plans=plans_of([(one.picture, one.attribution.info) for one in results], renderer, metric),
        comparison=comparison,
    )


def _with_value(
    attribution: SceneAttribution, measured: Measured, metric: TargetedMetric, *, stated: bool
) -> Explanation:
    """Return a design with the value that confirmed it, so that no second one is shown.

    ``stated`` says whether it is shown as that by the definition, beside the relaxed one.
    """
    means = metric.verdict(measured.value, measured.image)
    value, error, definition = measured.value, measured.error, None
    if stated and measured.relaxed is not None:
        definition = Definition(value, class_by_definition(metric, value, measured.image), error=error)
        value, error = measured.relaxed, measured.relaxed_error
    confirmed = dataclasses.replace(
        attribution,
        metric_value=value,
        metric_standard_error=error,
        metric_error_parts=None,
        info={**attribution.info, "verdict": means},
    )
    return Explanation(confirmed, count=0, definition=definition, picture=measured.image)


def explained(
    renderer: SceneRenderer,
    metric: Metric,
    values: Mapping[str, torch.Tensor] | None,
    options: argparse.Namespace,
    *,
    target: int | None = None,
    below: float | None = None,
) -> Explanation:
    """Return the explanation of a metric, and under which light it was computed."""
    explanation = explain(
        renderer,
        metric,
        values,
        target=target,
        below=below,
        changes=options.changes,
        seed=options.seed,
        show_progress=_arguments.shows_progress(options),
    )
    attribution = explanation.attribution
    assert isinstance(attribution, SceneAttribution), "explain returns that of a gradient method"
    return dataclasses.replace(
        explanation,
        attribution=with_settings(attribution, renderer, options),
        premises=explanation.premises + premises(metric, options) + grid_premises(renderer),
    )


def explanation_formats(renderer: SceneRenderer, metric: Metric) -> list[OutputFormat[Explanation]]:
    """Return the files of an explanation, with a plan if it is one of a sensor grid."""

    def write_json(explanation: Explanation, path: Path) -> None:
        path.write_text(_json(explanation, renderer) + "\n", encoding="utf-8")

    formats = [
        OutputFormat("explanation.md", "the sentences in Markdown", _write_markdown),
        OutputFormat("explanation.json", "the numbers", write_json),
    ]
    if not renderer.has_grid:
        return formats
    return [*formats, plan_format(renderer, metric, lambda one: (one.picture, one.attribution.info))]


def explanation_numbers(explanation: Explanation, renderer: SceneRenderer) -> dict[str, Any]:
    """Return an explanation as plain values."""
    attribution, goal, definition = explanation.attribution, explanation.goal, explanation.definition
    return {
        "metric": {
            "name": metric_name(attribution) if definition is None else f"relaxed {metric_name(attribution)}",
            "unit": metric_unit(attribution),
            "value": attribution.metric_value,
            "standard_error": attribution.metric_standard_error,
            "verdict": verdict(attribution) if definition is None else definition.verdict,
            "definition": None if definition is None else vars(definition),
        },
        "premises": list(explanation.premises),
        "sources": [vars(source) for source in explanation.sources],
        "not_in_sources": list(explanation.not_in_sources),
        "effects": [
            {"name": row.name, "label": row.label, "effect": row.effect, "standard_error": row.effect_error}
            for row in attribution.ranking()
        ],
        "changes": [_change_numbers(change, renderer) for change in explanation.changes],
        "rows": [vars(row) for row in explanation.rows],
        "goal": None if goal is None else optimization_numbers(goal, renderer),
        "sentences": dict(explanation.sections()),
    }


def _change_numbers(change: Change, renderer: SceneRenderer) -> dict[str, Any]:
    """Return a change as plain values; of a texture the means of both, and what changes all its texels alike."""
    before, after = change.before, change.after
    numbers = {**vars(change), "before": plain_or_mean(before), "after": plain_or_mean(after)}
    if not is_large(before):
        return numbers
    setting = change_of_texture(renderer, change.name, before, after)
    return {**numbers, "setting": dict([setting]) if setting else None}


def _json(explanation: Explanation, renderer: SceneRenderer) -> str:
    return json.dumps(explanation_numbers(explanation, renderer), indent=1, ensure_ascii=False)


def _write_markdown(explanation: Explanation, path: Path) -> None:
    path.write_text(explanation.markdown(), encoding="utf-8")


def _goal(explanation: Explanation) -> Optimization:
    goal: Optimization = explanation.goal
    return goal
