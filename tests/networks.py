"""Small networks and pictures for the tests of network metrics."""

from __future__ import annotations

import torch
from seeds import shifted


def ordinary(height: int = 16, width: int = 20, seed: int = 0) -> torch.Tensor:
    """Return random radiance between black and white, excluding both."""
    generator = torch.Generator().manual_seed(shifted(seed))
    return torch.rand(height, width, 3, dtype=torch.float64, generator=generator) * 0.8 + 0.1


def gradient(metric: torch.nn.Module, image: torch.Tensor) -> torch.Tensor:
    """Return the derivative of a scalar metric with respect to the image."""
    leaf = image.detach().clone().requires_grad_()
    (found,) = torch.autograd.grad(metric(leaf), leaf)
    return found


def small_network(outputs: int = 4) -> torch.nn.Module:
    """Return a random smooth network in float64 from pictures of any size to ``(N, outputs)``."""
    torch.manual_seed(shifted(1))
    layers = [torch.nn.Conv2d(3, 5, 3, stride=2), torch.nn.Tanh(), torch.nn.AdaptiveAvgPool2d(2)]
    return torch.nn.Sequential(*layers, torch.nn.Flatten(), torch.nn.Linear(20, outputs)).double()


def logits_of(values: list[float]) -> torch.nn.Module:
    """Return a network whose logits are these multiples of the mean of its input."""

    class Fixed(torch.nn.Module):
        def forward(self, x: torch.Tensor) -> torch.Tensor:
            return x.mean((1, 2, 3))[:, None] * x.new_tensor(values)

    return Fixed()


# A white picture, on which the logits of ``logits_of`` are its values.
WHITE = torch.ones(6, 8, 3, dtype=torch.float64)
UNCHANGED = torch.nn.Identity()
