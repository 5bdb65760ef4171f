"""``scenecaptum compare``: two scenes, two designs, or two saved results."""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import torch

from .. import metrics
from ..attr import Definition, Explanation, SceneAttribution, VanillaSceneGradient
from ..designs import design_of, read_design
from ..errors import SceneCaptumError
from ..estimation import DEFAULT_REPLICATES, Metric, TargetedMetric, at_values
from ..explanation import definition_of, difference_by_definition, photometric_premises, states_definition
from ..rendering import SceneRenderer
from ..report import Comparison, different_values, write_report
from ..scene import with_unit
from ..validation import Scenes, denoise_of
from ..visualization import (
    Format,
    format_with_error,
    grid,
    metric_name,
    metric_unit,
    pluralize,
    rounded,
    signed_with_error,
    terminal_width,
    unit_of_change,
    wrapped_lines,
)
from . import _arguments
from ._design import add_design, designed_values
from ._files import print_files, writable
from ._messages import warnings_after_checks
from ._metrics import add_metric, find_metrics
from ._once import Once
from ._plan import plan_of
from ._points import check_grid, check_report, grid_premises, needed_coefficients, premises, with_settings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

REPORT = "comparison.html"
COMMON_NAMES = ("scene", "attribution", "design")
# Settings on which a value depends, by their key in ``info``, and their names.
SETTINGS = {"resolution": "resolution", "sensor": "camera", "max_depth": "max depth"}
ROWS = 10
SMALL = 0.01  # of the largest change of an effect: smaller ones are left out of the table
WIDTH = 100  # of sentences, without a terminal
SIGNIFICANT = 2.0  # standard errors
ROUNDING = 1e-5  # of both effects: a difference in single precision below this is not a change
MEASURED = (
    "The change comes from separate renders of both designs with the same random numbers, in which most of the "
    "noise cancels: it can differ from the difference of the two values, by about their errors."
)
BY_DEFINITION = (
    "The values by the definition come from separate renders of both designs with the same random numbers, in "
    "which most of the noise of their change cancels."
)
SAVED = (
    "Both values are relaxed near the threshold, which only serves the derivatives: a saved result has no value "
    "by the definition. Explain the scenes to get it."
)
RELAXED = "The effects are those of the relaxed metric, which only serves the derivatives"


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
    parser.set_defaults(run=run)


@dataclass(frozen=True)
class Compared:
    """Two results of one metric, their titles, and the change of the metric with its standard error.

    ``measured`` says how, where the change is not the difference of the two values. Of metrics of daylight, also
    the change by the definition and its error. ``sides`` have what belongs to each result.
    """

    before: SceneAttribution
    after: SceneAttribution
    titles: Sequence[str]
    change: float
    error: float | None
    sides: Sequence[Side]
    measured: str = ""
    by_definition: tuple[float, float | None] | None = None

    def notes(self) -> list[str]:
        """Return what belongs to the change: how it was measured, that of the relaxed metric, and cautions."""
        return list(filter(None, (self.measured, self.relaxed(), self.different_settings())))

    def different_settings(self) -> str:
        """Return a caution that names the settings by which the two results differ; empty if there are none."""
        different = [
            f"{name} {' against '.join(values)}"
            for key, name in SETTINGS.items()
            if all(values := _different_settings(self.before, self.after, key))
        ]
        if not different:
            return ""
        return f"caution: made with different settings, which are part of the change: {'; '.join(different)}"

    def premises(self) -> list[str]:
        """Return what both results were computed for; what holds for one of them alone begins with its title."""
        first, second = (side.premises for side in self.sides)
        return [
            text if text in first and text in second else f"{title}: {text}"
            for title, own, others in zip(self.titles, (first, second), ((), first), strict=True)
            for text in own
            if text not in others
        ]

    def relaxed(self) -> str:
        """Return the change of the relaxed metric in a sentence; empty if the metric is not relaxed."""
        if self.by_definition is None:
            return SAVED if self.are_relaxed_ratings() else ""
        unit = unit_of_change(metric_unit(self.before))
        change = f"{signed_with_error(self.change, self.error)} {unit}".rstrip()
        return f"{RELAXED}: it changes by {change}."

    def are_relaxed_ratings(self) -> bool:
        """Whether the two values are relaxed ratings of glare, as one that was saved is."""
        return any(side.is_saved for side in self.sides) and _is_glare_rating(self.before)

    def shown(self) -> list[Explanation]:
        """Return both results for the page, with what belongs to their values."""
        return [
            Explanation(one, definition=side.definition, premises=tuple(side.premises), count=0)
            for one, side in zip((self.before, self.after), self.sides, strict=True)
        ]


class ChangedEffect(NamedTuple):
    """The effect of a parameter in both designs, its change, and the error of that."""

    name: str
    label: str
    before: float
    after: float
    change: float
    error: float | None

    def numbers(self) -> tuple[str, str, str]:
        """Return both effects and the change in one notation, with the digits that the error supports."""
        style = Format.of(max(map(abs, (self.before, self.after, self.change))), self.error)
        change = [style.write_signed(self.change), *([style.write(self.error)] if self.error else [])]
        return style.write(self.before), style.write(self.after), " ± ".join(change)


class Result(NamedTuple):
    """One of the two results, and the renderer and the metric that made it; without these if it was loaded."""

    attribution: SceneAttribution
    renderer: SceneRenderer | None = None
    metric: Metric | None = None


@dataclass(frozen=True)
class Side:
    """What belongs to one of the two results: its plan, its value by the definition, and its premises.

    A result that was saved has none of these.
    """

    plan: Figure | None = None
    definition: Definition | None = None
    premises: Sequence[str] = ()
    is_saved: bool = False


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    with writable(options.out):
        found = _compare(options)
        plans = [side.plan for side in found.sides]
        change = found.by_definition or (found.change, found.error)
        comparison = Comparison(*change, found.notes())
        write_report(
            found.shown(),
            options.out / REPORT,
            found.titles,
            title=options.title,
            plans=plans,
            comparison=comparison,
        )
    if options.json:
        print(json.dumps(_numbers(found), indent=1, ensure_ascii=False))
        return 0
    print("\n".join(_lines(found)))
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
    renderer, metric = _renderer_and_metric(options, options.scene)
    origin = None if options.origin is None else design_of(renderer, read_design(options.origin))
    design = designed_values(options, renderer)
    method, progress = VanillaSceneGradient(renderer, metric), _arguments.shows_progress(options)
    # The design first: a value of it that is refused costs no time.
    after, before = (
        with_settings(
            method.attribute(values, target=options.target, seed=options.seed, show_progress=progress),
            renderer,
            options,
        )
        for values in (design, origin)
    )
    scenes = Scenes(
        renderer,
        metric,
        options.target,
        seed=options.seed,
        spp=(before.info.get("picture") or {}).get("spp"),  # the change is to be as accurate as the values
        replicates=DEFAULT_REPLICATES,
        denoise=denoise_of(before),
        values=origin,
    )
    titles = options.titles or _design_titles(options.origin, options.design)
    images = scenes.render(design or {})
    change = scenes.difference(images, design or {})
    rated = scenes.metric, at_values(scenes.metric, renderer, {**scenes.values, **(design or {})})
    both = list(zip(rated, (scenes.images, images), strict=True))
    stated = any(states_definition(one, pictures.mean(0)) for one, pictures in both)
    sides = [
        _side(Result(one, renderer, metric), of_definition if stated else None, options)
        for one, of_definition in zip((before, after), both, strict=True)
    ]
    exact = difference_by_definition(*rated, (scenes.images, images)) if stated else None
    measured = MEASURED if exact is None else BY_DEFINITION
    return Compared(before, after, titles, *change, sides, measured, exact)


def _side(
    result: Result, of_definition: tuple[TargetedMetric, torch.Tensor] | None, options: argparse.Namespace
) -> Side:
    """Return what belongs to a result; of the metric and the renders by which its definition is stated, if it is.

    What is said and drawn of daylight is of the renders whose value is quoted.
    """
    attribution, renderer, metric = result
    if renderer is None or metric is None:
        return Side(is_saved=True)
    assert attribution.image is not None, "every attribution of a SceneRenderer has its image"
    definition, of_value, shown = None, attribution.image, None
    if of_definition is not None:
        targeted, images = of_definition
        definition, of_value = definition_of(targeted, images), images.mean(0)
        shown = targeted.transform(of_value)
    value = attribution.metric_value if definition is None else definition.value
    of_picture = photometric_premises(metric, of_value, value, shown, renderer)
    return Side(
        plan_of(of_value, renderer, metric, attribution.info),
        definition,
        of_picture + premises(metric, options) + grid_premises(renderer),
    )


def _compare_scenes(options: argparse.Namespace) -> Compared:
    if options.origin is not None:
        raise SceneCaptumError(
            "--from needs --set or --design: it is the design that they are compared with."
        )
    results = [_loaded_or_attributed(options, given) for given in (options.scene, options.other)]
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


def _loaded_or_attributed(options: argparse.Namespace, given: str) -> Result:
    if given.endswith(".npz"):
        loaded = SceneAttribution.load(given)
        if loaded.surfaces is None:
            raise SceneCaptumError(
                f"{given} has no picture of objects, as a sensor grid has none: compare the scenes, not the files."
            )
        return Result(loaded)
    renderer, metric = _renderer_and_metric(options, given)
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
        Scenes(
            renderer,
            metric,
            options.target,
            seed=options.seed,
            spp=(attribution.info.get("picture") or {}).get("spp"),
            replicates=DEFAULT_REPLICATES,
            denoise=denoise_of(attribution),
        )
        for attribution, renderer, metric, _ in known
    ]
    return [(one.metric, one.images) for one in scenes]


def _renderer_and_metric(options: argparse.Namespace, scene: str) -> tuple[SceneRenderer, Metric]:
    (create,) = find_metrics([options.metric], options).values()
    coefficients = needed_coefficients([options.metric], options)
    with warnings_after_checks():
        renderer = _arguments.make_renderer(
            argparse.Namespace(**{**vars(options), "scene": scene}), coefficients
        )
        check_grid(renderer)
        check_report(renderer)
        return renderer, create(renderer)


def _design_titles(origin: Path | None, design: Path | None) -> list[str]:
    if origin is not None and design is not None:
        return _titles(origin, design)
    return [
        "as it is" if origin is None else _name(origin),
        "the design" if design is None else _name(design),
    ]


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


def _lines(found: Compared) -> list[str]:
    """Return the comparison as text: the metric, the values that differ, and the effects that changed."""
    before, after = found.before, found.after
    suffix = f" {unit_of_change(metric_unit(before))}".rstrip()
    text = [
        *(
            f"{title}: {_value_line(one, side)}{', relaxed' if found.are_relaxed_ratings() else ''}"
            for title, one, side in zip(found.titles, (before, after), found.sides, strict=True)
        ),
        f"change: {signed_with_error(*(found.by_definition or (found.change, found.error)))}{suffix}",
        *(line for note in found.notes() for line in _note(note)),
        *(line for text in found.premises() for line in wrapped_lines(text, _width(), indent=4)),
    ]
    labels = {
        name: with_unit(before.labels.get(name, name), name) for name in different_values(before, after)
    }
    moved = [
        (label, *(_values(one.parameter_values[name]) for one in (before, after)))
        for name, label in labels.items()
    ]
    if moved:
        text += ["", *grid(("parameter", *found.titles), moved[:ROWS])]
    if set(before) != set(after):
        only = pluralize(len(set(before) ^ set(after)), "parameter")
        return [*text, "", f"{only} of one of the two only; effects are not compared."]
    changed = _changed_effects(before, after)
    shown = [one for one in changed if abs(one.change) >= SMALL * abs(changed[0].change)]
    table = [(one.label, *one.numbers()) for one in shown[:ROWS]]
    if table:
        text += ["", *grid(("effect of", *found.titles, f"change{suffix}"), table)]
    longer = _with_different_ranges(before, after)
    if of_longer := [one.label for one in shown if one.name in longer]:
        text += _note(f"over the longer of the two ranges: {'; '.join(of_longer)}")
    if small := len(changed) - len(shown):
        effects = (
            f"{pluralize(small, 'effect')} that changed by less than {100 * SMALL:g} % of the largest change"
        )
        text += _note(f"left out: {effects}")
    return text


def _value_line(attribution: SceneAttribution, side: Side) -> str:
    """Return the metric and its value; by the definition, with the relaxed one behind it, if there are two."""
    headline = Explanation(attribution, definition=side.definition).headline()
    if side.definition is None:
        return headline
    relaxed = format_with_error(attribution.metric_value, attribution.metric_standard_error)
    relaxed = f"{relaxed} {metric_unit(attribution)}".rstrip()
    return f"{headline} by the definition; relaxed {relaxed}"


def _is_glare_rating(attribution: SceneAttribution) -> bool:
    """Whether a result is of a rating of glare, also if it was saved."""
    rating = getattr(metrics, str(attribution.info.get("metric")), None)
    return isinstance(rating, type) and issubclass(rating, metrics.GlareRating)


def _different_settings(before: SceneAttribution, after: SceneAttribution, key: str) -> list[str]:
    """Return a setting of two results in words, what differs of it; empty where it is equal or not known."""
    values = [_setting(one, key) for one in (before, after)]
    if not all(values):
        return ["", ""]
    parts, others = (value.split(", ") for value in values)
    different = [
        ", ".join(part for part in own if part not in rest)
        for own, rest in ((parts, others), (others, parts))
    ]
    return different if all(different) or parts == others else values


def _setting(attribution: SceneAttribution, key: str) -> str:
    """Return a setting of a result in words; empty if it is not known."""
    value = attribution.info.get(key)
    if key == "resolution" and value is not None:
        return "×".join(map(str, value))
    return "no limit" if value == -1 else str("" if value is None else value)


def _note(text: str) -> list[str]:
    """Return a sentence as indented lines."""
    return wrapped_lines(f"  {text}", _width(), indent=2) if text else []


def _width() -> int:
    return max(terminal_width() or WIDTH, 40)


def _numbers(found: Compared) -> dict[str, Any]:
    """Return the comparison as plain values."""
    before, after = found.before, found.after
    rows = _changed_effects(before, after) if set(before) == set(after) else []
    return {
        "metric": metric_name(before),
        "unit": metric_unit(before),
        "results": [
            {
                "title": title,
                "value": one.metric_value,
                "standard_error": one.metric_standard_error,
                "definition": None if side.definition is None else vars(side.definition),
            }
            for title, one, side in zip(found.titles, (before, after), found.sides, strict=True)
        ],
        "change": {
            "value": found.change,
            "standard_error": found.error,
            "definition": None
            if found.by_definition is None
            else dict(zip(("value", "error"), found.by_definition, strict=True)),
        },
        "values": {
            name: [one.parameter_values[name].tolist() for one in (before, after)]
            for name in different_values(before, after)
        },
        "notes": found.notes(),
        "effects": [
            {
                "name": one.name,
                "label": one.label,
                "before": one.before,
                "after": one.after,
                "change": one.change,
                "standard_error": one.error,
            }
            for one in rows
        ],
    }


def _changed_effects(before: SceneAttribution, after: SceneAttribution) -> list[ChangedEffect]:
    """Return the changes of effects that are clear of the noise, the largest first."""
    before, after = _over_equal_ranges(before, after)
    rows, differences = ({row.name: row for row in one.ranking()} for one in (before, after - before))
    found = []
    for row in after.ranking():
        own, difference = rows[row.name], differences[row.name]
        change, error = difference.effect, difference.effect_error
        if row.name in after.vectors:
            # Each effect is in a direction of its own.
            change = row.effect - own.effect
            error = math.hypot(row.effect_error or math.inf, own.effect_error or math.inf)
        rounding = ROUNDING * max(abs(own.effect), abs(row.effect))
        if abs(change) > max(SIGNIFICANT * (error or math.inf), rounding):
            found.append(ChangedEffect(row.name, row.label, own.effect, row.effect, change, error))
    return sorted(found, key=lambda one: -abs(one.change))


def _over_equal_ranges(
    before: SceneAttribution, after: SceneAttribution
) -> tuple[SceneAttribution, SceneAttribution]:
    """Return both results with effects over the longer of their two ranges, so that they can be subtracted.

    The range of a lamp is from off to its value.
    """
    if not (before.extents and after.extents):
        return before, after
    longer = {name: torch.maximum(length, after.extents[name]) for name, length in before.extents.items()}
    return dataclasses.replace(before, extents=longer), dataclasses.replace(after, extents=longer)


def _with_different_ranges(before: SceneAttribution, after: SceneAttribution) -> list[str]:
    """Return the parameters whose own ranges differ."""
    return [
        name
        for name, length in before.extents.items()
        if name in after.extents and not torch.equal(length, after.extents[name])
    ]


def _values(value: torch.Tensor) -> str:
    return " ".join(rounded(number) for number in value.flatten().tolist())
