"""Orders in which parameters are deleted and inserted, from importances, and their curves."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
import torch

from ..attr import SceneAttribution
from ..errors import SceneCaptumError, near_misses
from ..estimation import mean_and_error
from ..projection import sum_over_objects
from ..protocols import Capabilities, Renderer

Orders: TypeAlias = Mapping[str, Mapping[str, float] | SceneAttribution]


@dataclass(frozen=True, eq=False)
class OrderCurves:
    """Deletion and insertion curves of an order.

    Attributes
    ----------
    names
        The parameters in this order.
    moved
        ``(points,)``: number of parameters deleted or inserted at each point of the curves, from 0 to all.
    deletion
        ``(points, replicates)``: the metric with the first ``moved`` parameters at their baselines.
    insertion
        ``(points, replicates)``: the metric with all but the first ``moved`` parameters at their baselines.
    """

    names: tuple[str, ...]
    moved: torch.Tensor
    deletion: torch.Tensor
    insertion: torch.Tensor

    @cached_property
    def areas(self) -> torch.Tensor:
        """``(2, replicates)``: the mean change from the original scene over the deletion and insertion curve."""
        curves = (self.deletion, self.insertion)
        return torch.stack([area(curve, self.deletion[0], self.moved) for curve in curves])

    @property
    def deletion_area(self) -> tuple[float, float]:
        """Mean change of the metric from the original scene over the deletion curve, and its standard error.

        Larger is better: the first parameters change the metric most. If the metric falls, this is its original
        value minus the usual area under the curve; a rise counts in the same way.
        """
        return mean_and_error(self.areas[0])

    @property
    def insertion_area(self) -> tuple[float, float]:
        """Mean difference of the metric from the original scene over the insertion curve, and its standard error.

        Smaller is better: the first parameters restore most of the metric.
        """
        return mean_and_error(self.areas[1])


def area(curve: torch.Tensor, original: torch.Tensor, moved: torch.Tensor) -> torch.Tensor:
    """Return the mean distance of a curve from the original scene, in each replicate."""
    change = curve - original
    # The sign of the mean over the replicates: with signs of their own, noise would add to the distance.
    distance = change * change.mean(1, keepdim=True).sign()
    return torch.trapezoid(distance, moved.double() / moved[-1], dim=0)


def importances(
    name: str, given: Mapping[str, float] | SceneAttribution, parameters: Sequence[str], renderer: Renderer
) -> dict[str, float]:
    """Return the magnitudes of the importances of the parameters, the largest first.

    ``given`` has numbers for parameters or objects of the renderer; a parameter without any gets 0.
    """
    scores = given.saliency() if isinstance(given, SceneAttribution) else dict(given)
    values = {key: float(value) for key, value in scores.items()}
    others = {key: value for key, value in values.items() if key not in (Capabilities(renderer).inputs or {})}
    found = dict.fromkeys(parameters, 0.0)
    if others:
        surfaces: Any = Capabilities(renderer).surfaces
        known = () if surfaces is None else surfaces.objects
        for key in others:
            if key not in known:
                close = near_misses(key, [*parameters, *known])
                raise SceneCaptumError(
                    f"orders[{name!r}] contains {key!r}, which is neither an input of the renderer nor an object "
                    f"of its scene.{close}"
                )
        found = sum_over_objects(surfaces, others, parameters)
    found |= {key: values[key] for key in parameters if key in values}
    if not all(math.isfinite(value) for value in found.values()):
        raise SceneCaptumError(f"The importances of orders[{name!r}] must be finite numbers.")
    return dict(sorted(((key, abs(value)) for key, value in found.items()), key=lambda item: -item[1]))


def order_curves(
    importance: Mapping[str, float],
    moved: torch.Tensor,
    without: Callable[[Sequence[str]], torch.Tensor],
) -> OrderCurves:
    """Return the curves of the order of the importances, the largest first.

    Parameters of equal importance have no order: they move together, and the curves are linear in between.
    """
    names, ranked = list(importance), list(importance.values())
    ends = [k for k in range(len(names) + 1) if k in (0, len(names)) or ranked[k] != ranked[k - 1]]
    counts = sorted({min(ends, key=lambda end: abs(end - count)) for count in moved.tolist()})

    def interpolated(curve: list[torch.Tensor]) -> torch.Tensor:
        columns = torch.stack(curve, dim=1).numpy()
        return torch.from_numpy(
            np.stack([np.interp(moved.numpy(), counts, column) for column in columns], axis=1)
        )

    return OrderCurves(
        tuple(names),
        moved,
        deletion=interpolated([without(names[:count]) for count in counts]),
        insertion=interpolated([without(names[count:]) for count in counts]),
    )
