"""Deletion and insertion curves: moving parameters to their baselines and back, the most important first."""

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
from ..attr._passes import DEFAULT_PASSES
from ..checkpoint import Folder, with_checkpoint
from ..errors import SceneCaptumError, check_seed, whole_number
from ._faithfulness import contributions, measure_without
from ._scenes import Scenes, mean_and_error

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, repr=False)
class DeletionInsertion:
    """The metric while parameters move to their baselines, and from them; prints as a table.

    Attributes
    ----------
    names, labels
        The parameters in the order of the ranking.
    moved
        ``(points,)``: how many of them have moved at each point of the curves, from 0 to all.
    deletion
        ``(points, replicates)``: the metric where the first parameters of the order are at their baselines.
    insertion
        The same where all others are.
    random
        ``(orders, points, replicates)``: deletion in random orders. Read backwards each is an insertion.
    metric, method
        What was attributed, and how.
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
        """By how much the metric has changed from the whole scene's, on average over the curve, and its error.

        Larger is better: the first parameters change most. It is the whole scene's metric minus the usual area
        under the curve where the metric falls, but counts a rise as well.
        """
        return mean_and_error(self._area(self.deletion, self.moved))

    @cached_property
    def insertion_area(self) -> tuple[float, float]:
        """By how much the metric still differs from the whole scene's, on average over the curve, and its error.

        Smaller is better: the first parameters bring most of it back.
        """
        return mean_and_error(self._area(self.insertion, self.moved))

    @cached_property
    def random_areas(self) -> torch.Tensor:
        """``(2, orders)``: both areas for the random orders."""
        left = self.moved[-1] - self.moved.flip(0)
        deletions = [self._area(one, self.moved).mean() for one in self.random]
        insertions = [self._area(one.flip(0), left).mean() for one in self.random]
        return torch.stack([torch.stack(deletions), torch.stack(insertions)])

    @property
    def verdict(self) -> str:
        """One sentence."""
        deletions, insertions = self.random_areas
        better = (
            int((self.deletion_area[0] > deletions).sum()),
            int((self.insertion_area[0] < insertions).sum()),
        )
        return (
            f"the order of {self.method} deletes faster than {better[0]} and inserts faster than {better[1]} of "
            f"{len(deletions)} random orders"
        )

    def _area(self, curve: torch.Tensor, moved: torch.Tensor) -> torch.Tensor:
        """Return the mean distance of a curve from the whole scene, in each replicate."""
        change = curve - self.deletion[0]
        # The sign is the mean's: each replicate's own would make distances of noise.
        distance = change * change.mean(1, keepdim=True).sign()
        return torch.trapezoid(distance, moved.double() / moved[-1], dim=0)

    def plot(self, figure: Figure | None = None) -> Figure:
        """Draw both curves, and what random orders do."""
        from ..visualization import plot_deletion

        return plot_deletion(self, figure=figure)

    def __str__(self) -> str:
        from ..visualization import deletion_text

        return deletion_text(self)

    __repr__ = __str__


def deletion_insertion(  # noqa: PLR0913 -- those of every validation, and three of its own
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
    replicates: int = DEFAULT_PASSES,
    checkpoint: Folder = None,
) -> DeletionInsertion:
    """Move parameters to their baselines in the order of their ranking, and back, and watch the metric.

    Deletion begins with the whole scene, insertion with all parameters at their baselines; both take the most
    important first. All scenes share their seeds.

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
        Contributions compared with the same baselines, ranked by their magnitude; by default those of integrated
        gradients are computed.
    baselines
        What a parameter is set to when it is deleted, as for ``IntegratedGradientsScene``. One that is at its
        baseline already takes no part.
    steps
        In how many steps at most, each of as many parameters.
    random_orders
        How many random orders to compare with, 2 at least.
    seed
        Seed from which all others are drawn.
    spp
        Samples per pixel of every scene, in all its replicates; the renderer's by default.
    replicates
        In how many independent passes each scene is rendered: their spread tells the errors.
    checkpoint
        A folder that keeps every finished pass: a job that was killed goes on from there when it is started again
        with the same arguments.

    Returns
    -------
    DeletionInsertion
        Both curves and those of the random orders, in the metric's unit.

    Raises
    ------
    SceneCaptumError
        Where the attribution is one of gradients or of groups, or fewer than two parameters have baselines other
        than their values.

    References
    ----------
    Petsiuk, Das and Saenko, "RISE: Randomized Input Sampling for Explanation of Black-box Models", BMVC 2018.
    """
    renderer = with_checkpoint(renderer, checkpoint)
    options: dict[str, Any] = {"seed": seed, "spp": spp, "replicates": replicates}
    scenes = Scenes.split(renderer, metric, target, **options)
    attribution, absent = contributions(scenes, metric, attribution, target, baselines, **options)
    if len(absent) < 2:
        raise SceneCaptumError(
            f"An order takes at least 2 parameters that are not at their baselines already, not {len(absent)}."
        )
    names = list(absent)
    moved = np.linspace(0, len(names), min(whole_number("steps", steps), len(names)) + 1).round().astype(int)
    draw = np.random.default_rng([check_seed("seed", seed), 7])
    curves = _Curves(scenes, absent, moved.tolist())
    orders = whole_number("random_orders", random_orders, 2)
    return DeletionInsertion(
        names=tuple(names),
        labels=tuple(attribution.labels.get(name, name) for name in names),
        moved=torch.from_numpy(moved),
        deletion=curves.deletion(names),
        insertion=curves.insertion(names),
        random=torch.stack([curves.deletion(draw.permutation(names).tolist()) for _ in range(orders)]),
        metric=str(attribution.info["metric"]),
        method=str(attribution.info["method"]),
    )


class _Curves:
    """Measures the scenes along an order, none of them twice."""

    def __init__(self, scenes: Scenes, absent: Mapping[str, torch.Tensor], moved: Sequence[int]) -> None:
        self.scenes = scenes
        self.absent = absent
        self.moved = moved
        self.seen = {frozenset[str](): scenes.still}

    def deletion(self, order: Sequence[str]) -> torch.Tensor:
        """Return the metric without the first ones of an order, ``(points, replicates)``."""
        return torch.stack([self._without(order[:count]) for count in self.moved])

    def insertion(self, order: Sequence[str]) -> torch.Tensor:
        """Return the metric with the first ones only."""
        return torch.stack([self._without(order[count:]) for count in self.moved])

    def _without(self, names: Sequence[str]) -> torch.Tensor:
        key = frozenset(names)
        if key not in self.seen:
            self.seen[key] = measure_without(self.scenes, self.absent, names)
        return self.seen[key]
