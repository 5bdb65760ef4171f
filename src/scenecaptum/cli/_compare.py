"""``scenecaptum compare``: two scenes, two designs, or two saved results."""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch

from ..attr import SceneAttribution, VanillaSceneGradient, own_texels, summarize
from ..designs import read_design
from ..errors import SceneCaptumError
from ..estimation import Metric, TargetedMetric, at_values, difference_by_definition
from ..explanation import (
    definition_of,
    depth_premises,
    grid_premises,
    missing_at_edges,
    photometric_premises,
    rated_image,
    states_definition,
    values_of,
)
from ..protocols import ResultKind
from ..rendering import SceneRenderer
from ..report import Comparison, write_report
from ..visualization import method_name, metric_name, share_scale
from . import _arguments
from ._compared import Compared, Side, lines, numbers
from ._compared_effects import with_contradictions
from ._design import add_design, design_settings, fixed_values, whole_design
from ._files import print_files, writable
from ._messages import warnings_after_checks
from ._metrics import add_metric, find_metrics
from ._once import Once
from ._plan import plan_of
from ._points import check_grid, check_report, needed_coefficients, premises, with_settings
from ._renders import renders_like

REPORT = "comparison.html"
COMMON_NAMES = ("scene", "attribution", "design")
MEASURED = (
    "The change comes from separate renders of both designs with the same random numbers{}: it can differ from "
    "the difference of the two values, by about their errors."
)
BY_DEFINITION = (
    "The values by the definition come from separate renders of both designs with the same random numbers{}."
)
SAME = "Both designs are the same."
MOST = 0.5  # of the error of a change without common random numbers


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    parser = commands.add_parser(
        "compare",
        help="compare two scenes, two designs of a scene, or two saved results",
        description="Compare a metric and its causes in two scenes or two saved results (attribution.npz). With "
        "--set or --design, B is that design of the scene, and A the scene as it is or the design --from. Both "
        "are rendered with the same random numbers, so that the error of the change is small.",
        epilog="example: scenecaptum compare office --set desk.base_color.value=0.8 --metric ugr --spp 64",
    )
    _arguments.add_scene(parser)
    parser.add_argument("other", nargs="?", metavar="B", help="another scene or saved result")
    add_metric(parser, of_daylight=True)
    add_design(parser)
    parser.add_argument(
        "--from", action=Once, type=Path, dest="origin", metavar="FILE", help="the design that is A"
    )
    parser.add_argument("--titles", nargs=2, metavar=("A", "B"), help="names of the two in the output")
    _arguments.add_title(parser)
    _arguments.add_output(parser)
    parser.needless = {"--report": f"compare always writes its page, {REPORT} in the output folder."}
    parser.twice = {"--design": "two designs are compared by --from FILE --design FILE"}
    parser.set_defaults(run=run)


class Result(NamedTuple):
    """One of the two results, and the renderer and the metric that made it; without these if it was loaded."""

    attribution: SceneAttribution
    renderer: SceneRenderer | None = None
    metric: Metric | None = None


class Designed(NamedTuple):
    """The result of a design, with its renderer and its metric."""

    attribution: SceneAttribution
    renderer: SceneRenderer
    metric: Metric


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    with writable(options.out):
        found = _compare(options)
        plans = [side.plan for side in found.sides]
        share_scale(plan for plan in plans if plan is not None)
        change = found.by_definition or (found.change, found.error)
        comparison = Comparison(*change, found.notes(), found.effects())
        write_report(
            found.shown(),
            options.out / REPORT,
            found.titles,
            title=options.title,
            plans=plans,
            comparison=comparison,
        )
    if options.json:
        print(json.dumps(numbers(found), indent=1, ensure_ascii=False))
        return 0
    print("\n".join(lines(found)))
    print_files(options.out, [])
    shown = "both plans" if any(plans) else "both pictures and maps"
    print(f"{options.out / REPORT}  the change, what was set, and {shown}")
    return 0


def _compare(options: argparse.Namespace) -> Compared:
    if options.titles and len(set(options.titles)) < len(options.titles):
        raise SceneCaptumError("--titles must differ: they tell the two apart.")
    _refuse_designs(options)
    designed = bool(options.settings or options.design)
    if (options.other is None) != designed:
        raise SceneCaptumError(
            "Give either a second scene or saved result, or the values of a design with --set or --design."
        )
    return _compare_designs(options) if designed else _compare_scenes(options)


def _refuse_designs(options: argparse.Namespace) -> None:
    """Raise if a design is given in the place of a scene."""
    given = [one for one in (options.scene, options.other) if one and Path(one).suffix in (".json", ".toml")]
    if not given:
        return
    scene = next((one for one in (options.scene, options.other) if one and one not in given), "SCENE")
    is_one = len(given) == 1
    files = f"--design {given[0]}" if is_one else f"--from {given[0]} --design {given[1]}"
    what = (
        f"{given[0]} is a design, not a scene" if is_one else f"{' and '.join(given)} are designs, not scenes"
    )
    raise SceneCaptumError(f"{what}: scenecaptum compare {scene} {files}")


def _compare_designs(options: argparse.Namespace) -> Compared:
    renderer, metric = _renderer_and_metric(options, options.scene, {})
    of_origin = {} if options.origin is None else read_design(options.origin)
    origin, design = (
        whole_design(options, renderer, settings) for settings in (of_origin, design_settings(options))
    )
    is_same = all(torch.equal(value, origin[name]) for name, value in design.items())
    # The design first: a value of it that is refused costs no time.
    after = _attributed_at(design, renderer, metric, design_settings(options), options)
    before = after if is_same else _attributed_at(origin, renderer, metric, of_origin, options)
    scenes = renders_like(before.attribution, renderer, before.metric, options, origin)
    titles = options.titles or _design_titles(
        options.origin, options.design, is_changed=bool(options.settings)
    )
    images = scenes.render(design)
    # That of B knows where B's camera is.
    transform = at_values(scenes.metric, renderer, design).transform
    rated = scenes.metric, TargetedMetric(after.metric, options.target).with_transform(transform)
    change = scenes.difference_to(images, rated[1])
    both = list(zip(rated, (scenes.images, images), strict=True))
    stated = any(states_definition(one, pictures.mean(0)) for one, pictures in both)
    sides = [
        _side(one, of_definition if stated else None, options)
        for one, of_definition in zip((before, after), both, strict=True)
    ]
    exact = difference_by_definition(*rated, (scenes.images, images)) if stated else None
    if is_same:
        measured = SAME
    elif exact is None:
        measured = MEASURED.format(
            _remaining(change[1], [one.attribution.metric_standard_error for one in (before, after)])
        )
    else:
        values = [side.definition for side in sides if side.definition is not None]
        measured = BY_DEFINITION.format(_remaining(exact[1], [one.error for one in values]))
    results = with_contradictions(before.attribution, after.attribution, change)
    return Compared(*results, titles, *change, sides, measured, exact)


def _attributed_at(
    values: Mapping[str, torch.Tensor],
    renderer: SceneRenderer,
    metric: Metric,
    settings: Mapping[str, Any],
    options: argparse.Namespace,
) -> Designed:
    """Return the result of a design, whose values beside the inputs are fixed; it has these values, too."""
    if fixed := fixed_values(options, renderer, settings):
        renderer, metric = _renderer_and_metric(options, options.scene, fixed)
    inputs = renderer.inputs
    result: SceneAttribution = VanillaSceneGradient(renderer, metric).attribute(
        {name: values[name] for name in inputs},
        target=options.target,
        seed=options.seed,
        show_progress=_arguments.shows_progress(options),
    )
    beside = {name: value for name, value in values.items() if name not in inputs}
    result = dataclasses.replace(
        with_settings(result, renderer, options),
        parameter_values={**result.parameter_values, **summarize(own_texels(renderer, beside))},
        labels={**result.labels, **{name: renderer.parameters[name].label for name in beside}},
    )
    return Designed(result, renderer, metric)


def _remaining(error: float | None, errors: Sequence[float | None]) -> str:
    """Return how much of the noise of two values is left in their change; empty if it is not known."""
    if error is None or None in errors or not any(errors):
        return ""
    if error < MOST * math.hypot(*(one or 0.0 for one in errors)):
        return ", in which most of the noise of the change cancels"
    return ", in which half or more of the noise of the change remains"


def _side(
    result: Result | Designed,
    of_definition: tuple[TargetedMetric, torch.Tensor] | None,
    options: argparse.Namespace,
) -> Side:
    """Return what belongs to a result; of the metric and the renders by which its definition is stated, if it is.

    What is said and drawn of daylight is of the renders whose value is quoted.
    """
    attribution, renderer, metric = result
    if renderer is None or metric is None:
        return Side(is_saved=True)
    assert attribution.image is not None, "every attribution of a SceneRenderer has its image"
    definition, of_value, shown = None, attribution.image, rated_image(attribution, renderer)
    if of_definition is not None:
        targeted, images = of_definition
        definition, of_value = definition_of(targeted, images), images.mean(0)
        shown = targeted.transform(of_value)
    value, error = attribution.metric_value, attribution.metric_standard_error
    if definition is not None:
        value, error = definition.value, definition.error
    is_doubted = bool(attribution.untrusted_errors())
    values = values_of(attribution, renderer)
    of_picture = photometric_premises(
        metric, of_value, value, error, shown, renderer, values, is_doubted=is_doubted
    )
    return Side(
        plan_of(of_value, renderer, metric, attribution.info),
        definition,
        of_picture + premises(metric, options) + grid_premises(renderer),
        depth_premises(renderer),
        missing_at_edges(metric, shown, renderer, values),
    )


def _compare_scenes(options: argparse.Namespace) -> Compared:
    if options.origin is not None:
        raise SceneCaptumError(
            "--from needs --set or --design: it is the design that they are compared with."
        )
    both = options.scene, options.other
    saved = {
        one: _loaded(one, is_beside_a_scene=not all(map(_is_saved, both))) for one in both if _is_saved(one)
    }
    results = [saved[one] if one in saved else _attributed(options, one) for one in both]
    before, after = (one.attribution for one in results)
    if metric_name(before) != metric_name(after):
        raise SceneCaptumError(
            f"The results are of different metrics, {metric_name(before)} and {metric_name(after)}: compare "
            "results of one metric."
        )
    a, b = before.metric_standard_error, after.metric_standard_error
    error = None if a is None or b is None else math.hypot(a, b)
    change = after.metric_value - before.metric_value
    titles = options.titles or _titles(options.scene, options.other)
    sides = [
        _side(one, of_definition, options)
        for one, of_definition in zip(results, _for_definition(results, options), strict=True)
    ]
    definitions = [side.definition for side in sides if side.definition is not None]
    exact = None
    if len(definitions) == len(sides):
        first, second = definitions
        exact = second.value - first.value, math.hypot(first.error or 0.0, second.error or 0.0)
    return Compared(before, after, titles, change, error, sides, by_definition=exact)


def _is_saved(given: str) -> bool:
    # By any name: a result may be saved under another.
    return given.endswith(".npz") or zipfile.is_zipfile(given)


def _loaded(given: str, *, is_beside_a_scene: bool) -> Result:
    loaded = SceneAttribution.load(given)
    if loaded.surfaces is None:
        raise SceneCaptumError(
            f"{given} has no picture of objects, as a sensor grid has none: compare the scenes, not the files."
        )
    if is_beside_a_scene and loaded.kind not in (ResultKind.GRADIENT, ResultKind.EFFECT):
        raise SceneCaptumError(
            f"{given} has the quantity {loaded.kind.value} ({method_name(loaded)}), but of a scene, compare "
            f"computes the {ResultKind.GRADIENT.value}: save a result of the scene by the same method with "
            "attribute, and compare both files."
        )
    fixed = {name: torch.tensor(value) for name, value in loaded.info.get("values", {}).items()}
    return Result(dataclasses.replace(loaded, parameter_values={**loaded.parameter_values, **fixed}))


def _attributed(options: argparse.Namespace, scene: str) -> Result:
    renderer, metric = _renderer_and_metric(options, scene, {})
    result: SceneAttribution = VanillaSceneGradient(renderer, metric).attribute(
        target=options.target, seed=options.seed, show_progress=_arguments.shows_progress(options)
    )
    return Result(with_settings(result, renderer, options), renderer, metric)


def _for_definition(
    results: Sequence[Result], options: argparse.Namespace
) -> Sequence[tuple[TargetedMetric, torch.Tensor] | None]:
    """Return the metrics and renders by which the definition is stated: of both scenes, or of none.

    A saved result has no replicates of its picture.
    """
    known = [
        (attribution, renderer, metric, attribution.image)
        for attribution, renderer, metric in results
        if renderer is not None and metric is not None and attribution.image is not None
    ]
    if len(known) < len(results) or not any(
        states_definition(TargetedMetric(metric, options.target), image) for _, _, metric, image in known
    ):
        return [None] * len(results)
    scenes = [
        renders_like(attribution, renderer, metric, options) for attribution, renderer, metric, _ in known
    ]
    return [(one.metric, one.images) for one in scenes]


def _renderer_and_metric(
    options: argparse.Namespace, scene: str, fixed: Mapping[str, torch.Tensor]
) -> tuple[SceneRenderer, Metric]:
    (create,) = find_metrics([options.metric], options).values()
    coefficients = needed_coefficients([options.metric], options)
    with warnings_after_checks():
        renderer = _arguments.make_renderer(
            argparse.Namespace(**{**vars(options), "scene": scene}), coefficients, fixed
        )
        check_grid(renderer)
        check_report(renderer)
        return renderer, create(renderer)


def _design_titles(origin: Path | None, design: Path | None, *, is_changed: bool) -> list[str]:
    """Return what to call two designs of a scene; ``is_changed`` says whether values are set beside the file."""
    if origin is not None and design is not None and (origin != design or not is_changed):
        titles = _titles(origin, design)
    else:
        titles = [
            "as it is" if origin is None else _name(origin),
            "the design" if design is None else _name(design),
        ]
    if design is not None and is_changed:
        titles[1] = f"{titles[1]}, changed"
    return titles


def _titles(*given: str | Path) -> list[str]:
    """Return what to call two files: their names, or what else tells them apart."""
    paths = [Path(one) for one in given]
    for titles in (
        [_name(path) for path in paths],
        [path.parent.name or path.stem for path in paths],
        [str(path.with_suffix("")) for path in paths],
    ):
        if len(set(titles)) == len(titles):
            return titles
    return [f"{_name(path)} ({letter})" for path, letter in zip(paths, "AB", strict=True)]


def _name(path: Path) -> str:
    """Return the name of a file without its extension; of one that a command has named, that of its folder."""
    return path.parent.name if path.stem in COMMON_NAMES and path.parent.name else path.stem
