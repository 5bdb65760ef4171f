"""Resolving ``groups=`` to groups of parameters that are attributed together."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from fnmatch import fnmatchcase
from typing import TypeAlias, TypeVar

import torch

from ..errors import INPUT_NAMES, SceneCaptumError, near_misses
from ..estimation import channel_totals
from ..projection import light_maps_left_out
from ..protocols import Capabilities, Renderer
from ..scene import Parameter
from ._baselines import table_of
from ._data import AttributionData, covariances

Groups: TypeAlias = "str | Mapping[str, str | Iterable[str]] | None"

A = TypeVar("A", bound=AttributionData)

GROUPS = ("kind", "material", "object")


def resolve_groups(
    renderer: Renderer, names: Iterable[str], groups: Groups = None
) -> dict[str, tuple[str, ...]]:
    """Return the members of every group. Each parameter is in exactly one group.

    Example
    -------
    >>> from scenecaptum import SceneRenderer
    >>> renderer = SceneRenderer("cornell-box", inputs=["reflectance", "emitters"])
    >>> resolve_groups(renderer, renderer.inputs, "material")["light"]
    ('light.bsdf.reflectance.value', 'light.emitter.radiance.value')

    Parameters
    ----------
    renderer, names
        The parameters to be grouped, and where their kinds, owners and objects come from.
    groups
        - None: each parameter is a group, named like the parameter.
        - ``"kind"``: reflectances, roughnesses, emitters, ….
        - ``"material"``: by the materials, emitters or media that own the parameter.
        - ``"object"``: by the set of objects that use the parameter. A parameter that no object uses is grouped
          with its owner. A material that several objects share is a group of its own: its name, with these
          objects in parentheses. So is one that a single object has, under another name: ``Floor (Mesh056)``.
        - A mapping from a group's name to the names or globs of its members. Other parameters stay separate.

    Raises
    ------
    SceneCaptumError
        If a name matches nothing or is in two groups, or the renderer does not provide the required information.
    """
    names = tuple(names)
    if groups is None:
        return {name: (name,) for name in names}
    if isinstance(groups, Mapping):
        return _from_mapping(names, groups)
    if groups not in GROUPS:
        raise SceneCaptumError(
            f"groups={groups!r} must be {', '.join(map(repr, GROUPS))}, or a mapping from a group's name to the "
            "names of its members."
        )
    table = table_of(renderer)
    if table is None:
        raise SceneCaptumError(
            f"groups={groups!r} requires a renderer with a parameters_table(). Give a mapping from a group's name "
            "to the names of its members."
        )
    if groups == "object":
        return _by_object(renderer, table, names)
    if groups == "kind":
        return _group_by(names, lambda name: (table[name].kind,))
    return _group_by(names, lambda name: table[name].owners or (name,))


def _from_mapping(
    names: tuple[str, ...], groups: Mapping[str, str | Iterable[str]]
) -> dict[str, tuple[str, ...]]:
    group_of: dict[str, str] = {}
    for group, members in groups.items():
        patterns = [members] if isinstance(members, str) else list(members)
        if not patterns:
            raise SceneCaptumError(f"The group {group!r} is empty: give it names or globs, or leave it out.")
        for name in {name: None for pattern in patterns for name in _matching(names, group, pattern)}:
            if name in group_of:
                raise SceneCaptumError(
                    f"{name!r} is in two groups, {group_of[name]!r} and {group!r}: remove it from one of them."
                )
            group_of[name] = group
    ungrouped = [name for name in names if name not in group_of]
    if clashing := [name for name in ungrouped if name in groups]:
        raise SceneCaptumError(
            f"The group {clashing[0]!r} has the name of a parameter that is not in it. Give it another name."
        )
    members_of = {group: tuple(n for n in names if group_of.get(n) == group) for group in groups}
    return {**members_of, **{name: (name,) for name in ungrouped}}


def _matching(names: tuple[str, ...], group: str, pattern: str) -> list[str]:
    if not isinstance(pattern, str):
        raise SceneCaptumError(
            f"The group {group!r} must contain names or globs of parameters, not {type(pattern).__name__}."
        )
    matched = [pattern] if pattern in names else [name for name in names if fnmatchcase(name, pattern)]
    if not matched:
        raise SceneCaptumError(
            f"The group {group!r} names {pattern!r}, which matches none of the {len(names)} inputs."
            f"{near_misses(pattern, names, instead=INPUT_NAMES)}"
        )
    return matched


def _by_object(
    renderer: Renderer, table: Mapping[str, Parameter], names: tuple[str, ...]
) -> dict[str, tuple[str, ...]]:
    surfaces = Capabilities(renderer).surfaces
    if surfaces is None:
        raise SceneCaptumError('groups="object" requires a renderer with surfaces, such as a SceneRenderer.')
    objects_using: dict[str, list[str]] = {}
    for object_name, parameters in zip(surfaces.objects, surfaces.parameters, strict=True):
        for name in parameters:
            objects_using.setdefault(name, []).append(object_name)
    grouped = _group_by(names, lambda name: tuple(objects_using.get(name) or table[name].owners or (name,)))

    def named(group: str, members: tuple[str, ...]) -> str:
        owners = {table[name].owners for name in members}
        owner = ", ".join(owners.pop()) if len(owners) == 1 else group
        # The group of desk_top alone needs no "desk", but what is Mesh056?
        is_named = owner == group or (owner in group and len(objects_using.get(members[0], ())) == 1)
        return group if is_named else f"{owner} ({group})"

    return {named(group, members): members for group, members in grouped.items()}


def _group_by(
    names: tuple[str, ...], owners_of: Callable[[str], tuple[str, ...]]
) -> dict[str, tuple[str, ...]]:
    """Group the parameters with the same owners; a group is named after its owners."""
    members: dict[tuple[str, ...], list[str]] = {}
    for name in names:
        members.setdefault(owners_of(name), []).append(name)
    abbreviations = [_abbreviate(owners) for owners in members]
    return {
        abbreviation if abbreviations.count(abbreviation) == 1 else ", ".join(owners): tuple(members[owners])
        for abbreviation, owners in zip(abbreviations, members, strict=True)
    }


def _abbreviate(owners: tuple[str, ...]) -> str:
    first = ", ".join(owners[:2])
    return first if len(owners) <= 2 else f"{first} and {len(owners) - 2} more"


def sum_groups(attribution: A, members: Mapping[str, tuple[str, ...]]) -> A:
    """Return the sum of each group's effects, 0-d by group, with standard errors from the replicates.

    Where there are none, as of sampled Shapley values, the standard error is an upper limit, the sum of those of
    the members. Gradients are summed over the ranges of the members where these are known: they have no common
    unit. A light that is off is left out of a group that has others, and so is a map of light beside its scale,
    whose effect is that of all its light, unless the two share a change between them.
    """
    kind, factors = attribution.kind.in_scale(attribution.scale_or_default()), dict(attribution.weights())
    maps = {
        group: light_maps_left_out(kind, {name: attribution[name] for name in names})
        for group, names in members.items()
    }
    groups = {group: list(names) for group, names in members.items()}
    members = {group: tuple(n for n in names if n not in maps[group]) for group, names in members.items()}
    jumps = attribution.info.get("jumps", {})
    off, on = attribution.lights_off(), {*attribution.info.get("lights_on", ())}
    of_lights_off = {group for group, names in members.items() if {*names} - {*jumps} <= off}
    off -= {name for group in of_lights_off for name in members[group]}
    factors |= {name: 0 * factors[name] for name in {*jumps, *off}}

    def total(tensors: Mapping[str, torch.Tensor], names: tuple[str, ...]) -> torch.Tensor:
        return torch.stack([channel_totals(tensors[name]) @ factors[name] for name in names]).sum()

    effects = {name: rows @ factors[name].double() for name, rows in attribution.replicates.items()}
    rows = {
        group: torch.stack([effects[name] for name in names]).sum(0)[:, None]
        for group, names in members.items()
        if {*names} <= {*effects}
    }
    bias = None if attribution.bias is None else {g: total(attribution.bias, n) for g, n in members.items()}
    errors, covariance = attribution.effects_error(), None
    if errors is not None:
        known = covariances(rows, bias)
        # Sampled Shapley values have no replicates. If they err together, it is by no more than the sum.
        largest = {group: sum(errors[name] for name in names) for group, names in members.items()}
        covariance = {
            group: known.get(group, torch.tensor([[largest[group] ** 2]], dtype=torch.float64))
            for group in members
        }
    # A group of nothing else is not ranked either.
    without = {group: jumps[names[0]] for group, names in members.items() if all(n in jumps for n in names)}
    hidden = {name for group in without for name in members[group]}
    without |= {name: reason for name, reason in jumps.items() if name not in hidden}
    scale_of = {name: scale for of_group in maps.values() for name, scale in of_group.items()}
    noted = {*without, *off, *scale_of, *scale_of.values(), *attribution.info.get("left_out_directions", {})}
    return dataclasses.replace(
        attribution,
        attributions={group: total(attribution, names) for group, names in members.items()},
        standard_error=None
        if covariance is None
        else {g: c[0, 0].sqrt().float() for g, c in covariance.items()},
        bias=bias,
        replicates=rows,
        covariance=covariance,
        extents={},
        labels={
            **{name: label for name, label in attribution.labels.items() if name in noted},
            **{group: attribution.labels.get(group, group) for group in members},
        },
        info={
            **attribution.info,
            "quantity": kind.value,
            "vectors": [],
            "jumps": without,
            "lights_off": [*sorted(of_lights_off), *sorted(off)],
            "lights_on": [group for group, names in members.items() if {*names} & on],
            "kept_directions": {},
            "maps_left_out": scale_of,
            "groups": groups,
        },
    )
