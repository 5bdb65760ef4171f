"""Adding the quadrature error to the standard errors of an attribution."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import TypeVar

import torch

from ..estimation import GradientSum, Quadrature, channel_totals
from ._data import AttributionData

A = TypeVar("A", bound=AttributionData)


def with_quadrature_error(
    attribution: A, rule: Quadrature, total: GradientSum, members: Mapping[str, tuple[str, ...]] | None = None
) -> A:
    """Return the attribution with standard errors that include the estimated quadrature error.

    Each parameter has its own quadrature error. ``members`` are the parameters of each group, or None without
    groups.
    """
    if attribution.standard_error is None or attribution.covariance is None:
        return attribution
    if members is None:
        errors = {n: rule.error([torch.stack(by_name[n]) for by_name in total.totals]) for n in attribution}
    else:
        errors = {group: rule.error(_sums(total, members[group])) for group in attribution}
    return dataclasses.replace(
        attribution,
        quadrature_error=errors,
        standard_error={
            name: error.hypot(_elementwise(errors[name], attribution[name]))
            for name, error in attribution.standard_error.items()
        },
        covariance={
            name: covariance + covariance_of_quadrature(errors[name], attribution[name])
            for name, covariance in attribution.covariance.items()
        },
    )


def error_of_sum(rule: Quadrature, total: GradientSum) -> float:
    """Estimate the quadrature error of the sum of all attributions."""
    return rule.error(_sums(total, total.totals[0])).item()


def covariance_of_quadrature(errors: torch.Tensor, attribution: torch.Tensor) -> torch.Tensor:
    """Return the ``(C, C)`` covariance of the quadrature errors, assuming fully correlated channels."""
    signed = torch.where(channel_totals(attribution) < 0, -errors, errors)
    return signed[:, None] * signed


def _sums(total: GradientSum, names: Iterable[str]) -> list[torch.Tensor]:
    """Return for each point ``(replicates, 1)`` sums over parameters and their channels."""
    names = list(names)
    return [
        torch.cat([torch.stack(by_name[name]) for name in names], 1).sum(1, keepdim=True)
        for by_name in total.totals
    ]


def _elementwise(errors: torch.Tensor, attribution: torch.Tensor) -> torch.Tensor:
    """Return elementwise errors; those of a texture's channels are distributed by the magnitude of the texels."""
    if attribution.ndim < 2:
        return errors.reshape(attribution.shape).to(attribution)
    size = attribution.abs()
    sums = channel_totals(size).clamp_min(torch.finfo(size.dtype).tiny)
    return size * (errors / sums).to(size)
