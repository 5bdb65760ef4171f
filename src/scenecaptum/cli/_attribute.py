"""``scenecaptum attribute``: compute attributions and write the ranking, the heatmap and the numbers."""

from __future__ import annotations

import argparse
import dataclasses
import inspect
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args

import torch

from ..attr import GROUPS, METHODS, AttributionInterrupted, Definition, Explanation, SceneAttribution
from ..errors import SceneCaptumError
from ..estimation import DEFAULT_REPLICATES, Denoise, Metric, TargetedMetric
from ..explanation import (
    definition_of,
    depth_premises,
    photometric_premises,
    rated_image,
    states_definition,
    values_of,
)
from ..metrics import NO_SOURCE, GlareRating
from ..protocols import Scale
from ..rendering import SceneRenderer
from ..report import json_text, write_report
from ..visualization import cautions_among, metric_name, table_text, terminal_width, wrap
from . import _arguments
from ._design import add_design, designed_values
from ._files import OutputFormat, print_files, writable, write_files
from ._formats import FORMATS, check_formats, default_formats, selected_formats
from ._messages import warnings_after_checks
from ._metrics import DEFAULT, add_metric, find_metrics
from ._once import Once
from ._plan import plan_format, plan_of
from ._points import check_grid, check_report, needed_coefficients, premises, with_settings
from ._renders import renders_like

REPORT = "report.html"

DENOISE: dict[str, Denoise] = {"auto": "auto", "on": True, "off": False}
WIDTH = 100  # of sentences, without a terminal
RELAXED = "this rating is relaxed near the threshold; the value by the definition has no error bar here"
EXPLAIN = "`scenecaptum explain` states the value by the definition with its error bar"


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    parser = commands.add_parser(
        "attribute",
        help="rank the parameters of a scene by their effect on a metric",
        description="Render a scene, differentiate a metric through all light bounces, and write the ranking, the "
        "heatmap and the numbers.",
        epilog="example: scenecaptum attribute office --metric luminance --out out",
    )
    add_options(parser)
    parser.set_defaults(run=attribute)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command, which ``attribute`` reads."""
    _arguments.add_scene(parser)
    add_metric(parser, several=True, of_daylight=True)
    parser.add_argument(
        "--method",
        action=Once,
        choices=METHODS,
        default=next(iter(METHODS)),
        metavar="METHOD",
        help=f"{_arguments.describe(METHODS)} (default: %(default)s)",
    )
    parser.add_argument(
        "--scale",
        action=Once,
        choices=get_args(Scale),
        help="compare effects over each parameter's range, per unit, or relative to its value (default: range)",
    )
    parser.add_argument(
        "--groups",
        action=Once,
        choices=GROUPS,
        help="attribute to all parameters of a kind, material or object together; to ablate a lamp, choose "
        "object: without groups each colour channel is removed alone",
    )
    parser.add_argument(
        "--baselines",
        metavar="BASELINE",
        help="for methods that compare with another scene: dark, black, grey, or a number",
    )
    parser.add_argument(
        "--signed",
        action=argparse.BooleanOptionalAction,
        help="draw the heatmap with signs, or magnitudes (default: signs if there are effects of both)",
    )
    add_design(parser)
    parser.add_argument(
        "--replicates",
        type=int,
        default=DEFAULT_REPLICATES,
        metavar="N",
        help="minimum number of independent replicates for the error bars; 1 for no error bars "
        "(default: %(default)s)",
    )
    parser.add_argument(
        "--tolerance",
        type=float,
        metavar="X",
        help="sample until the 95 %% confidence half-width is at most X times the saliency, such as 0.05, for "
        "each parameter that may have 5 %% of the total saliency; the table shows the half-width achieved; "
        "--spp is then for the first round",
    )
    parser.add_argument(
        "--time-limit",
        type=float,
        metavar="SECONDS",
        help="stop after SECONDS per metric, not counting kernel compilation, and report the best estimate",
    )
    parser.add_argument(
        "--denoise",
        choices=DENOISE,
        default="auto",
        help="denoise the image for a non-linear metric, such as a glare rating; auto: if that reduces the "
        "measured error, and for ablation and Shapley values also changes the metric by more than its noise "
        "(default: %(default)s); the pictures are denoised unless off",
    )
    parser.add_argument(
        "--picture-spp",
        type=int,
        metavar="N",
        help="samples per pixel of the image for a non-linear metric (default: 2 times --spp, 4 times if the "
        "image is denoised, and 16 times if the metric is smoothed)",
    )
    add_results(parser)


def add_results(parser: argparse.ArgumentParser) -> None:
    """Add the options for the files that are written."""
    _arguments.add_output(parser)
    parser.add_argument(
        "--format",
        action="append",
        choices=FORMATS,
        dest="formats",
        metavar="FORMAT",
        help=f"{_arguments.describe(FORMATS)}; may be repeated (default: {', '.join(default_formats())})",
    )
    _arguments.add_report(parser, "an interactive page with all metrics")


class Finished(NamedTuple):
    """A result, its metric, and of a metric of daylight the value by the definition."""

    attribution: SceneAttribution
    metric: Metric
    definition: Definition | None = None


def attribute(options: argparse.Namespace) -> int:
    """Run the command."""
    names = options.metrics or [DEFAULT]
    metrics, coefficients = find_metrics(names, options), needed_coefficients(names, options)
    method, arguments = METHODS[options.method].create, _method_arguments(options)
    with writable(options.out):
        with warnings_after_checks():
            renderer = _arguments.make_renderer(options, coefficients)
            check_grid(renderer)
            if options.report:
                check_report(renderer)
            if not renderer.shows_a_view:
                check_formats(options.formats or ())
            # All of them before the first run, which may take long.
            created = {name: create(renderer) for name, create in metrics.items()}
        finished: list[Finished] = []
        for name, metric in created.items():
            folder = options.out if len(metrics) == 1 else options.out / folder_name(name)
            values = designed_values(options, renderer)
            try:
                attribution = method(renderer, metric).attribute(values, **arguments)
            except AttributionInterrupted as interruption:
                partial = _stated(interruption.partial, metric, renderer, values, options)
                _write_result(partial, folder, options, renderer)
                _write_report([*finished, partial], options, renderer)
                raise
            result = _stated(attribution, metric, renderer, values, options)
            _write_result(result, folder, options, renderer)
            finished.append(result)
            # After every metric, so that an interruption of the next one leaves a report.
            _write_report(finished, options, renderer)
        if not options.json:
            _arguments.print_resumed(renderer)
    return 0


def _method_arguments(options: argparse.Namespace) -> dict[str, Any]:
    """Return the arguments of the method's ``attribute``; raise if an option has no effect on it."""
    accepted = inspect.signature(METHODS[options.method].create.attribute).parameters
    optional = ("picture_spp", "tolerance", "time_limit", "groups", "baselines")
    given = {name: value for name in optional if (value := getattr(options, name)) is not None}
    if options.spp is not None and given.keys() & {"tolerance", "time_limit"}:
        given["spp"] = options.spp  # of the first round, which a pilot would choose
    if "baselines" in given:
        given["baselines"] = _number_or_name(given["baselines"])
    for name in given.keys() - accepted:
        raise SceneCaptumError(
            f"--{name.replace('_', '-')} has no effect on --method {options.method}: omit it."
        )
    return {
        "target": options.target,
        "seed": options.seed,
        "replicates": options.replicates,
        "denoise": DENOISE[options.denoise],
        "show_progress": _arguments.shows_progress(options),
        **given,
    }


def _number_or_name(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def folder_name(metric: str) -> str:
    """Return the name of the folder for the files of one of several metrics."""
    return "".join(c if c.isalnum() else "-" for c in metric).strip("-")


def _stated(
    attribution: SceneAttribution,
    metric: Metric,
    renderer: SceneRenderer,
    values: Mapping[str, torch.Tensor] | None,
    options: argparse.Namespace,
) -> Finished:
    """Return a result, of a relaxed metric of daylight with the value by the definition and its error.

    They are of renders of their own, one for each replicate, and so is what is said and drawn of the points. After
    an interruption nothing more is rendered, and the value has no error.
    """
    attribution, targeted = (
        with_settings(attribution, renderer, options),
        TargetedMetric(metric, options.target),
    )
    image = attribution.image
    if renderer.shows_a_view or image is None or targeted.by_definition() is None:
        return Finished(attribution, metric)
    if attribution.info.get("interrupted"):
        return Finished(attribution, metric, definition_of(targeted, image[None]))
    images = renders_like(attribution, renderer, metric, options, values).images
    shown = dataclasses.replace(attribution, image=images.mean(0))
    return Finished(shown, metric, definition_of(targeted, images))


def _write_result(
    result: Finished, folder: Path, options: argparse.Namespace, renderer: SceneRenderer
) -> None:
    """Write the files of a result and print it."""
    said, metric = _explained(result, renderer), result.metric
    of_inputs = premises(metric, options)
    attribution = result.attribution if said is None else _with_what_is_said(said, of_inputs)
    view = renderer.shows_a_view
    formats = selected_formats(
        options.formats or default_formats(view=view),
        options.scale,
        signed=options.signed,
        denoised=options.denoise != "off",
    )
    if renderer.has_grid and not options.formats:
        formats.append(plan_format(renderer, metric, lambda one: (one.image, one.info)))
    write_files(attribution, folder, formats)
    if options.json:
        print(json_text(attribution))
        return
    print(table_text(attribution, scale=options.scale, complete=_complete_table(formats)))
    width = terminal_width() or WIDTH
    notes = [] if said is None else said.value_notes()
    notes += [EXPLAIN] if RELAXED in notes else []
    print("".join(f"\n{wrap(line, width)}" for line in [*notes, *of_inputs]))
    print_files(folder, formats)


def _complete_table(formats: Sequence[OutputFormat[SceneAttribution]]) -> str:
    """Return the file with all parameters, or the option that writes it."""
    written = {one.file for one in formats}
    of_numbers = [FORMATS[name].file for name in ("csv", "json")]
    return next((file for file in of_numbers if file in written), "--format csv")


def _explained(result: Finished, renderer: SceneRenderer, more: Sequence[str] = ()) -> Explanation | None:
    """Return a result with what belongs to its value; None if nothing does.

    That is what a photometric metric takes for granted, and of a metric of daylight the value by the definition.
    """
    attribution, metric, definition = result
    image = attribution.image
    if image is None or (attribution.surfaces is None and not renderer.has_grid):  # of several cameras
        return None
    shown = rated_image(attribution, renderer)
    value, error = attribution.metric_value, attribution.metric_standard_error
    if definition is not None:
        value, error = definition.value, definition.error
    is_doubted = bool(attribution.untrusted_errors())
    values = values_of(attribution, renderer)
    notes = photometric_premises(metric, image, value, error, shown, renderer, values, is_doubted=is_doubted)
    if isinstance(metric, GlareRating) and states_definition(TargetedMetric(metric), shown):
        notes += (RELAXED,)
        attribution = _called_relaxed(attribution)
    if not notes and definition is None:
        return None
    return Explanation(attribution, premises=(*notes, *more), count=0, definition=definition)


def _called_relaxed(attribution: SceneAttribution) -> SceneAttribution:
    """Return a relaxed glare rating without its class: the rating by the definition may be in another one."""
    info = attribution.info
    has_class = not info["relaxed"] and info["verdict"] != NO_SOURCE
    verdict = "" if has_class else info["verdict"]
    return dataclasses.replace(attribution, info={**info, "relaxed": True, "verdict": verdict})


def _with_what_is_said(said: Explanation, more: Sequence[str]) -> SceneAttribution:
    """Return a result with the cautions on its value, those among ``more`` notes too.

    If it has a value by the definition, it is called relaxed, with what that other value means.
    """
    attribution = said.attribution
    assert isinstance(attribution, SceneAttribution), "it is what _explained was given"
    info = {**attribution.info, "metric_cautions": cautions_among([*said.premises, *more])}
    if said.definition is not None:
        # The relaxed value is in no class.
        measure = {**info["measure"], "name": f"relaxed {metric_name(attribution)}", "limits": []}
        info |= {"measure": measure, "verdict": said.rating()}
    return dataclasses.replace(attribution, info=info)


def _write_report(finished: Sequence[Finished], options: argparse.Namespace, renderer: SceneRenderer) -> None:
    """Write the report of the results so far, if requested."""
    if not options.report:
        return
    path = options.out / REPORT
    plans = [plan_of(one.image, renderer, metric, one.info) for one, metric, _ in finished]
    missing = depth_premises(renderer)
    shown: list[SceneAttribution | Explanation] = []
    for one in finished:
        said = _explained(one, renderer, (*premises(one.metric, options), *missing))
        if said is None and missing:
            said = Explanation(one.attribution, premises=missing, count=0)
        shown.append(said or one.attribution)
    write_report(shown, path, title=options.title, plans=plans, denoised=options.denoise != "off")
    if not options.json:
        print(f"{path}  interactive page with all results")
