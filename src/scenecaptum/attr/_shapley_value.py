"""Shapley values: a fair share of the metric for each part of the scene, interactions of light included."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from itertools import combinations, pairwise
from typing import Literal, TypeAlias

import numpy as np
import torch

from ..checkpoint import Folder
from ..errors import SceneCaptumError, check_seed, whole_number
from ._baselines import Baselines, Values, resolve_baselines
from ._gradients import input_values
from ._groups import Groups, resolve_groups
from ._method import Result, Settings, Targets
from ._passes import DEFAULT_PASSES
from ._perturbation import Arm, Effect, Effects, Missed, Perturbation
from ._view import Denoise

Coalition: TypeAlias = "frozenset[str]"
Order: TypeAlias = "tuple[str, ...]"

MOST_EXACT_PLAYERS = 10


class ShapleyValueScene(Perturbation):
    """The Shapley value of each player: its average marginal effect over the orders in which players can join.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", inputs="all", resolution=(16, 16), spp=64)
    >>> shapley = ShapleyValueScene(renderer, metrics.MeanLuminance())
    >>> attribution = shapley.attribute(groups="kind", n_samples="all", seed=0)
    >>> sorted(attribution)
    ['emitters', 'reflectance']
    >>> abs(sum(attribution.values()).item() - attribution.metric_value) < 1e-5
    True

    The players are groups of parameters. They start at their baselines and join, one after the other, at their
    values. The values sum to the metric of the scene minus that of the scene at its baselines, up to rounding, for
    any number of permutations, since each permutation's marginal effects do and all share their samples.

    Parameters
    ----------
    renderer
        A ``SceneRenderer``, or any callable ``renderer(inputs, *, seed, spp)`` that returns an image.
    metric
        A torch function from the image to a scalar, or to a vector of which ``target`` names elements; it need not
        be differentiable.

    References
    ----------
    Castro, Gómez and Tejada, "Polynomial calculation of the Shapley value based on sampling", 2009.
    Štrumbelj and Kononenko, "An efficient explanation of individual classifications using game theory", 2010.
    Lundberg and Lee, "A Unified Approach to Interpreting Model Predictions", NeurIPS 2017.
    """

    def attribute(  # noqa: PLR0913 -- those of every method, and some of its own
        self,
        inputs: Mapping[str, torch.Tensor] | None = None,
        target: Targets = None,
        *,
        baselines: Baselines = None,
        groups: Groups = None,
        n_samples: int | Literal["all"] = 25,
        seed: int = 0,
        spp: int | None = None,
        replicates: int = DEFAULT_PASSES,
        denoise: Denoise = "auto",
        checkpoint: Folder = None,
        show_progress: bool = False,
    ) -> Result:
        """Attribute the metric to each player.

        Parameters
        ----------
        inputs
            Values by parameter name; the renderer's own by default.
        target
            Which element of the metric's output is meant, where it is not a scalar; a list of them gives a list of
            results from the same renders.
        baselines
            What a player is before it joins: None (lights and reflectances 0, everything else as it is),
            ``"dark"``, ``"black"``, ``"grey"``, a number, a mapping by name, glob or kind, or another renderer.
        groups
            The players: ``"kind"``, ``"material"``, ``"object"``, or a mapping from a player's name to the
            names or globs of its parameters. By default, and for what the mapping leaves out, each parameter is
            a player.
        n_samples
            Number of permutations, which come in pairs, each with its reverse (an odd number is rounded up), or
            ``"all"`` for the exact value from every subset of at most ten players. Ones that are at their
            baselines already do not count.
        seed
            Seed from which the permutations and those of all replicates are drawn; the same for all subsets.
        spp
            Total samples per pixel over all subsets of players that are rendered, the renderer's by default: each
            subset gets its share, rounded up, split over the replicates, and each replicate at least one sample.
        replicates
            Number of independent seeds. Their spread is the part of the standard errors that is due to rendering;
            with 1 there are no errors, and no correction of the bias that a noisy image puts into a non-linear
            metric.
        denoise
            Whether a metric that is not linear sees denoised pictures (Open Image Denoise). ``"auto"`` measures on
            two halves of the samples whether that brings them nearer to the truth; ``info["picture"]`` says what
            was done.
        checkpoint
            A folder that keeps every finished pass: a job that was killed goes on from there when it is started
            again with the same arguments. ``info["checkpoint"]`` counts the passes that came from it.
        show_progress
            Whether to show a progress bar.

        Returns
        -------
        SceneAttribution
            A 0-d value for each player, in units of the metric, with its parameters in ``info["groups"]``. The
            errors hold the noise of the renders and the choice of the permutations together.

        Raises
        ------
        SceneCaptumError
            Where baselines or groups do not fit the parameters, all players are at their baselines already or too
            many for ``"all"``, or the metric is not a finite scalar.
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
            Arm(_described(joined, players), partial(_scene, joined, members, values, absent))
            for joined in game.coalitions
        ]
        measured = self._measure(
            arms,
            target,
            Settings(seed, spp, replicates, show_progress, checkpoint=checkpoint, denoise=denoise),
        )

        def effects_of(pseudo: torch.Tensor) -> tuple[Effects, Missed | None]:
            return _effects(game, pseudo, members)

        count, drawn = len(measured.budget.seeds), len(game.finished(len(measured.pseudo)))
        return self._results(
            measured,
            target,
            effects_of,
            quantity="Shapley value",
            groups={group: list(names) for group, names in members.items()},
            permutations="all" if orders is None else 2 * drawn,
            passes=count if orders is None else min(count, drawn),  # sets the errors' degrees of freedom
        )


@dataclass(frozen=True)
class _Game:
    """Who joins in which orders (one of each pair with its reverse, None for all), by way of which coalitions."""

    players: Order
    orders: list[Order] | None
    coalitions: list[Coalition]

    def finished(self, measured: int) -> list[Order]:
        """Return the orders whose coalitions, and those of their reverse, are among the first so many."""
        done = set(self.coalitions[:measured])
        return [order for order in self.orders or () if done.issuperset(_both_ways(order))]


def _players(values: Values, absent: Values, members: Mapping[str, tuple[str, ...]]) -> Order:
    """Return the groups that change anything by joining."""
    players = tuple(
        group
        for group, names in members.items()
        if any(not torch.equal(values[name], absent[name]) for name in names)
    )
    if not players:
        raise SceneCaptumError(
            f"There is nothing to share out: all {len(values)} inputs are at their baselines already. Give "
            "others with baselines=, a number or a mapping by name, say."
        )
    return players


def _orders(players: Order, n_samples: int | Literal["all"], seed: int) -> list[Order] | None:
    """Draw the orders in which players join, one of each pair with its reverse; None stands for all orders."""
    if isinstance(n_samples, str):
        if n_samples != "all":
            raise SceneCaptumError(f'n_samples must be a number of permutations or "all", not {n_samples!r}.')
        if len(players) > MOST_EXACT_PLAYERS:
            raise SceneCaptumError(
                f'n_samples="all" renders every subset of at most {MOST_EXACT_PLAYERS} players, and there are '
                f"{len(players)}. Join some with groups=, or give a number of permutations."
            )
        return None
    pairs = math.ceil(whole_number("n_samples", n_samples) / 2)
    if len(players) <= 2:
        return None  # an order and its reverse are all there are
    # A stream of its own, independent of the seeds of the renders.
    (stream,) = np.random.SeedSequence(check_seed("seed", seed)).spawn(1)
    generator = np.random.default_rng(stream)
    return [tuple(players[i] for i in generator.permutation(len(players))) for _ in range(pairs)]


def _walk(order: Order) -> list[Coalition]:
    """Return what has joined before each player and in the end."""
    return [frozenset(order[:count]) for count in range(len(order) + 1)]


def _both_ways(order: Order) -> list[Coalition]:
    return _walk(order) + _walk(order[::-1])


def _coalitions(players: Order, orders: list[Order] | None) -> list[Coalition]:
    """Return every coalition that is needed, once each, the full one first."""
    if orders is None:
        needed = [frozenset(c) for size in range(len(players) + 1) for c in combinations(players, size)]
    else:
        needed = [joined for order in orders for joined in _both_ways(order)]
    return list(dict.fromkeys([frozenset(players), frozenset(), *needed]))


def _scene(
    joined: Coalition, members: Mapping[str, tuple[str, ...]], values: Values, absent: Values
) -> dict[str, torch.Tensor]:
    here = {name for player in joined for name in members[player]}
    return {name: value if name in here else absent[name] for name, value in values.items()}


def _described(joined: Coalition, players: Order) -> str:
    away = [player for player in players if player not in joined]
    if not away:
        return "the unchanged scene"
    named = "all" if len(away) == len(players) else ", ".join(map(repr, away[:3]))
    return f"the scene with {named}{' …' if 3 < len(away) < len(players) else ''} at the baselines"


def _exact(metric_of: Mapping[Coalition, torch.Tensor], players: Order) -> torch.Tensor:
    """Return Shapley's formula in every replicate, ``(1, replicates, players)``."""
    count = len(players)
    shares = []
    for player in players:
        share = torch.zeros_like(metric_of[frozenset()])
        for joined, metric in metric_of.items():
            if player not in joined:
                weight = 1 / (count * math.comb(count - 1, len(joined)))
                share += weight * (metric_of[joined | {player}] - metric)
        shares.append(share)
    return torch.stack(shares, -1)[None]


def _sampled(
    metric_of: Mapping[Coalition, torch.Tensor], players: Order, orders: list[Order]
) -> torch.Tensor:
    """Return what each player adds, averaged over an order and its reverse: ``(pairs, replicates, players)``."""
    pairs = []
    for order in orders:
        added = dict.fromkeys(players, torch.zeros_like(metric_of[frozenset()]))
        for way in (order, order[::-1]):
            for player, (before, after) in zip(way, pairwise(_walk(way)), strict=True):
                added[player] = added[player] + (metric_of[after] - metric_of[before]) / 2
        pairs.append(torch.stack([added[player] for player in players], -1))
    return torch.stack(pairs)


def _effects(
    game: _Game, pseudo: torch.Tensor, members: Mapping[str, tuple[str, ...]]
) -> tuple[Effects, Missed | None]:
    """Return every group's value, 0 where it changes nothing, and what they miss of the whole by rounding."""
    metric_of = dict(zip(game.coalitions, pseudo, strict=False))
    finished = game.finished(len(pseudo))
    if game.orders is None and len(metric_of) == len(game.coalitions):
        shares = _exact(metric_of, game.players)
    elif finished:
        shares = _sampled(metric_of, game.players, finished)
    else:
        return {}, None
    of = {player: shares[..., index] for index, player in enumerate(game.players)}
    nothing = torch.zeros_like(shares[..., 0])
    gained = (metric_of[frozenset(game.players)] - metric_of[frozenset()]).mean()
    return (
        {group: _effect(of.get(group, nothing), exact=game.orders is None) for group in members},
        Missed((shares.mean((0, 1)).sum() - gained).item(), gained.item()),
    )


def _effect(shares: torch.Tensor, *, exact: bool) -> Effect:
    pairs, replicates = shares.shape
    if exact:
        return Effect.of_totals(shares.reshape(replicates, 1), torch.zeros(()))
    value = shares.mean().float()
    if min(pairs, replicates) < 2:
        return Effect(value, None, None, None)
    variance = _crossed_variance(shares)
    # No replicates: their spread alone would pass for the whole error where two results are subtracted.
    return Effect(value, variance.sqrt().float(), None, variance.reshape(1, 1))


def _crossed_variance(shares: torch.Tensor) -> torch.Tensor:
    """Return the variance of the mean of ``(pairs, replicates)`` numbers, where both rows and columns are drawn.

    With ``x = μ + pair + replicate + rest`` the spread of the row means and that of the column means both hold the
    rest once, so it is taken off once (Searle, Casella and McCulloch, "Variance Components", 1992, chapter 4).
    """
    pairs, replicates = shares.shape
    rows, columns = shares.mean(1), shares.mean(0)
    rest = shares - rows[:, None] - columns + shares.mean()
    rest_mean_square = rest.square().sum() / ((pairs - 1) * (replicates - 1))
    by_pairs, by_replicates = rows.var() / pairs, columns.var() / replicates
    both = by_pairs + by_replicates - rest_mean_square / (pairs * replicates)
    return torch.stack([both, by_pairs, by_replicates]).max()
