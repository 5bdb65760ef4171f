"""Whether a ranking depends on what a metric's network has learnt: its weights are made random."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ..attr import SceneAttribution, VanillaSceneGradient
from ..attr._metric import Metric, Target
from ..attr._passes import DEFAULT_PASSES
from ..errors import SceneCaptumError, check_seed, whole_number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FEWEST = 4  # parameters of which a rank correlation says anything


@dataclass(frozen=True, repr=False)
class RandomisationCheck:
    """How much of a ranking is left when a network's layers are made random; prints as a table.

    Attributes
    ----------
    layers
        The network's layers from the output to the input.
    randomised
        ``(stages,)``: how many of them were random at each stage.
    correlations
        ``(stages, draws)``: Spearman's correlation of the saliencies with those of the network itself.
    ceiling
        ``(draws,)``: the same for the network itself and other seeds of the renderer: what noise leaves of it.
    metric, method
        What was attributed, and how.
    """

    layers: tuple[str, ...]
    randomised: tuple[int, ...]
    correlations: torch.Tensor
    ceiling: torch.Tensor
    metric: str
    method: str

    @property
    def changes(self) -> bool:
        """Whether with all layers random every correlation is below every one of the network itself.

        If the weights made no difference this would happen by chance once in ``(2n choose n)`` times for ``n``
        draws: once in 70 for 4.
        """
        return bool(self.correlations[-1].max() < self.ceiling.min())

    @property
    def verdict(self) -> str:
        """One sentence."""
        what = "depends" if self.changes else "cannot be told to depend"
        return (
            f"the ranking {what} on what the network has learnt: with all {len(self.layers)} layers random its "
            f"rank correlation with the network's own is {_span(self.correlations[-1])}, against "
            f"{_span(self.ceiling)} for the same network and other seeds"
        )

    def plot(self, ax: Axes | None = None) -> Figure:
        """Draw the correlations over the number of random layers, and their ceiling."""
        from ..visualization import plot_randomisation

        return plot_randomisation(self, ax=ax)

    def __str__(self) -> str:
        from ..visualization import randomisation_text

        return randomisation_text(self)

    __repr__ = __str__


def randomisation_check(
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
) -> RandomisationCheck:
    """Make the layers of a metric's network random, from the output on, and see whether the ranking changes.

    An attribution that stays the same shows the scene and not the network. Every layer is initialised anew, by
    its own ``reset_parameters`` or else by normal numbers of the weights' own mean and standard deviation; those
    of earlier stages stay random. The metric itself is left as it is.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", "reflectance", resolution=(16, 16), spp=8)
    >>> metric = metrics.ClassLogit(metrics.ShapeClassifier.pretrained(), target="cube")
    >>> check = randomisation_check(renderer, metric, stages=2, draws=2)
    >>> check.correlations.shape
    torch.Size([2, 2])

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

    Raises
    ------
    SceneCaptumError
        Where the metric has no parameters, or fewer than four inputs are ranked.

    References
    ----------
    Adebayo et al., "Sanity Checks for Saliency Maps", NeurIPS 2018.
    """
    layers = _layers(metric)
    steps = min(whole_number("stages", stages), len(layers))
    ends = [round(len(layers) * stage / steps) for stage in range(steps + 1)]
    count = whole_number("draws", draws, 2)
    # For the network itself, each of its repeats, and of each draw the weights and all stages.
    sequence = np.random.SeedSequence([check_seed("seed", seed), 8])
    seeds = iter(sequence.generate_state(1 + count + count * (1 + steps)).tolist())

    def attribute(network: Metric) -> SceneAttribution:
        options = {"seed": next(seeds), "spp": spp, "replicates": replicates}
        found: SceneAttribution = method(renderer, network).attribute(target=target, **options)
        return found

    own = attribute(metric)
    if len(own) < FEWEST:
        raise SceneCaptumError(
            f"A rank correlation takes at least {FEWEST} parameters, not {len(own)}: select more with inputs=."
        )
    ceiling = [spearman(own, attribute(metric)) for _ in range(count)]
    drawn = [
        [spearman(own, attribute(network)) for network in _randomised(metric, layers, ends, next(seeds))]
        for _ in range(count)
    ]
    return RandomisationCheck(
        layers=tuple(layers),
        randomised=tuple(ends[1:]),
        correlations=torch.tensor(drawn, dtype=torch.float64).T,
        ceiling=torch.tensor(ceiling, dtype=torch.float64),
        metric=str(own.info["metric"]),
        method=str(own.info["method"]),
    )


def spearman(one: SceneAttribution, two: SceneAttribution) -> float:
    """Return the rank correlation of the saliencies of two attributions to the same parameters.

    A ranking of nothing but ties agrees with no other: 0.
    """
    both = [one.saliency(), two.saliency()]
    ranks = torch.stack([_ranks(torch.tensor([each[name] for name in one])) for each in both])
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
    network = copy.deepcopy(metric)
    assert isinstance(network, torch.nn.Module)
    states = np.random.SeedSequence(seed).generate_state(len(layers)).tolist()
    start = 0
    for end in ends[1:]:
        for name, state in zip(layers[start:end], states[start:end], strict=True):
            _reset(network.get_submodule(name), state)
        yield network
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


def _span(values: torch.Tensor) -> str:
    return f"{values.mean():.2f} ({values.min():.2f} to {values.max():.2f})"
