"""What the error of a quadrature adds to the errors of an attribution."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping

import torch

from ._attribution import SceneAttribution
from ._gradients import GradientSum
from ._passes import channel_totals
from ._quadrature import Quadrature


def with_quadrature_error(
    attribution: SceneAttribution,
    rule: Quadrature,
    found: GradientSum,
    members: Mapping[str, tuple[str, ...]] | None = None,
) -> SceneAttribution:
    """Return integrals whose errors hold that of their quadrature, as far as the rule's own points tell it.

    Each has its own, since parameters need not bend alike on the way that they share. ``members`` are the
    parameters of each group, where the attribution is one of groups.
    """
    if attribution.standard_error is None or attribution.covariance is None:
        return attribution
    if members is None:
        errors = {name: rule.error([torch.stack(one[name]) for one in found.totals]) for name in attribution}
    else:
        errors = {group: rule.error(_sums(found, members[group])) for group in attribution}
    return dataclasses.replace(
        attribution,
        quadrature_error=errors,
        standard_error={
            name: one.hypot(_elementwise(errors[name], attribution[name]))
            for name, one in attribution.standard_error.items()
        },
        covariance={
            name: one + covariance_of_quadrature(errors[name], attribution[name])
            for name, one in attribution.covariance.items()
        },
    )


def error_of_sum(rule: Quadrature, found: GradientSum) -> float:
    """Estimate the error of the quadrature of all attributions together."""
    return rule.error(_sums(found, found.totals[0])).item()


def covariance_of_quadrature(errors: torch.Tensor, attribution: torch.Tensor) -> torch.Tensor:
    """Return the ``(C, C)`` covariance of channel totals with such errors: channels are wrong together."""
    signed = torch.where(channel_totals(attribution) < 0, -errors, errors)
    return signed[:, None] * signed


def _sums(found: GradientSum, names: Iterable[str]) -> list[torch.Tensor]:
    """Return for each point ``(passes, 1)`` sums over parameters and their channels."""
    names = list(names)
    return [
        torch.cat([torch.stack(one[name]) for name in names], 1).sum(1, keepdim=True) for one in found.totals
    ]


def _elementwise(errors: torch.Tensor, attribution: torch.Tensor) -> torch.Tensor:
    """Return errors by element: the texels of a texture's channel have parts as large as their attributions'."""
    if attribution.ndim < 2:
        return errors.reshape(attribution.shape).to(attribution)
    size = attribution.abs()
    whole = channel_totals(size).clamp_min(torch.finfo(size.dtype).tiny)
    return size * (errors / whole).to(size)
