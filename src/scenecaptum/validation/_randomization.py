"""Model parameter randomisation: whether an attribution depends on the learnt weights of a metric's network."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch

from ..attr import SceneAttribution, VanillaSceneGradient
from ..checkpoint import Folder, with_checkpoint
from ..errors import SceneCaptumError, check_seed, whole_number
from ..estimation import DEFAULT_REPLICATES, Metric, Target, channel_totals
from ..protocols import Renderer
from ..ranks import spearman
from ._randomization_result import RandomizationCheck

MIN_PARAMETERS = 4  # for a meaningful rank correlation


def randomization_check(  # noqa: PLR0913 -- the options of every check, and its own
    renderer: Renderer,
    metric: Metric,
    target: Target = None,
    *,
    method: Any = VanillaSceneGradient,
    stages: int = 3,
    draws: int = 4,
    seed: int = 0,
    spp: int | None = None,
    replicates: int = DEFAULT_REPLICATES,
    checkpoint: Folder = None,
) -> RandomizationCheck:
    """Randomise the layers of a metric's network, starting at the output, and compare the attributions.

    An attribution that does not change reflects the scene and not the network. Large and bright objects rank high
    for almost any network, so the magnitudes may change less than the signs. Each layer is re-initialised by its
    ``reset_parameters``, or else with normal numbers of the mean and standard deviation of its weights; layers of
    earlier stages stay randomised. The metric itself is not modified.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", "reflectance", resolution=(16, 16), spp=8)
    >>> metric = metrics.ClassLogit(metrics.ShapeClassifier.pretrained(), target="cube")
    >>> check = randomization_check(renderer, metric, stages=2, draws=2)
    >>> check.magnitudes.shape  # none, half and all layers randomised
    torch.Size([3, 2])

    Parameters
    ----------
    renderer, target
        As for ``VanillaSceneGradient``.
    metric
        A ``torch.nn.Module`` with parameters, for example ``metrics.ClassLogit``.
    method
        The class of the attribution method to check.
    stages
        Maximum number of stages in which the layers are randomised; 1 for all at once.
    draws
        Number of random weight initialisations, and of repeats of the unmodified network with other seeds.
    seed
        Base seed; all other seeds, including those of the weights, are derived from it.
    spp
        Total samples per pixel of each attribution; the renderer's by default.
    replicates
        Minimum number of independent replicates of each attribution.
    checkpoint
        Folder that stores every finished replicate. A killed job resumes from it when it is started again with
        the same arguments.

    Returns
    -------
    RandomizationCheck
        Rank correlations with the attribution of the unmodified network, summarised in ``verdict``.

    Raises
    ------
    SceneCaptumError
        If the metric has no parameters, or fewer than four inputs are ranked.

    References
    ----------
    Adebayo et al., "Sanity Checks for Saliency Maps", NeurIPS 2018.
    """
    renderer = with_checkpoint(renderer, checkpoint)
    layers = _layers(metric)
    steps = min(whole_number("stages", stages), len(layers))
    ends = [round(len(layers) * stage / steps) for stage in range(steps + 1)]
    count = whole_number("draws", draws, 2)
    # For the reference; and for each draw the weights, the repeat of the unmodified network and every stage.
    sequence = np.random.SeedSequence([check_seed("seed", seed), 8])
    seeds = iter(sequence.generate_state(1 + count * (2 + steps)).tolist())

    def attribute(network: Metric) -> SceneAttribution:
        options = {"seed": next(seeds), "spp": spp, "replicates": replicates}
        attribution: SceneAttribution = method(renderer, network).attribute(target=target, **options)
        return attribution

    reference = attribute(metric)
    if len(reference) < MIN_PARAMETERS:
        raise SceneCaptumError(
            f"A rank correlation needs at least {MIN_PARAMETERS} parameters, not {len(reference)}: select more "
            "with inputs=."
        )
    correlations = []
    for _ in range(count):
        networks: list[Metric] = [metric, *_randomized(metric, layers, ends, next(seeds))]
        attributions = [attribute(network) for network in networks]
        correlations.append(
            [
                [_correlation(values(reference), values(a)) for values in (_magnitudes, _signed)]
                for a in attributions
            ]
        )
    magnitudes, signed = torch.tensor(correlations, dtype=torch.float64).permute(2, 1, 0)
    return RandomizationCheck(
        layers=tuple(layers),
        randomized=tuple(ends),
        magnitudes=magnitudes,
        signed=signed,
        metric=str(reference.info["metric"]),
        method=str(reference.info["method"]),
    )


def _magnitudes(attribution: SceneAttribution) -> torch.Tensor:
    return torch.tensor(list(attribution.saliency().values()))


def _signed(attribution: SceneAttribution) -> torch.Tensor:
    return torch.cat([channel_totals(value) for value in attribution.values()])


def _correlation(a: torch.Tensor, b: torch.Tensor) -> float:
    """Return the rank correlation; 0 if all values of one are tied."""
    correlation = spearman(a, b)
    return 0.0 if math.isnan(correlation) else correlation


def _layers(metric: Metric) -> list[str]:
    """Return the names of the modules with their own parameters, from the output to the input."""
    modules = dict(metric.named_modules()) if isinstance(metric, torch.nn.Module) else {}
    layers = [name for name, module in modules.items() if any(True for _ in module.parameters(recurse=False))]
    if not layers:
        raise SceneCaptumError(
            f"randomization_check needs a metric with parameters to randomise, and {_name(metric)} has none. "
            "Pass a torch.nn.Module that contains the network, for example metrics.ClassLogit(network)."
        )
    return layers[::-1]


def _name(metric: Metric) -> str:
    return str(getattr(metric, "__name__", type(metric).__name__))


def _randomized(
    metric: Metric, layers: Sequence[str], ends: Sequence[int], seed: int
) -> Iterator[torch.nn.Module]:
    """Yield copies of the metric with its first ``ends[1]``, ``ends[2]``, ... layers randomised."""
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
    reset_parameters = getattr(layer, "reset_parameters", None)
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(seed)
        if reset_parameters is not None:
            reset_parameters()
            return
        for weights in layer.parameters(recurse=False):
            spread = weights.std().item() if weights.numel() > 1 else abs(weights.item())
            weights.normal_(weights.mean().item(), spread)
