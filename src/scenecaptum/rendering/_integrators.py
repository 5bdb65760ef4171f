"""The integrators that a plan can choose. To add one, write its module and add it to ``INTEGRATORS``."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any

from ..backend import activate
from ..errors import SceneCaptumError


@dataclass(frozen=True)
class IntegratorKind:
    """An integrator and what the renderer must know of it."""

    plugin: str  # its name in Mitsuba
    module: str | None  # in ``rendering.integrators``, which registers it; None for Mitsuba's own
    media: bool  # whether it renders participating media
    reason: str  # why a plan chooses it
    light_tracing: bool = False  # whether derivatives of low roughnesses can be left to light tracing
    sensor_grids: bool = False  # whether it lights the surfaces of a sensor grid
    path_differences: bool = False  # whether it traces paths with moved materials
    freezable: bool = True  # whether frozen kernels see every change of a scene; they see no phase functions

    @property
    def is_stock(self) -> bool:
        """Whether it is Mitsuba's own, with its uncorrected derivatives."""
        return self.module is None

    def create(self, **settings: Any) -> Any:
        """Return the Mitsuba integrator."""
        mi = activate()
        self.register()
        return mi.load_dict({"type": self.plugin, **settings})

    def register(self) -> None:
        """Make its name known to Mitsuba."""
        if self.module is not None:
            import_module(f"{__package__}.integrators.{self.module}")


_STOCK_REASON = "as requested: Mitsuba's own, for comparison"

INTEGRATORS = {
    kind.plugin: kind
    for kind in (
        IntegratorKind(
            "scenecaptum_replay",
            "path",
            media=False,
            reason="path replay, mirrors included; no medium in the scene",
            light_tracing=True,
            sensor_grids=True,
            path_differences=True,
        ),
        IntegratorKind(
            "scenecaptum_volumetric_replay",
            "volumetric",
            media=True,
            reason="path replay: the scene has a participating medium",
            freezable=False,
        ),
        IntegratorKind("prb", None, media=False, reason=_STOCK_REASON),
        IntegratorKind("prbvolpath", None, media=True, reason=_STOCK_REASON, freezable=False),
    )
}

STOCK_INTEGRATORS = tuple(plugin for plugin, kind in INTEGRATORS.items() if kind.is_stock)


def register_integrators() -> None:
    """Make the names of all integrators known to Mitsuba, for scenes that name one."""
    activate()
    for kind in INTEGRATORS.values():
        kind.register()


def check_integrator(plugin: str) -> None:
    """Raise if there is no integrator of this name."""
    if plugin not in INTEGRATORS:
        raise SceneCaptumError(
            f"integrator must be one of {', '.join(INTEGRATORS)}, not {plugin!r}. To use one of your own, "
            'list it: see "An integrator" on the page Extending scenecaptum.'
        )


def choose_integrator(*, media: bool, stock: bool = False) -> IntegratorKind:
    """Return the first integrator for scenes with or without media."""
    return next(k for k in INTEGRATORS.values() if (k.media, k.is_stock) == (media, stock))
