"""Shared implementation of the perturbation methods: the metric of changed scenes with common random numbers."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import torch
from tqdm import tqdm

from ..checkpoint import Stopwatch
from ..errors import SceneCaptumError
from ..estimation import (
    Budget,
    Denoise,
    Metric,
    SampleOption,
    TargetedMetric,
    TransformSelector,
    at_values,
    check_renderer_and_metric,
    covariance_of_mean,
    describe_picture,
    deviations_of_mean,
    error_parts,
    pseudo_values,
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

    ``pseudo_values`` are those of the jackknife in float64, ``R·M(mean image) − (R − 1)·M(mean without image r)``.
    An effect is a difference of two arms. Its mean over the replicates is free of the bias of order ``1/R`` that
    noise causes in a non-linear metric, and its variance gives the standard error.
    """

    pseudo_values: torch.Tensor  # (arms, replicates, targets)
    values: torch.Tensor  # (targets,): the metric at the mean image of the first arm, the unchanged scene
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
        rows, interrupted = [], False
        with bar, torch.no_grad():
            images = _images(renderer, arms[0], budget)
            metrics, (values, first) = _with_transforms(metrics, images, arms[0], renderer, settings.denoise)
            image, noise = torch.stack(images).mean(0), relative_noise(images)
            rows.append(first)
            bar.update()
            try:
                for arm in arms[1:]:
                    images = _images(renderer, arm, budget)
                    moved = [at_values(metric, renderer, arm.values()) for metric in metrics]
                    rows.append(_pseudo_values(moved, images, arm.description)[1])
                    bar.update()
            except KeyboardInterrupt:
                interrupted = True
        info = {"method": type(self).__name__, "seed": settings.seed, **watch.info}
        inputs = summarize(own_texels(renderer, arms[0].values()))
        return ArmMeasurements(
            torch.stack(rows), values, image, noise, inputs, metrics, budget, interrupted, info
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

        ``effects_of`` computes the effects from ``(arms, replicates)`` pseudo-values, and a residual if the
        effects explain a difference. ``quantity`` says what the effects are. AttributionInterrupted has the
        finished effects; KeyboardInterrupt is raised if there are none.
        """
        info["quantity"] = quantity.value
        results = []
        for index in range(len(measured.metrics)):
            effects, residual = effects_of(measured.pseudo_values[..., index])
            if not effects:
                raise KeyboardInterrupt
            results.append(self._result(measured, index, effects, residual, info))
        if measured.interrupted:
            raise AttributionInterrupted(*results)
        return results if isinstance(target, list) else results[0]

    def _result(
        self,
        measured: ArmMeasurements,
        index: int,
        effects: Effects,
        residual: Residual | None,
        info: Mapping[str, Any],
    ) -> SceneAttribution:
        value, unbiased = measured.values[index].item(), measured.pseudo_values[0, :, index]
        count = len(unbiased)
        bias = value - unbiased.mean().item() if count > 1 else None
        error = (unbiased.std() / math.sqrt(count)).item() if count > 1 else None
        drift = None if bias is None or error is None else (bias, error)
        parts = (
            None if bias is None else error_parts(bias, 0.0, deviations_of_mean(unbiased) / math.sqrt(count))
        )
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
            "metric_bias": bias,
            "picture": describe_picture(
                measured.metrics[index].transform,
                value,
                drift,
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
            replicates=_all_or_none({name: effect.totals for name, effect in effects.items()}) or {},
            covariance=_all_or_none({name: effect.covariance for name, effect in effects.items()}),
            parameter_values=measured.inputs,
            labels={name: labels.get(name, name) for name in effects},
            image=measured.image,
            surfaces=surfaces,
            info=result_info,
        )


def measured_drops(
    pseudo_values: torch.Tensor, parts: Sequence[tuple[str, int]], sizes: Mapping[str, int]
) -> dict[str, torch.Tensor]:
    """Return how much each part lowers the metric, ``(replicates, size)`` by the owner of the parts.

    Arm ``1 + k`` lacks part ``k``: its owner and its index there. Owners with an unmeasured part are left out.
    """
    drops = {}
    for owner, size in sizes.items():
        own = [(1 + arm, index) for arm, (name, index) in enumerate(parts) if name == owner]
        if all(arm < len(pseudo_values) for arm, _ in own):
            drops[owner] = pseudo_values.new_zeros(pseudo_values.shape[1], size)
            for arm, index in own:
                drops[owner][:, index] = pseudo_values[0] - pseudo_values[arm]
    return drops


def _images(renderer: Renderer, arm: Arm, budget: Budget) -> list[torch.Tensor]:
    with error_context(f"On {arm.description}"):
        return render_images(renderer, dict(arm.values()), budget.seeds[0], budget.spp[0])


def _all_or_none(tensors: Mapping[str, torch.Tensor | None]) -> dict[str, torch.Tensor] | None:
    """Return the tensors, or None if one is missing."""
    present = {name: tensor for name, tensor in tensors.items() if tensor is not None}
    return present if len(present) == len(tensors) else None


def _pseudo_values(
    metrics: Sequence[TargetedMetric], images: Sequence[torch.Tensor], scene: str
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the metrics at the mean image ``(targets,)``, and their pseudo-values ``(replicates, targets)``."""
    stack = torch.stack(tuple(images))

    def values(kept: torch.Tensor) -> torch.Tensor:
        return _evaluate(metrics, stack[kept].mean(0), scene)

    count = len(images)
    unchanged = values(torch.arange(count))
    return unchanged, unchanged[None] if count == 1 else pseudo_values(values, count)


def _with_transforms(
    metrics: Sequence[TargetedMetric],
    images: Sequence[torch.Tensor],
    arm: Arm,
    renderer: Renderer,
    mode: Denoise,
) -> tuple[tuple[TargetedMetric, ...], tuple[torch.Tensor, torch.Tensor]]:
    """Return the metrics with their image transforms, and their values at the images as in ``_pseudo_values``.

    With common random numbers, most of the noise of two renders cancels in their difference. The denoiser undoes
    this: it changes each of them in its own way, and the replicates of a scene share most of that. So ``"auto"``
    denoises only where that changes the values of the metrics.
    """

    def transformed(by: Denoise) -> tuple[TargetedMetric, ...]:
        selector = TransformSelector(by, renderer, arm.values(), smoothed=metrics[0].is_smoothed)
        return tuple(with_image_transform(metrics, images, selector))

    found = transformed(mode)
    values = _pseudo_values(found, images, arm.description)
    if mode != "auto" or len(images) == 1 or not any(metric.transform.denoises for metric in found):
        return found, values
    rendered = transformed(False)
    of_rendered = _pseudo_values(rendered, images, arm.description)
    first, second = values[1], of_rendered[1]
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
