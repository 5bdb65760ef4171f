"""Which integrator, depth and derivatives a scene requires, each decision with its reason."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from ..backend import activate
from ..scene import SceneParameters
from ..scene._graph import SceneGraph
from ._memory import size
from ._routes import reason_against_replay, shiny_ones

# Up to this depth every path is traced to its end: the cost of the last bounces is small, and without
# random termination the rendered number is a smooth function of the parameters.
FULL_PATH_DEPTH = 16
DEFAULT_DEPTH = 6

# Mitsuba's own path replay, without and with participating media.
STOCK = ("prb", "prbvolpath")


@dataclass(frozen=True)
class RenderPlan:
    """How a scene is rendered and differentiated; prints one decision a line, with its reason.

    Attributes
    ----------
    integrator
        The Mitsuba integrator plugin.
    max_depth
        Longest path, in segments; -1 for no limit.
    rr_depth
        Depth from which Russian roulette may end a path.
    hide_emitters
        Whether the camera does not see lights directly.
    reasons
        ``(decision, reason)`` pairs.
    differences
        The inputs whose derivative is a finite difference with a shared seed, each with the reason why path
        replay does not serve; at the scene's own values, since at others it may.
    cautions
        ``(parameter, caution)`` pairs: of inputs, what is known to be wrong with their derivatives; of others,
        that the scene's own value is not finite or physically impossible.
    memory
        Bytes that a picture and its backward pass take at most, of the renderer's own samples.
    """

    integrator: str
    max_depth: int
    rr_depth: int
    hide_emitters: bool
    reasons: tuple[tuple[str, str], ...]
    differences: tuple[tuple[str, str], ...]
    cautions: tuple[tuple[str, str], ...]
    memory: int = 0

    def __str__(self) -> str:
        """Write one decision a line."""
        from ..visualization import plan_text

        return plan_text(self)

    def _repr_html_(self) -> str:
        from ..visualization import plan_html

        return plan_html(self)

    def create_integrator(self, *, hide_emitters: bool | None = None) -> Any:
        """Return a Mitsuba integrator as planned; ``hide_emitters`` may be set otherwise."""
        return activate().load_dict(
            {
                "type": self.integrator,
                "max_depth": self.max_depth,
                "rr_depth": self.rr_depth,
                "hide_emitters": self.hide_emitters if hide_emitters is None else hide_emitters,
            }
        )

    @property
    def decisions(self) -> tuple[tuple[str, str], ...]:
        """The decisions with their reasons, and what they take."""
        if not self.memory:
            return self.reasons
        return (
            *self.reasons,
            (f"at most {size(self.memory)} of memory", "to render and differentiate one picture"),
        )


def make_plan(
    graph: SceneGraph,
    parameters: SceneParameters,
    inputs: Mapping[str, torch.Tensor],
    max_depth: int | None,
) -> RenderPlan:
    """Choose the integrator, its settings and a derivative for each of the inputs that are asked for."""
    mi = activate()
    own = graph.scene.integrator()
    reasons: list[tuple[str, str]] = []

    if graph.has(mi.Medium):
        integrator = "scenecaptum_volumetric_replay"
        reasons.append((f"integrator {integrator}", "path replay: the scene has a participating medium"))
    else:
        integrator = "scenecaptum_replay"
        reasons.append((f"integrator {integrator}", "path replay, mirrors included; no medium in the scene"))

    reasons.append((f"variant {mi.variant()}", "linear RGB; spectra are converted when the scene is loaded"))

    depth, reason = _depth(own, max_depth)
    reasons.append((f"max_depth {'unlimited' if depth == -1 else depth}", reason))

    if 0 < depth <= FULL_PATH_DEPTH:
        rr_depth = depth + 1
        reasons.append(
            ("no Russian roulette", f"paths of at most {FULL_PATH_DEPTH} segments are traced whole")
        )
    else:
        rr_depth = _setting(own, "rr_depth") or 5
        reasons.append((f"Russian roulette from depth {rr_depth}", "deeper paths end at random, unbiased"))

    hide_emitters = bool(getattr(own, "hide_emitters", False))
    if hide_emitters:
        reasons.append(("lights hidden from the camera", "as the scene's integrator says"))
    reasons += _not_used(own)

    left_out = sum(not p.problem for p in parameters.values()) - len(inputs)
    reasons.append(
        (f"{len(inputs)} inputs tracked", f"{left_out} other differentiable parameters stay detached")
    )
    against_replay = ((n, reason_against_replay(parameters[n], value)) for n, value in inputs.items())
    differences = tuple((name, reason) for name, reason in against_replay if reason is not None)
    if differences:
        reasons.append(
            (f"{len(differences)} of them by finite differences", "two or three more renders each, see below")
        )
    replayed = {name: value for name, value in inputs.items() if name not in dict(differences)}
    shiny = shiny_ones(parameters, replayed)
    if shiny:
        reasons.append(
            (
                f"{len(shiny)} of them from their surfaces",
                "low roughness (pinhole and lens cameras, no bump maps)",
            )
        )
    cautions = (
        *((name, f"{p.fault}; left out, and rendered as it is") for name, p in parameters.items() if p.fault),
        *((name, caution) for name in inputs if (caution := parameters[name].caution)),
    )
    return RenderPlan(integrator, depth, rr_depth, hide_emitters, tuple(reasons), differences, cautions)


# The scene's own integrators that do not render what path replay does, or not in its way, by their classes.
_OTHERS = {
    "AOVIntegrator": ("aov", "its channels beside radiance are not rendered"),
    "DepthIntegrator": ("depth", "it shows distances, and radiance is rendered"),
    "MomentIntegrator": ("moment", "squares of radiance are not rendered"),
    "StokesIntegrator": ("stokes", "polarization is not rendered"),
    "ParticleTracerIntegrator": ("ptracer", "the same light is found from the camera, with other noise"),
    "VolumetricPathIntegrator": ("volpath", "the same light is found by path replay"),
    "VolpathMisIntegratorImpl": ("volpathmis", "the same light is found by path replay"),
    "PRBVolpathIntegrator": ("prbvolpath", "the same light is found by path replay"),
    "DirectProjectiveIntegrator": ("direct_projective", "visibility is not differentiated"),
    "PathProjectiveIntegrator": ("prb_projective", "visibility is not differentiated"),
}
# Those that path replay stands in for.
_ALIKE = {"PathIntegrator", "DirectIntegrator", "PRBIntegrator", "BasicPRBIntegrator"}
_ALIKE |= {"ReplayIntegrator", "VolumetricReplayIntegrator"}


def _not_used(own: Any) -> list[tuple[str, str]]:
    """Say that the scene's own integrator is not used, where pictures or derivatives could be expected of it."""
    if own is None:
        return []
    # Mitsuba knows a plugin in Python by the class of its base.
    name = type(own).__name__ if own.class_name() == "SamplingIntegrator" else str(own.class_name())
    if name in _ALIKE:
        return []
    plugin, reason = _OTHERS.get(name, (name, "radiance is found by path replay"))
    return [(f"the scene's integrator {plugin!r} is not used", reason)]


def stock_plan(plan: RenderPlan) -> RenderPlan:
    """Return the same plan with Mitsuba's own integrator, and its derivatives as they come."""
    integrator = STOCK["volumetric" in plan.integrator]
    return dataclasses.replace(
        plan,
        integrator=integrator,
        reasons=(
            (f"integrator {integrator}", "as asked: Mitsuba's own, to compare with"),
            *plan.reasons[1:4],
        ),
        differences=(),
    )


def _depth(own: Any, max_depth: int | None) -> tuple[int, str]:
    if max_depth is not None:
        return max_depth, "as asked"
    depth = _setting(own, "max_depth")
    if depth is None and "Direct" in str(own):
        return 2, "the scene's integrator stops at direct light"
    if depth is None:
        return DEFAULT_DEPTH, "the scene names no depth"
    # Mitsuba keeps "no limit" as the largest unsigned integer.
    return (-1 if depth >= 2**31 else depth), "as the scene's integrator says"


def _setting(integrator: Any, name: str) -> int | None:
    """Read a setting of an integrator from its description; C++ integrators do not expose it otherwise."""
    found = re.search(rf"{name} = (\d+)", str(integrator))
    return int(found.group(1)) if found else None
