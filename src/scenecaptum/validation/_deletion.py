"""Deletion and insertion curves: set parameters to their baselines, or restore them, in order of importance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ..attr import SceneAttribution
from ..attr._baselines import Baselines
from ..attr._metric import Metric, Target
from ..attr._passes import DEFAULT_REPLICATES
from ..checkpoint import Folder, with_checkpoint
from ..errors import SceneCaptumError, check_seed, whole_number
from ._faithfulness import contributions, measure_without
from ._scenes import Scenes, mean_and_error

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, repr=False)
class DeletionInsertion:
    """Deletion and insertion curves of a ranking; prints as a table.

    Attributes
    ----------
    names, labels
        The parameters in the order of the ranking.
    moved
        ``(points,)``: number of parameters deleted or inserted at each point of the curves, from 0 to all.
    deletion
        ``(points, replicates)``: the metric with the first ``moved`` parameters at their baselines.
    insertion
        ``(points, replicates)``: the metric with all but the first ``moved`` parameters at their baselines.
    random
        ``(orders, points, replicates)``: deletion in random orders. Reversed, each is an insertion curve.
    metric, method
        Names of the metric and of the attribution method.
    """

    names: tuple[str, ...]
    labels: tuple[str, ...]
    moved: torch.Tensor
    deletion: torch.Tensor
    insertion: torch.Tensor
    random: torch.Tensor
    metric: str
    method: str

    @cached_property
    def deletion_area(self) -> tuple[float, float]:
        """Mean change of the metric from the original scene over the deletion curve, and its standard error.

        Larger is better: the first parameters change the metric most. If the metric falls, this is its original
        value minus the usual area under the curve; a rise counts in the same way.
        """
        return mean_and_error(self._area(self.deletion, self.moved))

    @cached_property
    def insertion_area(self) -> tuple[float, float]:
        """Mean difference of the metric from the original scene over the insertion curve, and its standard error.

        Smaller is better: the first parameters restore most of the metric.
        """
        return mean_and_error(self._area(self.insertion, self.moved))

    @cached_property
    def random_areas(self) -> torch.Tensor:
        """``(2, orders)``: the deletion and insertion areas of the random orders."""
        remaining = self.moved[-1] - self.moved.flip(0)
        deletions = [self._area(curve, self.moved).mean() for curve in self.random]
        insertions = [self._area(curve.flip(0), remaining).mean() for curve in self.random]
        return torch.stack([torch.stack(deletions), torch.stack(insertions)])

    @property
    def verdict(self) -> str:
        """The result in one sentence."""
        deletions, insertions = self.random_areas
        by_deletion = int((self.deletion_area[0] > deletions).sum())
        by_insertion = int((self.insertion_area[0] < insertions).sum())
        return (
            f"the order of {self.method} beats {by_deletion} of {len(deletions)} random orders by deletion and "
            f"{by_insertion} by insertion"
        )

    def _area(self, curve: torch.Tensor, moved: torch.Tensor) -> torch.Tensor:
        """Return the mean distance of a curve from the original scene, in each replicate."""
        change = curve - self.deletion[0]
        # The sign of the mean over the replicates: with signs of their own, noise would add to the distance.
        distance = change * change.mean(1, keepdim=True).sign()
        return torch.trapezoid(distance, moved.double() / moved[-1], dim=0)

    def plot(self, figure: Figure | None = None) -> Figure:
        """Plot both curves and those of the random orders."""
        from ..visualization import plot_deletion

        return plot_deletion(self, figure=figure)

    def __str__(self) -> str:
        from ..visualization import deletion_text

        return deletion_text(self)

    __repr__ = __str__


def deletion_insertion(  # noqa: PLR0913 -- the options of every check, and three of its own
    renderer: Any,
    metric: Metric,
    attribution: SceneAttribution | None = None,
    target: Target = None,
    *,
    baselines: Baselines = None,
    steps: int = 12,
    random_orders: int = 10,
    seed: int = 0,
    spp: int | None = None,
    replicates: int = DEFAULT_REPLICATES,
    checkpoint: Folder = None,
) -> DeletionInsertion:
    """Compute deletion and insertion curves of a ranking and compare them with random orders.

    Deletion starts from the original scene and sets parameters to their baselines; insertion starts with all
    parameters at their baselines and restores them. Both begin with the most important parameter. All scenes are
    rendered with common random numbers.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", "reflectance", resolution=(16, 16), spp=16)
    >>> curves = deletion_insertion(renderer, metrics.MeanLuminance(), random_orders=2, steps=4)
    >>> curves.deletion.shape  # 5 points in 8 replicates
    torch.Size([5, 8])

    Parameters
    ----------
    renderer, metric, target
        As for ``IntegratedGradientsScene``.
    attribution
        Contributions relative to the same baselines, ranked by magnitude; integrated gradients by default.
    baselines
        The values of deleted parameters, as for ``IntegratedGradientsScene``. Parameters that are already at their
        baselines are skipped.
    steps
        Maximum number of steps, each with about the same number of parameters.
    random_orders
        Number of random orders to compare with, at least 2.
    seed
        Base seed; all other seeds are derived from it.
    spp
        Samples per pixel of each scene, over all replicates; the renderer's by default.
    replicates
        Number of independent renders of each scene; the standard errors come from their spread.
    checkpoint
        Folder that stores every finished replicate. A killed job resumes from it when it is started again with
        the same arguments.

    Returns
    -------
    DeletionInsertion
        Both curves and those of the random orders, in the unit of the metric.

    Raises
    ------
    SceneCaptumError
        If the attribution is one of gradients or of groups, or fewer than two parameters differ from their
        baselines.

    References
    ----------
    Petsiuk, Das and Saenko, "RISE: Randomized Input Sampling for Explanation of Black-box Models", BMVC 2018.
    """
    renderer = with_checkpoint(renderer, checkpoint)
    options: dict[str, Any] = {"seed": seed, "spp": spp, "replicates": replicates}
    scenes = Scenes.split(renderer, metric, target, **options)
    attribution, deleted = contributions(scenes, metric, attribution, target, baselines, **options)
    if len(deleted) < 2:
        raise SceneCaptumError(
            f"deletion_insertion needs at least 2 parameters that differ from their baselines, not {len(deleted)}."
        )
    names = list(deleted)
    moved = np.linspace(0, len(names), min(whole_number("steps", steps), len(names)) + 1).round().astype(int)
    generator = np.random.default_rng([check_seed("seed", seed), 7])
    curves = _Curves(scenes, deleted, moved.tolist())
    orders = whole_number("random_orders", random_orders, 2)
    return DeletionInsertion(
        names=tuple(names),
        labels=tuple(attribution.labels.get(name, name) for name in names),
        moved=torch.from_numpy(moved),
        deletion=curves.deletion(names),
        insertion=curves.insertion(names),
        random=torch.stack([curves.deletion(generator.permutation(names).tolist()) for _ in range(orders)]),
        metric=str(attribution.info["metric"]),
        method=str(attribution.info["method"]),
    )


class _Curves:
    """Computes curves for any order of the parameters; caches the metric of every set of deleted parameters."""

    def __init__(self, scenes: Scenes, deleted: Mapping[str, torch.Tensor], moved: Sequence[int]) -> None:
        self.scenes = scenes
        self.deleted = deleted
        self.moved = moved
        self.cache = {frozenset[str](): scenes.unmodified}

    def deletion(self, order: Sequence[str]) -> torch.Tensor:
        """Return the deletion curve of an order, ``(points, replicates)``."""
        return torch.stack([self._without(order[:count]) for count in self.moved])

    def insertion(self, order: Sequence[str]) -> torch.Tensor:
        """Return the insertion curve of an order, ``(points, replicates)``."""
        return torch.stack([self._without(order[count:]) for count in self.moved])

    def _without(self, names: Sequence[str]) -> torch.Tensor:
        key = frozenset(names)
        if key not in self.cache:
            self.cache[key] = measure_without(self.scenes, self.deleted, names)
        return self.cache[key]
