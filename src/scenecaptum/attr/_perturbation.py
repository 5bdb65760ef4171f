"""Shared implementation of the perturbation methods: the metric of changed scenes with common random numbers."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeAlias

import torch
from tqdm import tqdm

from ..checkpoint import Stopwatch
from ..errors import SceneCaptumError
from ..estimation import (
    Budget,
    Denoise,
    HalvesOfSamples,
    Metric,
    SampleOption,
    TargetedMetric,
    TransformSelector,
    at_values,
    channel_totals,
    check_renderer_and_metric,
    covariance_of_mean,
    describe_picture,
    deviations_of_mean,
    error_parts,
    halves_of_samples,
    relative_noise,
    render_images,
    require_memory,
    with_image_transform,
)
from ..executors import spread
from ..finite import error_context
from ..protocols import Capabilities, Renderer, ResultKind
from ._attribution import SceneAttribution, info_of, seen_through, surfaces_of, versions
from ._baselines import own_texels
from ._convergence import convergence
from ._data import summarize
from ._method import AttributionInterrupted, Result, Settings, Targets, target_list

UNCHANGED = 2.0  # standard errors between the values of a denoised and a noisy picture


@dataclass(frozen=True)
class Arm:
    """A scene to measure: a description for messages, and its values."""

    description: str
    values: Callable[[], Mapping[str, torch.Tensor]]


@dataclass(frozen=True)
class ArmMeasurements:
    """The metric of each arm; after an interruption only of the finished arms.

    An effect is a difference of two arms. The standard error of its mean over the replicates is that of the noise,
    to which its drifts add what a non-linear metric makes of the noise. A metric may jump, such as where a pixel
    crosses a threshold: half samples see that where the delete-one jackknife misses it and states an error of 0.
    """

    values: torch.Tensor  # (arms, targets): the metric at the mean image, in float64
    per_replicate: torch.Tensor  # (arms, replicates, targets): of ``halves_of_samples``
    drifts: torch.Tensor  # (arms, halves, targets); none for a single replicate
    image: torch.Tensor  # the mean image of the unchanged scene
    noise: float | None  # of its pixels, relative; None for a single replicate
    inputs: Mapping[str, torch.Tensor]  # a summary of its values
    metrics: tuple[TargetedMetric, ...]
    budget: Budget
    interrupted: bool
    info: Mapping[str, Any]


@dataclass(frozen=True)
class Effect:
    """An attribution with its errors (None for a single replicate)."""

    value: torch.Tensor
    error: torch.Tensor | None
    totals: torch.Tensor | None  # (replicates, C): of the channels; None if there are other sources of error
    covariance: torch.Tensor | None

    @classmethod
    def of_totals(cls, totals: torch.Tensor, like: torch.Tensor) -> Effect:
        """Reshape ``(replicates, C)`` totals like a parameter; of a texture spread evenly over texels."""
        covariance = covariance_of_mean(totals) if len(totals) > 1 else None
        texels = 1 if like.ndim < 2 else like[..., 0].numel()

        def shaped(channels: torch.Tensor) -> torch.Tensor:
            even = (channels / texels).to(like)
            return even.reshape(like.shape) if like.ndim < 2 else even.expand(like.shape).clone()

        error = None if covariance is None else shaped(covariance.diagonal().sqrt())
        return cls(shaped(totals.mean(0)), error, totals, covariance)

    def with_bias(self, bias: torch.Tensor) -> Effect:
        """Return the effect with a bias, shaped like it, as a part of its errors."""
        if self.error is None or self.covariance is None:
            return self
        total = channel_totals(bias).to(self.covariance)
        return replace(
            self, error=self.error.hypot(bias), covariance=self.covariance + total[:, None] * total
        )


Effects: TypeAlias = "dict[str, Effect]"


class Residual(NamedTuple):
    """The sum of the effects minus the difference that they explain, and this difference."""

    delta: float
    explained: float


class Perturbation:
    """Base class of methods that compare the metric of changed scenes, without derivatives."""

    def __init__(self, renderer: Renderer, metric: Metric) -> None:
        check_renderer_and_metric(renderer, metric)
        self.renderer = renderer
        self.metric = metric

    def _measure(self, arms: Sequence[Arm], target: Targets, settings: Settings) -> ArmMeasurements:
        """Measure every arm with common random numbers; the first arm is the unchanged scene.

        Only the images of one arm are in memory at a time.
        """
        renderer = spread(self.renderer, settings.executor, settings.checkpoint)
        watch = Stopwatch(renderer)
        metrics = tuple(TargetedMetric(self.metric, element) for element in target_list(target))
        spp = Capabilities(self.renderer).spp if settings.spp is None else settings.spp
        budget = Budget.with_common_seeds(spp, settings.replicates, settings.seed, len(arms))
        require_memory(renderer, budget.spp, settings.replicates)
        bar = tqdm(total=len(arms), disable=not settings.show_progress, desc=metrics[0].label, unit="scene")
        measured, interrupted = [], False
        with bar, torch.no_grad():
            images = _images(renderer, arms[0], budget)
            metrics, first = _with_transforms(metrics, images, arms[0], renderer, settings.denoise)
            image, noise = torch.stack(images).mean(0), relative_noise(images)
            measured.append(first)
            bar.update()
            try:
                for arm in arms[1:]:
                    images = _images(renderer, arm, budget)
                    moved = [at_values(metric, renderer, arm.values()) for metric in metrics]
                    measured.append(_values(moved, images, arm.description))
                    bar.update()
            except KeyboardInterrupt:
                interrupted = True
        info = {"method": type(self).__name__, "seed": settings.seed, **watch.info}
        inputs = summarize(own_texels(renderer, arms[0].values()))
        values, per_replicate, drifts = (torch.stack(part) for part in zip(*measured, strict=True))
        return ArmMeasurements(
            values, per_replicate, drifts, image, noise, inputs, metrics, budget, interrupted, info
        )

    def _results(
        self,
        measured: ArmMeasurements,
        target: Targets,
        effects_of: Callable[[torch.Tensor], tuple[Effects, Residual | None]],
        *,
        quantity: ResultKind,
        **info: Any,
    ) -> Result:
        """Return a result for each target; raise if the measurement was interrupted.

        ``effects_of`` computes the effects from ``(arms, replicates)`` values, in which they are linear, and a
        residual if the effects explain a difference. ``quantity`` says what the effects are.
        AttributionInterrupted has the finished effects; KeyboardInterrupt is raised if there are none.
        """
        info["quantity"] = quantity.value
        results = []
        for index in range(len(measured.metrics)):
            effects, residual = effects_of(measured.per_replicate[..., index])
            if not effects:
                raise KeyboardInterrupt
            drifts = [effects_of(drift[:, None])[0] for drift in measured.drifts[..., index].T]
            biases = {
                name: _norm(torch.stack([drift[name].value for drift in drifts]))
                for name in effects
                if drifts
            }
            results.append(self._result(measured, index, effects, biases, residual, info))
        if measured.interrupted:
            raise AttributionInterrupted(*results)
        return results if isinstance(target, list) else results[0]

    def _result(
        self,
        measured: ArmMeasurements,
        index: int,
        effects: Effects,
        biases: Mapping[str, torch.Tensor],
        residual: Residual | None,
        info: Mapping[str, Any],
    ) -> SceneAttribution:
        value, unbiased = measured.values[0, index].item(), measured.per_replicate[0, :, index]
        count = len(unbiased)
        has_errors = count > 1
        drift = value - unbiased.mean().item() if has_errors else None  # from half of the samples to all
        noise = deviations_of_mean(unbiased) / math.sqrt(count) if has_errors else None
        parts = None if noise is None else error_parts(_norm(measured.drifts[0, :, index]).item(), 0.0, noise)
        if has_errors:
            effects = {name: effect.with_bias(biases[name]) for name, effect in effects.items()}
        surfaces = surfaces_of(self.renderer, effects, measured.inputs)
        spp_per_arm = None if measured.budget.spp[0] is None else count * measured.budget.spp[0]
        result_info = {
            **info_of(self.renderer, measured.inputs),
            "cautions": {},  # the renderer's cautions are about derivatives
            **measured.info,
            **measured.metrics[index].describe(value, measured.image),
            "spp": measured.budget.total,
            "replicates": count,
            "budget": {
                "arms": len(measured.budget.spp),
                "spp_per_arm": spp_per_arm,
                "replicates": count,
                "total_spp": measured.budget.total,
            },
            "metric_bias": drift,
            "picture": describe_picture(
                measured.metrics[index].transform,
                value,
                None if drift is None or noise is None else (drift, noise.norm().item()),
                spp_per_arm,
                metric=measured.metrics[index],
                image=measured.image,
                noise=measured.noise,
                option=None if measured.budget.total is None else SampleOption("spp", measured.budget.total),
                compares=True,
                shows_a_view=Capabilities(self.renderer).shows_a_view is not False,
            ),
            "seen_through": seen_through(self.renderer, surfaces, measured.inputs, measured.inputs),
            "interrupted": measured.interrupted,
            "versions": versions(),
            **info,
        }
        if residual is not None:
            magnitude = sum(effect.value.abs().sum().item() for effect in effects.values())
            result_info |= convergence(residual.delta, None, residual.explained, magnitude, freedom=1)
        labels = Capabilities(self.renderer).labels or {}
        return SceneAttribution(
            attributions={name: effect.value.float() for name, effect in effects.items()},
            standard_error=_all_or_none(
                {n: None if e.error is None else e.error.float() for n, e in effects.items()}
            ),
            metric_value=value,
            metric_standard_error=None if parts is None else parts.norm().item(),
            metric_error_parts=parts,
            convergence_delta=None if residual is None else residual.delta,
            bias={name: one.float() for name, one in biases.items()} if has_errors else None,
            replicates=_all_or_none({name: effect.totals for name, effect in effects.items()}) or {},
            covariance=_all_or_none({name: effect.covariance for name, effect in effects.items()}),
            parameter_values=measured.inputs,
            labels={name: labels.get(name, name) for name in effects},
            image=measured.image,
            surfaces=surfaces,
            info=result_info,
        )


def measured_drops(
    per_replicate: torch.Tensor, parts: Sequence[tuple[str, int]], sizes: Mapping[str, int]
) -> dict[str, torch.Tensor]:
    """Return how much each part lowers the metric, ``(replicates, size)`` by the owner of the parts.

    Arm ``1 + k`` lacks part ``k``: its owner and its index there. Owners with an unmeasured part are left out.
    """
    drops = {}
    for owner, size in sizes.items():
        own = [(1 + arm, index) for arm, (name, index) in enumerate(parts) if name == owner]
        if all(arm < len(per_replicate) for arm, _ in own):
            drops[owner] = per_replicate.new_zeros(per_replicate.shape[1], size)
            for arm, index in own:
                drops[owner][:, index] = per_replicate[0] - per_replicate[arm]
    return drops


def _images(renderer: Renderer, arm: Arm, budget: Budget) -> list[torch.Tensor]:
    with error_context(f"On {arm.description}"):
        return render_images(renderer, dict(arm.values()), budget.seeds[0], budget.spp[0])


def _all_or_none(tensors: Mapping[str, torch.Tensor | None]) -> dict[str, torch.Tensor] | None:
    """Return the tensors, or None if one is missing."""
    present = {name: tensor for name, tensor in tensors.items() if tensor is not None}
    return present if len(present) == len(tensors) else None


def _norm(drifts: torch.Tensor) -> torch.Tensor:
    """Return the norm over the halves, with the sign of their sum, so that two results cancel what they share."""
    size = drifts.square().sum(0).sqrt()
    return size.copysign(drifts.sum(0))


def _values(metrics: Sequence[TargetedMetric], images: Sequence[torch.Tensor], scene: str) -> HalvesOfSamples:
    """Return the metrics at the mean image, ``(targets,)``, of the replicates, and their drifts."""
    stack = torch.stack(tuple(images))

    def values(kept: torch.Tensor) -> torch.Tensor:
        # In float64: without noise, the mean of every half is the same image.
        return _evaluate(metrics, stack[kept].mean(0, dtype=torch.float64).to(stack), scene)

    count = len(images)
    if count > 1:
        return halves_of_samples(values, count)
    value = values(torch.arange(count))
    return HalvesOfSamples(value, value[None], value.new_empty(0, len(value)))


def _with_transforms(
    metrics: Sequence[TargetedMetric],
    images: Sequence[torch.Tensor],
    arm: Arm,
    renderer: Renderer,
    mode: Denoise,
) -> tuple[tuple[TargetedMetric, ...], HalvesOfSamples]:
    """Return the metrics with their image transforms, and their values at the images as in ``_values``.

    With common random numbers, most of the noise of two renders cancels in their difference. The denoiser undoes
    this: it changes each of them in its own way, and the replicates of a scene share most of that. So ``"auto"``
    denoises only where that changes the values of the metrics.
    """

    def transformed(by: Denoise) -> tuple[TargetedMetric, ...]:
        selector = TransformSelector(by, renderer, arm.values(), smoothed=metrics[0].is_smoothed)
        return tuple(with_image_transform(metrics, images, selector))

    found = transformed(mode)
    values = _values(found, images, arm.description)
    if mode != "auto" or len(images) == 1 or not any(metric.transform.denoises for metric in found):
        return found, values
    rendered = transformed(False)
    of_rendered = _values(rendered, images, arm.description)
    first, second = values.per_sample, of_rendered.per_sample
    error = torch.hypot(first.std(0), second.std(0)) / math.sqrt(len(images))
    is_same = (first.mean(0) - second.mean(0)).abs() <= UNCHANGED * error
    return (rendered, of_rendered) if is_same.all() else (found, values)


def _evaluate(metrics: Sequence[TargetedMetric], image: torch.Tensor, scene: str) -> torch.Tensor:
    """Evaluate the metric once for all targets, or for each target if it needs the correction for denoising."""
    try:
        if any(metric.transform.denoises for metric in metrics):
            values = [metric.check_value(metric.value(image)) for metric in metrics]
            return torch.tensor(values, dtype=torch.float64)
        output = metrics[0].output(image)
        return torch.tensor([metric.value_of(output) for metric in metrics], dtype=torch.float64)
    except SceneCaptumError as error:
        raise SceneCaptumError(f"On {scene}: {error}") from error
