"""Notes on effects that may be read for something else, or that may have smaller errors alone."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence

from ..projection import SHARES, light_maps_left_out
from ..protocols import Attribution, RankedParameter, ResultKind, Scale
from ..student import clear_from
from ._layout import first_few
from ._moves import move
from ._numbers import signed_with_error
from ._text import LARGE_ERROR, OF_DIFFERENCES, advised, metric_symbol, metric_unit, unit_of_change

_ROUGHNESS = {"alpha", "alpha_u", "alpha_v", "roughness"}
# Below these, Mitsuba's microfacets have α = 1e-4; those of a principled material, α = roughness², have 1e-3.
_LEAST_ROUGHNESS = {**dict.fromkeys(("alpha", "alpha_u", "alpha_v"), 1e-4), "roughness": math.sqrt(1e-3)}
_MANY_TIMES = 4  # the roughness: the length of a range over which a tangent holds no longer
RENDER = "render the change"
RANKED_LAST = "so ranked last, without a bar or a colour"
_NOTABLE = 0.1  # of the largest effect


def range_notes(
    attribution: Attribution, scale: Scale | None = None, among: Collection[str] | None = None
) -> dict[str, list[str]]:
    """Return notes on effects that may be read for something else, or that may have smaller errors alone.

    Each has the parameters that it is about. ``among`` are the parameters that are shown, by default all.
    """
    shown = [name for name in attribution if among is None or name in among]
    notes = _alone_notes(attribution, shown) | _group_notes(attribution)
    kind = attribution.kind.in_scale(attribution.scale_or_default(scale))
    if kind is ResultKind.RELATIVE_EFFECT:
        notes |= _texture_notes(attribution, shown)
    if kind is ResultKind.EFFECT:
        notes |= {
            **_map_notes(attribution, shown),
            **_bump_notes(attribution, shown),
            **_roughness_notes(attribution, scale, shown),
            **_least_roughness_notes(attribution, shown),
            **_off_notes(attribution, shown),
            **_light_notes(attribution, scale, shown),
            **_contradicted_notes(attribution, shown),
            **_local_notes(attribution, scale, shown),
        }
    return notes


def light_notes(
    attribution: Attribution, rows: Sequence[RankedParameter], scale: Scale | None = None
) -> list[str]:
    """Return a note on the effects of lights, unless the metric is linear in the light.

    A small effect has it, too: a derivative says little of what remains without the light. Of contributions it is
    on a light that has two rows.
    """
    if attribution.kind in SHARES:
        return _shared_light_notes(attribution, [row.name for row in rows])
    kind = attribution.kind.in_scale(attribution.scale_or_default(scale))
    if kind is not ResultKind.EFFECT or attribution.info.get("linear_in_light"):
        return []
    if not any(row.name in attribution.info.get("lights_on", ()) for row in rows):
        return []
    # Without surfaces, as of a sensor grid, there are no objects to group by.
    groups = "material" if attribution.surfaces is None else "object"
    return [
        advised(
            f"effects of lights are to first order: {metric_symbol(attribution)} is not linear in the light, and "
            "may change by much more or less, or in the other direction, if one is switched off",
            f'for that, use an ablation with groups="{groups}" (--method ablation --groups {groups})',
        )
    ]


def range_marked(notes: Mapping[str, Collection[str]]) -> set[str]:
    """Return the parameters that a mark, ``~``, refers to such notes."""
    return {name for names in notes.values() for name in names}


def _alone_notes(attribution: Attribution, shown: Sequence[str]) -> dict[str, list[str]]:
    """Return a note on the low roughnesses that are lost in the noise of a gradient of many inputs."""
    effects, errors = attribution.saliency(), attribution.saliency_error()
    if not errors or attribution.kind in OF_DIFFERENCES:
        return {}
    noisy = [
        name
        for name in attribution.info.get("noisy_roughness", ())
        if name in shown and errors[name] > LARGE_ERROR * effects[name]
    ]
    if not noisy:
        return {}
    # Alone, its paths are sampled so that they find the lamps, which those of many inputs do not.
    large, alone = (
        ("the error of this roughness is large", "it is often smaller if you select it alone")
        if len(noisy) == 1
        else ("the errors of these roughnesses are large", "they are often smaller if you select each alone")
    )
    return {advised(f"{large} among many inputs: {_named(attribution, noisy)}", alone): noisy}


def _named(attribution: Attribution, names: Sequence[str], *, of: int | None = None) -> str:
    """Return the labels of the first few parameters, and how many more there are ``of`` all."""
    # A label may have a comma or a colon.
    return first_few([attribution.labels.get(name, name) for name in names], "; ", of=of)


def _map_notes(attribution: Attribution, shown: Sequence[str]) -> dict[str, list[str]]:
    """Return a note on each map of light: it changes alike in all texels, and its scale switches it on."""
    labels, notes = attribution.labels, dict[str, list[str]]()
    effects = {name: attribution[name] for name in attribution}
    for name, scale in light_maps_left_out(ResultKind.EFFECT, effects).items():
        if name in shown:
            of_light = f"{labels.get(scale, scale)}: for all of its light"
            notes[f"{labels.get(name, name)}: for the same amount added to every texel; {of_light}"] = [name]
    return notes


def _texture_notes(attribution: Attribution, shown: Sequence[str]) -> dict[str, list[str]]:
    """Return a note on textures: relative to their mean, all texels change alike, not each by its share."""
    textures = [name for name in shown if attribution[name].ndim > 1]
    if not textures:
        return {}
    note = advised(
        f"{_named(attribution, textures)}: relative to the mean, which is added to every texel alike",
        "for each texel relative to its own value, use InputXGradientScene (--method input-x-gradient)",
    )
    return {note: textures}


def _shared_light_notes(attribution: Attribution, shown: Collection[str]) -> list[str]:
    """Return a note on each map of light that shares what the light contributes with its scale."""
    contributions = {name: attribution[name] for name in attribution}
    labels = {name: attribution.labels.get(name, name) for name in attribution}
    return [
        f"{labels[name]}; {labels[scale]}: one light, whose contribution is the sum of both"
        for name, scale in light_maps_left_out(ResultKind.EFFECT, contributions).items()
        if {name, scale} & set(shown) and contributions[name].any() and contributions[scale].any()
    ]


def _bump_notes(attribution: Attribution, shown: Sequence[str]) -> dict[str, list[str]]:
    """Return a note on bump maps, whose effect, for the same change of all texels, is 0 whatever they do."""
    bumps = [name for name in shown if "nested_texture" in name.split(".")]
    if not bumps:
        return {}
    reason = "the same height added to every texel bends no normal, so the effect is 0 whatever its texels do"
    return {f"{_named(attribution, bumps)}: {reason}; the bump scale says what the bumps do": bumps}


def _group_notes(attribution: Attribution) -> dict[str, list[str]]:
    """Return a note on each map of light that a group leaves out, because its scale is in the group."""
    labels, notes = attribution.labels, {}
    for name, scale in attribution.info.get("maps_left_out", {}).items():
        of_light = f"left out of groups with {labels.get(scale, scale)}, which is for all of its light"
        notes[f"{labels.get(name, name)}: {of_light}"] = [name]
    return notes


def _off_notes(attribution: Attribution, shown: Sequence[str]) -> dict[str, list[str]]:
    """Return a note on what is 0 in the scene, as a lamp that is off: its range is one unit."""
    off = [name for name in attribution.info.get("unit_ranges", ()) if name in shown]
    return {f"off, or 0, in the scene: per unit of 1: {_named(attribution, off)}": off} if off else {}


def _light_notes(attribution: Attribution, scale: Scale | None, shown: Sequence[str]) -> dict[str, list[str]]:
    """Return notes on lights that are off: on what their effects are, and on their groups."""
    rendered = range_marked(_contradicted_notes(attribution, shown))
    off = [
        name
        for name in attribution.info.get("lights_off", ())
        if (name in shown or name not in attribution) and name not in rendered
    ]
    last = attribution.ranked_last(scale)
    of_groups = [name for name in off if name not in attribution]
    if attribution.info.get("linear_in_light"):
        per_unit = attribution.info.get("unit_ranges", ())
        reasons = {
            "off, so left out of groups": of_groups,
            "off: the effect is that of switching on, to the value in the scene": [
                name for name in off if name in attribution and name not in per_unit
            ],
        }
        return {f"{_named(attribution, names)}: {why}": names for why, names in reasons.items() if names}
    cases = {
        f", {RANKED_LAST}": [name for name in off if name in last],
        ", so left out of groups": of_groups,
        "": [name for name in off if name in attribution and name not in last],
    }
    reason = (
        f"off, and {metric_symbol(attribution)} is not linear in the light: to first order, the effect of "
        "switching on may be far off, even in its sign"
    )
    return {
        advised(f"{_named(attribution, names)}: {reason}{consequence}", RENDER): names
        for consequence, names in cases.items()
        if names
    }


def _contradicted_notes(attribution: Attribution, shown: Sequence[str]) -> dict[str, list[str]]:
    """Return a note on the effects that a render of the change contradicts."""
    notes: Mapping[str, Sequence[str]] = attribution.info.get("contradicted") or {}
    of_shown = {note: [name for name in names if name in shown] for note, names in notes.items()}
    return {note: names for note, names in of_shown.items() if names}


def _local_notes(attribution: Attribution, scale: Scale | None, shown: Sequence[str]) -> dict[str, list[str]]:
    """Return notes on the poses whose gradients do not hold over their ranges, of a camera and of objects.

    They say by how much the metric changes there, where renders do, and which poses rank last for it.
    """
    reasons = {
        "local": "the picture moves by several pixels",
        "nonlinear": f"{metric_symbol(attribution)} is not linear in the picture",
    }
    changes, last = attribution.info.get("range_changes", {}), attribution.ranked_last(scale)
    notes, may_differ = {}, "the effect may be quite different, or in the other direction"
    untested = [name for name in attribution.info.get("untested", ()) if name in shown]
    if untested:
        note = (
            f"{_named(attribution, untested)}: the gradient at this value, not tested over the range, over which "
            f"{reasons['local']}; {may_differ}"
        )
        notes[advised(note, RENDER, ": ")] = untested
    for key, reason in reasons.items():
        names = [name for name in attribution.info.get(key, ()) if name in shown]
        does_not_hold = f"the gradient at this value does not hold over the range, over which {reason}"
        unknown = [name for name in names if name not in changes]
        if unknown:
            note = f"{_named(attribution, unknown)}: {does_not_hold}; {may_differ}"
            notes[advised(note, RENDER, ": ")] = unknown
        for is_last, consequence in ((True, f"; {RANKED_LAST}"), (False, "")):
            known = [name for name in names if name in changes and (name in last) == is_last]
            if known:
                numbers = _changes_over_range(attribution, known)
                notes[f"{_named(attribution, known)}: {does_not_hold}: {numbers}{consequence}"] = known
    return notes


def _changes_over_range(attribution: Attribution, names: Sequence[str]) -> str:
    """Return ``"as rendered over ±0.05 units towards (0, 0.6, −0.8), UGR changes by −0.71 ± 0.12"``."""
    unit, effects = f" {unit_of_change(metric_unit(attribution))}".rstrip(), attribution.effects()
    changes = [
        # That of a number is in the direction in which it increases.
        f"{signed_with_error(math.copysign(1.0, effects[name]) * change, error)}{unit}"
        for name, (change, error) in attribution.info["range_changes"].items()
        if name in names
    ]
    over = "over the ranges, each in the direction of its effect"
    if len(names) == 1:
        half = attribution.weights()[names[0]] / 2
        over = f"over ±{move(names[0].rpartition('.')[2], half, attribution.info.get('up'))}"
    return f"as rendered {over}, {metric_symbol(attribution)} changes by {first_few(changes)}"


def _roughness_notes(
    attribution: Attribution, scale: Scale | None, shown: Sequence[str]
) -> dict[str, list[str]]:
    """Return a note on small roughnesses, whose tangents do not hold over the whole range: most overstate it.

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
    note = advised(
        f"{_named(attribution, named, of=len(small))}: a small roughness often acts most near 0, so its effect "
        "over the whole range may be far off",
        f"{RENDER}, or measure an ablation with another roughness as baseline",
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
    note = advised(
        f"{_named(attribution, flat)}: Mitsuba renders a roughness this low as its lowest, so the derivative is 0 "
        "and says nothing of the range",
        f"start from a higher one, or {RENDER}",
    )
    return {note: flat}
