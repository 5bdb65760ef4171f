"""The metric's value and adjoint images, with what is known of their errors."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ._metric_image import IDENTITY, ImageTransform


def error_parts(bias: float, denoiser: float, noise: torch.Tensor) -> torch.Tensor:
    """Return the parts of a metric's standard error, as in ``Adjoints``."""
    return torch.cat([torch.tensor([bias, denoiser], dtype=torch.float64), noise.double()])


@dataclass(frozen=True)
class Adjoints:
    """The metric's value and adjoint images, estimated from the primal images."""

    value: float  # of the metric at the mean image
    standard_error: float | None  # estimated by the jackknife; includes the bias; None for a single replicate
    bias: float | None  # the remaining one, due to the finite number of samples; None for a single replicate
    per_replicate: tuple[torch.Tensor, ...]  # the adjoint image for each backward pass
    # Biases of the adjoint: of the finite number of samples, and of the denoiser or its absence; none for a linear
    # metric or a single replicate.
    bias_adjoints: tuple[torch.Tensor, ...]
    # The metric at half of the samples minus that at all samples, on average, and the standard error without the
    # bias; None for a linear metric or a single replicate.
    drift: tuple[float, float] | None = None
    # The metric at the denoised image, if that is estimated to be more accurate but denoising was switched off.
    # The difference is part of the standard error.
    denoised: float | None = None
    transform: ImageTransform = IDENTITY  # from the render to the metric image
    # The part of ``per_replicate`` that is due to the draws of noise of each replicate, for a smoothed metric.
    draw_noise: torch.Tensor | None = None
    # The independent parts of which ``standard_error`` is the norm, with their signs: the bias, the denoiser's
    # error, one for each direction of the images' noise, and one for each share of the draws. Those of two metrics
    # on the same images add and subtract.
    error_parts: torch.Tensor | None = None

    @property
    def is_linear(self) -> bool:
        """Whether the metric was found to be linear."""
        return self.bias is not None and not self.bias_adjoints
