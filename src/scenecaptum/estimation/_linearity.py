"""Whether a metric is linear: then its adjoint is known, and noise of the image causes no bias."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from ._metric import TargetedMetric


def is_linear(metric: TargetedMetric, images: Sequence[torch.Tensor]) -> bool:
    """Whether a metric has the same adjoint at two different images; the second may be derived from the first.

    A metric without a derivative counts as non-linear.
    """
    first = images[0]
    metric = metric.with_few_draws()  # noise is no reason for being linear or not
    darker = torch.lerp(first, first.roll(1, 0), 0.5) / 2
    other = next((image for image in images[1:] if not torch.equal(image, first)), darker)
    adjoint, other_adjoint = (metric.value_and_derivative(image)[1] for image in (first, other))
    if adjoint is None or other_adjoint is None:
        return False
    return is_rounding(other_adjoint - adjoint, adjoint)


def is_rounding(difference: torch.Tensor, of: torch.Tensor) -> bool:
    return bool(difference.double().norm() <= 1e-5 * of.double().norm())
