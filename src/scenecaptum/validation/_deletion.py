"""Deletion and insertion curves: set parameters to their baselines, or restore them, in order of importance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from ..attr import Baselines, SceneAttribution
from ..checkpoint import Folder, with_checkpoint
from ..errors import SceneCaptumError, check_seed, whole_number
from ..estimation import DEFAULT_REPLICATES, Metric, Target
from ..protocols import Renderer
from ._deletion_result import DeletionInsertion
from ._faithfulness import contributions, measure_without
from ._scenes import Scenes


def deletion_insertion(  # noqa: PLR0913 -- the options of every check, and three of its own
    renderer: Renderer,
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
