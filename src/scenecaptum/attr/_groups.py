"""From ``groups=`` to the parameters that are changed, or counted, together."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from fnmatch import fnmatchcase
from typing import Any, TypeAlias

import torch

from ..errors import SceneCaptumError, near_misses
from ..scene import Parameter
from ._attribution import SceneAttribution, covariances
from ._baselines import table_of

Groups: TypeAlias = "str | Mapping[str, str | Iterable[str]] | None"

PRESETS = ("kind", "material", "object")


def resolve_groups(renderer: Any, names: Iterable[str], groups: Groups = None) -> dict[str, tuple[str, ...]]:
    """Return the members of every group; together the groups hold each parameter exactly once.

    Example
    -------
    >>> from scenecaptum import SceneRenderer
    >>> renderer = SceneRenderer("cornell-box", inputs=["reflectance", "emitters"])
    >>> resolve_groups(renderer, renderer.inputs, "material")["light"]
    ('light.bsdf.reflectance.value', 'light.emitter.radiance.value')

    Parameters
    ----------
    renderer
        Its ``parameters_table()`` tells kinds and owners, its ``surfaces`` which objects show a parameter.
    names
        The parameters to be grouped.
    groups
        - None: each parameter is a group of its own, named as the parameter.
        - ``"kind"``: reflectances, roughnesses, lights, ….
        - ``"material"``: by the materials, lights or media that own the parameter.
        - ``"object"``: by what shows the parameter. A parameter that several objects show is in one group with
          those that the very same objects show; one that no object shows goes to its owner.
        - A mapping from a group's name to the names or globs of its members. A parameter that is in none stays
          alone.

    Raises
    ------
    SceneCaptumError
        Where a name matches nothing or is in two groups, or the renderer does not know what is asked for.
    """
    names = tuple(names)
    if groups is None:
        return {name: (name,) for name in names}
    if isinstance(groups, Mapping):
        return _given(names, groups)
    if groups not in PRESETS:
        raise SceneCaptumError(
            f"groups={groups!r} must be {', '.join(map(repr, PRESETS))}, or a mapping from a group's name to the "
            "names of its members."
        )
    table = table_of(renderer)
    if table is None:
        raise SceneCaptumError(
            f"groups={groups!r} asks the renderer what it knows of its parameters, and this one has no "
            "parameters_table(). Give a mapping from a group's name to the names of its members."
        )
    if groups == "object":
        return _by_object(renderer, table, names)
    if groups == "kind":
        return _collect(names, lambda name: (table[name].kind,))
    return _collect(names, lambda name: table[name].owners or (name,))


def _given(names: tuple[str, ...], groups: Mapping[str, str | Iterable[str]]) -> dict[str, tuple[str, ...]]:
    group_of: dict[str, str] = {}
    for group, members in groups.items():
        wanted = [members] if isinstance(members, str) else list(members)
        if not wanted:
            raise SceneCaptumError(f"The group {group!r} is empty: give it names or globs, or leave it out.")
        for name in {name: None for one in wanted for name in _matching(names, group, one)}:
            if name in group_of:
                raise SceneCaptumError(
                    f"{name!r} is in two groups, {group_of[name]!r} and {group!r}; it can change with one only."
                )
            group_of[name] = group
    alone = [name for name in names if name not in group_of]
    if clashing := [name for name in alone if name in groups]:
        raise SceneCaptumError(
            f"The group {clashing[0]!r} has the name of a parameter that is not in it. Give it another name."
        )
    collected = {group: tuple(n for n in names if group_of.get(n) == group) for group in groups}
    return {**collected, **{name: (name,) for name in alone}}


def _matching(names: tuple[str, ...], group: str, wanted: str) -> list[str]:
    if not isinstance(wanted, str):
        raise SceneCaptumError(
            f"The group {group!r} must hold names or globs of parameters, not {type(wanted).__name__}."
        )
    matched = [wanted] if wanted in names else [name for name in names if fnmatchcase(name, wanted)]
    if not matched:
        raise SceneCaptumError(
            f"The group {group!r} names {wanted!r}, which matches none of the {len(names)} inputs."
            f"{near_misses(wanted, names)}"
        )
    return matched


def _by_object(
    renderer: Any, table: Mapping[str, Parameter], names: tuple[str, ...]
) -> dict[str, tuple[str, ...]]:
    surfaces = getattr(renderer, "surfaces", None)
    if surfaces is None:
        raise SceneCaptumError(
            'groups="object" needs a renderer that knows what each object shows, as a SceneRenderer does.'
        )
    showing: dict[str, list[str]] = {}
    for shown_by, below in zip(surfaces.objects, surfaces.parameters, strict=True):
        for name in below:
            showing.setdefault(name, []).append(shown_by)
    return _collect(names, lambda name: tuple(showing.get(name) or table[name].owners or (name,)))


def _collect(
    names: tuple[str, ...], holders_of: Callable[[str], tuple[str, ...]]
) -> dict[str, tuple[str, ...]]:
    """Put the parameters of the same holders into one group, which goes by their names."""
    members: dict[tuple[str, ...], list[str]] = {}
    for name in names:
        members.setdefault(holders_of(name), []).append(name)
    short = [_abbreviated(holders) for holders in members]
    return {
        brief if short.count(brief) == 1 else ", ".join(holders): tuple(members[holders])
        for brief, holders in zip(short, members, strict=True)
    }


def _abbreviated(holders: tuple[str, ...]) -> str:
    shown = ", ".join(holders[:2])
    return shown if len(holders) <= 2 else f"{shown} and {len(holders) - 2} more"


def add_up(attribution: SceneAttribution, members: Mapping[str, tuple[str, ...]]) -> SceneAttribution:
    """Return the sum of each group's attributions, 0-d by group, with the errors that their passes tell."""

    def total(tensors: Mapping[str, torch.Tensor], names: tuple[str, ...]) -> torch.Tensor:
        return torch.stack([tensors[name].sum() for name in names]).sum()

    rows = {
        group: torch.stack([attribution.replicates[name].sum(1) for name in names]).sum(0)[:, None]
        for group, names in members.items()
    }
    bias = None if attribution.bias is None else {g: total(attribution.bias, n) for g, n in members.items()}
    covariance = None if attribution.covariance is None else covariances(rows, bias)
    return dataclasses.replace(
        attribution,
        attributions={group: total(attribution, names) for group, names in members.items()},
        standard_error=None
        if covariance is None
        else {g: c[0, 0].sqrt().float() for g, c in covariance.items()},
        bias=bias,
        replicates=rows,
        covariance=covariance,
        labels={group: attribution.labels.get(group, group) for group in members},
        info={**attribution.info, "groups": {group: list(names) for group, names in members.items()}},
    )
