"""A result to first order in the picture with what its poses do to the metric itself over their ranges."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import torch

from ..estimation import TargetedMetric
from ..protocols import Renderer
from ..scene import pose_component
from ._attribution import SceneAttribution
from ._nonlinear_poses import nonlinear_poses


def checked_over_ranges(
    attribution: SceneAttribution,
    renderer: Renderer,
    metric: TargetedMetric,
    values: Mapping[str, torch.Tensor],
    *,
    image: torch.Tensor,
    adjoints: Sequence[torch.Tensor],
    spp: int,
) -> tuple[SceneAttribution, dict[str, torch.Tensor]]:
    """Return plain gradients along a fixed adjoint with the marks and errors that those of the metric would have.

    ``image`` is the mean of the renders behind the adjoint, ``adjoints`` are its pseudo-values, and a quarter or
    half of the ``spp`` are rendered at each end. The second result has what the errors contain for it.
    """
    info, errors = attribution.info, dict(attribution.standard_error or {})
    covariance = dict(attribution.covariance or {})
    names = [n for n in attribution if pose_component(n) is not None and n not in info["jumps"]]
    found = nonlinear_poses(
        renderer,
        metric,
        values,
        image=image,
        adjoints=adjoints,
        gradients={name: attribution[name] for name in names},
        errors=errors,
        kept={name: info["kept_directions"].get(name, 1.0) for name in names},
        marked=info["local"],
        samples=dict.fromkeys(names, spp),
        seed=info["seed"],
    )
    for name, error in found.errors.items():
        errors[name] = errors[name].hypot(error)
        covariance[name] = covariance[name] + torch.outer(error.reshape(-1), error.reshape(-1))
    checked = dataclasses.replace(
        attribution,
        standard_error=errors,
        covariance=covariance,
        info={**info, "nonlinear": found.marked, "range_changes": found.changes},
    )
    return checked, found.errors
