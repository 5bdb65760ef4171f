"""What the metric does beyond first order over the ranges of poses, where single pixels change much."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch

from ..estimation import Stream, TargetedMetric, derived_seeds, render_images, student_t
from ..protocols import Capabilities, Renderer
from ._steps import FALSE_ALARMS, LARGEST_CHANGE, RangeErrors, StepErrors

Tensors = Mapping[str, torch.Tensor]

REPLICATES = 16
# Of the samples of the gradient: some find the poses that are worth more.
PARTS = (1 / 4, 1 / 2)
SUSPICIOUS = LARGEST_CHANGE / 2
UNCLEAR = 2.0  # standard errors, below which neither the effect nor its direction is known


def nonlinear_poses(  # noqa: PLR0913 -- those of the result
    renderer: Renderer,
    metric: TargetedMetric,
    values: Tensors,
    *,
    image: torch.Tensor,
    adjoints: Sequence[torch.Tensor],
    gradients: Tensors,
    errors: Tensors,
    steps: StepErrors,
    local: RangeErrors,
    samples: Mapping[str, float],
    seed: int,
) -> RangeErrors:
    """Compare the gradients of poses with the change of the metric between the ends of their ranges.

    A gradient of a pose is a difference of images over the whole range, or was compared with one, but to first
    order in these. A pixel at the edge of an object may become much brighter or darker, and a rating of glare
    depends on the square of its luminance. The metric is evaluated at the ``image`` of the result plus the
    differences to the images at both ends, which are rendered with common random numbers. ``adjoints`` are those
    of the replicates of the result, ``steps`` the errors of the steps of the poses that have any, ``local`` those
    over the ranges of the others, and ``samples`` the samples per pixel behind the gradients.
    """
    found, poses = RangeErrors(), {}
    ranges = Capabilities(renderer).ranges or {}
    for name in [name for name in (*steps.truncation, *local.errors) if name in ranges]:
        gradient = gradients[name].double()
        gradient = gradient * torch.tensor(steps.kept_directions.get(name, 1.0)).to(gradient)
        length = gradient.norm()
        is_clear = length > UNCLEAR * (errors[name].double() * gradient / length).norm()  # not if it is 0
        if is_clear and name not in steps.jumps:
            low, high = ranges[name]
            poses[name] = _Pose(name, gradient / length, high - low)
    if not poses:
        return found
    ends = _Ends(renderer, metric, metric.transform(image), adjoints, values, seed)
    # The noise of the differences and that of the image are independent: the sum has as many degrees of freedom.
    significant = student_t(1 - FALSE_ALARMS / (len(PARTS) * len(poses)), REPLICATES - 1)
    for name, pose in poses.items():
        effect = pose.range * (gradients[name].double() * pose.direction).sum().item()
        for number, part in enumerate(PARTS):
            change, noise = ends.beyond_first_order(
                pose, number, max(1, math.ceil(part * samples[name] / REPLICATES))
            )
            larger = max(effect, abs(effect + change))
            is_marked = not math.isfinite(change) or (
                abs(change) > significant * noise and abs(change) > LARGEST_CHANGE * larger
            )
            if is_marked or abs(change) <= SUSPICIOUS * larger:
                break
        if is_marked:
            found.marked.append(name)
        else:
            error = math.sqrt(max(0.0, change**2 - noise**2)) / pose.range
            found.errors[name] = (error * pose.direction).to(gradients[name])
    return found


@dataclass(frozen=True)
class _Pose:
    """A pose with the direction of its gradient and the length of its range."""

    name: str
    direction: torch.Tensor
    range: float


class _Ends:
    """The metric at the ends of the ranges of poses."""

    def __init__(
        self,
        renderer: Renderer,
        metric: TargetedMetric,
        image: torch.Tensor,
        adjoints: Sequence[torch.Tensor],
        values: Tensors,
        seed: int,
    ) -> None:
        self._renderer = renderer
        self._metric = metric
        self._image = image
        self._adjoints = adjoints
        self._adjoint = self._evaluate(image)[1]
        self._values = values
        self._seed = seed
        self._unmoved: dict[tuple[int, int], torch.Tensor] = {}

    def beyond_first_order(self, pose: _Pose, number: int, spp: int) -> tuple[float, float]:
        """Return the change of the metric over the range minus that to first order, and its standard error.

        ``number`` tells the random numbers of one call from those of another.
        """
        if (number, spp) not in self._unmoved:
            self._unmoved[number, spp] = self._render(self._values, number, spp)
        unmoved = self._unmoved[number, spp]
        step = pose.range / 2 * pose.direction.to(self._values[pose.name])
        half = REPLICATES // 2
        changes, rows, seen = [], [], []
        for sign in (1, -1):
            point = {**self._values, pose.name: self._values[pose.name] + sign * step}
            differences = self._render(point, number, spp)
            differences -= unmoved
            image, change, adjoint = self._beyond(differences, unmoved)
            parts = [
                self._beyond(differences[part], unmoved[part])[1] for part in (slice(half), slice(half, None))
            ]
            changes.append(sign * torch.tensor([change, *parts], dtype=torch.float64))
            rows.append(sign * torch.stack([_inner_product(adjoint, one) for one in differences]))
            seen.append(image)
        whole, *halves = torch.stack(changes).sum(0).tolist()
        of_differences = max(_error_of_mean(rows[0] + rows[1]), abs(halves[0] - halves[1]) / 2)
        # The noise of the image is in the adjoints, and in the gradient.
        of_image = _error_of_mean(
            torch.stack([_inner_product(one, seen[0] - seen[1]) for one in self._adjoints])
        )
        drift = sum(halves) / 2 - whole  # a change that is due to noise is less with more samples
        return whole, math.hypot(of_differences, of_image, drift)

    def _render(self, values: Tensors, number: int, spp: int) -> torch.Tensor:
        seeds = derived_seeds(self._seed, Stream.RANGE_CHANGES, REPLICATES, number)
        return torch.stack(render_images(self._renderer, values, seeds, spp))

    def _beyond(
        self, differences: torch.Tensor, unmoved: torch.Tensor
    ) -> tuple[torch.Tensor, float, torch.Tensor]:
        """Return the image plus a mean difference, the metric there beyond first order, and its derivative."""
        difference, rest = differences.mean(0), unmoved.mean(0)
        # A difference between other images could make a dark pixel negative.
        darker = self._image * (1 + difference / rest.clamp_min(torch.finfo(rest.dtype).tiny)).clamp(0, 1)
        image = torch.where(difference < 0, darker, self._image + difference)
        value, adjoint = self._evaluate(image)
        first_order = _inner_product(self._adjoint, image - self._image).item()
        return image, value - first_order, adjoint - self._adjoint

    def _evaluate(self, image: torch.Tensor) -> tuple[float, torch.Tensor]:
        """Return the metric at an image without the transform, and its derivative, 0 if it has none."""
        value, adjoint = self._metric.value_and_derivative(image)
        return value, torch.zeros_like(image) if adjoint is None else adjoint


def _inner_product(left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
    return (left.double() * right.double()).sum()


def _error_of_mean(rows: torch.Tensor) -> float:
    return (rows.std() / math.sqrt(len(rows))).item()
