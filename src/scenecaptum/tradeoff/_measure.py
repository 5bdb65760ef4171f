"""Run the settings and compare their gradients with a reference."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tqdm import tqdm

from ..attr import SceneAttribution, VanillaSceneGradient
from ..checkpoint import Folder, with_checkpoint
from ..errors import SceneCaptumError, check_seed, whole_number
from ..estimation import (
    Denoise,
    Metric,
    Stream,
    Target,
    channel_totals,
    derived_seeds,
    input_values,
    require_memory,
)
from ..metrics import Smoothed
from ..protocols import Capabilities, Renderer
from ..ranks import kendall_tau, spearman
from ..visualization import metric_name
from ._result import TOP, Measured, Reference, Tradeoff
from ._settings import Setting, default_values, own_setting, reference_setting, settings_of
from ._statistics import (
    Estimate,
    kendall_of_resolved,
    relative_bias,
    relative_error,
    relative_spread,
    top_agreement,
)

RUNS = 8

# Samples of the reference relative to the renderer's own setting, and its number of replicates.
REFERENCE_SPP_FACTOR, REFERENCE_REPLICATES = 32, 16


def measure(  # noqa: PLR0913 -- the options of every long job, and its own
    renderer: Renderer,
    metric: Metric,
    target: Target = None,
    *,
    inputs: Mapping[str, torch.Tensor] | None = None,
    vary: Mapping[str, Iterable[Any]] | None = None,
    metric_for: Callable[[Any], Metric] | None = None,
    reference_spp: int | None = None,
    runs: int = RUNS,
    seed: int = 0,
    denoise: Denoise = "auto",
    checkpoint: Folder = None,
    show_progress: bool = False,
) -> Tradeoff:
    """Measure the time, error and bias of plain gradients at several settings, against a reference.

    Each setting differs from the renderer's own in one option and is run several times. Gradients are compared per
    unit, as vectors of the channel totals of all inputs (a texture is summed over its texels); rankings by
    saliency.

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
        As for ``VanillaSceneGradient``; the renderer must have ``spp``.
    inputs
        The values at which to attribute; by default the scene's own.
    vary
        Options and the values to try: ``"spp"`` (of both primal and gradient), ``"primal_spp"``,
        ``"gradient_spp"``, ``"max_depth"``, ``"resolution"``, ``"replicates"``, ``"integrator"`` (only
        ``"prb"``, Mitsuba's own) and ``"smoothing"`` (the ``sigma`` of ``metrics.Smoothed``, compared with the
        gradient of the metric without smoothing). By default all options that the renderer supports except for
        smoothing, the resolution only with ``metric_for``. An empty mapping measures only the renderer's own
        setting.
    metric_for
        Creates the metric for a renderer of another resolution, if the metric depends on it:
        ``lambda renderer: metrics.UnifiedGlareRating(renderer.camera)``.
    reference_spp
        Samples per pixel of the reference, by default 32 times the renderer's. The reference has the largest depth
        and resolution of all settings, so the bias of smaller ones is relative to these.
    runs
        Number of runs of each setting, with independent seeds; at least 2.
    seed
        Base seed; all other seeds are derived from it.
    denoise
        As for ``VanillaSceneGradient``. The image of a non-linear metric has only the samples of the forward
        passes.
    checkpoint, show_progress
        As for ``validation.ablation_test``.

    Returns
    -------
    Tradeoff
        One row per setting; prints as a table.

    Raises
    ------
    SceneCaptumError
        If an option cannot be varied, a value is invalid, or all gradients are 0.
    """
    base = own_setting(renderer)
    runs, seed = whole_number("runs", runs, 2), check_seed("seed", seed)
    if vary is None:
        vary = default_values(renderer, base, vary_resolution=metric_for is not None)
    settings = settings_of(renderer, base, vary)
    default = REFERENCE_SPP_FACTOR * base.primal_spp
    spp = default if reference_spp is None else whole_number("reference_spp", reference_spp, 2)
    best = reference_setting([setting for _, setting in settings], spp, REFERENCE_REPLICATES)

    runner = SettingRunner(
        with_checkpoint(renderer, checkpoint), metric_for or (lambda _: metric), target, denoise, inputs
    )
    runner.check([best, *(setting for _, setting in settings)])
    seeds = derived_seeds(seed, Stream.TRADEOFF_RUNS, 1 + runs * len(settings))
    reference = ReferenceGradient.of(runner.run(best, seeds.pop(), show_progress=show_progress))
    rows = []
    with tqdm(total=len(seeds), disable=not show_progress, desc="settings", unit="run") as bar:
        for varied, setting in settings:
            attributions = []
            for _ in range(runs):
                attributions.append(runner.run(setting, seeds.pop()))
                bar.update()
            rows.append(reference.compare(varied, setting, attributions))
    return Tradeoff(
        rows=tuple(rows),
        reference=reference.describe(best),
        runs=runs,
        parameters=len(reference.saliency),
        metric=metric_name(reference.attribution),
        scene=Capabilities(renderer).name or type(renderer).__name__,
    )


class SettingRunner:
    """Runs attributions of one scene and metric at different settings; caches the renderers."""

    def __init__(
        self,
        renderer: Renderer,
        metric_for: Callable[[Any], Metric],
        target: Target = None,
        denoise: Denoise = "auto",
        inputs: Mapping[str, torch.Tensor] | None = None,
    ) -> None:
        self._values = input_values(renderer, inputs)
        self._renderer = renderer
        self._own = own_setting(renderer)
        self._metric_for = metric_for
        self._target = target
        self._denoise = denoise
        self._cache: dict[tuple[Any, ...], tuple[Any, Metric]] = {}

    def run(self, setting: Setting, seed: int, *, show_progress: bool = False) -> SceneAttribution:
        """Attribute once at a setting."""
        renderer, metric = self._renderer_and_metric(setting)
        if setting.smoothing is not None:
            metric = Smoothed(metric, setting.smoothing)
        if setting.gradient_spp != setting.primal_spp:
            renderer = SplitSamples(renderer, setting)
        attribution: SceneAttribution = VanillaSceneGradient(renderer, metric).attribute(
            self._values,
            target=self._target,
            seed=seed,
            spp=setting.primal_spp,
            picture_spp=setting.primal_spp,
            denoise=self._denoise,
            replicates=setting.used_replicates,
            show_progress=show_progress,
        )
        return attribution

    def check(self, settings: Sequence[Setting]) -> None:
        """Run every renderer with one sample, to report errors, and lack of memory, before the long runs."""
        for setting in settings:
            if setting.renderer_options in self._cache:
                continue
            try:
                self.run(Setting(1, 1, 1, *setting.renderer_options), seed=0)
            except SceneCaptumError as error:
                if setting.resolution == self._own.resolution:
                    raise
                raise SceneCaptumError(
                    f"{error} To vary the resolution, pass metric_for=, which creates the metric for a renderer."
                ) from error
        for setting in settings:
            spp = math.ceil(max(setting.primal_spp, setting.gradient_spp) / setting.replicates)
            require_memory(self._renderer_and_metric(setting)[0], [spp], setting.replicates)

    def _renderer_and_metric(self, setting: Setting) -> tuple[Any, Metric]:
        key, own = setting.renderer_options, self._own
        if key not in self._cache:
            renderer = self._renderer
            replace = Capabilities(renderer).replace
            if replace is not None and key != own.renderer_options:
                renderer = replace(
                    max_depth=setting.max_depth,
                    resolution=setting.resolution if setting.resolution != own.resolution else None,
                    integrator=setting.integrator if setting.integrator != own.integrator else None,
                )
                renderer = with_checkpoint(renderer, Capabilities(self._renderer).checkpoint)
            self._cache[key] = renderer, self._metric_for(renderer)
        return self._cache[key]


class SplitSamples:
    """A renderer with a different number of samples in the forward and the backward pass."""

    def __init__(self, renderer: Renderer, setting: Setting) -> None:
        self._setting = setting
        offered = Capabilities(renderer)
        assert offered.with_spp_grad is not None
        self._render = offered.with_spp_grad
        self.info = offered.info or {}
        self.guides, self.guides_of = offered.guides, offered.guides_of
        self.checkpoint = offered.checkpoint

    def __call__(
        self, inputs: Mapping[str, torch.Tensor], *, seed: int, spp: int, seed_grad: int | None = None
    ) -> torch.Tensor:
        """Render with the samples of the setting."""
        spp_grad = math.ceil(spp * self._setting.gradient_spp / self._setting.primal_spp)
        return self._render(inputs, seed=seed, spp=spp, seed_grad=seed_grad, spp_grad=spp_grad)


@dataclass(frozen=True)
class ReferenceGradient:
    """The reference gradient to which runs are compared, in float64.

    The covariance of the gradient is ``noise.T @ noise``. A bias correction is a row of ``noise``: its whole size
    counts as error.
    """

    attribution: SceneAttribution
    gradient: torch.Tensor  # (P,): the channel totals of all parameters, over their ranges
    noise: torch.Tensor  # (rows, P)
    saliency: torch.Tensor  # one value per parameter
    saliency_error: torch.Tensor

    @classmethod
    def of(cls, attribution: SceneAttribution) -> ReferenceGradient:
        """Use an attribution as the reference."""
        gradient, saliency = gradient_of(attribution), saliency_of(attribution)
        if not gradient.any():
            raise SceneCaptumError("All gradients are 0: there is no relative error, and nothing to rank.")
        factors = _factors(attribution)
        replicates = torch.cat([attribution.replicates[name].double() for name in attribution], 1) * factors
        count = len(replicates)
        spread = (replicates - replicates.mean(0)) / math.sqrt(count * max(count - 1, 1))
        errors = attribution.saliency_error() or {}
        bias = attribution.bias or {}
        removed = [channel_totals(bias.get(n, torch.zeros_like(value))) for n, value in attribution.items()]
        return cls(
            attribution,
            gradient,
            torch.cat([spread, torch.cat(removed)[None].double() * factors]),
            saliency,
            torch.tensor([errors[name] for name in attribution], dtype=torch.float64),
        )

    @property
    def size(self) -> float:
        """The norm of the gradient."""
        return float(self.gradient.norm())

    def compare(self, varied: str, setting: Setting, runs: Sequence[SceneAttribution]) -> Measured:
        """Return the cost and accuracy of a setting from its runs."""
        deviations = torch.stack([gradient_of(run) for run in runs]) - self.gradient
        saliencies = [saliency_of(run) for run in runs]
        top = min(TOP, len(self.saliency))

        def agreement(compare: Callable[[torch.Tensor], float]) -> Estimate:
            return Estimate.of(torch.tensor([compare(s) for s in saliencies], dtype=torch.float64))

        return Measured(
            varied=varied,
            setting=setting,
            # The median, since the first run of a setting may include kernel compilation.
            seconds=statistics.median_low(run.info["seconds"] for run in runs),
            relative_error=relative_error(deviations, self.size),
            spread=relative_spread(deviations, self.size),
            bias=relative_bias(deviations, self.noise, self.size),
            spearman=agreement(lambda s: spearman(s, self.saliency)),
            kendall=agreement(lambda s: kendall_tau(s, self.saliency)),
            kendall_resolved=agreement(lambda s: kendall_of_resolved(s, self.saliency, self.saliency_error)),
            top=agreement(lambda s: top_agreement(s, self.saliency, top)),
        )

    def describe(self, setting: Setting) -> Reference:
        """Return the cost and accuracy of the reference itself."""
        factors = self.attribution.factors()
        effects = torch.stack(
            [
                totals.double() @ factors[name].double()
                for name, totals in self.attribution.replicates.items()
            ],
            1,
        )
        half = len(effects) // 2
        first, second = (effects[part].mean(0).abs() for part in (slice(half), slice(half, 2 * half)))
        return Reference(
            setting=setting,
            seconds=self.attribution.info["seconds"],
            relative_error=self.noise.norm().item() / self.size,
            kendall_of_halves=kendall_tau(first, second),
        )


def gradient_of(attribution: SceneAttribution) -> torch.Tensor:
    """Return the channel totals of all parameters, over their ranges, as one vector in float64."""
    totals = torch.cat([channel_totals(value) for value in attribution.values()]).double()
    return totals * _factors(attribution)


def _factors(attribution: SceneAttribution) -> torch.Tensor:
    return torch.cat(list(attribution.factors().values())).double()


def saliency_of(attribution: SceneAttribution) -> torch.Tensor:
    """Return the saliencies in the order of the parameters, in float64."""
    return torch.tensor(list(attribution.saliency().values()), dtype=torch.float64)
