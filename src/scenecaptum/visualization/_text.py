"""Text about a result that tables, figures and the report share."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

from ..protocols import Attribution, RankedParameter, ResultKind, Scale
from ..student import clear_from
from ._layout import first_few, group_by_text
from ._numbers import format_with_error, rounded, rounded_up, shorten, with_error

_MAX_CAUTIONS = 5
_OF_DIFFERENCES = {ResultKind.ABLATION, ResultKind.OCCLUSION, ResultKind.SHAPLEY_VALUE}
_LARGE_ERROR = 0.3  # of the norm of all effects, or of a parameter's own
_ROUGHNESS = {"alpha", "alpha_u", "alpha_v", "roughness"}
# Below these, Mitsuba's microfacets have α = 1e-4; those of a principled material, α = roughness², have 1e-3.
_LEAST_ROUGHNESS = {**dict.fromkeys(("alpha", "alpha_u", "alpha_v"), 1e-4), "roughness": math.sqrt(1e-3)}
_MANY_TIMES = 4  # the roughness: the length of a range over which a tangent holds no longer
_MAP_NDIM = 3
_NOTABLE = 0.1  # of the largest effect
_ROUNDING = 1e-6  # relative to the explained difference
FINDING_WIDTH = 60  # maximum length of a name in a figure's title
METRIC_WIDTH = FINDING_WIDTH  # and of a metric's on an axis, which keeps both classes of a difference


def metric_line(attribution: Attribution, width: int | None = None) -> str:
    """Return ``'mean luminance = 2.337 ± 0.005 cd/m²'``, with the name shortened to ``width``.

    Of two metrics in different units it has no number, which would mean nothing.
    """
    if units := attribution.info.get("units"):
        first, second = (one or "a number without a unit" for one in units)
        return f"{metric_name(attribution, width)}, of different units ({first} and {second})"
    value = format_with_error(attribution.metric_value, attribution.metric_standard_error)
    unit = metric_unit(attribution)
    return f"{metric_name(attribution, width)} = {value}{f' {unit}' if unit else ''}"


def metric_name(attribution: Attribution, width: int | None = None) -> str:
    """Return the metric's name, that of its class if it has no other, shortened to ``width``."""
    name = str(_measure(attribution).get("name") or attribution.info.get("metric", "metric"))
    return name if width is None else shorten([name], width)[0]


def metric_symbol(attribution: Attribution) -> str:
    """Return the metric's usual abbreviation, such as ``"UGR"``, or its name."""
    return str(_measure(attribution).get("symbol") or metric_name(attribution))


def metric_unit(attribution: Attribution) -> str:
    """Return the metric's unit; empty if it has none, or none is known."""
    return str(_measure(attribution).get("unit") or "")


def unit_of_change(unit: str) -> str:
    """Return the unit of a change of a value in a unit: from 50 % to 60 % are ten percentage points, not 10 %."""
    return "percentage points" if unit == "%" else unit


def verdict(attribution: Attribution) -> str:
    """Return what the metric's value means; empty if the metric does not say."""
    return str(attribution.info.get("verdict") or "")


def _measure(attribution: Attribution) -> Mapping[str, Any]:
    return attribution.info.get("measure") or {}


def finding(attribution: Attribution, scale: Scale | None = None, *, metric: str | None = None) -> str:
    """Return ``'UGR depends most on sky: radiance'``, or the first two if the errors do not tell them apart.

    Of squares and variances it says what is largest, and of a difference of one metric what its sides differ in.

    If the third may be the first as well, "and others" follows. It names only effects that are clear of
    their noise, and says so if the largest is not, or if one within its noise may be larger. It names no effect
    with a note (``~``), which may be overstated. ``metric`` is by default its name.
    """
    metric, ranking = metric or metric_name(attribution, FINDING_WIDTH), attribution.ranking(scale=scale)
    most, none = _findings(attribution, metric)
    allowed = clear_from(attribution.info)
    noted = range_marked(range_notes(attribution, scale))
    if not noted and not any(row.saliency for row in ranking):
        return none
    if ranking[0].saliency and not _is_clear(ranking[0], allowed):
        return f"{metric}: the largest effect is within the noise"
    unmarked = [row for row in ranking if row.name not in noted]
    if not unmarked or not _is_clear(unmarked[0], allowed):
        return f"{metric}: see the notes on the effects marked ~"
    first, *others = [row for row in unmarked if _is_clear(row, allowed)][:3]
    noisy = [
        row for row in unmarked if not _is_clear(row, allowed) and _upper_end(row, allowed) > first.saliency
    ]
    if noisy:
        return f"{metric}: the largest effect is uncertain; {_too_large(noisy, allowed)}"
    tied = [row for row in others if not _are_apart(first, row, allowed)]
    names = shorten([row.label for row in (first, *tied[:1])], FINDING_WIDTH)
    listed = ", ".join(names) + " and others" if len(tied) > 1 else " and ".join(names)
    aside = "" if first is ranking[0] else ", effects marked ~ aside"
    return f"{most} {listed}{aside}"


def _findings(attribution: Attribution, metric: str) -> tuple[str, str]:
    """Return what precedes the names of the largest effects, and what is said where all are 0."""
    kind, terms = attribution.kind, attribution.info.get("terms") or ()
    if kind.has_sign and "minus" in attribution.info and len(terms) == 1:
        # Two results of one metric: not it, but their difference is what the effects are of.
        return "the two results differ most in", "the two results differ in none of these parameters"
    return kind.finding.format(metric), kind.finding_of_none.format(metric)


def _is_clear(row: RankedParameter, allowed: float) -> bool:
    """Whether a saliency is not 0 and more than the ``allowed`` standard errors from it."""
    return not row.saliency <= allowed * (row.saliency_error or 0.0)


def _upper_end(row: RankedParameter, allowed: float) -> float:
    """Return the saliency plus the ``allowed`` standard errors."""
    return row.saliency + allowed * (row.saliency_error or 0.0)


def _too_large(noisy: Sequence[RankedParameter], allowed: float) -> str:
    """Return ``'the error of sky: radiance is too large'``; of several, that of the largest upper end is first."""
    ordered = sorted(noisy, key=partial(_upper_end, allowed=allowed), reverse=True)
    named = shorten([row.label for row in ordered[: 1 if len(noisy) > 2 else 2]], FINDING_WIDTH)
    if len(noisy) == 1:
        return f"the error of {named[0]} is too large"
    others = [f"{len(noisy) - 1} others"] if len(noisy) > 2 else []
    return f"the errors of {' and '.join(named + others)} are too large"


def _are_apart(larger: RankedParameter, smaller: RankedParameter, allowed: float) -> bool:
    """Whether two saliencies differ by more than the ``allowed`` standard errors."""
    errors = (larger.saliency_error or 0.0, smaller.saliency_error or 0.0)
    return larger.saliency - smaller.saliency > allowed * math.hypot(*errors)


def method_name(attribution: Attribution) -> str:
    """Return the name of the attribution method."""
    return str(attribution.info.get("method", "unknown method"))


def axis_label(
    attribution: Attribution,
    scale: Scale | None = None,
    width: int | None = METRIC_WIDTH,
    *,
    metric: str | None = None,
) -> str:
    """Return the axis label for effects in a scale; by default ``metric`` is its name, shortened to ``width``."""
    kind = attribution.kind.in_scale(attribution.scale_or_default(scale))
    if metric is None:
        metric = with_unit_of_effects(attribution, metric_name(attribution, width))
    label = kind.axis_label.format(metric)
    return f"ℓ2 norm of the {label}" if attribution.ranks_by_norm(scale) else label


def with_unit_of_effects(attribution: Attribution, metric: str) -> str:
    """Return the metric followed by its unit, or the square of it for squares and variances, in parentheses."""
    unit, square = metric_unit(attribution), "" if attribution.kind.has_sign else "²"
    return f"{metric} ({unit_of_change(unit)}){square}" if unit else metric


def sign_labels(attribution: Attribution) -> tuple[str, str] | None:
    """Return the meanings of positive and negative attributions; None if the quantity has no sign.

    A gradient describes a change of the parameter; a contribution describes its presence.
    """
    subject = "difference" if "minus" in attribution.info else "metric"
    if not attribution.kind.has_sign:
        return None
    if attribution.kind.is_contribution:
        return f"adds to the {subject}", f"takes from the {subject}"
    return f"raising it raises the {subject}", f"raising it lowers the {subject}"


def color_meanings(attribution: Attribution) -> str:
    """Return ``'blue raises the metric, orange lowers it'``; empty if the quantity has no sign."""
    if not attribution.kind.has_sign:
        return ""
    subject = "difference" if "minus" in attribution.info else "metric"
    more, less = ("adds to", "takes from") if attribution.kind.is_contribution else ("raises", "lowers")
    return f"blue {more} the {subject}, orange {less} it"


def sampling_notes(attribution: Attribution) -> list[str]:
    """Return notes on samples, goals, the metric image, interruption and missing error bars."""
    spp, replicates = attribution.info.get("spp"), attribution.info.get("replicates")
    counted = None if replicates is None else f"{replicates} replicate{'' if replicates == 1 else 's'}"
    interrupted = attribution.info.get("interrupted", False)
    notes = [] if spp is None else [f"{spp} spp"]
    if interrupted:
        notes.append(f"interrupted after {counted}" if counted else "interrupted")
    elif counted:
        notes = [f"{spp} spp in {counted}" if notes else counted]
    notes += goal_notes(attribution) + _comparison_notes(attribution)
    picture = attribution.info.get("picture") or {}
    if picture.get("denoised"):
        notes.append("denoised image" + ("" if picture.get("spp") is None else f" of {picture['spp']} spp"))
    notes += noise_notes(attribution) + _gradient_notes(attribution) + _advice(attribution)
    if attribution.covariance is None:
        notes.append(f"no error bars: {counted}" if replicates == 1 else "no error bars")
    return notes


def noise_notes(attribution: Attribution) -> list[str]:
    """Return a caution if the metric image is too noisy for the metric."""
    caution = (attribution.info.get("picture") or {}).get("caution")
    return [f"caution: {caution}"] if caution else []


def group_notes(attribution: Attribution, names: Iterable[str]) -> list[str]:
    """Return what a group named after several shapes is, if there is one among the named rows.

    Its shapes are in other rows as well, with what belongs to each of them alone.
    """
    groups, surfaces = attribution.info.get("groups") or {}, attribution.surfaces
    if surfaces is None:
        return []
    for name in names:
        members = set(groups.get(name, ()))
        using = zip(surfaces.objects, surfaces.parameters, strict=True)
        shapes = [shape for shape, used in using if members.intersection(used)]
        if len(shapes) > 1 and ", ".join(shapes[:2]) in name:
            return ["a material that several shapes share is one row, with these shapes in parentheses"]
    return []


def unit_notes(
    attribution: Attribution, rows: Sequence[RankedParameter], scale: Scale | None = None
) -> list[str]:
    """Return a note where numbers per unit of different kinds of parameters are ranked together.

    A reflectance has a range of 1 and a radiance one of hundreds: the order of their numbers per unit says little.
    """
    kind = attribution.kind.in_scale(attribution.scale_or_default(scale))
    if kind.has_sign and not kind.is_gradient_per_unit:
        return []
    kinds = {row.label.rpartition(": ")[2] for row in rows if ": " in row.label}
    ranges = {
        round(float(attribution.extents[row.name].max()), 6)
        for row in rows
        if row.name in attribution.extents
    }
    if len(kinds) < 2 or len(ranges) == 1:
        return []
    return ["per unit: compare parameters of one kind only"]


def jump_notes(attribution: Attribution) -> list[str]:
    """Return a note on each pose that has no derivative and is not ranked, or not in some directions."""
    labels, info = attribution.labels, attribution.info
    jumps = [
        f"–  {labels.get(name, name)} is not ranked: {reason}; no derivative"
        for name, reason in info.get("jumps", {}).items()
    ]
    parts = [
        f"–  {labels.get(name, name)}: {reason}; this direction is left out"
        for name, reason in info.get("left_out_notes", {}).items()
    ]
    return jumps + parts


def _gradient_notes(attribution: Attribution) -> list[str]:
    """Return what the metric says of its gradient, for a method that uses one."""
    note = attribution.info.get("gradient_note")
    return [str(note)] if note and attribution.kind not in _OF_DIFFERENCES else []


def _advice(attribution: Attribution) -> list[str]:
    """Return what the metric advises against large errors, if the effects have them."""
    advice, errors = attribution.info.get("advice"), attribution.saliency_error()
    if not advice or not errors:
        return []
    are_large = math.hypot(*errors.values()) > _LARGE_ERROR * math.hypot(*attribution.saliency().values())
    if not are_large:
        return []
    if attribution.kind in _OF_DIFFERENCES:  # the metric's advice is about its gradient
        large = f"the errors are large: more samples lower them, {_option('spp')}"
        return [] if noise_notes(attribution) else [large]
    has_path = ((attribution.info.get("budget") or {}).get("points") or 1) > 1
    more = f", and so do more samples of the pictures, {_option('picture_spp')}" if has_path else ""
    return [f"the errors are large: {advice}{more}"]


def _option(keyword: str) -> str:
    """Return how to set a number, for the readers of both languages: a table may be of either."""
    return f"{keyword}= in Python, --{keyword.replace('_', '-')} on the command line"


def convergence_notes(attribution: Attribution) -> list[str]:
    """Return a note on whether contributions add up to the difference that they explain, if they explain one."""
    delta, error = attribution.convergence_delta, attribution.convergence_delta_error
    if delta is None:
        return []
    verdict, explained = attribution.info.get("convergence"), attribution.info.get("explained")
    if verdict == "inconclusive":
        verdict += " whether the effects add up"
    if verdict is None or explained is None:
        unknown = f"{verdict}: the metric is not finite at the baseline" if not math.isfinite(delta) else ""
        return [unknown or f"convergence delta {rounded(delta, 2)}"]
    if abs(delta) <= _ROUNDING * abs(explained):
        if attribution.kind is ResultKind.SHAPLEY_VALUE:
            return [f"adds up to {with_error(explained, error)[0]} by construction"]
        delta = 0.0
    note = f"{verdict}: delta {format_with_error(delta, error)} of {with_error(explained, error)[0]}"
    quadrature = attribution.info.get("quadrature_error")
    if error and quadrature and quadrature > error / 2:
        note += ", mostly quadrature error: use more steps"
    elif error and attribution.info.get("convergence") == "inconclusive":
        draws = " or more n_samples" if attribution.info.get("n_samples") else ""  # of random scenes
        note += f", mostly noise: use more samples{draws}"
    return [note]


def baseline_notes(attribution: Attribution) -> list[str]:
    """Return a note on what contributions are compared with, if the user chose it."""
    compared = attribution.info.get("compared_with")
    return [f"compared with: {compared}"] if compared else []


def _comparison_notes(attribution: Attribution) -> list[str]:
    """Return a note on the change by another renderer, if it was measured."""
    against = (attribution.info.get("planner") or {}).get("against")
    if not against or against["relative_change"] is None:
        return []
    names = [f"depth {against['max_depth']}"] if "max_depth" in against else []
    names += ["×".join(map(str, against["resolution"]))] if "resolution" in against else []
    change, half_width = 100 * against["relative_change"], 100 * against["relative_half_width"]
    return [
        f"{' at '.join(names) or 'the other renderer'} changes ≤ {rounded(change, 2)} ± {rounded(half_width, 2)} %"
    ]


def goal_notes(attribution: Attribution) -> list[str]:
    """Return a note on the achieved accuracy; nothing if the number of samples was fixed."""
    planner = attribution.info.get("planner")
    if planner is None:
        return []
    top, tolerance, half_width = planner["top"], planner["tolerance"], planner["relative_half_width"]
    stopped = "" if planner["reached"] else f", stopped by {planner['stopped']}"
    if top is not None:
        tied = sum(len(tier) > 1 for tier in planner["order"] or [])
        ties = f" except {pluralize(tied, 'tie')}" if tied else ""
        outcome = f"resolved{ties}" if planner["reached"] else f"not resolved{stopped}"
        return [f"order of the top {top} {outcome}"]
    achieved = "unknown" if half_width is None else f"{rounded_up(100 * half_width, 3)} %"
    if tolerance is None:
        return [f"95 % half-widths ≤ {achieved} in {planner['time_limit']:g} s"]
    return [f"95 % half-widths ≤ {achieved} (target: {100 * tolerance:g} %{stopped})"]


def caution_groups(attribution: Attribution, names: Iterable[str]) -> dict[str, list[str]]:
    """Group the named parameters whose derivatives are known to be inaccurate by the reason."""
    cautions = attribution.info.get("cautions") or {}
    return group_by_text((name, cautions.get(name)) for name in names)


def scene_cautions(attribution: Attribution) -> list[str]:
    """Return a caution for each parameter that is left out because its value in the scene is invalid."""
    left_out = attribution.info.get("left_out") or {}
    cautions = [f"{name} is left out: {fault}" for name, fault in left_out.items()]
    more = len(cautions) - _MAX_CAUTIONS
    if more <= 0:
        return cautions
    return [*cautions[:_MAX_CAUTIONS], f"{more} more are left out"]


def range_notes(
    attribution: Attribution, scale: Scale | None = None, among: Collection[str] | None = None
) -> dict[str, list[str]]:
    """Return notes on effects that may be read for something else, or that would have smaller errors alone.

    Each has the parameters that it is about. ``among`` are the parameters that are shown, by default all.
    """
    shown = [name for name in attribution if among is None or name in among]
    notes = _alone_notes(attribution, shown)
    if attribution.kind.in_scale(attribution.scale_or_default(scale)) is ResultKind.EFFECT:
        notes |= {
            **_sky_notes(attribution, shown),
            **_roughness_notes(attribution, scale, shown),
            **_least_roughness_notes(attribution, shown),
            **_off_notes(attribution, shown),
            **_light_notes(attribution, shown),
            **_contradicted_notes(attribution, shown),
            **_local_notes(attribution, shown),
        }
    return notes


def range_marked(notes: Mapping[str, Collection[str]]) -> set[str]:
    """Return the parameters that a mark, ``~``, refers to such notes."""
    return {name for names in notes.values() for name in names}


def _alone_notes(attribution: Attribution, shown: Sequence[str]) -> dict[str, list[str]]:
    """Return a note on the low roughnesses that are lost in the noise of a gradient of many inputs."""
    effects, errors = attribution.saliency(), attribution.saliency_error()
    if not errors or attribution.kind in _OF_DIFFERENCES:
        return {}
    noisy = [
        name
        for name in attribution.info.get("noisy_roughness", ())
        if name in shown and errors[name] > _LARGE_ERROR * effects[name]
    ]
    if not noisy:
        return {}
    # Alone, its paths are sampled so that they find the lamps, which those of many inputs do not.
    alone = (
        "the error of this roughness is large among many inputs and smaller if you select it alone"
        if len(noisy) == 1
        else "the errors of these roughnesses are large among many inputs and smaller if you select each alone"
    )
    return {f"{alone}: {_named(attribution, noisy)}": noisy}


def _named(attribution: Attribution, names: Sequence[str], *, of: int | None = None) -> str:
    """Return the labels of the first few parameters, and how many more there are ``of`` all."""
    # A label may have a comma or a colon.
    return first_few([attribution.labels.get(name, name) for name in names], "; ", of=of)


def _sky_notes(attribution: Attribution, shown: Sequence[str]) -> dict[str, list[str]]:
    """Return a note on each map of light: it changes alike in all texels, and its scale switches it on."""
    labels, notes = attribution.labels, {}
    for name in shown:
        scale = f"{name.rpartition('.')[0]}.scale"
        if attribution[name].ndim == _MAP_NDIM and scale in attribution:
            of_light = f"{labels.get(scale, scale)} is of its light"
            notes[f"{labels.get(name, name)}: of the same change in all texels; {of_light}"] = [name]
    return notes


def _off_notes(attribution: Attribution, shown: Sequence[str]) -> dict[str, list[str]]:
    """Return a note on what is 0 in the scene, as a lamp that is off: its range is one unit."""
    off = [name for name in attribution.info.get("unit_ranges", ()) if name in shown]
    return {f"off, or 0, in the scene: per unit of 1: {_named(attribution, off)}": off} if off else {}


def _light_notes(attribution: Attribution, shown: Sequence[str]) -> dict[str, list[str]]:
    """Return a note on lights that are off, under a metric that is not linear in the image."""
    rendered = range_marked(_contradicted_notes(attribution, shown))
    off = [name for name in attribution.info.get("lights_off", ()) if name in shown and name not in rendered]
    if not off:
        return {}
    note = (
        f"{_named(attribution, off)}: off, and {metric_symbol(attribution)} is not linear in the light: to first "
        "order, the effect of switching it on may be far off, even in its sign; render the change"
    )
    return {note: off}


def _contradicted_notes(attribution: Attribution, shown: Sequence[str]) -> dict[str, list[str]]:
    """Return a note on the effects that a render of the change contradicts."""
    notes: Mapping[str, Sequence[str]] = attribution.info.get("contradicted") or {}
    of_shown = {note: [name for name in names if name in shown] for note, names in notes.items()}
    return {note: names for note, names in of_shown.items() if names}


def _local_notes(attribution: Attribution, shown: Sequence[str]) -> dict[str, list[str]]:
    """Return a note on the turns and zooms of a camera whose gradients do not hold over their ranges."""
    local = [name for name in attribution.info.get("local", ()) if name in shown]
    if not local:
        return {}
    note = (
        f"{_named(attribution, local)}: the gradient at this value does not hold over its range, over which the "
        "picture moves by several pixels; the effect may be quite different: render the change"
    )
    return {note: local}


def _roughness_notes(
    attribution: Attribution, scale: Scale | None, shown: Sequence[str]
) -> dict[str, list[str]]:
    """Return a note on small roughnesses, whose tangents over the whole range overstate what they can do.

    It names those whose effects are notable beside the largest of all, or the largest of them.
    """
    effects, gradients = attribution.saliency(scale), attribution.saliency("unit")
    errors, allowed = attribution.saliency_error(scale) or {}, clear_from(attribution.info)
    small = [
        name
        for name, value in attribution.parameter_values.items()
        if name in shown
        and _ROUGHNESS & set(name.split("."))
        and effects.get(name, 0.0) > allowed * errors.get(name, 0.0)
        # That over the range is the gradient times the length of the range.
        and effects[name] > _MANY_TIMES * gradients[name] * float(value.mean())
    ]
    if not small:
        return {}
    small.sort(key=effects.__getitem__, reverse=True)
    notable = _NOTABLE * max(effects.values())
    named = [name for name in small if effects[name] > notable] or small[:1]
    note = (
        f"{_named(attribution, named, of=len(small))}: a small roughness acts most near 0, so its effect over the "
        "whole range is overstated; render the change, or measure an ablation"
    )
    return {note: small}


def _least_roughness_notes(attribution: Attribution, shown: Sequence[str]) -> dict[str, list[str]]:
    """Return a note on roughnesses so low that Mitsuba uses its least one, whatever the value is."""
    gradients = attribution.saliency("unit")
    flat = [
        name
        for name, value in attribution.parameter_values.items()
        if name in shown
        and not gradients[name]
        and any(
            float(value.max()) < least for role, least in _LEAST_ROUGHNESS.items() if role in name.split(".")
        )
    ]
    if not flat:
        return {}
    note = (
        f"{_named(attribution, flat)}: Mitsuba renders a roughness this low as its lowest, so the derivative is 0 "
        "and says nothing of the range; start from a higher one, or render the change"
    )
    return {note: flat}


def untrusted_groups(attribution: Attribution) -> dict[str, list[str]]:
    """Group the parameters with unreliable error bars by the reason."""
    return group_by_text(attribution.untrusted_errors().items())


def doubt_notes(
    doubts: Mapping[str, Sequence[str]], labels: Mapping[str, str], shown: Collection[str], count: int
) -> list[str]:
    """Return what the mark ``?`` means: each reason, with the first of the rows that it is about of ``count``."""
    notes = []
    for reason, names in doubts.items():
        first_shown = sorted(names, key=lambda name: name not in shown)
        named = first_few([labels.get(name, name) for name in first_shown], "; ")
        whose = ", ".join(filter(None, [named, hidden_of(names, shown)]))
        notes.append(f"{reason} ({'all parameters' if len(names) == count else whose})")
    return notes


def is_of_camera(name: str) -> bool:
    """Whether a parameter belongs to the camera, which is in no picture and moves all of it."""
    return name.startswith("camera.")


def pluralize(count: int, noun: str) -> str:
    """Return ``'1 parameter'`` or ``'3 parameters'``."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def count_of(names: Collection[str], shown: Collection[str]) -> str:
    """Return the number of parameters of a note, and how many of them have no row that could bear its mark."""
    return ", ".join(filter(None, [pluralize(len(names), "parameter"), hidden_of(names, shown)]))


def hidden_of(names: Collection[str], shown: Collection[str]) -> str:
    """Return how many parameters of a note have no row; empty if all have one."""
    hidden = len(set(names) - set(shown))
    if hidden < len(names):
        return f"{hidden} of them not shown" if hidden else ""
    return "not shown" if hidden == 1 else "none of them shown"


def pack(parts: Sequence[str], width: int) -> list[str]:
    """Join parts with dots into lines of at most ``width`` characters where possible."""
    lines = [parts[0]]
    for part in parts[1:]:
        joined = f"{lines[-1]} · {part}"
        if len(joined) <= width:
            lines[-1] = joined
        else:
            lines.append(part)
    return lines
