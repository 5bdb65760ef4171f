"""Choose integrator, path depth and derivative methods for a scene, each with its reason."""

from __future__ import annotations

import dataclasses
import html
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from ..backend import activate
from ..errors import SceneCaptumError
from ..scene import SceneGraph, SceneParameters, named_integrator
from ..visualization import STYLE, first_few, group_by_text, html_cells, pluralize, terminal_width, wrap
from ._derivative_routes import Routes, derivative_routes, low_roughness_names, noisy_roughness_names
from ._integrators import INTEGRATORS, IntegratorKind, check_integrator, choose_integrator
from ._memory import format_bytes
from ._sensors import allows_light_tracing

# Up to this depth there is no Russian roulette: the last bounces cost little, and without random termination the
# image is a smooth function of the parameters.
FULL_PATH_DEPTH = 16
DEFAULT_DEPTH = 6


@dataclass(frozen=True)
class RenderPlan:
    """How a scene is rendered and differentiated; prints one decision per line, with its reason.

    Printed lists of parameters are cut after the first few names; the attributes have all of them.

    Attributes
    ----------
    integrator
        The Mitsuba integrator plugin.
    max_depth
        Longest path, in segments; -1 for no limit.
    rr_depth
        Depth from which Russian roulette may end a path.
    hide_emitters
        Whether lights are hidden from the camera.
    reasons
        ``(decision, reason)`` pairs.
    differences
        The inputs that attributions differentiate by finite differences with common random numbers, each with the
        reason why path replay is not used. They are determined at the scene's own values and may differ at others.
    cautions
        ``(parameter, caution)`` pairs: for inputs, known errors of their derivatives; for other parameters, a
        value in the scene that is not finite or not physical.
    noisy_roughness
        The inputs of low roughness that are differentiated by path replay, because light tracing would take
        samples from the others. Attributed alone they are light traced; lit by lamps, they often have smaller
        errors, but not where the light passes through glass.
    scene_depth
        The depth that the scene's own integrator sets, -1 for no limit; None where it sets none.
    memory
        Upper bound on the bytes of a render and its backward pass with the renderer's own ``spp``.
    """

    integrator: str
    max_depth: int
    rr_depth: int
    hide_emitters: bool
    reasons: tuple[tuple[str, str], ...]
    differences: tuple[tuple[str, str], ...]
    cautions: tuple[tuple[str, str], ...]
    noisy_roughness: tuple[str, ...] = ()
    scene_depth: int | None = None
    memory: int = 0

    def __str__(self) -> str:
        """Return one decision per line; in a terminal within its width."""
        width, column = terminal_width(), max(len(decision) for decision, _ in self.decisions)
        lines = [(f"{decision.ljust(column)}  {reason}", column + 2) for decision, reason in self.decisions]
        for text, names in group_by_text(self.differences).items():
            lines.append((f"finite difference for {first_few(names)}: {text}", 4))
        for text, names in group_by_text(self.cautions).items():
            lines.append((f"caution: {first_few(names)}: {text}", 4))
        if self.noisy_roughness:
            lines.append((f"low roughness among other inputs: {first_few(self.noisy_roughness)}", 4))
        return "\n".join(text if width is None else wrap(text, width, indent) for text, indent in lines)

    def _repr_html_(self) -> str:
        """Return a table of the decisions and their reasons, with finite differences and cautions below it."""
        rows = "\n".join(f"<tr>{html_cells(pair, 'td')}</tr>" for pair in self.decisions)
        notes = [
            f"<div><b>{html.escape(title)}</b> {html.escape(first_few(names))}: {html.escape(text)}</div>"
            for title, pairs in (("Finite difference for", self.differences), ("Caution:", self.cautions))
            for text, names in group_by_text(pairs).items()
        ]
        if self.noisy_roughness:
            names = html.escape(first_few(self.noisy_roughness))
            notes.append(f"<div><b>Low roughness among other inputs:</b> {names}</div>")
        return (
            f'<div class="scenecaptum">\n{STYLE}\n'
            f"<table>\n<thead><tr>{html_cells(('decision', 'reason'), 'th')}</tr></thead>\n"
            f'<tbody>\n{rows}\n</tbody>\n</table>\n<div class="notes">{"".join(notes)}</div>\n</div>'
        )

    def create_integrator(self, *, hide_emitters: bool | None = None) -> Any:
        """Return the planned Mitsuba integrator, optionally with another ``hide_emitters``."""
        return self.kind.create(
            max_depth=self.max_depth,
            rr_depth=self.rr_depth,
            hide_emitters=self.hide_emitters if hide_emitters is None else hide_emitters,
        )

    @property
    def kind(self) -> IntegratorKind:
        """What the renderer knows of the integrator."""
        return INTEGRATORS[self.integrator]

    @property
    def decisions(self) -> tuple[tuple[str, str], ...]:
        """The decisions with their reasons, and the memory bound."""
        if not self.memory:
            return self.reasons
        memory = f"at most {format_bytes(self.memory)} of memory"
        return (*self.reasons, (memory, "to render and differentiate one image"))


def make_plan(
    graph: SceneGraph,
    parameters: SceneParameters,
    values: Mapping[str, torch.Tensor],
    inputs: Sequence[str],
    max_depth: int | None,
    sensors: Sequence[Any],
) -> RenderPlan:
    """Choose the integrator, its settings and a derivative method for each input, given the scene's values."""
    mi = activate()
    own = graph.scene.integrator()
    reasons: dict[str, str] = {}

    integrator = choose_integrator(media=graph.has(mi.Medium))
    reasons[f"integrator {integrator.plugin}"] = integrator.reason
    reasons[f"variant {mi.variant()}"] = "linear RGB; spectra are converted when the scene is loaded"

    depth, reason = _depth(own, max_depth)
    reasons[f"max_depth {_in_words(depth)}"] = reason

    if 0 < depth <= FULL_PATH_DEPTH:
        rr_depth = depth + 1
        reasons["no Russian roulette"] = (
            f"all paths are traced to their end; only beyond {FULL_PATH_DEPTH} segments would they end at random"
        )
    else:
        rr_depth = _setting(own, "rr_depth") or 5
        reasons[f"Russian roulette from depth {rr_depth}"] = "deeper paths end at random, without bias"

    if hide_emitters := bool(getattr(own, "hide_emitters", False)):
        reasons["lights hidden from the camera"] = "as set by the scene's integrator"
    reasons |= _unused_integrator(own, media=integrator.media)
    reasons |= _film_filters(sensors)

    left_out = sum(not p.problem and not p.moves for n, p in parameters.items() if n not in inputs)
    others = "1 other differentiable parameter is" if left_out == 1 else f"{left_out} others are"
    reasons[f"{pluralize(len(inputs), 'input')} tracked"] = f"{others} not tracked"
    routes = derivative_routes(parameters, values, inputs)
    differences = tuple((name, route.reason) for name, route in routes.items() if route.reason is not None)
    if differences:
        from ._moved_materials import movable_materials
        from ._turning_camera import turned_names

        turned = turned_names(dict(differences), sensors)
        differences = tuple((name, reason) for name, reason in differences if name not in turned)
        if count := sum(math.prod(parameters[name].shape) for name in turned):
            reasons[f"{pluralize(count, 'number')} of the camera by moving the film"] = (
                "one more evaluation of the light in attributions; plain autograd takes differences"
            )
        moved = movable_materials(graph, parameters, dict(differences)) if integrator.path_differences else {}
        if moved:
            reasons[f"{len(moved)} of them by differences of paths"] = (
                "one pass for all together; mean slopes over small steps, such as ±0.02 of an index"
            )
        poses = [name for name, _ in differences if parameters[name].moves]
        if count := len(differences) - len(moved) - len(poses):
            reasons[f"{count} of them by differences of renders"] = (
                "two or three more renders each, see below"
            )
        if count := sum(math.prod(parameters[name].shape) for name in poses):
            numbers = pluralize(count, "number")
            reasons[f"{numbers} of {pluralize(len(poses), 'pose')} by differences of renders"] = (
                "two more renders for each number"
            )
    if count := len(low_roughness_names(routes)):
        reasons[f"{count} of them by light tracing"] = (
            "low roughness (pinhole and lens cameras, no bump maps)"
        )
    noisy = _noisy_roughness(graph, routes, sensors) if integrator.light_tracing and not hide_emitters else ()
    if noisy:
        reasons[f"{len(noisy)} of low roughness among others"] = (
            "as the only input, each often has a smaller error, because lamps light it"
        )
    cautions = (
        *(
            (name, f"{p.why_left_out}; left out, and rendered as it is")
            for name, p in parameters.items()
            if p.why_left_out
        ),
        *((name, caution) for name in inputs if (caution := parameters[name].caution)),
    )
    return RenderPlan(
        integrator.plugin,
        depth,
        rr_depth,
        hide_emitters,
        tuple(reasons.items()),
        differences,
        cautions,
        noisy,
        _scene_depth(own),
    )


def _noisy_roughness(graph: SceneGraph, routes: Routes, sensors: Sequence[Any]) -> tuple[str, ...]:
    """Return the low roughnesses that light tracing would differentiate with less noise, were they alone."""
    names = noisy_roughness_names(routes)
    return tuple(names) if all(allows_light_tracing(graph, sensor) for sensor in sensors) else ()


STOCK_DERIVATIVES = (
    "derivatives of Mitsuba's own integrator: 0 or wrong where they are of mirrors, glass, plastics or masks"
)

# Integrators of scenes that estimate something other than path replay does, or in another way, by class name.
_OTHER_INTEGRATORS = {
    "AOVIntegrator": ("aov", "only radiance is rendered, not its other channels"),
    "DepthIntegrator": ("depth", "it renders depth; radiance is rendered instead"),
    "MomentIntegrator": ("moment", "squares of radiance are not rendered"),
    "StokesIntegrator": ("stokes", "polarization is not rendered"),
    "ParticleTracerIntegrator": ("ptracer", "the same light is traced from the camera, with other noise"),
    "VolumetricPathIntegrator": ("volpath", "path replay renders the same light"),
    "VolpathMisIntegratorImpl": ("volpathmis", "path replay renders the same light"),
    "PRBVolpathIntegrator": ("prbvolpath", "path replay renders the same light"),
    "DirectProjectiveIntegrator": ("direct_projective", "visibility is not differentiated"),
    "PathProjectiveIntegrator": ("prb_projective", "visibility is not differentiated"),
}
# Integrators that path replay replaces without a difference, but for media.
_WITHOUT_MEDIA = {
    "PathIntegrator": "path",
    "DirectIntegrator": "direct",
    "PRBIntegrator": "prb",
    "BasicPRBIntegrator": "prb_basic",
}
_OWN_INTEGRATORS = {"ReplayIntegrator", "VolumetricReplayIntegrator"}


def _unused_integrator(own: Any, *, media: bool) -> dict[str, str]:
    """Return the decision not to use the scene's own integrator, where its results would differ.

    ``media`` says that the scene has media, and that they are rendered.
    """
    if own is None:
        return {}
    # For a plugin written in Python, Mitsuba reports the name of the base class.
    of_python = own.class_name() == "SamplingIntegrator"
    name = type(own).__name__ if of_python else str(own.class_name())
    # A class of the user's may have the name of a known one.
    is_known = not of_python or type(own).__module__.partition(".")[0] in (
        "mitsuba",
        __name__.partition(".")[0],
    )
    if is_known and (name in _OWN_INTEGRATORS or (name in _WITHOUT_MEDIA and not media)):
        return {}
    found = _OTHER_INTEGRATORS.get(name) if is_known else None
    if is_known and name in _WITHOUT_MEDIA:
        found = _WITHOUT_MEDIA[name], "it leaves the scene's media out, which are rendered"
    plugin, reason = found or (named_integrator(own) or name, "path replay renders the radiance")
    return {f"the scene's integrator {plugin!r} is not used": reason}


def _film_filters(sensors: Sequence[Any]) -> dict[str, str]:
    """Return a reason for each film filter that spreads a sample over pixels."""
    filters = [sensor.film().rfilter() for sensor in sensors]
    reason = (
        "as set by the scene: it spreads noise over pixels, which the denoiser keeps; where the image is "
        'denoised, <rfilter type="box"/> gives less noise'
    )
    names = dict.fromkeys(str(one.class_name()) for one in filters if not one.is_box_filter())
    return {f"film filter {name}": reason for name in names}


def with_integrator(plan: RenderPlan, plugin: str, surfaces: Sequence[str]) -> RenderPlan:
    """Return the same plan with another integrator; raise if there is none, or it does not render the media.

    ``surfaces`` are the inputs of materials: the derivatives of Mitsuba's own integrators are not right for all.
    """
    check_integrator(plugin)
    kind = INTEGRATORS[plugin]
    if kind.is_stock:
        kind = choose_integrator(media=plan.kind.media, stock=True)
    if plan.kind.media and not kind.media:
        raise SceneCaptumError(f"The integrator {plugin!r} does not render the scene's participating media.")
    # Mitsuba's own integrators have no finite differences and no light tracing.
    return dataclasses.replace(
        plan,
        integrator=kind.plugin,
        reasons=((f"integrator {kind.plugin}", kind.reason), *plan.reasons[1 : 4 if kind.is_stock else None]),
        differences=() if kind.is_stock else plan.differences,
        noisy_roughness=plan.noisy_roughness if kind.light_tracing else (),
        cautions=tuple((name, STOCK_DERIVATIVES) for name in surfaces) if kind.is_stock else plan.cautions,
    )


def _depth(own: Any, max_depth: int | None) -> tuple[int, str]:
    in_scene = _scene_depth(own)
    if max_depth is not None:
        if in_scene in (None, max_depth):
            return max_depth, "as requested"
        return max_depth, f"as requested; the scene's integrator sets {_in_words(in_scene)}"
    if in_scene is None:
        if own is not None and not _description(own):
            return DEFAULT_DEPTH, "the scene's integrator does not say its depth: give max_depth="
        return DEFAULT_DEPTH, "the scene sets no depth"
    if _setting(own, "max_depth") is None:
        return in_scene, "the scene's integrator renders direct light only"
    return in_scene, "as set by the scene's integrator"


def _in_words(depth: int | None) -> str:
    return "unlimited" if depth == -1 else str(depth)


def _scene_depth(own: Any) -> int | None:
    """Return the depth of the scene's integrator, -1 for no limit; None where it sets none."""
    depth = _setting(own, "max_depth")
    if depth is None:
        return 2 if "Direct" in _description(own) else None
    # Mitsuba stores "no limit" as the largest unsigned integer.
    return -1 if depth >= 2**31 else depth


def _setting(integrator: Any, name: str) -> int | None:
    """Read a setting of an integrator: in its description, C++ integrators do not expose it otherwise."""
    if match := re.search(rf"{name} = (\d+)", _description(integrator)):
        return int(match.group(1))
    own = getattr(integrator, name, None)  # of an integrator written in Python
    return own if isinstance(own, int) else None


def _description(integrator: Any) -> str:
    """Return Mitsuba's description; nothing for an integrator of a user that has none."""
    try:
        return str(integrator)
    except RuntimeError:  # it was written in Python, without to_string
        return ""
