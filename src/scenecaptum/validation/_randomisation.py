"""Whether an attribution depends on what a metric's network has learnt: its weights are made random."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ..attr import SceneAttribution, VanillaSceneGradient
from ..attr._metric import Metric, Target
from ..attr._passes import DEFAULT_PASSES, channel_totals
from ..checkpoint import Folder, with_checkpoint
from ..errors import SceneCaptumError, check_seed, whole_number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FEWEST = 4  # parameters of which a rank correlation says anything


@dataclass(frozen=True, repr=False)
class RandomisationCheck:
    """How much of an attribution is left when a network's layers are made random; prints as a table.

    Attributes
    ----------
    layers
        The network's layers from the output to the input.
    randomised
        How many of them were random at each stage, from 0 to all.
    magnitudes
        ``(stages, draws)``: Spearman's correlation of the saliencies with those of the network itself. The first
        row is of the network itself with other seeds of the renderer: what noise leaves of it.
    signed
        The same of the attributions with their signs, channel by channel.
    metric, method
        What was attributed, and how.
    """

    layers: tuple[str, ...]
    randomised: tuple[int, ...]
    magnitudes: torch.Tensor
    signed: torch.Tensor
    metric: str
    method: str

    @property
    def ranking_changes(self) -> bool:
        """Whether with all layers random every correlation of saliencies is below all of the network itself.

        If the weights made no difference this would happen by chance once in ``(2n choose n)`` times for ``n``
        draws: once in 70 for 4.
        """
        return _all_below(self.magnitudes)

    @property
    def signs_change(self) -> bool:
        """The same of the attributions with their signs."""
        return _all_below(self.signed)

    @property
    def verdict(self) -> str:
        """One sentence."""
        changed = [
            what
            for what, changes in (("ranking", self.ranking_changes), ("signs", self.signs_change))
            if changes
        ]
        depends = (
            f"the attribution depends on what the network has learnt, by its {' and its '.join(changed)}"
            if changed
            else "the attribution cannot be told to depend on what the network has learnt"
        )
        return (
            f"{depends}: with all {len(self.layers)} layers random its magnitudes have a rank correlation of "
            f"{_span(self.magnitudes[-1])} with the network's own, against {_span(self.magnitudes[0])} for the "
            f"same network and other seeds; with signs {_span(self.signed[-1])} against {_span(self.signed[0])}"
        )

    def plot(self, ax: Axes | None = None) -> Figure:
        """Draw the correlations over the number of random layers, and their ceiling."""
        from ..visualization import plot_randomisation

        return plot_randomisation(self, ax=ax)

    def __str__(self) -> str:
        from ..visualization import randomisation_text

        return randomisation_text(self)

    __repr__ = __str__


def randomisation_check(  # noqa: PLR0913 -- those of every long job, and its own
    renderer: Any,
    metric: Metric,
    target: Target = None,
    *,
    method: Any = VanillaSceneGradient,
    stages: int = 3,
    draws: int = 4,
    seed: int = 0,
    spp: int | None = None,
    replicates: int = DEFAULT_PASSES,
    checkpoint: Folder = None,
) -> RandomisationCheck:
    """Make the layers of a metric's network random, from the output on, and see whether the attribution changes.

    One that stays the same shows the scene and not the network. Large and bright objects rank high for almost any
    network, so that magnitudes may change little where signs do. Every layer is initialised anew, by
    its own ``reset_parameters`` or else by normal numbers of the weights' own mean and standard deviation; those
    of earlier stages stay random. The metric itself is left as it is.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", "reflectance", resolution=(16, 16), spp=8)
    >>> metric = metrics.ClassLogit(metrics.ShapeClassifier.pretrained(), target="cube")
    >>> check = randomisation_check(renderer, metric, stages=2, draws=2)
    >>> check.magnitudes.shape  # none, half and all layers random
    torch.Size([3, 2])

    Parameters
    ----------
    renderer, target
        As for ``VanillaSceneGradient``.
    metric
        A ``torch.nn.Module`` with parameters, ``metrics.ClassLogit`` for instance.
    method
        The attribution method that is checked, a class.
    stages
        In how many stages at most all layers become random; 1 for all at once.
    draws
        How many times the weights are drawn, and the network itself attributed again with another seed.
    seed
        Seed from which all others are drawn, those of the weights as well.
    spp
        Total samples per pixel of each attribution; the renderer's by default.
    replicates
        Least number of independent passes of each attribution.
    checkpoint
        A folder that keeps every finished pass: a job that was killed goes on from there when it is started again
        with the same arguments.

    Returns
    -------
    RandomisationCheck
        Rank correlations with the attribution of the network itself; ``verdict`` judges them.

    Raises
    ------
    SceneCaptumError
        Where the metric has no parameters, or fewer than four inputs are ranked.

    References
    ----------
    Adebayo et al., "Sanity Checks for Saliency Maps", NeurIPS 2018.
    """
    renderer = with_checkpoint(renderer, checkpoint)
    layers = _layers(metric)
    steps = min(whole_number("stages", stages), len(layers))
    ends = [round(len(layers) * stage / steps) for stage in range(steps + 1)]
    count = whole_number("draws", draws, 2)
    # For the network itself, and of each draw for the weights, the network itself again and all stages.
    sequence = np.random.SeedSequence([check_seed("seed", seed), 8])
    seeds = iter(sequence.generate_state(1 + count * (2 + steps)).tolist())

    def attribute(network: Metric) -> SceneAttribution:
        options = {"seed": next(seeds), "spp": spp, "replicates": replicates}
        found: SceneAttribution = method(renderer, network).attribute(target=target, **options)
        return found

    own = attribute(metric)
    if len(own) < FEWEST:
        raise SceneCaptumError(
            f"A rank correlation takes at least {FEWEST} parameters, not {len(own)}: select more with inputs=."
        )
    drawn = []
    for _ in range(count):
        networks: list[Metric] = [metric, *_randomised(metric, layers, ends, next(seeds))]
        found = [attribute(network) for network in networks]
        drawn.append([(_spearman(own, one, _magnitudes), _spearman(own, one, _signed)) for one in found])
    magnitudes, signed = torch.tensor(drawn, dtype=torch.float64).permute(2, 1, 0)
    return RandomisationCheck(
        layers=tuple(layers),
        randomised=tuple(ends),
        magnitudes=magnitudes,
        signed=signed,
        metric=str(own.info["metric"]),
        method=str(own.info["method"]),
    )


def _magnitudes(attribution: SceneAttribution) -> torch.Tensor:
    return torch.tensor(list(attribution.saliency().values()))


def _signed(attribution: SceneAttribution) -> torch.Tensor:
    return torch.cat([channel_totals(one) for one in attribution.values()])


def _spearman(
    one: SceneAttribution, two: SceneAttribution, of: Callable[[SceneAttribution], torch.Tensor]
) -> float:
    """Return the rank correlation of two attributions to the same parameters; a ranking of ties has none."""
    ranks = torch.stack([_ranks(of(one)), _ranks(of(two))])
    return 0.0 if bool((ranks.std(1) == 0).any()) else torch.corrcoef(ranks)[0, 1].item()


def _ranks(values: torch.Tensor) -> torch.Tensor:
    """Return the ranks, of equal values their mean."""
    below = (values[:, None] > values).sum(1)
    return below + ((values[:, None] == values).double().sum(1) + 1) / 2


def _layers(metric: Metric) -> list[str]:
    """Return the names of the modules with parameters of their own, the output's first."""
    modules = dict(metric.named_modules()) if isinstance(metric, torch.nn.Module) else {}
    layers = [name for name, module in modules.items() if any(True for _ in module.parameters(recurse=False))]
    if not layers:
        raise SceneCaptumError(
            f"randomisation_check takes a metric with parameters to make random, and {_name(metric)} has none. "
            "Give a torch.nn.Module that holds the network, metrics.ClassLogit(network) for instance."
        )
    return layers[::-1]


def _name(metric: Metric) -> str:
    return str(getattr(metric, "__name__", type(metric).__name__))


def _randomised(
    metric: Metric, layers: Sequence[str], ends: Sequence[int], seed: int
) -> Iterator[torch.nn.Module]:
    """Yield the metric with more and more of its layers random."""
    start = 0
    network = copy.deepcopy(metric)
    assert isinstance(network, torch.nn.Module)
    states = np.random.SeedSequence(seed).generate_state(len(layers)).tolist()
    for end in ends[1:]:
        for name, state in zip(layers[start:end], states[start:end], strict=True):
            _reset(network.get_submodule(name), state)
        yield copy.deepcopy(network)
        start = end


def _reset(layer: torch.nn.Module, seed: int) -> None:
    own = getattr(layer, "reset_parameters", None)
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(seed)
        if own is not None:
            own()
            return
        for weights in layer.parameters(recurse=False):
            spread = weights.std().item() if weights.numel() > 1 else abs(weights.item())
            weights.normal_(weights.mean().item(), spread)


def _all_below(correlations: torch.Tensor) -> bool:
    return bool(correlations[-1].max() < correlations[0].min())


def _span(values: torch.Tensor) -> str:
    return f"{values.mean():.2f} ({values.min():.2f} to {values.max():.2f})"
