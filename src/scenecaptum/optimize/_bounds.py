"""What a design may change, and within which bounds."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Protocol, TypeAlias, TypeVar

import torch

from ..errors import INPUT_NAMES, SceneCaptumError, near_misses
from ..protocols import Capabilities, Renderer

Limit: TypeAlias = "float | Sequence[float]"

# Properties of emitters that are part of their construction.
CONSTRUCTION = ("cutoff_angle", "beam_width")
SAME_LIGHT = ("scale", "data")  # of an environment map
BOUND_MARGIN = 0.01  # distance from a physical bound, which may be degenerate, as a fraction of the range
LIGHTEST = 0.85  # reflectance of a design: that of white matt paint


def construction(renderer: Renderer) -> set[str]:
    """Return the parameters that a design does not change: the cone of a spot belongs to the lamp."""
    describe = Capabilities(renderer).parameters_table
    if describe is None:
        return set()
    return {name for name, parameter in describe().items() if parameter.role in CONSTRUCTION}


def lamps(renderer: Renderer) -> set[str]:
    """Return the emitted light of lamps and skies, which a dimmer scales as a whole."""
    describe = Capabilities(renderer).parameters_table
    if describe is None:
        return set()
    return {
        name for name, one in describe().items() if one.kind == "emitters" and math.isinf(one.bounds.high)
    }


class Named(Protocol):
    """What concerns a parameter, such as a row of a ranking."""

    @property
    def name(self) -> str:
        """The parameter's name."""


AnyNamed = TypeVar("AnyNamed", bound=Named)


def first_of_each_light(found: Iterable[AnyNamed]) -> list[AnyNamed]:
    """Return all but the later of the scale and the map of a sky, which both dim the same light."""
    kept: dict[str, AnyNamed] = {}
    for one in found:
        owner, _, last = one.name.rpartition(".")
        kept.setdefault(owner if owner and last in SAME_LIGHT else one.name, one)
    return list(kept.values())


def design_bounds(renderer: Renderer, values: Mapping[str, torch.Tensor]) -> dict[str, tuple[float, float]]:
    """Return the bounds within which a design changes values: no paint is lighter than white paint."""
    bounds = dict(Capabilities(renderer).bounds or {})
    describe = Capabilities(renderer).parameters_table
    for name, parameter in (describe() if describe is not None else {}).items():
        if name in bounds and name in values and parameter.kind == "reflectance":
            low, high = bounds[name]
            bounds[name] = low, min(high, max(LIGHTEST, values[name].max().item()))
    return bounds


def chosen_limits(
    values: Mapping[str, torch.Tensor], limits: Mapping[str, tuple[Limit, Limit]]
) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
    """Return the limits of the parameters that have some; names take precedence over globs."""
    chosen = {}
    for key, interval in sorted(limits.items(), key=lambda item: item[0] in values):
        names = [key] if key in values else [name for name in values if fnmatchcase(name, key)]
        if not names:
            raise SceneCaptumError(
                f"limits names {key!r}, which no input matches."
                f"{near_misses(key, values, instead=INPUT_NAMES)}"
            )
        for name in names:
            value = values[name]
            low, high = (torch.as_tensor(limit).to(value) for limit in interval)
            fits = value.ndim <= 1 and all(limit.shape in ((), value.shape) for limit in (low, high))
            if not fits or not bool((low <= high).all()):
                raise SceneCaptumError(
                    f"limits[{key!r}] must be (low, high) with low <= high, numbers or one for each channel of "
                    f"{name!r}, not {interval!r}; textures have none."
                )
            chosen[name] = low, high
    return chosen


def brought_inside(
    values: Mapping[str, torch.Tensor], limits: Mapping[str, tuple[torch.Tensor, torch.Tensor]]
) -> dict[str, torch.Tensor]:
    """Return the nearest values within the limits, of the parameters that are outside theirs."""
    nearest = {name: values[name].clamp(low, high) for name, (low, high) in limits.items()}
    return {name: value for name, value in nearest.items() if not torch.equal(value, values[name])}
