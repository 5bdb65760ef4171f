"""What all perturbation methods share: measuring changed scenes with the same samples, and their error bars."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import torch
from tqdm import tqdm

from .._finite import located
from ..checkpoint import Stopwatch, with_checkpoint
from ..errors import SceneCaptumError, check_seed, whole_number
from ._attribution import SceneAttribution, _versions, surfaces_of
from ._completeness import convergence
from ._gradients import require_memory
from ._interruption import AttributionInterrupted
from ._jackknife import through_view
from ._method import Result, Settings, Targets, listed
from ._metric import Metric, TargetedMetric
from ._passes import covariance_of_mean, pictures
from ._picture_info import describe_picture
from ._values import summarise
from ._view import Viewer


@dataclass(frozen=True)
class ArmBudget:
    """How samples are split over the arms, which are the unchanged scene and every changed one.

    Attributes
    ----------
    arms
        Number of scenes that are rendered.
    spp
        Samples per pixel in each replicate of each arm, or None where the renderer decides.
    seeds
        A seed for each replicate, the same for all arms: what two arms have in common cancels, noise included.
    """

    arms: int
    spp: int | None
    seeds: tuple[int, ...]

    @classmethod
    def split(cls, spp: int | None, arms: int, replicates: int, seed: int) -> ArmBudget:
        """Give each arm ``⌈spp / arms⌉`` samples, split over the replicates, and each replicate one at least."""
        replicates = whole_number("replicates", replicates)
        states = np.random.SeedSequence(check_seed("seed", seed)).generate_state(replicates)
        if spp is not None:
            spp = math.ceil(math.ceil(whole_number("spp", spp) / arms) / replicates)
        return cls(arms, spp, tuple(int(state) for state in states))

    @property
    def total(self) -> int | None:
        """Samples per pixel over all arms and replicates."""
        return None if self.spp is None else self.arms * self.spp * len(self.seeds)

    def describe(self) -> dict[str, int | None]:
        """Return the budget in plain values."""
        count = len(self.seeds)
        per_arm = None if self.spp is None else self.spp * count
        return {"arms": self.arms, "spp_per_arm": per_arm, "replicates": count, "total_spp": self.total}


@dataclass(frozen=True)
class Arm:
    """One scene to be measured: what is special about it, in words, and its values."""

    what: str
    values: Callable[[], Mapping[str, torch.Tensor]]


@dataclass(frozen=True)
class Measured:
    """What the arms gave; fewer than asked for after an interruption.

    Attributes
    ----------
    pseudo
        ``(arms, replicates, targets)`` in float64: ``R·M(mean image) − (R − 1)·M(mean without image r)``. An
        effect is a difference of two arms; its mean over the replicates is free of the bias of order ``1/R``
        that noise puts into a non-linear metric, and its spread gives the standard error (the jackknife's).
    values
        ``(targets,)``: the metric at the mean image of the first arm, the unchanged scene.
    image
        That image.
    inputs
        That scene's values, in brief.
    """

    pseudo: torch.Tensor
    values: torch.Tensor
    image: torch.Tensor
    inputs: Mapping[str, torch.Tensor]
    metrics: tuple[TargetedMetric, ...]
    budget: ArmBudget
    interrupted: bool
    info: Mapping[str, Any]


@dataclass(frozen=True)
class Effect:
    """An attribution with its errors (None for a single replicate).

    Attributes
    ----------
    totals
        ``(replicates, C)``: the channel totals in every replicate, where their spread is the whole error.
    """

    value: torch.Tensor
    error: torch.Tensor | None
    totals: torch.Tensor | None
    covariance: torch.Tensor | None

    @classmethod
    def of_totals(cls, totals: torch.Tensor, like: torch.Tensor) -> Effect:
        """Shape the ``(replicates, C)`` totals as a parameter; a texture's are spread evenly over its texels."""
        covariance = covariance_of_mean(totals) if len(totals) > 1 else None
        texels = 1 if like.ndim < 2 else like[..., 0].numel()

        def shaped(channels: torch.Tensor) -> torch.Tensor:
            even = (channels / texels).to(like)
            return even.reshape(like.shape) if like.ndim < 2 else even.expand(like.shape).clone()

        error = None if covariance is None else shaped(covariance.diagonal().sqrt())
        return cls(shaped(totals.mean(0)), error, totals, covariance)


Effects: TypeAlias = "dict[str, Effect]"


class Missed(NamedTuple):
    """By how much effects exceed the difference that they explain, and this: the noise of both is the same."""

    delta: float
    explained: float


class Perturbation:
    """A method that compares renders of changed scenes, and never differentiates one."""

    def __init__(self, renderer: Any, metric: Metric) -> None:
        self.renderer = renderer
        self.metric = metric

    def _measure(self, arms: Sequence[Arm], target: Targets, settings: Settings) -> Measured:
        """Measure every arm with the same seeds; the first is the unchanged scene.

        Only the images of one arm are in memory at any time.
        """
        renderer = with_checkpoint(self.renderer, settings.checkpoint)
        watch = Stopwatch(renderer)
        metrics = tuple(TargetedMetric(self.metric, one) for one in listed(target))
        spp = getattr(self.renderer, "spp", None) if settings.spp is None else settings.spp
        budget = ArmBudget.split(spp, len(arms), settings.replicates, settings.seed)
        require_memory(renderer, [budget.spp], len(budget.seeds))
        bar = tqdm(total=len(arms), disable=not settings.show_progress, desc=metrics[0].name, unit="scene")
        pseudo, interrupted = [], False
        with bar, torch.no_grad():
            images = _images(renderer, arms[0], budget)
            metrics = tuple(through_view(metrics, images, Viewer(settings.denoise, renderer)))
            values, first = _pseudo_values(metrics, images, arms[0].what)
            image = torch.stack(images).mean(0)
            pseudo.append(first)
            bar.update()
            try:
                for arm in arms[1:]:
                    pseudo.append(_pseudo_values(metrics, _images(renderer, arm, budget), arm.what)[1])
                    bar.update()
            except KeyboardInterrupt:
                interrupted = True
        info = {"method": type(self).__name__, "seed": settings.seed, **watch.record}
        inputs = summarise(arms[0].values())
        return Measured(torch.stack(pseudo), values, image, inputs, metrics, budget, interrupted, info)

    def _results(
        self,
        measured: Measured,
        target: Targets,
        effects_of: Callable[[torch.Tensor], tuple[Effects, Missed | None]],
        **info: Any,
    ) -> Result:
        """Return a result for each target: ``effects_of`` turns ``(arms, replicates)`` into its effects.

        Where these explain a difference, it also tells what they miss of it, but for the noise that both share.

        Raises
        ------
        AttributionInterrupted
            With what is finished, if the measurement was interrupted; KeyboardInterrupt if nothing is.
        """
        results = []
        for index in range(len(measured.metrics)):
            effects, missed = effects_of(measured.pseudo[..., index])
            if not effects:
                raise KeyboardInterrupt
            results.append(self._result(measured, index, effects, missed, info))
        if measured.interrupted:
            raise AttributionInterrupted(*results)
        return results if isinstance(target, list) else results[0]

    def _result(
        self,
        measured: Measured,
        index: int,
        effects: Effects,
        missed: Missed | None,
        info: Mapping[str, Any],
    ) -> SceneAttribution:
        value, unbiased = measured.values[index].item(), measured.pseudo[0, :, index]
        count = len(unbiased)
        bias = value - unbiased.mean().item() if count > 1 else None
        error = (unbiased.std() / math.sqrt(count)).item() if count > 1 else None
        drift = None if bias is None or error is None else (bias, error)
        spp = None if measured.budget.spp is None else count * measured.budget.spp
        about = {
            **getattr(self.renderer, "info", {}),
            "cautions": {},  # they are about derivatives, and there are none here
            **measured.info,
            "metric": measured.metrics[index].name,
            "spp": measured.budget.total,
            "passes": count,
            "budget": measured.budget.describe(),
            "metric_bias": bias,
            "picture": describe_picture(measured.metrics[index].view, value, drift, spp),
            "interrupted": measured.interrupted,
            "versions": _versions(),
            **info,
        }
        if missed is not None:
            magnitude = sum(effect.value.abs().sum().item() for effect in effects.values())
            about |= convergence(missed.delta, None, missed.explained, magnitude)
        labels = getattr(self.renderer, "labels", {})
        return SceneAttribution(
            attributions={name: effect.value.float() for name, effect in effects.items()},
            standard_error=_all(
                {n: None if e.error is None else e.error.float() for n, e in effects.items()}
            ),
            metric_value=value,
            metric_standard_error=None if drift is None else math.hypot(*drift),
            convergence_delta=None if missed is None else missed.delta,
            replicates=_all({name: effect.totals for name, effect in effects.items()}) or {},
            covariance=_all({name: effect.covariance for name, effect in effects.items()}),
            parameter_values=measured.inputs,
            labels={name: labels.get(name, name) for name in effects},
            image=measured.image,
            surfaces=surfaces_of(self.renderer, effects),
            info=about,
        )


def _images(renderer: Any, arm: Arm, budget: ArmBudget) -> list[torch.Tensor]:
    with located(f"On {arm.what}"):
        return pictures(renderer, dict(arm.values()), budget.seeds, budget.spp)


def _all(tensors: Mapping[str, torch.Tensor | None]) -> dict[str, torch.Tensor] | None:
    """Return the tensors, or None where one is missing."""
    present = {name: tensor for name, tensor in tensors.items() if tensor is not None}
    return present if len(present) == len(tensors) else None


def _pseudo_values(
    metrics: Sequence[TargetedMetric], images: Sequence[torch.Tensor], what: str
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the metrics at the mean image ``(targets,)``, and their pseudo-values ``(replicates, targets)``."""
    count = len(images)
    total = torch.stack(tuple(images)).sum(0)
    whole = _at(metrics, total / count, what)
    if count == 1:
        return whole, whole[None]
    without = torch.stack([_at(metrics, (total - image) / (count - 1), what) for image in images])
    return whole, count * whole - (count - 1) * without


def _at(metrics: Sequence[TargetedMetric], image: torch.Tensor, what: str) -> torch.Tensor:
    """Evaluate the metric once, for all targets; through a denoiser for each, which has derivatives of its own."""
    try:
        if any(metric.view.denoises for metric in metrics):
            values = [metric.check_value(metric.value(image)) for metric in metrics]
            return torch.tensor(values, dtype=torch.float64)
        output = metrics[0].output(image)
        return torch.tensor([metric.value_of(output) for metric in metrics], dtype=torch.float64)
    except SceneCaptumError as error:
        raise SceneCaptumError(f"On {what}: {error}") from error
