"""``explain``: attribute, find the causes, and render the changes that matter."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch

from ..attr import Change, Definition, Explanation, SceneAttribution, VanillaSceneGradient
from ..daylight import AnnualSunlightExposure, DaylightMetric
from ..denoising import denoise as denoised
from ..denoising import guides_of
from ..errors import whole_number
from ..estimation import (
    DEFAULT_REPLICATES,
    THIS_METRIC,
    TOO_NOISY,
    Denoise,
    Metric,
    Stream,
    Target,
    at_values,
    derived_seeds,
    input_values,
)
from ..metrics import (
    DaylightGlareProbability,
    GlareRating,
    UnifiedGlareRating,
    Uniformity,
    VerticalIlluminance,
)
from ..optimize import Optimization, Search, SearchOptions, warn_if_more_is_better
from ..projection import SurfaceMap
from ..protocols import Capabilities, Renderer
from ..rendering import Reflection, SceneRenderer
from ..validation import Scenes, denoise_of
from ..visualization import Format, advised, cautions_among, rounded
from ._changes import propose, rendered, why_none
from ._definition import definition_of, states_definition
from ._rows import find_rows, is_of_daylight
from ._sources import find_sources
from ._threshold import (
    EdgeLoss,
    Lamps,
    edge_loss,
    has_absolute_threshold,
    is_near_threshold,
    lamp_edge_notes,
    relative_rating,
    relative_sentence,
    single_sample_notes,
    threshold_notes,
)

# Where the fit of Wienold and Christoffersen (2006) holds: DGP, and lux at the eye.
DGP_VALUES, DGP_ILLUMINANCE = (0.2, 0.8), 380.0
# Irradiance under a sky of radiance 1, relative to that in the open: 10 lx of an overcast 10 000 lx.
DARK = 1e-3
POINT_LAMPS = "the scene's point, spot and IES lamps have no area: they are not visible and not rated"
NOISY_MINIMUM = 0.05  # the error of a uniformity, relative to it
AT_THE_GOAL = "at the goal"
STEPS_ALONE = 12  # of the leading parameter: with ten it reaches the limit of its change


def explain(  # noqa: PLR0913 -- those of attributing and of optimizing
    renderer: Renderer,
    metric: Metric,
    inputs: Mapping[str, torch.Tensor] | None = None,
    *,
    target: Target = None,
    below: float | None = None,
    changes: int = 3,
    seed: int = 0,
    spp: int | None = None,
    replicates: int = DEFAULT_REPLICATES,
    denoise: Denoise = "auto",
    show_progress: bool = False,
) -> Explanation:
    """Explain a metric of a scene: its value and class, its causes, and the few changes that matter.

    The changes are single steps of a tenth of a parameter's range, or of a quarter of an unbounded value, in the
    direction that improves the metric: down if there is a goal, and up if neither is better. Objects are moved
    horizontally and turned about the vertical. The effects are predicted from the gradient, and measured by
    rendering the changed scenes with common random numbers and seeds of their own.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", inputs="all", resolution=(16, 16), spp=64)
    >>> print(explain(renderer, metrics.MeanLuminance(), changes=1))  # doctest: +SKIP

    Parameters
    ----------
    renderer, metric, inputs, target, seed, spp, replicates, denoise, show_progress
        As for ``VanillaSceneGradient``.
    below
        A goal for ``optimize.minimize``, which changes the leading parameter alone if that is enough. A metric of
        which more is better, such as an illuminance, has a warning.
    changes
        The number of changes to render.

    Returns
    -------
    Explanation
        Its ``text()`` and ``markdown()`` are the sentences.

    Raises
    ------
    SceneCaptumError
        As ``VanillaSceneGradient`` and ``optimize.minimize``.
    """
    if below is not None:
        warn_if_more_is_better(metric, target, below)
    attribution_seed, scenes_seed, goal_seed = derived_seeds(seed, Stream.EXPLANATION, 3)
    attribution = VanillaSceneGradient(renderer, metric).attribute(
        inputs,
        target=target,
        seed=attribution_seed,
        spp=spp,
        replicates=replicates,
        denoise=denoise,
        show_progress=show_progress,
    )
    attribution = dataclasses.replace(attribution, info={**attribution.info, "explanation_seed": seed})
    values = input_values(renderer, inputs)
    better = (attribution.info.get("measure") or {}).get("better")
    lowers = better == "lower" or below is not None
    count = whole_number("changes", changes, 0)
    proposed = propose(renderer, attribution, values, -1 if lowers else 1, count)
    scenes = Scenes(
        renderer,
        metric,
        target,
        seed=scenes_seed,
        spp=spp,
        replicates=replicates,
        denoise=denoise_of(attribution),
        values=inputs,
    )
    grid = renderer.grid if is_of_daylight(scenes.metric) and isinstance(renderer, SceneRenderer) else None
    goal = None
    if below is not None:
        search = Search(
            renderer,
            metric,
            inputs=inputs,
            target=target,
            seed=goal_seed,
            spp=spp,
            denoise=denoise,
            ranked=attribution,
        )
        goal = _reach(below, search, show_progress=show_progress)
    picture = scenes.images.mean(0)
    # Of the pictures from which the changes are measured: before and after are values of the same points.
    definition = (
        definition_of(scenes.metric, scenes.images) if states_definition(scenes.metric, picture) else None
    )
    if definition is not None:
        attribution = _with_caution_of_relaxed(attribution)
    # What the notes are of, a plan draws and the rows count is what the quoted value is of.
    assert attribution.image is not None, "every attribution of a gradient method has its image"
    value, error = attribution.metric_value, attribution.metric_standard_error
    of_value, other = attribution.image, picture
    if definition is not None:
        value, error = definition.value, definition.error
        of_value, other = picture, attribution.image
    shown = scenes.metric.transform(of_value)
    is_doubted = bool(attribution.untrusted_errors())
    premises = photometric_premises(
        metric, of_value, value, error, shown, renderer, values, is_doubted=is_doubted
    )
    scene = renderer if isinstance(renderer, SceneRenderer) else None
    light = scene.direct_light(values) if scene else {}
    lamps, loss, is_rated = Lamps({}, {}, {}), EdgeLoss.nothing(), True
    if isinstance(metric, GlareRating):
        lamps = Lamps.of(scene, values) if scene else lamps
        loss = edge_loss(metric, scenes.metric.transform(picture), lamps)
        # In other renders, single samples may pass the threshold.
        is_rated = bool(metric.sources(shown)) and value != 0
        light = _with_reflections(light, lamps.reflected)
        premises += single_sample_notes(metric, shown, scenes.metric.transform(other))
        if goal is not None and goal.moved:
            premises += _said_of(goal, scenes, metric, shown)
    surfaces = _surfaces(renderer, attribution) if is_rated else None
    sources = find_sources(scenes.metric, scenes.images, surfaces, lamps.small, light, loss.reflected)
    return Explanation(
        attribution,
        rows=() if grid is None else find_rows(scenes.metric, scenes.images, grid, of_value),
        definition=definition,
        premises=premises,
        sources=sources,
        changes=_rendered(scenes, proposed, definition, metric),
        no_changes=why_none(attribution) if count and not proposed else "",
        not_in_sources=loss.reflections,
        goal=goal,
        picture=of_value,
    )


def _with_caution_of_relaxed(attribution: SceneAttribution) -> SceneAttribution:
    """Say that a caution on noise is on the relaxed value, where the value by the definition stands beside it."""
    picture = attribution.info["picture"]
    if TOO_NOISY not in (picture["caution"] or ""):
        return attribution
    caution = picture["caution"].replace(f"{TOO_NOISY} {THIS_METRIC}", f"{TOO_NOISY} the relaxed value")
    return dataclasses.replace(
        attribution, info={**attribution.info, "picture": {**picture, "caution": caution}}
    )


def _reach(below: float, search: Search, *, show_progress: bool) -> Optimization:
    """Search with the leading parameter alone, and with more where that is not enough."""
    alone = search.to(below, SearchOptions(top=1, steps=STEPS_ALONE), show_progress=show_progress)
    if alone.reached:
        return alone
    more = search.to(below, SearchOptions(), show_progress=show_progress)
    return more if more.reached else min(more, alone, key=lambda found: found.after.order)


def _said_of(
    goal: Optimization, scenes: Scenes, metric: GlareRating, before: torch.Tensor
) -> tuple[str, ...]:
    """Return what the rating of a design owes to the threshold, and what it lacks of lamps below a pixel.

    A source that the design dims may not count any more.
    """
    after = at_values(scenes.metric, scenes.renderer, goal.values).transform(goal.after.image)
    said = []
    if metric.threshold_factor is None and any(is_near_threshold(metric, one) for one in (before, after)):
        said.append(relative_sentence(metric, after, Format.of(goal.after.value, goal.after.error)))
    if isinstance(scenes.renderer, SceneRenderer):
        said += cautions_among(_edge_notes(metric, after, scenes.renderer, goal.values))
    whose = AT_THE_GOAL if goal.reached else "of the design that was tried"
    return tuple(f"{whose}: {text}" for text in said)


def _with_reflections(
    light: Mapping[str, torch.Tensor], reflected: Mapping[str, Reflection]
) -> dict[str, torch.Tensor]:
    """Return the light of objects with that of reflections, which more rays meet."""
    found = dict(light)
    for name, one in reflected.items():
        own = one.radiance * one.fraction[..., None]
        found[name] = torch.maximum(found[name], own) if name in found else own
    return found


def _edge_notes(
    metric: GlareRating,
    image: torch.Tensor,
    renderer: SceneRenderer,
    values: Mapping[str, torch.Tensor] | None,
) -> list[str]:
    return lamp_edge_notes(metric, image, Lamps.of(renderer, values))


def missing_at_edges(
    metric: Metric, image: torch.Tensor, renderer: Renderer, values: Mapping[str, torch.Tensor]
) -> float:
    """Return how much a rating lacks of lamps that cover pixels in part; 0 where it is none of glare."""
    if not isinstance(metric, GlareRating) or not isinstance(renderer, SceneRenderer):
        return 0.0
    return edge_loss(metric, image, Lamps.of(renderer, values)).missing


def _rendered(
    scenes: Scenes, proposed: Sequence[Change], definition: Definition | None, metric: Metric
) -> tuple[Change, ...]:
    """Return the changes with their effects of rendering them, also on what a glare rating lacks."""
    if not isinstance(metric, GlareRating):
        return tuple(rendered(scenes, one, definition)[0] for one in proposed)

    def rate(images: torch.Tensor, values: Mapping[str, torch.Tensor]) -> tuple[float, float]:
        """Return what the rating of a picture lacks, and the rating by the other usual threshold."""
        shown = at_values(scenes.metric, scenes.renderer, values).transform(images.mean(0))
        return missing_at_edges(metric, shown, scenes.renderer, values), relative_rating(metric, shown)

    before = rate(scenes.images, scenes.values) if proposed else (0.0, 0.0)
    # The definition of a rating is stated only near its threshold.
    is_near = definition is not None and has_absolute_threshold(metric)
    found = []
    for one in proposed:
        change, images = rendered(scenes, one, definition)
        missing, relative = np.subtract(rate(images, {**scenes.values, one.name: one.after}), before).tolist()
        found.append(dataclasses.replace(change, missing=missing, relative=relative if is_near else None))
    return tuple(found)


def rated_image(attribution: SceneAttribution, renderer: Renderer) -> torch.Tensor:
    """Return the picture of a result that its metric rated: the denoised one where its value is of that."""
    image = attribution.image
    assert image is not None, "every attribution of a SceneRenderer has its image"
    if not (attribution.info.get("picture") or {}).get("denoised"):
        return image
    return denoised(image, guides_of(renderer, values_of(attribution, renderer)))


def values_of(attribution: SceneAttribution, renderer: Renderer) -> dict[str, torch.Tensor]:
    """Return the values of a result but those of textures, of which it keeps the means; no pose is one."""
    own = Capabilities(renderer).inputs or {}
    return {
        name: value.reshape(own[name].shape)
        for name, value in attribution.parameter_values.items()
        if name in own and own[name].numel() == value.numel()
    }


def photometric_premises(
    metric: Metric,
    image: torch.Tensor,
    value: float,
    error: float | None,
    shown: torch.Tensor | None = None,
    renderer: Renderer | None = None,
    values: Mapping[str, torch.Tensor] | None = None,
    *,
    is_doubted: bool = False,
) -> tuple[str, ...]:
    """Return what a photometric metric of a picture takes for granted of the scene.

    ``value`` and ``error`` are those that it stands beside. ``shown`` is the picture that is rated, if that is
    denoised; ``renderer`` knows the lamps of the scene, which are as in ``values``. ``is_doubted`` says that error
    bars of effects are unreliable: few samples find some of the light, which points may lack in all replicates.
    """
    premises = []
    efficacy = getattr(metric, "efficacy", 1)
    if efficacy != 1 and not isinstance(metric, DaylightMetric):
        premises.append(
            f"valid if the scene's lights are in W/(m² sr); {efficacy:g} lm/W make them luminances"
        )
    if isinstance(metric, DaylightMetric):
        # The coefficients of exposure to the sun are of direct light alone.
        if not isinstance(metric, AnnualSunlightExposure) and image.sum(1).max() < DARK * math.pi:
            premises.append("almost no light of the sky reaches the points: what covers the windows?")
        premises += filter(None, [metric.in_words(image)])
    if isinstance(metric, Uniformity) and (is_doubted or (error or 0.0) > NOISY_MINIMUM * value):
        premises.append(
            advised(
                "caution: noise lowers the smallest illuminance, so that the uniformity may be too low and its "
                "error too small",
                "use more samples",
            )
        )
    if isinstance(metric, UnifiedGlareRating):
        premises.append(
            "UGR and its limits are for luminaires; a window is rated by the daylight glare probability (DGP)"
        )
    rated = image if shown is None else shown
    edges = []
    if isinstance(metric, GlareRating) and isinstance(renderer, SceneRenderer):
        edges = _edge_notes(metric, rated, renderer, values)
    premises += threshold_notes(metric, rated, Format.of(value, error), explained=bool(edges))
    if isinstance(metric, VerticalIlluminance) and not metric.camera.sees_hemisphere:
        premises.append(
            advised(
                f"only light from within the camera's field of view of {metric.camera.fov:.0f}° counts",
                "for all light that reaches the eye, use a fisheye camera",
            )
        )
    if isinstance(metric, GlareRating) and isinstance(renderer, SceneRenderer):
        premises += [POINT_LAMPS] if renderer.has_point_lamps else []
        premises += edges
    if isinstance(metric, DaylightGlareProbability):
        premises += _validity(value, VerticalIlluminance(metric.camera, metric.efficacy)(image).item())
    return tuple(premises)


def _validity(value: float, lux: float) -> list[str]:
    """Return the vertical illuminance, and a caution where a daylight glare probability is not valid."""
    low, high = DGP_VALUES
    outside = [
        *([f"DGP is {value:.2f}"] if not low <= value <= high else []),
        *([f"there are {lux:.0f} lx"] if lux <= DGP_ILLUMINANCE else []),
    ]
    valid = f"DGP is valid from {low:g} to {high:g}, and above {DGP_ILLUMINANCE:g} lx at the eye"
    return [
        f"vertical illuminance at the eye: {rounded(lux)} lx",
        *([f"caution: {valid}; here {' and '.join(outside)}"] if outside else []),
    ]


def _surfaces(renderer: Renderer, attribution: SceneAttribution) -> SurfaceMap | None:
    """Return what each pixel shows, through glass and in mirrors if the renderer can tell."""
    trace = Capabilities(renderer).see_through
    found: SurfaceMap | None = None if trace is None else trace((), attribution.parameter_values)
    return attribution.surfaces if found is None else found
