"""Notes on a whole result: how it was sampled, what it is compared with, and what puts it in doubt."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from ..protocols import Attribution, RankedParameter, ResultKind, Scale
from ._layout import first_few, group_by_text
from ._numbers import format_with_error, rounded, rounded_up, with_error
from ._text import CAUTION, LARGE_ERROR, OF_DIFFERENCES, advised, hidden_of, pluralize

_MAX_CAUTIONS = 5
_ROUNDING = 1e-6  # relative to the explained difference
_TOLERANCE = 5  # % of it, within which contributions add up


def sampling_notes(attribution: Attribution) -> list[str]:
    """Return notes on samples, goals, the metric image, interruption and missing error bars."""
    replicates = attribution.info.get("replicates")
    counted = None if replicates is None else pluralize(replicates, "replicate")
    notes = _sample_counts(attribution.info)
    notes += goal_notes(attribution) + _comparison_notes(attribution)
    picture = attribution.info.get("picture") or {}
    if picture.get("denoised"):
        notes.append("denoised image" + ("" if picture.get("spp") is None else f" of {picture['spp']} spp"))
    notes += noise_notes(attribution) + gradient_notes(attribution)
    if attribution.covariance is None:
        notes.append(f"no error bars: {counted}" if replicates == 1 else "no error bars")
    return notes


def _sample_counts(info: Mapping[str, Any]) -> list[str]:
    """Return ``["64 spp in 8 replicates"]``, or ``["64 and 512 spp in 8 replicates"]`` of two results."""
    own = info.get("spp"), info.get("replicates")
    pairs = list(dict.fromkeys((spp, count) for _, spp, count in info.get("sampled") or [(None, *own)]))
    counts = list(dict.fromkeys(count for _, count in pairs))
    spp = " and ".join(str(one) for one, _ in pairs if one is not None)
    counted = None if counts == [None] else pluralize(counts[0], "replicate")
    if len(counts) > 1:
        each = [_sample_counts({"spp": one, "replicates": count}) for one, count in pairs]
        return [" and ".join(text for texts in each for text in texts)]
    if info.get("interrupted", False):
        return [
            *([f"{spp} spp"] if spp else []),
            f"interrupted after {counted}" if counted else "interrupted",
        ]
    if counted:
        return [f"{spp} spp in {counted}" if spp else counted]
    return [f"{spp} spp"] if spp else []


def noise_notes(attribution: Attribution) -> list[str]:
    """Return a caution if the metric image is too noisy for the metric."""
    picture = attribution.info.get("picture") or {}
    caution = picture.get("caution")
    return [advised(f"{CAUTION}{caution}", picture.get("advice"), ": ")] if caution else []


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
    """Return notes on the units of the rows: of differences over two ranges, and per unit of different kinds.

    A reflectance has a range of 1 and a radiance one of hundreds: the order of their numbers per unit says little.
    """
    ranged = [row.label for row in rows if row.name in attribution.info.get("own_ranges", ())]
    notes = [f"{first_few(ranged, '; ')}: over the range in each result, not per unit"] if ranged else []
    kind = attribution.kind.in_scale(attribution.scale_or_default(scale))
    if kind.has_sign and not kind.is_gradient_per_unit:
        return notes
    kinds = {row.label.rpartition(": ")[2] for row in rows if ": " in row.label}
    ranges = {
        round(float(attribution.extents[row.name].max()), 6)
        for row in rows
        if row.name in attribution.extents
    }
    if len(kinds) < 2 or len(ranges) == 1:
        return notes
    return [*notes, "per unit: compare parameters of one kind only"]


def pose_notes(attribution: Attribution, rows: Sequence[RankedParameter]) -> list[str]:
    """Return a note on what the effects of translations and rotations among the rows are."""
    vectors = attribution.info.get("vectors") or ()
    of_poses = [row for row in rows if row.name in vectors]
    if not of_poses:
        return []
    in_noise = any(row.effect == 0 and row.effect_error for row in of_poses)
    zero = "; 0: not above the noise" if in_noise else ""
    return [f"of a translation or rotation in the direction with the largest effect{zero}"]


def jump_notes(attribution: Attribution, among: Collection[str] | None = None) -> list[str]:
    """Return a note on each pose that has no derivative and is not ranked, or not in some directions.

    ``among`` are the parameters that are shown, by default all.
    """
    labels, info = attribution.labels, attribution.info
    jumps = [
        f"–  {labels.get(name, name)} is {_not_ranked(attribution, name)}: {reason}; no derivative"
        for name, reason in info.get("jumps", {}).items()
        if among is None or name in among
    ]
    parts = [
        f"–  {labels.get(name, name)}: {reason}; this direction is left out"
        for name, reason in info.get("left_out_directions", {}).items()
        if among is None or name in among
    ]
    return jumps + parts


def _not_ranked(attribution: Attribution, name: str) -> str:
    return "not ranked" if name in attribution else "left out of its group"


def note_of_none(attribution: Attribution) -> str:
    """Return what is said of effects none of which differs from 0: a pose that jumps has none at all."""
    jumps = attribution.info.get("jumps", {})
    if not jumps:
        return "all effects are 0"
    return "all other effects are 0" if attribution.ranking() else "no parameter has a derivative"


def kept_channels(attribution: Attribution, row: RankedParameter) -> list[tuple[float, float | None]]:
    """Return each channel of a row with its error, without the directions in which a pose has no derivative."""
    errors: Sequence[float | None] = row.total_error or [None] * len(row.total)
    kept = attribution.info.get("kept_directions", {}).get(row.name) or [1] * len(row.total)
    numbers = zip(row.total, errors, kept, strict=True)
    return [(value, error) for value, error, is_kept in numbers if is_kept]


def gradient_notes(attribution: Attribution) -> list[str]:
    """Return what the metric says of its gradient, and advises against large errors of effects by it."""
    note = attribution.info.get("gradient_note")
    notes = [str(note)] if note and attribution.kind not in OF_DIFFERENCES else []
    return notes + _advice(attribution)


def gradient_advice(attribution: Attribution) -> str:
    """Return what the metric advises against large errors of its gradient; empty if nothing, or of differences."""
    return "" if attribution.kind in OF_DIFFERENCES else str(attribution.info.get("advice") or "")


def _advice(attribution: Attribution) -> list[str]:
    """Return what the metric advises against large errors, if the effects have them."""
    advice, rows = attribution.info.get("advice"), attribution.ranking()
    if not advice or attribution.covariance is None:
        return []
    errors = math.hypot(*(row.saliency_error or 0.0 for row in rows))
    are_large = errors > LARGE_ERROR * math.hypot(*(row.saliency for row in rows))
    if not are_large:
        return []
    if attribution.kind in OF_DIFFERENCES:  # the metric's advice is about its gradient
        large = advised("the errors are large", f"more samples lower them, {_option('spp')}", ": ")
        return [] if noise_notes(attribution) else [large]
    has_path = ((attribution.info.get("budget") or {}).get("points") or 1) > 1
    more = f", and so do more samples of the pictures, {_option('picture_spp')}" if has_path else ""
    return [advised("the errors are large", f"{advice}{more}", ": ")]


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
    if verdict == "adds up":
        verdict += f" within {_TOLERANCE:g} %"
    note = f"{verdict}: delta {format_with_error(delta, error)} of {with_error(explained, error)[0]}"
    quadrature = attribution.info.get("quadrature_error")
    adds_up = attribution.info["convergence"] == "adds up"
    if error and quadrature and quadrature > error / 2 and not adds_up:
        return [advised(f"{note}, mostly quadrature error", "use more steps", ": ")]
    if error and attribution.info.get("convergence") == "inconclusive":
        draws = " or more n_samples" if attribution.info.get("n_samples") else ""  # of random scenes
        return [advised(f"{note}, mostly noise", f"use more samples{draws}", ": ")]
    return [note]


def baseline_notes(attribution: Attribution) -> list[str]:
    """Return a note on what contributions are compared with.

    It names the inputs that the baselines leave as they are: their contribution is 0, whatever their effect is.
    """
    compared = attribution.info.get("compared_with")
    if not compared:
        return []
    return [f"compared with: {compared}{_unchanged(attribution)}"]


def _unchanged(attribution: Attribution) -> str:
    """Return which inputs have their own value as their baseline: rows, and those in a group with others."""
    baselines = attribution.info.get("baselines")
    if not isinstance(baselines, Mapping):  # of a list of baselines
        return ""
    names = [name for name, baseline in baselines.items() if baseline == "unchanged"]
    groups = attribution.info.get("groups") or {name: [name] for name in attribution}
    rows = [row for row, inputs in groups.items() if row in attribution and set(inputs) <= set(names)]
    grouped = [
        name for name in names if any(name in inputs for row, inputs in groups.items() if row not in rows)
    ]
    note = ""
    if rows:
        its = "its" if len(rows) == 1 else "their"
        named = first_few([attribution.labels.get(name, name) for name in rows], "; ")
        note = f"; compared with {_itself(rows)}, so that {its} 0 says nothing: {named}"
    if grouped:
        its = "its group" if len(grouped) == 1 else "their groups"
        note += f"; compared with {_itself(grouped)} in {its}: {first_few(grouped, '; ')}"
    return note


def _itself(names: Sequence[str]) -> str:
    return "itself" if len(names) == 1 else "themselves"


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
    if planner is None or not attribution.ranking():  # nothing has an error to reach
        return []
    top, tolerance, half_width = planner["top"], planner["tolerance"], planner["relative_half_width"]
    stopped = "" if planner["reached"] else f", stopped by {planner['stopped']}"
    if top is not None:
        tied = sum(len(tier) > 1 for tier in planner["order"] or [])
        ties = f" except {pluralize(tied, 'tie')}" if tied else ""
        outcome = f"resolved{ties}" if planner["reached"] else f"not resolved{stopped}"
        return [f"order of the top {top} {outcome}"]
    limits = (
        f"in {planner['time_limit']:g} s"
        if tolerance is None
        else f"(target: {100 * tolerance:g} %{stopped})"
    )
    if half_width is None:  # of what has no derivative, an effect of 0 with an error, or too few replicates
        needed = "" if planner["stopped"] == "the lack of a derivative" else ": more samples are needed"
        return [f"95 % half-widths not known {limits}{needed}"]
    which = f"for effects ≥ {100 * planner['share']:g} % of the total"
    return [f"95 % half-widths ≤ {rounded_up(100 * half_width, 3)} % {limits}, {which}"]


def caution_groups(attribution: Attribution, names: Iterable[str]) -> dict[str, list[str]]:
    """Group the named parameters whose derivatives are known to be inaccurate by the reason."""
    cautions = attribution.info.get("cautions") or {}
    return group_by_text((name, cautions.get(name)) for name in names)


def caution_marks(groups: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Return the mark of each reason of ``caution_groups``: ``!``, with a number if there are several."""
    return {text: f"!{number}" if len(groups) > 1 else "!" for number, text in enumerate(groups, start=1)}


def scene_cautions(attribution: Attribution) -> list[str]:
    """Return a caution for each parameter that is left out because its value in the scene is invalid."""
    left_out = attribution.info.get("left_out") or {}
    cautions = [f"{name} is left out: {fault}" for name, fault in left_out.items()]
    more = len(cautions) - _MAX_CAUTIONS
    if more <= 0:
        return cautions
    return [*cautions[:_MAX_CAUTIONS], f"{more} more are left out"]


def untrusted_groups(attribution: Attribution) -> dict[str, list[str]]:
    """Group the parameters with unreliable error bars by the reason, in the order of the ranking."""
    jumps = attribution.info.get("jumps", {})
    reasons = {name: why for name, why in attribution.untrusted_errors().items() if name not in jumps}
    order = dict.fromkeys([*(row.name for row in attribution.ranking()), *reasons])
    return group_by_text((name, reasons[name]) for name in order if name in reasons)


def doubt_notes(
    doubts: Mapping[str, Sequence[str]], labels: Mapping[str, str], shown: Sequence[str], count: int
) -> list[str]:
    """Return what a mark means: each reason, with the first of the rows that it is about of ``count``.

    ``shown`` are those that have a row, in their order; others follow.
    """
    notes, place = [], {name: index for index, name in enumerate(shown)}
    for reason, names in doubts.items():
        first_shown = sorted(names, key=lambda name: place.get(name, len(place)))
        named = first_few([labels.get(name, name) for name in first_shown], "; ")
        whose = ", ".join(filter(None, [named, hidden_of(names, shown)]))
        notes.append(f"{reason} ({'all parameters' if len(names) == count else whose})")
    return notes


def marked_doubts(
    doubts: Mapping[str, Sequence[str]],
    labels: Mapping[str, str],
    shown: Sequence[str],
    count: int,
    mark: str,
) -> list[str]:
    """Return the notes on doubts with their mark, which no row has if a doubt is of all."""
    notes = zip(doubts.items(), doubt_notes(doubts, labels, shown, count), strict=True)
    return [
        f"all parameters: {reason}" if len(names) == count else f"{mark}{note}"
        for (reason, names), note in notes
    ]
