"""Shapley values of the parts of a scene, including their interactions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from itertools import combinations, pairwise
from typing import Literal, TypeAlias

import torch

from ..checkpoint import Folder
from ..errors import SceneCaptumError, whole_number
from ..estimation import DEFAULT_REPLICATES, Denoise, Stream, input_values, random_generator
from ..protocols import ResultKind
from ._baseline_words import describe_baselines
from ._baselines import Baselines, Values, resolve_baselines
from ._groups import Groups, resolve_groups
from ._method import Result, Settings, Targets
from ._perturbation import Arm, Effect, Effects, Perturbation, Residual

Coalition: TypeAlias = "frozenset[str]"
Order: TypeAlias = "tuple[str, ...]"

MAX_EXACT_PLAYERS = 10


class ShapleyValueScene(Perturbation):
    """The Shapley value of each player: its average marginal effect over all orders in which players can join.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", inputs="all", resolution=(16, 16), spp=64)
    >>> shapley = ShapleyValueScene(renderer, metrics.MeanLuminance())
    >>> attribution = shapley.attribute(groups="kind", n_samples="all", seed=0)
    >>> sorted(attribution)
    ['emitters', 'reflectance']
    >>> abs(sum(attribution.values()).item() / attribution.metric_value - 1) < 1e-5
    True

    The players are groups of parameters. They start at their baselines and switch to their values one after the
    other. Up to rounding, the Shapley values sum to the metric of the scene minus the metric at the baselines for
    any number of permutations, because the marginal effects of each permutation do and all subsets use common
    random numbers.

    Parameters
    ----------
    renderer, metric
        As for ``FeatureAblationScene``.

    References
    ----------
    Castro, Gómez and Tejada, "Polynomial calculation of the Shapley value based on sampling", 2009.
    Štrumbelj and Kononenko, "An efficient explanation of individual classifications using game theory", 2010.
    Lundberg and Lee, "A Unified Approach to Interpreting Model Predictions", NeurIPS 2017.
    """

    def attribute(  # noqa: PLR0913 -- those of every method, and some of its own
        self,
        inputs: Mapping[str, torch.Tensor] | None = None,
        *,
        target: Targets = None,
        baselines: Baselines = None,
        groups: Groups = None,
        n_samples: int | Literal["all"] = 25,
        seed: int = 0,
        spp: int | None = None,
        replicates: int = DEFAULT_REPLICATES,
        denoise: Denoise = "auto",
        checkpoint: Folder = None,
        executor: Executor | None = None,
        show_progress: bool = False,
    ) -> Result:
        """Attribute the metric to each player.

        Parameters
        ----------
        inputs, target, checkpoint, executor, show_progress
            As for ``VanillaSceneGradient``.
        denoise
            As for ``FeatureAblationScene``.
        baselines
            Values of players that have not joined, as for ``FeatureAblationScene``: inputs that a mapping does not
            name take the default, 0 for emitters and reflectances.
        groups
            The players: ``"kind"``, ``"material"``, ``"object"``, or a mapping from a player's name to the
            names or globs of its parameters. Parameters in no group are players of their own.
        n_samples
            Number of permutations, in antithetic pairs of a permutation and its reverse (an odd number is rounded
            up), or ``"all"`` for exact values from all subsets of at most ten players. Players that are already at
            their baselines do not count.
        seed
            Random seed, for the permutations and the renders. All subsets use common random numbers.
        spp
            Total samples per pixel over all subsets of players that are rendered, split evenly over subsets and
            replicates and rounded up to at least one each, so that ``info["spp"]`` may be a multiple of it.
        replicates
            As for ``FeatureAblationScene``.

        Returns
        -------
        SceneAttribution
            A 0-d value for each player, in units of the metric, with its parameters in ``info["groups"]``. The
            errors include both the noise of the renders and the sampling of permutations.

        Raises
        ------
        SceneCaptumError
            If baselines or groups do not fit the parameters, all players are already at their baselines, there are
            too many for ``"all"``, or the metric is not a finite scalar.
        AttributionInterrupted
            On Ctrl-C after at least one pair of permutations, with the result so far.
        """
        values = input_values(self.renderer, inputs)
        absent = resolve_baselines(self.renderer, values, baselines)
        members = resolve_groups(self.renderer, values, groups)
        players = _players(values, absent, members)
        orders = _orders(players, n_samples, seed)
        game = _Game(players, orders, _coalitions(players, orders))
        arms = [
            Arm(_description(coalition, players), partial(_scene, coalition, members, values, absent))
            for coalition in game.coalitions
        ]
        settings = Settings(
            seed, spp, replicates, show_progress, checkpoint=checkpoint, denoise=denoise, executor=executor
        )
        measured = self._measure(arms, target, settings)

        def effects_of(per_replicate: torch.Tensor) -> tuple[Effects, Residual | None]:
            return _effects(game, per_replicate, members)

        count, pairs = measured.per_replicate.shape[1], len(game.finished(len(measured.per_replicate)))
        return self._results(
            measured,
            target,
            effects_of,
            quantity=ResultKind.SHAPLEY_VALUE,
            **describe_baselines(self.renderer, values, baselines, absent),
            groups={group: list(names) for group, names in members.items()},
            permutations="all" if orders is None else 2 * pairs,
            # These set the degrees of freedom of the errors.
            replicates=count if orders is None else min(count, pairs),
        )


@dataclass(frozen=True)
class _Game:
    """The players, the orders in which they join, and the coalitions to render.

    ``orders`` has one of each antithetic pair; None stands for all orders.
    """

    players: Order
    orders: list[Order] | None
    coalitions: list[Coalition]

    def finished(self, measured: int) -> list[Order]:
        """Return the orders for which all coalitions, including the reverse order, have been measured."""
        finished = set(self.coalitions[:measured])
        return [order for order in self.orders or () if finished.issuperset(_antithetic_coalitions(order))]


def _players(values: Values, absent: Values, members: Mapping[str, tuple[str, ...]]) -> Order:
    """Return the groups whose values differ from their baselines."""
    players = tuple(
        group
        for group, names in members.items()
        if any(not torch.equal(values[name], absent[name]) for name in names)
    )
    if not players:
        raise SceneCaptumError(
            f"There is nothing to attribute to: all {len(values)} inputs are already at their baselines. Give "
            "other baselines=, such as a number or a mapping by name."
        )
    return players


def _orders(players: Order, n_samples: int | Literal["all"], seed: int) -> list[Order] | None:
    """Sample orders in which players join, one of each antithetic pair; None stands for all orders."""
    if isinstance(n_samples, str):
        if n_samples != "all":
            raise SceneCaptumError(f'n_samples must be a number of permutations or "all", not {n_samples!r}.')
        if len(players) > MAX_EXACT_PLAYERS:
            raise SceneCaptumError(
                f'n_samples="all" renders every subset of at most {MAX_EXACT_PLAYERS} players, and there are '
                f"{len(players)}. Combine some with groups=, or give a number of permutations."
            )
        return None
    pairs = math.ceil(whole_number("n_samples", n_samples) / 2)
    if len(players) <= 2:
        return None  # there are no other orders than one and its reverse
    generator = random_generator(seed, Stream.PERMUTATIONS)
    return [tuple(players[i] for i in generator.permutation(len(players))) for _ in range(pairs)]


def _growing_coalitions(order: Order) -> list[Coalition]:
    return [frozenset(order[:count]) for count in range(len(order) + 1)]


def _antithetic_coalitions(order: Order) -> list[Coalition]:
    return _growing_coalitions(order) + _growing_coalitions(order[::-1])


def _coalitions(players: Order, orders: list[Order] | None) -> list[Coalition]:
    """Return the coalitions to render, without duplicates, the full one first."""
    if orders is None:
        needed = [frozenset(c) for size in range(len(players) + 1) for c in combinations(players, size)]
    else:
        needed = [coalition for order in orders for coalition in _antithetic_coalitions(order)]
    return list(dict.fromkeys([frozenset(players), frozenset(), *needed]))


def _scene(
    coalition: Coalition, members: Mapping[str, tuple[str, ...]], values: Values, absent: Values
) -> dict[str, torch.Tensor]:
    present = {name for player in coalition for name in members[player]}
    return {name: value if name in present else absent[name] for name, value in values.items()}


def _description(coalition: Coalition, players: Order) -> str:
    missing = [player for player in players if player not in coalition]
    if not missing:
        return "the unchanged scene"
    names = "all" if len(missing) == len(players) else ", ".join(map(repr, missing[:3]))
    return f"the scene with {names}{' …' if 3 < len(missing) < len(players) else ''} at the baselines"


def _exact_values(metric_of: Mapping[Coalition, torch.Tensor], players: Order) -> torch.Tensor:
    """Evaluate Shapley's formula in every replicate, ``(1, replicates, players)``."""
    count = len(players)
    values = []
    for player in players:
        value = torch.zeros_like(metric_of[frozenset()])
        for coalition, metric in metric_of.items():
            if player not in coalition:
                weight = 1 / (count * math.comb(count - 1, len(coalition)))
                value += weight * (metric_of[coalition | {player}] - metric)
        values.append(value)
    return torch.stack(values, -1)[None]


def _sampled_values(
    metric_of: Mapping[Coalition, torch.Tensor], players: Order, orders: list[Order]
) -> torch.Tensor:
    """Return marginal effects, averaged over an order and its reverse: ``(pairs, replicates, players)``."""
    pairs = []
    for order in orders:
        effects = dict.fromkeys(players, torch.zeros_like(metric_of[frozenset()]))
        for joining in (order, order[::-1]):
            steps = pairwise(_growing_coalitions(joining))
            for player, (before, after) in zip(joining, steps, strict=True):
                effects[player] = effects[player] + (metric_of[after] - metric_of[before]) / 2
        pairs.append(torch.stack([effects[player] for player in players], -1))
    return torch.stack(pairs)


def _effects(
    game: _Game, per_replicate: torch.Tensor, members: Mapping[str, tuple[str, ...]]
) -> tuple[Effects, Residual | None]:
    """Return the value of every group, 0 if it is at its baseline, and the residual due to rounding."""
    metric_of = dict(zip(game.coalitions, per_replicate, strict=False))
    finished = game.finished(len(per_replicate))
    if game.orders is None and len(metric_of) == len(game.coalitions):
        values = _exact_values(metric_of, game.players)
    elif finished:
        values = _sampled_values(metric_of, game.players, finished)
    else:
        return {}, None
    by_player = {player: values[..., index] for index, player in enumerate(game.players)}
    zero = torch.zeros_like(values[..., 0])
    explained = (metric_of[frozenset(game.players)] - metric_of[frozenset()]).mean()
    return (
        {group: _effect(by_player.get(group, zero), exact=game.orders is None) for group in members},
        Residual((values.mean((0, 1)).sum() - explained).item(), explained.item()),
    )


def _effect(values: torch.Tensor, *, exact: bool) -> Effect:
    pairs, replicates = values.shape
    if exact:
        return Effect.of_totals(values.reshape(replicates, 1), torch.zeros(()))
    value = values.mean().float()
    if min(pairs, replicates) < 2:
        return Effect(value, None, None, None)
    variance = _crossed_variance(values)
    # Without totals: a difference of two results would mistake their variance for the whole error.
    return Effect(value, variance.sqrt().float(), None, variance.reshape(1, 1))


def _crossed_variance(values: torch.Tensor) -> torch.Tensor:
    """Return the variance of the mean of ``(pairs, replicates)`` values with random rows and columns.

    With ``x = μ + pair + replicate + residual`` the variances of the row means and of the column means both
    include the residual, so it is subtracted once (Searle, Casella and McCulloch, "Variance Components", 1992,
    chapter 4).
    """
    pairs, replicates = values.shape
    rows, columns = values.mean(1), values.mean(0)
    residual = values - rows[:, None] - columns + values.mean()
    residual_variance = residual.square().sum() / ((pairs - 1) * (replicates - 1))
    between_pairs, between_replicates = rows.var() / pairs, columns.var() / replicates
    total = between_pairs + between_replicates - residual_variance / (pairs * replicates)
    return torch.stack([total, between_pairs, between_replicates]).max()
