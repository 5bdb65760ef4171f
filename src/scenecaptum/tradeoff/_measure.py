"""Running the settings and comparing what comes out with a reference."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from ..attr import SceneAttribution, VanillaSceneGradient
from ..attr._gradients import input_values, require_memory
from ..attr._metric import Metric, Target
from ..attr._passes import channel_totals
from ..attr._view import Denoise
from ..checkpoint import Folder, with_checkpoint
from ..errors import SceneCaptumError, check_seed, whole_number
from ._result import TOP, Measured, Reference, Tradeoff
from ._settings import Setting, default_values, own_setting, reference_setting, settings_of
from ._statistics import (
    Estimate,
    kendall,
    kendall_of_resolved,
    relative_bias,
    relative_error,
    spearman,
    top_agreement,
)

RUNS = 8

# The reference has so many times the samples of the renderer's own setting, in so many passes.
REFERENCE, REFERENCE_PASSES = 32, 16


def measure(  # noqa: PLR0913 -- those of every long job, and its own
    renderer: Any,
    metric: Metric,
    target: Target = None,
    *,
    vary: Mapping[str, Iterable[Any]] | None = None,
    metric_for: Callable[[Any], Metric] | None = None,
    reference_spp: int | None = None,
    runs: int = RUNS,
    seed: int = 0,
    denoise: Denoise = "auto",
    checkpoint: Folder = None,
    show_progress: bool = False,
) -> Tradeoff:
    """Measure what accuracy costs: plain gradients at several settings, each several times, against a reference.

    Each setting differs from the renderer's own in one thing. Gradients are compared as vectors of the channel
    totals of all inputs (a texture is summed over its texels), per unit; rankings by saliency.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", "reflectance", resolution=(16, 16), spp=16, max_depth=3)
    >>> trade = measure(renderer, metrics.MeanLuminance(), vary={"spp": [4, 64]}, runs=3)
    >>> [row.setting.primal_spp for row in trade.rows]
    [16, 4, 64]
    >>> trade.rows[1].relative_error.value > trade.rows[2].relative_error.value
    True

    Parameters
    ----------
    renderer, metric, target
        As for ``VanillaSceneGradient``; the renderer must tell its ``spp``.
    vary
        What is varied and to which values: ``"spp"`` of primal and gradient alike, ``"primal_spp"``,
        ``"gradient_spp"``, ``"max_depth"``, ``"resolution"``, ``"replicates"`` and ``"integrator"`` (to
        ``"prb"``, Mitsuba's own). By default all that the renderer allows, the resolution only with
        ``metric_for``. An empty mapping measures the renderer's own setting alone.
    metric_for
        Makes the metric for a renderer of another resolution, where it depends on that:
        ``lambda renderer: metrics.UnifiedGlareRating(renderer.camera)``.
    reference_spp
        Samples per pixel of the reference, by default 32 times the renderer's. It has the longest paths and the
        finest resolution that occur, so that theirs is the bias that shorter and coarser ones show.
    runs
        How often each setting is run, with seeds of its own; 2 or more.
    seed
        Seed from which all others are drawn.
    denoise
        As for ``VanillaSceneGradient``. A metric that is not linear sees the samples of the forward passes alone.
    checkpoint
        A folder that keeps every finished pass: a job that was killed goes on from there when it is started again
        with the same arguments.
    show_progress
        Whether to show progress bars.

    Returns
    -------
    Tradeoff
        A row for each setting; prints as a table.

    Raises
    ------
    SceneCaptumError
        Where something cannot be varied, a value is wrong, or all gradients are 0.
    """
    base = own_setting(renderer)
    runs, seed = whole_number("runs", runs, 2), check_seed("seed", seed)
    if vary is None:
        vary = default_values(renderer, base, sizes=metric_for is not None)
    chosen = settings_of(renderer, base, vary)
    spp = (
        REFERENCE * base.primal_spp
        if reference_spp is None
        else whole_number("reference_spp", reference_spp, 2)
    )
    best = reference_setting([setting for _, setting in chosen], spp, REFERENCE_PASSES)

    bench = Bench(with_checkpoint(renderer, checkpoint), metric_for or (lambda _: metric), target, denoise)
    every = [best, *(setting for _, setting in chosen)]
    bench.try_all(every)
    bench.require_memory(every)
    seeds = np.random.SeedSequence([seed, 5]).generate_state(1 + runs * len(chosen)).tolist()
    judge = Judge.of(bench.run(best, seeds.pop(), show_progress=show_progress))
    rows = []
    with tqdm(total=len(seeds), disable=not show_progress, desc="settings", unit="run") as bar:
        for varied, setting in chosen:
            found = []
            for _ in range(runs):
                found.append(bench.run(setting, seeds.pop()))
                bar.update()
            rows.append(judge.compare(varied, setting, found))
    return Tradeoff(
        rows=tuple(rows),
        reference=judge.describe(best),
        runs=runs,
        parameters=len(judge.saliency),
        metric=str(judge.attribution.info["metric"]),
        scene=str(getattr(renderer, "name", type(renderer).__name__)),
    )


class Bench:
    """Runs settings of one scene and metric; the renderers that they take are made once.

    Parameters
    ----------
    renderer, target, denoise
        As for ``measure``.
    metric_for
        Makes the metric for a renderer.
    """

    def __init__(
        self,
        renderer: Any,
        metric_for: Callable[[Any], Metric],
        target: Target = None,
        denoise: Denoise = "auto",
    ) -> None:
        self._values = input_values(renderer, None)
        self._renderer = renderer
        self._own = own_setting(renderer)
        self._metric_for = metric_for
        self._target = target
        self._denoise = denoise
        self._made: dict[tuple[Any, ...], tuple[Any, Metric]] = {}

    def run(self, setting: Setting, seed: int, *, show_progress: bool = False) -> SceneAttribution:
        """Attribute once."""
        renderer, metric = self._at(setting)
        if setting.gradient_spp != setting.primal_spp:
            renderer = SplitSamples(renderer, setting)
        found: SceneAttribution = VanillaSceneGradient(renderer, metric).attribute(
            self._values,
            self._target,
            seed=seed,
            spp=setting.primal_spp,
            picture_spp=setting.primal_spp,
            denoise=self._denoise,
            # A pass has one sample at least, of either kind.
            replicates=min(setting.replicates, setting.gradient_spp),
            show_progress=show_progress,
        )
        return found

    def try_all(self, settings: Sequence[Setting]) -> None:
        """Render each picture with a sample: what cannot work is said before the long work begins."""
        for setting in settings:
            if _picture(setting) in self._made:
                continue
            try:
                self.run(Setting(1, 1, 1, *_picture(setting)), seed=0)
            except SceneCaptumError as error:
                if setting.resolution == self._own.resolution:
                    raise
                raise SceneCaptumError(
                    f"{error} For pictures of another resolution metric_for= makes the metric from the renderer."
                ) from error

    def require_memory(self, settings: Sequence[Setting]) -> None:
        """Refuse settings that will not fit into memory, before the first is run."""
        for setting in settings:
            samples = max(setting.primal_spp, setting.gradient_spp)
            spp = math.ceil(samples / setting.replicates)
            require_memory(self._at(setting)[0], [spp], setting.replicates)

    def _at(self, setting: Setting) -> tuple[Any, Metric]:
        key = _picture(setting)
        if key not in self._made:
            renderer, own = self._renderer, self._own
            if key != _picture(own):
                renderer = renderer.replace(
                    max_depth=setting.max_depth,
                    resolution=setting.resolution if setting.resolution != own.resolution else None,
                    integrator=setting.integrator if setting.integrator != own.integrator else None,
                )
                renderer = with_checkpoint(renderer, getattr(self._renderer, "checkpoint", None))
            self._made[key] = renderer, self._metric_for(renderer)
        return self._made[key]


def _picture(setting: Setting) -> tuple[Any, ...]:
    return setting.max_depth, setting.resolution, setting.integrator


class SplitSamples:
    """A renderer whose backward passes have another number of samples than its pictures."""

    def __init__(self, renderer: Any, setting: Setting) -> None:
        self._renderer = renderer
        self._setting = setting
        self.info = getattr(renderer, "info", {})
        self.guides = getattr(renderer, "guides", None)
        self.checkpoint = getattr(renderer, "checkpoint", None)

    def __call__(
        self, inputs: Mapping[str, torch.Tensor], *, seed: int, spp: int, seed_grad: int | None = None
    ) -> torch.Tensor:
        """Render as the renderer does."""
        spp_grad = math.ceil(spp * self._setting.gradient_spp / self._setting.primal_spp)
        image: torch.Tensor = self._renderer(
            inputs, seed=seed, spp=spp, seed_grad=seed_grad, spp_grad=spp_grad
        )
        return image


@dataclass(frozen=True)
class Judge:
    """The reference, to which runs are compared.

    Attributes
    ----------
    attribution
        The reference itself.
    gradient
        ``(P,)``: the channel totals of all parameters, in float64.
    noise
        ``(rows, P)``: the sum of the outer products of its rows is the covariance of ``gradient``. A bias that
        was taken out is a row: it counts as an error of its own size.
    saliency, saliency_error
        One for each parameter.
    """

    attribution: SceneAttribution
    gradient: torch.Tensor
    noise: torch.Tensor
    saliency: torch.Tensor
    saliency_error: torch.Tensor

    @classmethod
    def of(cls, attribution: SceneAttribution) -> Judge:
        """Take a result as the reference."""
        gradient, saliency = gradient_of(attribution), saliency_of(attribution)
        if not gradient.any():
            raise SceneCaptumError("All gradients are 0: there is no relative error, and nothing to rank.")
        passes = torch.cat([attribution.replicates[name].double() for name in attribution], 1)
        spread = (passes - passes.mean(0)) / math.sqrt(len(passes) * max(len(passes) - 1, 1))
        errors = attribution.saliency_error() or {}
        bias = attribution.bias or {}
        removed = [
            channel_totals(bias.get(name, torch.zeros_like(value))) for name, value in attribution.items()
        ]
        return cls(
            attribution,
            gradient,
            torch.cat([spread, torch.cat(removed)[None].double()]),
            saliency,
            torch.tensor([errors[name] for name in attribution], dtype=torch.float64),
        )

    @property
    def size(self) -> float:
        """The length of the gradient."""
        return float(self.gradient.norm())

    def compare(self, varied: str, setting: Setting, runs: Sequence[SceneAttribution]) -> Measured:
        """Return what the runs of a setting amount to."""
        deviations = torch.stack([gradient_of(run) for run in runs]) - self.gradient
        saliencies = [saliency_of(run) for run in runs]
        top = min(TOP, len(self.saliency))

        def agreement(compare: Callable[[torch.Tensor], float]) -> Estimate:
            return Estimate.of(torch.tensor([compare(one) for one in saliencies], dtype=torch.float64))

        return Measured(
            varied=varied,
            setting=setting,
            # Not the mean: the first run of a setting may compile.
            seconds=statistics.median_low(run.info["seconds"] for run in runs),
            relative_error=relative_error(deviations, self.size),
            bias=relative_bias(deviations, self.noise, self.size),
            spearman=agreement(lambda one: spearman(one, self.saliency)),
            kendall=agreement(lambda one: kendall(one, self.saliency)),
            kendall_resolved=agreement(
                lambda one: kendall_of_resolved(one, self.saliency, self.saliency_error)
            ),
            top=agreement(lambda one: top_agreement(one, self.saliency, top)),
        )

    def describe(self, setting: Setting) -> Reference:
        """Return what is known of the reference itself."""
        passes = {name: one.double() for name, one in self.attribution.replicates.items()}
        half = len(next(iter(passes.values()))) // 2
        first, second = (
            torch.stack([one[part].mean(0).norm() for one in passes.values()])
            for part in (slice(half), slice(half, 2 * half))
        )
        return Reference(
            setting=setting,
            seconds=self.attribution.info["seconds"],
            relative_error=self.noise.norm().item() / self.size,
            kendall_of_halves=kendall(first, second),
        )


def gradient_of(attribution: SceneAttribution) -> torch.Tensor:
    """Return the channel totals of all parameters as one vector, in float64."""
    return torch.cat([channel_totals(value) for value in attribution.values()]).double()


def saliency_of(attribution: SceneAttribution) -> torch.Tensor:
    """Return the saliencies, in the order of the parameters."""
    return torch.tensor(list(attribution.saliency().values()), dtype=torch.float64)
