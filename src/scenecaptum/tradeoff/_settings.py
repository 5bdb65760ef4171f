"""The settings to measure: the renderer's own, and others that differ from it in one option."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ..errors import SceneCaptumError, near_misses, whole_number
from ..estimation import DEFAULT_REPLICATES
from ..protocols import Capabilities, Renderer
from ..rendering import STOCK_INTEGRATORS

KEYS = (
    "spp",
    "primal_spp",
    "gradient_spp",
    "max_depth",
    "resolution",
    "replicates",
    "integrator",
    "smoothing",
)

# Options that require renderer.replace().
_RENDERER_OPTIONS = ("max_depth", "resolution", "integrator")


@dataclass(frozen=True)
class Setting:
    """Options of an attribution.

    Attributes
    ----------
    primal_spp, gradient_spp
        Total samples per pixel of the forward and of the backward passes.
    replicates
        Minimum number of replicates; with 1 the bias of a non-linear metric is not corrected.
    max_depth, resolution, integrator
        Options of the renderer; None if unknown.
    smoothing
        The ``sigma`` of noise of the picture over which the metric is averaged; None for the metric itself.
    """

    primal_spp: int
    gradient_spp: int
    replicates: int = DEFAULT_REPLICATES
    max_depth: int | None = None
    resolution: tuple[int, int] | None = None
    integrator: str | None = None
    smoothing: float | None = None

    @property
    def pixels(self) -> int:
        """Number of pixels; 0 if unknown."""
        return math.prod(self.resolution) if self.resolution else 0

    @property
    def used_replicates(self) -> int:
        """Minimum number of replicates that are run, each with at least one sample."""
        return min(self.replicates, self.gradient_spp)

    @property
    def renderer_options(self) -> tuple[Any, ...]:
        """The options that belong to the renderer."""
        return self.max_depth, self.resolution, self.integrator

    @property
    def depth(self) -> float:
        """The maximum depth, infinite if unlimited."""
        return math.inf if self.max_depth == -1 else self.max_depth or 0

    def __str__(self) -> str:
        """Return ``'64 spp, depth 6, 320×180'``."""
        primal, gradient = self.primal_spp, self.gradient_spp
        words = [f"{primal} spp" if primal == gradient else f"{primal} spp primal and {gradient} gradient"]
        if self.max_depth is not None:
            words.append("unlimited depth" if self.max_depth == -1 else f"depth {self.max_depth}")
        if self.resolution is not None:
            words.append("×".join(map(str, self.resolution)))
        if self.replicates == 1:
            words.append("1 replicate")
        if self.integrator in STOCK_INTEGRATORS:
            words.append(str(self.integrator))
        if self.smoothing is not None:
            words.append(f"smoothing {self.smoothing:g}")
        return ", ".join(words)

    def changed(self, key: str, value: Any) -> Setting:
        """Return the setting with another ``value`` of ``key``; ``"spp"`` changes both primal and gradient."""
        if key == "spp":
            return dataclasses.replace(self, primal_spp=value, gradient_spp=value)
        return dataclasses.replace(self, **{key: value})


def own_setting(renderer: Renderer) -> Setting:
    """Return the current setting of a renderer."""
    spp = Capabilities(renderer).spp
    if spp is None:
        raise SceneCaptumError(
            "This renderer has no attribute `spp`, the samples per pixel that settings are derived from: add it."
        )
    plan = Capabilities(renderer).plan
    own = {} if plan is None else {"max_depth": plan.max_depth, "integrator": plan.integrator}
    return Setting(spp, spp, resolution=Capabilities(renderer).resolution, **own)


def default_values(renderer: Renderer, base: Setting, *, vary_resolution: bool) -> dict[str, list[Any]]:
    """Return the options to vary by default and their values, as far as the renderer supports them."""
    spps = [max(base.primal_spp // 4, 1), 4 * base.primal_spp]
    vary: dict[str, list[Any]] = {"spp": spps}
    if Capabilities(renderer).with_spp_grad is not None:
        vary |= {"primal_spp": spps, "gradient_spp": spps}
    vary["replicates"] = [1, 4 * DEFAULT_REPLICATES]
    if Capabilities(renderer).replace is not None:
        deeper = 2 * base.max_depth if base.max_depth and base.max_depth > 0 else 8
        vary["max_depth"] = [2, 4, deeper]
        if vary_resolution and base.resolution:
            width, height = base.resolution
            vary["resolution"] = [(max(width // k, 1), max(height // k, 1)) for k in (2, 4)]
        vary["integrator"] = ["prb"]
    return vary


def settings_of(
    renderer: Renderer, base: Setting, vary: Mapping[str, Iterable[Any]]
) -> list[tuple[str, Setting]]:
    """Return pairs of varied option and setting, without duplicates; the first is the base, with an empty name."""
    settings = [("", base)]
    for key, values in vary.items():
        _check_key(renderer, key)
        if isinstance(values, str) or not isinstance(values, Iterable):
            raise SceneCaptumError(f"vary[{key!r}] must be a list of values, not {values!r}.")
        for value in values:
            setting = base.changed(key, _check_value(key, value))
            if setting not in [known for _, known in settings]:
                settings.append((key, setting))
    return settings


def reference_setting(settings: Sequence[Setting], spp: int, replicates: int) -> Setting:
    """Return the setting of the reference: the first with the highest resolution and the largest depth of all."""
    finest = max(settings, key=lambda setting: setting.pixels)
    deepest = max(settings, key=lambda setting: setting.depth)
    return dataclasses.replace(
        settings[0],
        primal_spp=spp,
        gradient_spp=spp,
        replicates=replicates,
        max_depth=deepest.max_depth,
        resolution=finest.resolution,
    )


def _check_key(renderer: Renderer, key: str) -> None:
    if key not in KEYS:
        raise SceneCaptumError(
            f"{key!r} cannot be varied.{near_misses(key, KEYS)} Options are {', '.join(KEYS)}."
        )
    if key in _RENDERER_OPTIONS and Capabilities(renderer).replace is None:
        raise SceneCaptumError(
            f"Varying {key!r} needs a SceneRenderer: {type(renderer).__name__} has no replace()."
        )
    if key in ("primal_spp", "gradient_spp") and Capabilities(renderer).with_spp_grad is None:
        raise SceneCaptumError(
            f"Varying {key!r} needs a renderer with spp_grad=, the samples per pixel of the backward pass: "
            f"{type(renderer).__name__} has none."
        )


def _check_value(key: str, value: Any) -> Any:
    if key == "integrator":
        if value != "prb":
            raise SceneCaptumError(f'integrator can only be varied to "prb", Mitsuba\'s own, not {value!r}.')
        return value
    if key == "resolution":
        if not isinstance(value, Sequence) or len(value) != 2:
            raise SceneCaptumError(f"resolution must be (width, height) in pixels, not {value!r}.")
        return whole_number("the width", value[0]), whole_number("the height", value[1])
    if key == "smoothing":
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < math.inf:
            raise SceneCaptumError(f"smoothing must be a positive number, the sigma of noise, not {value!r}.")
        return float(value)
    return -1 if key == "max_depth" and value == -1 else whole_number(key, value)
