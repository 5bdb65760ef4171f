"""Model parameter randomization: whether an attribution depends on the learnt weights of a metric's network."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from ..attr import SceneAttribution, VanillaSceneGradient
from ..checkpoint import Folder, with_checkpoint
from ..errors import SceneCaptumError, whole_number
from ..estimation import DEFAULT_REPLICATES, Metric, Stream, Target, channel_totals, derived_seeds
from ..protocols import Renderer
from ..ranks import spearman
from ..visualization import (
    LOWERS,
    RAISES,
    SMALL,
    add_footnotes,
    axes_or_new,
    figure_of,
    grid,
    metric_name,
    minus,
    pluralize,
    shorten,
    style_axes,
    wrapped_lines,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MIN_PARAMETERS = 4  # for a meaningful rank correlation
MIN_DRAWS = 4  # for a verdict: with fewer, chance alone often separates the correlations
MIN_CORRELATION = 0.7  # between runs of the unmodified network, for a verdict
_NAME_WIDTH, _NOTE_WIDTH = 36, 76


def randomization_check(  # noqa: PLR0913 -- the options of every check, and its own
    renderer: Renderer,
    metric: Metric,
    target: Target = None,
    *,
    method: Any = VanillaSceneGradient,
    stages: int | None = 3,
    draws: int = 4,
    seed: int = 0,
    spp: int | None = None,
    replicates: int = DEFAULT_REPLICATES,
    checkpoint: Folder = None,
) -> RandomizationCheck:
    """Randomize the layers of a metric's network, starting at the output, and compare the attributions.

    An attribution that does not change reflects the scene and not the network. Large and bright objects rank high
    for almost any network, so the magnitudes may change less than the signs. Each layer is re-initialised by its
    ``reset_parameters``, or else with normal numbers of the mean and standard deviation of its weights; layers of
    earlier stages stay randomized. The metric itself is not modified.

    The statistics of batch normalization are reset with its weights, to mean 0 and variance 1. Those of the learnt
    weights do not fit random ones: most units are then always or never active, and the network is nearly linear.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", "reflectance", resolution=(16, 16), spp=8)
    >>> metric = metrics.ClassLogit(metrics.ShapeClassifier.pretrained(), target="cube")
    >>> check = randomization_check(renderer, metric, stages=2, draws=2)
    >>> check.magnitudes.shape  # none, half and all layers randomized
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
        Maximum number of stages in which the layers are randomized; 1 for all at once, None for layer by layer.
    draws
        Number of random weight initialisations, and of repeats of the unmodified network with other seeds.
    seed, spp, replicates, checkpoint
        As for ``ablation_test``; ``spp`` and ``replicates`` are those of each attribution.

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
    steps = len(layers) if stages is None else min(whole_number("stages", stages), len(layers))
    ends = [round(len(layers) * stage / steps) for stage in range(steps + 1)]
    count = whole_number("draws", draws, 2)
    # For the reference; and for each draw the weights, the repeat of the unmodified network and every stage.
    seeds = iter(derived_seeds(seed, Stream.RANDOM_NETWORKS, 1 + count * (2 + steps)))

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
        for values in (_magnitudes, _signed):
            correlations.append([_correlation(values(reference), values(a)) for a in attributions])
    magnitudes, signed = (
        torch.tensor(correlations, dtype=torch.float64).reshape(count, 2, -1).permute(1, 2, 0)
    )
    return RandomizationCheck(
        layers=tuple(layers),
        randomized=tuple(ends),
        magnitudes=magnitudes,
        signed=signed,
        metric=metric_name(reference),
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
    """Return the names of the modules with parameters or statistics of their own, from the output to the input."""
    modules = dict(metric.named_modules()) if isinstance(metric, torch.nn.Module) else {}
    layers = [name for name, module in modules.items() if _is_learnt(module)]
    if not layers:
        raise SceneCaptumError(
            f"randomization_check needs a metric with parameters to randomize, and {_name(metric)} has none. "
            "Pass a torch.nn.Module that contains the network, for example metrics.ClassLogit(network)."
        )
    return layers[::-1]


def _is_learnt(module: torch.nn.Module) -> bool:
    has_parameters = any(True for _ in module.parameters(recurse=False))
    return has_parameters or getattr(module, "running_mean", None) is not None


def _name(metric: Metric) -> str:
    return str(getattr(metric, "__name__", type(metric).__name__))


def _randomized(
    metric: Metric, layers: Sequence[str], ends: Sequence[int], seed: int
) -> Iterator[torch.nn.Module]:
    """Yield copies of the metric with its first ``ends[1]``, ``ends[2]``, ... layers randomized."""
    start = 0
    network = copy.deepcopy(metric)
    assert isinstance(network, torch.nn.Module)
    states = derived_seeds(seed, Stream.NETWORK_LAYERS, len(layers))
    for end in ends[1:]:
        for name, state in zip(layers[start:end], states[start:end], strict=True):
            _reset(network.get_submodule(name), state)
        yield copy.deepcopy(network)
        start = end


def _reset(layer: Any, seed: int) -> None:
    reset_parameters = getattr(layer, "reset_parameters", None)
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(seed)
        if reset_parameters is not None:
            reset_parameters()
            return
        if getattr(layer, "running_mean", None) is not None:
            layer.running_mean.zero_()
            layer.running_var.fill_(1)
        for weights in layer.parameters(recurse=False):
            spread = weights.std().item() if weights.numel() > 1 else abs(weights.item())
            weights.normal_(weights.mean().item(), spread)


@dataclass(frozen=True, repr=False)
class RandomizationCheck:
    """Rank correlation of attributions with randomized and with learnt weights; prints as a table.

    Attributes
    ----------
    layers
        The network's layers, from the output to the input.
    randomized
        Number of randomized layers at each stage, from 0 to all.
    magnitudes
        ``(stages, draws)``: Spearman correlation of the saliencies with those of the unmodified network. The first
        row repeats the unmodified network with other renderer seeds: the upper limit that noise sets.
    signed
        The same for the signed attributions, channel by channel.
    metric, method
        Names of the metric and of the attribution method.
    """

    layers: tuple[str, ...]
    randomized: tuple[int, ...]
    magnitudes: torch.Tensor
    signed: torch.Tensor
    metric: str
    method: str

    @property
    def ranking_changes(self) -> bool:
        """Whether every correlation with all layers randomized is below every one of the unmodified network.

        If the weights made no difference, the probability of this would be 1 in ``(2n choose n)`` for ``n`` draws:
        1 in 70 for 4.
        """
        return _first_change(self.magnitudes) is not None

    @property
    def signs_change(self) -> bool:
        """The same for the signed attributions."""
        return _first_change(self.signed) is not None

    @property
    def too_noisy(self) -> bool:
        """Whether the attribution of the unmodified network is not reproducible: a mean correlation below 0.7.

        Noise then hides a dependence on the weights. Smooth the metric, or use more samples.
        """
        return not (_is_reproducible(self.magnitudes) and _is_reproducible(self.signed))

    @property
    def first_change(self) -> str | None:
        """The layer back to which the network is randomized when the attribution begins to differ, or None.

        At this and all later stages, all correlations of the magnitudes, or all of the signed attributions, are
        below those of the unmodified network. Those that are too noisy do not count.
        """
        stages = [_first_change(values) for values in self._reproducible().values()]
        first = min((stage for stage in stages if stage is not None), default=None)
        return None if first is None else self.layers[self.randomized[first] - 1]

    def _reproducible(self) -> dict[str, torch.Tensor]:
        named = {"ranking": self.magnitudes, "signs": self.signed}
        return {name: values for name, values in named.items() if _is_reproducible(values)}

    @property
    def verdict(self) -> str:
        """The result in one sentence."""
        changed = [name for name, v in self._reproducible().items() if _first_change(v) is not None]
        draws = self.magnitudes.shape[1]
        if draws < MIN_DRAWS:
            result = f"{pluralize(draws, 'draw')} of random weights cannot tell: use {MIN_DRAWS} or more"
        elif changed:
            first = self.first_change or "the parameters of the network itself"
            result = (
                f"the attribution depends on the learnt weights, in its {' and its '.join(changed)}, "
                f"once the layers back to {first} are randomized"
            )
        elif self.too_noisy:
            result = "too noisy to tell: use smoothing= or more samples"
        else:
            result = "the attribution shows no dependence on the learnt weights"
        return (
            f"{result}: with {_all(self.layers)} randomized, the magnitudes have a rank correlation "
            f"of {_mean_and_range(self.magnitudes[-1])} with those of the unmodified network, against "
            f"{_mean_and_range(self.magnitudes[0])} for the unmodified network with other seeds; signed "
            f"attributions {_mean_and_range(self.signed[-1])} against {_mean_and_range(self.signed[0])}"
        )

    def plot(self, *, ax: Axes | None = None) -> Figure:
        """Plot mean and draws of the rank correlations over the randomized layers, into ``ax`` if given."""
        ax = axes_or_new(ax, 5.4, 3.9)
        # Shifted sideways, since both begin near 1.
        shift = 0.01 * self.randomized[-1]
        curves = ((RAISES, self.magnitudes, "magnitudes", -shift), (LOWERS, self.signed, "signed", shift))
        for color, rows, label, offset in curves:
            positions = [count + offset for count in self.randomized]
            ax.plot(positions, rows.mean(1), color=color, linewidth=1.5, label=label)
            for draw in rows.T:
                ax.scatter(positions, draw, s=18, facecolors="none", edgecolors=color, zorder=3)
        ax.axhline(0, color="0.75", linewidth=1, zorder=0)
        lowest = min(self.magnitudes.min().item(), self.signed.min().item(), 0.0)
        ax.set_ylim(lowest - 0.05, 1.05)
        ax.set_xticks(self.randomized)
        x = "randomized layers, from the output; 0: other seeds only"
        style_axes(ax, "Randomization check", x=x, y="rank correlation (Spearman)")
        ax.legend(fontsize=SMALL, frameon=False)
        add_footnotes(ax, wrapped_lines(self.verdict, _NOTE_WIDTH), below=34)
        return figure_of(ax)

    def __str__(self) -> str:
        names = shorten(["none", *(self.layers[count - 1] for count in self.randomized[1:])], _NAME_WIDTH)
        counts = [f"{count} of {len(self.layers)}" for count in self.randomized]
        columns = (map(_mean_and_range, values) for values in (self.magnitudes, self.signed))
        rows = list(zip(counts, names, *columns, strict=True))
        head = (
            f"{self.metric}, {self.method}: rank correlation with the attribution of the unmodified network"
        )
        lines = grid(("random layers", "back to", "magnitudes", "signed"), rows)
        return "\n".join([head, "", *lines, "", *wrapped_lines(self.verdict, 100)])

    __repr__ = __str__


def _first_change(correlations: torch.Tensor) -> int | None:
    """Return the first stage from which on all correlations are below all of stage 0; None if the last is not."""
    below = (correlations.max(1).values < correlations[0].min()).tolist()
    unchanged = [stage for stage, is_below in enumerate(below) if not is_below]  # stage 0 is one
    return None if unchanged[-1] == len(below) - 1 else unchanged[-1] + 1


def _is_reproducible(correlations: torch.Tensor) -> bool:
    return bool(correlations[0].mean() >= MIN_CORRELATION)


def _all(layers: Sequence[str]) -> str:
    return "the only layer" if len(layers) == 1 else f"all {len(layers)} layers"


def _mean_and_range(values: torch.Tensor) -> str:
    mean, low, high = (_written(one.item()) for one in (values.mean(), values.min(), values.max()))
    return f"{mean} ({low} to {high})"


def _written(correlation: float) -> str:
    return minus(f"{correlation:.2f}")
