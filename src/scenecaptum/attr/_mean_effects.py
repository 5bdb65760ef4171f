"""Mean and spread of the effects of several results, such as those of several cameras."""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from ..errors import SceneCaptumError, whole_number
from ..protocols import Scale
from ..visualization import (
    DEFAULT_TOP,
    align_decimals,
    align_with_errors,
    grid,
    group_by_text,
    marked_doubts,
    pluralize,
    rounded,
    shorten,
)
from ._attribution import SceneAttribution

_NAME_WIDTH = 60


class MeanEffect(NamedTuple):
    """Mean and spread of a parameter's effect over several results.

    Attributes
    ----------
    rank
        From 1, the largest mean effect.
    name, label
        The parameter's name in the scene, and a readable label.
    mean, mean_error
        The mean effect, and its standard error, that of the renders; None with fewer than two replicates.
    spread
        Standard deviation of the effect over the results.
    noise
        The spread that the noise of the renders alone would cause; None with fewer than two replicates. Only a
        spread that is clearly larger is a difference between the results.
    effects
        The effect in each result.
    """

    rank: int
    name: str
    label: str
    mean: float
    mean_error: float | None
    spread: float
    noise: float | None
    effects: tuple[float, ...]


@dataclass(frozen=True, repr=False)
class MeanEffects:
    """What ``mean_effects`` returns; prints as a table.

    Attributes
    ----------
    rows
        A `MeanEffect` for each parameter, by descending mean effect.
    count
        Number of results.
    untrusted
        The parameters whose standard error is unreliable in one of the results, each with the reason; see
        ``SceneAttribution.untrusted_errors``.
    """

    rows: tuple[MeanEffect, ...]
    count: int
    untrusted: Mapping[str, str] = field(default_factory=dict)

    def text(self, top: int | None = DEFAULT_TOP) -> str:
        """Return the table that ``print`` shows, of the first ``top`` parameters; None for all."""
        rows = self.rows if top is None else self.rows[: whole_number("top", top)]
        doubts = group_by_text(self.untrusted.items())
        # No marks if all rows would have one.
        marked = {name for names in doubts.values() if len(names) < len(self.rows) for name in names}
        labels = shorten([row.label for row in rows], _NAME_WIDTH)
        columns = {
            "": [str(row.rank) for row in rows],
            "parameter": [
                f"{label} ?" if row.name in marked else label for row, label in zip(rows, labels, strict=True)
            ],
            "mean effect": align_with_errors([(row.mean, row.mean_error) for row in rows]),
            "spread": align_decimals([rounded(row.spread, 2) for row in rows]),
        }
        noises = [rounded(row.noise, 2) for row in rows if row.noise is not None]
        if len(noises) == len(rows):
            columns["by noise alone"] = align_decimals(noises)
        hidden = len(self.rows) - len(rows)
        more = [f"… and {pluralize(hidden, 'parameter')} more"] if hidden else []
        notes = [f"Mean and standard deviation of the effects in {self.count} results"]
        all_labels = {row.name: row.label for row in self.rows}
        notes += marked_doubts(doubts, all_labels, [row.name for row in rows], len(self.rows), "?  ")
        return "\n".join([*grid([*columns], list(zip(*columns.values(), strict=True))), *more, "", *notes])

    def __str__(self) -> str:
        return self.text()

    __repr__ = __str__


def mean_effects(results: Sequence[SceneAttribution], *, scale: Scale | None = None) -> MeanEffects:
    """Return the mean effect of each parameter over several results, and its spread.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, VanillaSceneGradient, metrics
    >>> renderer = SceneRenderer("cornell-box", "emitters", resolution=(8, 8), spp=8, sensor=[0, "fisheye"])
    >>> method = VanillaSceneGradient(renderer, metrics.PerCamera(metrics.MeanLuminance()))
    >>> [light] = mean_effects(method.attribute(target=[0, 1], seed=0)).rows
    >>> len(light.effects), light.spread > 3 * light.noise
    (2, True)

    Parameters
    ----------
    results
        Attributions of the same parameters of one scene: of several cameras, metrics or classes.
    scale
        As for ``SceneAttribution.effects``.

    Returns
    -------
    MeanEffects
        A row for each parameter.

    Raises
    ------
    SceneCaptumError
        If there are fewer than two results, or they have other parameters.

    Notes
    -----
    Results of one call of ``attribute``, or with the same seed and samples, share their renders; their errors are
    correlated, and the standard errors of the mean and of the differences are computed from the means and
    differences of their replicates. The standard error of the mean is that for exactly these results. If the
    cameras are a random sample of all cameras, that of the mean over all of them is at least
    ``spread / sqrt(number of results)``.
    """
    results = list(results)
    if len(results) < 2 or not all(isinstance(result, SceneAttribution) for result in results):
        raise SceneCaptumError(
            "mean_effects takes at least two results, such as those of attribute(target=[0, 1]); it got "
            f"{pluralize(len(results), 'item')}."
        )
    mean = functools.reduce(operator.add, results) / len(results)
    deviations = [result - mean for result in results]
    effects, spreads = [result.effects(scale) for result in results], [d.effects(scale) for d in deviations]
    noises, errors = [d.effects_error(scale) for d in deviations], mean.effects_error(scale)
    means = mean.effects(scale)
    rows = [
        MeanEffect(
            rank=rank,
            name=name,
            label=mean.labels.get(name, name),
            mean=means[name],
            mean_error=None if errors is None else errors[name],
            spread=_deviation([spread[name] for spread in spreads]),
            noise=None if errors is None else _deviation([noise[name] for noise in noises if noise]),
            effects=tuple(effect[name] for effect in effects),
        )
        for rank, name in enumerate(sorted(means, key=lambda name: -abs(means[name])), start=1)
    ]
    doubts = {name: reason for one in (mean, *results) for name, reason in one.untrusted_errors().items()}
    return MeanEffects(tuple(rows), len(results), doubts)


def _deviation(deviations: Sequence[float]) -> float:
    """Return the standard deviation of numbers whose mean is subtracted."""
    return math.sqrt(sum(deviation**2 for deviation in deviations) / (len(deviations) - 1))
