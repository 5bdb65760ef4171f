"""Errors from the steps of the finite differences of poses, and jumps that have no derivative."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch

from ..estimation import Stream, derived_seeds, student_t
from ..protocols import Capabilities, Renderer

Tensors = Mapping[str, torch.Tensor]

REPLICATES = 8
DIFFERENCE_SPP_DIVISOR = 4  # samples of a difference, as in the backward passes of the renderer
# Of all tests of the steps, and of all tests over the ranges, if noise is normal. Means of few skewed numbers are
# as far off up to ten times as often.
FALSE_ALARMS = 0.001
# A gradient that changes by more than this part of itself where its step is doubled is not near its limit. Across
# a jump it halves.
LARGEST_CHANGE = 0.3


@dataclass(frozen=True)
class StepErrors:
    """What doubling the steps says about the gradients of poses.

    Attributes
    ----------
    truncation
        Estimated errors of the gradients, due to their steps.
    jumps
        The poses without a derivative, each with the reason.
    kept_directions
        For other poses some directions of which have none: 1 for each direction that has one, or 0. The others
        matter less than these, and are left out.
    left_out_directions
        The reasons why they are left out.
    """

    truncation: dict[str, torch.Tensor] = field(default_factory=dict)
    jumps: dict[str, str] = field(default_factory=dict)
    kept_directions: dict[str, list[float]] = field(default_factory=dict)
    left_out_directions: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class RangeErrors:
    """By how much the gradients of poses differ from the changes over their ranges.

    Attributes
    ----------
    marked
        The poses of which the difference is large and clear of noise.
    errors
        The differences per unit of other poses, each along its own gradient.
    changes
        Of marked poses the change over the range in the direction of the gradient, and its error.
    """

    marked: list[str] = field(default_factory=list)
    errors: dict[str, torch.Tensor] = field(default_factory=dict)
    changes: dict[str, tuple[float, float]] = field(default_factory=dict)


def step_errors(
    renderer: Renderer,
    gradients: Tensors,
    values: Tensors,
    adjoint: torch.Tensor,
    samples: Mapping[str, float],
    seed: int,
) -> StepErrors:
    """Compare the gradients of poses with those at twice the step.

    The mean of a smooth derivative over ``±h`` differs from its value in the middle by ``c h²``, and over ``±2h``
    by ``4 c h²``: the error is a third of the change. ``adjoint`` and ``gradients`` are those of the result, and
    ``samples`` the samples per pixel behind the gradients of the parameters to check.
    """
    measure = Capabilities(renderer).step_changes
    if measure is None:
        return StepErrors()
    seeds = derived_seeds(seed, Stream.STEP_CHANGES, REPLICATES)
    by_spp = defaultdict(list)
    for name, count in samples.items():
        by_spp[max(1, math.ceil(count / (REPLICATES * DIFFERENCE_SPP_DIVISOR)))].append(name)
    measured = {
        name: changes
        for spp, names in by_spp.items()
        for name, changes in measure(values, adjoint, seeds=seeds, spp=spp, names=names).items()
    }
    found = StepErrors()
    significant = _significant(sum(changes[0].numel() for changes in measured.values()))
    for name, changes in measured.items():
        change = changes.double().mean(0)
        noise = changes.double().var(0) / len(changes)
        found.truncation[name] = ((change.square() - noise).clamp_min(0).sqrt() / 3).to(gradients[name])
        gradient = gradients[name].double()
        larger = torch.maximum(gradient.abs(), (gradient + change).abs())
        is_far = (change.abs() > significant * noise.sqrt()) & (change.abs() > LARGEST_CHANGE * larger)
        # What hardly matters beside the other directions does not make the whole pose a jump.
        is_far &= change.abs() > LARGEST_CHANGE * gradient.norm() / 2
        if not is_far.any():
            continue
        reason = _reason(renderer, name, is_far)
        if gradient[is_far].norm() < gradient[~is_far].norm():
            found.kept_directions[name] = (~is_far).double().tolist()
            found.left_out_directions[name] = reason
        else:
            found.jumps[name] = reason
    return found


def local_poses(
    renderer: Renderer,
    gradients: Tensors,
    errors: Tensors,
    values: Tensors,
    adjoint: torch.Tensor,
    samples: Mapping[str, float],
    seed: int,
) -> RangeErrors:
    """Compare the gradients of poses that are exact at their values with those over their ranges.

    Turning a camera moves the picture by several pixels over the range. Where the metric looks at edges, as a
    rating of glare does, or a network, the first fraction of a pixel does not say what the others do. The changes
    are to first order in the picture.
    """
    found = RangeErrors()
    measure, ranges = Capabilities(renderer).range_changes, Capabilities(renderer).ranges or {}
    lengths = {name: gradient.double().norm() for name, gradient in gradients.items() if name in samples}
    directions = {name: gradients[name].double() / length for name, length in lengths.items() if length > 0}
    if measure is None or not directions:
        return found
    spp = max(1, math.ceil(max(samples[name] for name in directions) / (REPLICATES * DIFFERENCE_SPP_DIVISOR)))
    seeds = derived_seeds(seed, Stream.RANGE_CHANGES, REPLICATES)
    measured = measure(values, directions, adjoint, seeds=seeds, spp=spp)
    significant = _significant(len(measured))
    for name, rows in measured.items():
        mean, noise = rows.mean(), rows.std() / math.sqrt(len(rows))
        change = (mean - lengths[name]).abs()
        error = torch.hypot(noise, (errors[name].double() * directions[name]).norm())
        larger = torch.maximum(lengths[name], mean.abs())
        if change > significant * error and change > LARGEST_CHANGE * larger:
            found.marked.append(name)
            low, high = ranges[name]
            found.changes[name] = (high - low) * mean.item(), (high - low) * noise.item()
        else:
            beyond_noise = (change.square() - error.square()).clamp_min(0).sqrt()
            found.errors[name] = (beyond_noise * directions[name]).to(gradients[name])
    return found


def _significant(tests: int) -> float:
    """Return how many standard errors a change must have, so that few of all tests of a result are false alarms.

    By Student's t, with Bonferroni's correction: of many directions, one would exceed a fixed threshold by chance.
    """
    return student_t(1 - FALSE_ALARMS / max(1, tests), REPLICATES - 1)


def _reason(renderer: Renderer, name: str, is_far: torch.Tensor) -> str:
    axes = (
        ""
        if not is_far.ndim
        else " along " + ", ".join(a for a, far in zip("xyz", is_far.tolist(), strict=True) if far)
    )
    near = (Capabilities(renderer).touching or (lambda _: []))(name)
    cause = f": {', '.join(near[:3])} {'is' if len(near) == 1 else 'are'} near" if near else ""
    # The gradient is compared with a difference over twice the range, where the contact may be.
    return f"the effect jumps or bends{axes} within twice the range{cause}"
