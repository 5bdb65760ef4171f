"""What the metric does beyond first order over the ranges of poses, where single pixels change much."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import torch

from ..estimation import Stream, TargetedMetric, derived_seeds, render_images, student_t
from ..protocols import Capabilities, Renderer
from ._steps import FALSE_ALARMS, LARGEST_CHANGE, RangeErrors

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
    kept: Mapping[str, Sequence[float] | float],
    marked: Collection[str],
    samples: Mapping[str, float],
    seed: int,
) -> RangeErrors:
    """Compare the gradients of poses with the change of the metric between the ends of their ranges.

    A gradient of a pose is a difference of images over the whole range, or was compared with one, but to first
    order in these. A pixel at the edge of an object may become much brighter or darker, and a rating of glare
    depends on the square of its luminance. The metric is evaluated at the ``image`` of the result plus the
    differences to the images at both ends, which are rendered with common random numbers. ``adjoints`` are those
    of the replicates of the result, and ``samples`` the samples per pixel behind the gradients. ``kept`` has the
    poses that have a gradient, with 1 for each direction that counts, or 0. Those that are ``marked`` anyway get a
    change over their range, too.
    """
    found, poses = RangeErrors(), {}
    ranges = Capabilities(renderer).ranges or {}
    for name in [name for name in kept if name in ranges]:
        gradient = gradients[name].double()
        gradient = gradient * torch.tensor(kept[name]).to(gradient)
        length = gradient.norm()
        is_clear = length > UNCLEAR * (errors[name].double() * gradient / length).norm()  # not if it is 0
        if is_clear or name in marked:
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
            beyond, whole = ends.changes(pose, number, max(1, math.ceil(part * samples[name] / REPLICATES)))
            change, noise = beyond
            larger = max(effect, abs(effect + change))
            is_marked = not math.isfinite(change) or (
                abs(change) > significant * noise and abs(change) > LARGEST_CHANGE * larger
            )
            if is_marked or abs(change) <= SUSPICIOUS * larger:
                break
        if is_marked and name not in marked:
            found.marked.append(name)
        if is_marked or name in marked:
            found.changes[name] = whole
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

    def changes(self, pose: _Pose, number: int, spp: int) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the change of the metric over the range beyond first order, and the whole, each with its error.

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
            image, both, adjoint = self._at(differences, unmoved)
            parts = [
                self._at(differences[part], unmoved[part])[1] for part in (slice(half), slice(half, None))
            ]
            changes.append(sign * torch.tensor([both, *parts], dtype=torch.float64))
            rows.append(
                [
                    sign * torch.stack([_inner_product(of, one) for one in differences])
                    for of in (adjoint - self._adjoint, adjoint)
                ]
            )
            seen.append(image)
        # The noise of the image is in the adjoints, and in the gradient.
        of_image = _error_of_mean(
            torch.stack([_inner_product(one, seen[0] - seen[1]) for one in self._adjoints])
        )
        beyond, whole = (
            _with_error(summed, first + second, of_image)
            for summed, first, second in zip(torch.stack(changes).sum(0).T.tolist(), *rows, strict=True)
        )
        return beyond, whole

    def _render(self, values: Tensors, number: int, spp: int) -> torch.Tensor:
        seeds = derived_seeds(self._seed, Stream.RANGE_CHANGES, REPLICATES, number)
        return torch.stack(render_images(self._renderer, values, seeds, spp))

    def _at(
        self, differences: torch.Tensor, unmoved: torch.Tensor
    ) -> tuple[torch.Tensor, tuple[float, float], torch.Tensor]:
        """Return the image plus a mean difference, the metric there, and its derivative.

        The metric is that beyond first order, and the whole.
        """
        difference, rest = differences.mean(0), unmoved.mean(0)
        # A difference between other images could make a dark pixel negative.
        darker = self._image * (1 + difference / rest.clamp_min(torch.finfo(rest.dtype).tiny)).clamp(0, 1)
        image = torch.where(difference < 0, darker, self._image + difference)
        value, adjoint = self._evaluate(image)
        first_order = _inner_product(self._adjoint, image - self._image).item()
        return image, (value - first_order, value), adjoint

    def _evaluate(self, image: torch.Tensor) -> tuple[float, torch.Tensor]:
        """Return the metric at an image without the transform, and its derivative, 0 if it has none."""
        value, adjoint = self._metric.value_and_derivative(image)
        return value, torch.zeros_like(image) if adjoint is None else adjoint


def _inner_product(left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
    return (left.double() * right.double()).sum()


def _with_error(changes: Sequence[float], rows: torch.Tensor, of_image: float) -> tuple[float, float]:
    """Return a change, given with those of both halves of the samples, and its standard error."""
    whole, *halves = changes
    of_differences = max(_error_of_mean(rows), abs(halves[0] - halves[1]) / 2)
    drift = sum(halves) / 2 - whole  # a change that is due to noise is less with more samples
    return whole, math.hypot(of_differences, of_image, drift)


def _error_of_mean(rows: torch.Tensor) -> float:
    return (rows.std() / math.sqrt(len(rows))).item()
