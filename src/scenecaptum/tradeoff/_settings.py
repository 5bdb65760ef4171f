"""The settings that are measured: the renderer's own, and others that differ in one thing."""

from __future__ import annotations

import dataclasses
import inspect
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ..attr._passes import DEFAULT_PASSES
from ..errors import SceneCaptumError, near_misses, whole_number

KEYS = ("spp", "primal_spp", "gradient_spp", "max_depth", "resolution", "replicates", "integrator")

# What only a renderer that can be had with other settings may vary.
_OF_THE_RENDERER = ("max_depth", "resolution", "integrator")


@dataclass(frozen=True)
class Setting:
    """How an attribution is computed.

    Attributes
    ----------
    primal_spp, gradient_spp
        Samples per pixel in all, of the pictures that the metric sees and of the backward passes.
    replicates
        Least number of passes that they are split into; with 1 the bias of a non-linear metric stays in.
    max_depth, resolution, integrator
        Those of the renderer; None where it does not tell.
    """

    primal_spp: int
    gradient_spp: int
    replicates: int = DEFAULT_PASSES
    max_depth: int | None = None
    resolution: tuple[int, int] | None = None
    integrator: str | None = None

    @property
    def pixels(self) -> int:
        """How many pixels the picture has, 0 where that is not told."""
        return math.prod(self.resolution) if self.resolution else 0

    @property
    def reach(self) -> float:
        """The depth, infinite where it has no limit."""
        return math.inf if self.max_depth == -1 else self.max_depth or 0

    def changed(self, key: str, value: Any) -> Setting:
        """Return the setting with another ``value`` of ``key``; ``"spp"`` is that of primal and gradient."""
        if key == "spp":
            return dataclasses.replace(self, primal_spp=value, gradient_spp=value)
        return dataclasses.replace(self, **{key: value})


def own_setting(renderer: Any) -> Setting:
    """Return the setting that a renderer has by itself."""
    spp = getattr(renderer, "spp", None)
    if spp is None:
        raise SceneCaptumError(
            "This renderer does not tell its samples per pixel, around which others are measured: give it an "
            "attribute `spp`."
        )
    plan = getattr(renderer, "plan", None)
    return Setting(
        spp,
        spp,
        max_depth=None if plan is None else plan.max_depth,
        resolution=getattr(renderer, "resolution", None),
        integrator=None if plan is None else plan.integrator,
    )


def default_values(renderer: Any, base: Setting, *, sizes: bool) -> dict[str, list[Any]]:
    """Return what is varied by default, as far as the renderer allows; the resolution where it may be."""
    spps = [max(base.primal_spp // 4, 1), 4 * base.primal_spp]
    found: dict[str, list[Any]] = {"spp": spps}
    if _has_samples_of_its_own(renderer):
        found |= {"primal_spp": spps, "gradient_spp": spps}
    found["replicates"] = [1, 4 * DEFAULT_PASSES]
    if hasattr(renderer, "replace"):
        deeper = 2 * base.max_depth if base.max_depth and base.max_depth > 0 else 8
        found["max_depth"] = [2, 4, deeper]
        if sizes and base.resolution:
            width, height = base.resolution
            found["resolution"] = [(max(width // k, 1), max(height // k, 1)) for k in (2, 4)]
        found["integrator"] = ["prb"]
    return found


def settings_of(renderer: Any, base: Setting, vary: Mapping[str, Iterable[Any]]) -> list[tuple[str, Setting]]:
    """Return each setting after the name of what is varied; the base, which varies nothing, comes first."""
    found = [("", base)]
    for key, values in vary.items():
        _check_key(renderer, key)
        for value in _listed(key, values):
            setting = base.changed(key, _check_value(key, value))
            if setting not in [one for _, one in found]:
                found.append((key, setting))
    return found


def reference_setting(settings: Sequence[Setting], spp: int, replicates: int) -> Setting:
    """Return the setting of the reference: the finest resolution and the longest paths, as by the first."""
    finest = max(settings, key=lambda one: one.pixels)
    longest = max(settings, key=lambda one: one.reach)
    return dataclasses.replace(
        settings[0],
        primal_spp=spp,
        gradient_spp=spp,
        replicates=replicates,
        max_depth=longest.max_depth,
        resolution=finest.resolution,
    )


def _has_samples_of_its_own(renderer: Any) -> bool:
    return "spp_grad" in inspect.signature(getattr(renderer, "forward", renderer)).parameters


def _check_key(renderer: Any, key: str) -> None:
    if key not in KEYS:
        raise SceneCaptumError(
            f"{key!r} cannot be varied.{near_misses(key, KEYS)} What can is {', '.join(KEYS)}."
        )
    if key in _OF_THE_RENDERER and not hasattr(renderer, "replace"):
        raise SceneCaptumError(
            f"Varying {key!r} takes a SceneRenderer: a {type(renderer).__name__} has no replace()."
        )
    if key in ("primal_spp", "gradient_spp") and not _has_samples_of_its_own(renderer):
        raise SceneCaptumError(
            f"Varying {key!r} takes a renderer with backward passes of their own samples: a "
            f"{type(renderer).__name__} has no spp_grad=."
        )


def _listed(key: str, values: Any) -> list[Any]:
    if isinstance(values, str) or not isinstance(values, Iterable):
        raise SceneCaptumError(f"vary[{key!r}] must be a list of values, not {values!r}.")
    return list(values)


def _check_value(key: str, value: Any) -> Any:
    if key == "integrator":
        if value != "prb":
            raise SceneCaptumError(f'integrator can be varied to "prb", Mitsuba\'s own, not {value!r}.')
        return value
    if key == "resolution":
        if not isinstance(value, Sequence) or len(value) != 2:
            raise SceneCaptumError(f"resolution must be (width, height) in pixels, not {value!r}.")
        return tuple(
            whole_number(f"the {side}", n) for side, n in zip(("width", "height"), value, strict=True)
        )
    return -1 if key == "max_depth" and value == -1 else whole_number(key, value)
