"""Changes of single parameters that a user might make, predicted from the gradient."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

import torch

from ..attr import Change, Definition, SceneAttribution
from ..estimation import at_values, channel_totals, difference_by_definition
from ..metrics import NO_SOURCE
from ..optimize import BOUND_MARGIN, construction, design_bounds, first_of_each_light
from ..protocols import Capabilities, RankedParameter, Renderer
from ..scene import clamp_inside, pose_component
from ..validation import Scenes
from ..visualization import verdict

STEP = 0.1  # of a bounded range
DIMMING = 0.25  # of an unbounded value, such as a radiance
MIN_STEP = 0.02  # of a range: a shorter step to a bound is no proposal
SIGNIFICANT = 2.0  # standard errors
# Of objects, which stay upright.
CHANGES_OF_POSES = {"translation": "move along the floor", "rotation": "turn about the vertical"}


def propose(
    renderer: Renderer,
    attribution: SceneAttribution,
    values: Mapping[str, torch.Tensor],
    sign: int,
    count: int,
) -> list[Change]:
    """Return the ``count`` single changes with the largest predicted effect of this sign, clear of the noise.

    Without error bars, of a single replicate, none is.
    """
    if attribution.covariance is None:
        return []
    ranges = Capabilities(renderer).ranges or Capabilities(renderer).bounds or {}
    bounds = design_bounds(renderer, values)
    unlimited = (-math.inf, math.inf)
    fixed = construction(renderer)
    changes = []
    for row in attribution.ranking():
        if row.name in fixed:
            continue
        value = values[row.name]
        direction = sign if row.effect > 0 else -sign
        low, high = bounds.get(row.name, unlimited)
        over = ranges.get(row.name, unlimited)
        after: torch.Tensor | None
        if row.name in attribution.vectors:
            # Half of its range, in the direction of its largest effect that leaves furniture on the floor.
            step = attribution.weights("range")[row.name].to(value)
            after = value + sign / 2 * _upright(row.name, step, Capabilities(renderer).up)
        else:
            after = _moved(value, direction, over, (low, high))
        if after is None:
            continue
        predicted, error = _predict(attribution, row.name, value, after)
        if abs(predicted) > SIGNIFICANT * error:
            changes.append(Change(row.name, row.label, value, after, predicted, error))
    return first_of_each_light(sorted(changes, key=lambda change: -abs(change.predicted)))[:count]


def why_none(attribution: SceneAttribution) -> str:
    """Return why there is no change to propose."""
    ranking = attribution.ranking()
    if not ranking:
        why = "nothing here has a derivative to predict it from"
    elif verdict(attribution) == NO_SOURCE:
        why = "nothing counts as a glare source, so that no small change affects the rating"
    elif not any(row.saliency or row.saliency_error for row in ranking):
        why = "every predicted effect is 0"
    elif attribution.covariance is None:
        why = "without error bars no effect is known to be clear of its noise"
    else:
        moved, others = _considered(attribution)
        unclear = "has a predicted effect that is clear of its noise"
        if any(_is_clear(row) and row.name not in attribution.vectors for row in ranking):
            why = "what has a clear effect is part of the construction, off, or as far as it can go"
            why += f", and {_listed(moved)} {unclear}" if moved else ""
        elif moved:
            why = f"{_listed([*moved, *(['no change of another parameter'] if others else [])])} {unclear}"
        else:
            why = f"no single one {unclear}"
    return f"no change is proposed: {why}"


def _considered(attribution: SceneAttribution) -> tuple[list[str], bool]:
    """Return the changes of objects that stay upright, each as what there is none of, and if there are others."""
    names = [row.name for row in attribution.ranking()]
    upright = [name for name in names if _is_kept_upright(name, attribution.info["up"])]
    components = {pose_component(name) for name in upright}
    moved = [f"no {change}" for component, change in CHANGES_OF_POSES.items() if component in components]
    return moved, len(upright) < len(names)


def _listed(items: Sequence[str]) -> str:
    return " and ".join([*filter(None, [", ".join(items[:-1])]), items[-1]])


def _is_clear(row: RankedParameter) -> bool:
    return row.effect_error is not None and abs(row.effect) > SIGNIFICANT * row.effect_error


def rendered(scenes: Scenes, change: Change, definition: Definition | None) -> tuple[Change, torch.Tensor]:
    """Return the change with its effect of rendering the changed scene, and the renders.

    Where a value by the definition is given, the change also has its effect on that.
    """
    changes = {change.name: change.after}
    images = scenes.render(changes)
    measured, error = scenes.difference(images, changes)
    change = dataclasses.replace(
        change, measured=measured, measured_error=error, degrees_of_freedom=len(images) - 1
    )
    if definition is None:
        return change, images
    changed = at_values(scenes.metric, scenes.renderer, {**scenes.values, **changes})
    by_definition = difference_by_definition(scenes.metric, changed, (scenes.images, images))
    assert by_definition is not None, "there is one of the scene as it is"
    exact, exact_error = definition.value + by_definition[0], by_definition[1]
    return dataclasses.replace(change, exact=exact, exact_error=exact_error), images


def _moved(
    value: torch.Tensor, direction: int, over: tuple[float, float], bounds: tuple[float, float]
) -> torch.Tensor | None:
    """Return the value after a step in a direction; None if a bound is too near."""
    length = over[1] - over[0]
    if not math.isfinite(length):
        moved = value * (1 + direction * DIMMING)
        return moved if bool(value.any()) else None
    moved = clamp_inside(value + direction * STEP * length, value, *bounds, BOUND_MARGIN * length)
    return moved if (moved - value).abs().mean() >= MIN_STEP * length else None


def _upright(name: str, step: torch.Tensor, up: int | None) -> torch.Tensor:
    """Return a step of the same length that moves an object horizontally, or turns it about the vertical."""
    if up is None or not _is_kept_upright(name, up):
        return step
    is_vertical = torch.arange(len(step), device=step.device) == up
    kept = torch.where(is_vertical == (pose_component(name) == "rotation"), step, 0.0)
    longer: torch.Tensor = step.norm() / kept.norm().clamp_min(1e-12)
    return kept * longer


def _is_kept_upright(name: str, up: int | None) -> bool:
    """Whether an object moves horizontally only, or turns about the vertical only."""
    return up is not None and pose_component(name) in CHANGES_OF_POSES and not name.startswith("camera.")


def _predict(
    attribution: SceneAttribution, name: str, value: torch.Tensor, after: torch.Tensor
) -> tuple[float, float]:
    """Return the first-order effect of a step and its standard error."""
    step = after - value
    predicted = (attribution[name].double() * step).sum().item()
    in_proportion = attribution.info["proportional_errors"]
    if name in in_proportion and any(torch.equal(after, value * (1 + s * DIMMING)) for s in (-1, 1)):
        return predicted, DIMMING * in_proportion[name]
    # Near a bound the texels of a texture move by different amounts; the error is that of their mean.
    mean = channel_totals(step).double() / max(1, step.numel() // max(1, len(channel_totals(step))))
    assert attribution.covariance is not None
    variance = mean @ attribution.covariance[name].double() @ mean
    return predicted, math.sqrt(max(0.0, variance.item()))
