"""What all gradient methods do alike: read the call, take gradients at points, and return results."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
import torch
from tqdm import tqdm

from ..checkpoint import Folder, Stopwatch, with_checkpoint
from ..errors import SceneCaptumError
from ._attribution import SceneAttribution, make_attribution, metric_interval
from ._gradients import (
    LEAST_SEEN,
    Gradients,
    GradientSum,
    Point,
    input_values,
    require_memory,
    sum_gradients,
)
from ._groups import Groups, add_up, resolve_groups
from ._interruption import AttributionInterrupted
from ._jackknife import Adjoints, jackknife, through_view
from ._metric import Metric, Target, TargetedMetric
from ._passes import Budget, pictures
from ._picture_info import describe_picture
from ._view import Denoise, Viewer

Targets: TypeAlias = "Target | list[Target]"

# A ``SceneAttribution``, or a list of them where ``target`` is a list.
Result: TypeAlias = Any

# One sample for so many shows the metric the inputs themselves, where gradients are taken elsewhere.
OWN = 8


@dataclass(frozen=True)
class Settings:
    """What was asked for, in every method alike."""

    seed: int
    spp: int | None
    replicates: int
    show_progress: bool
    groups: Groups = None
    checkpoint: Folder = None
    denoise: Denoise = "auto"
    picture_spp: int | None = None


@dataclass(frozen=True)
class Own:
    """The metric at the inputs themselves, and their picture.

    Attributes
    ----------
    samples
        Per pixel of the picture, where they are known.
    metric
        With the view through which it saw the picture.
    """

    adjoints: Adjoints
    image: torch.Tensor
    samples: int | None
    metric: TargetedMetric


@dataclass
class Run:
    """One call of ``attribute``.

    Attributes
    ----------
    values
        The inputs to attribute to.
    metrics
        One for each target.
    several
        Whether the targets were a list.
    members
        The parameters of each group, where there are groups.
    """

    method: str
    renderer: Any
    values: dict[str, torch.Tensor]
    metrics: list[TargetedMetric]
    several: bool
    members: dict[str, tuple[str, ...]] | None
    settings: Settings
    watch: Stopwatch = field(init=False)
    viewer: Viewer = field(init=False)

    def __post_init__(self) -> None:
        self.watch = Stopwatch(self.renderer)
        self.viewer = Viewer(self.settings.denoise, self.renderer)

    def finish(
        self,
        points: Iterable[Point],
        count: int = 1,
        *,
        at_random: bool = False,
        moment: Callable[[GradientSum], GradientSum] | None = None,
        **info: Any,
    ) -> Result:
        """Sum the gradients of so many points, and return what ``attribute`` returns.

        With a ``moment`` the result is what this makes of all points, each of which tells its noise.
        """
        budget = self.budget(count, pairs=1 if at_random and moment is None else count)
        sums, gradients, interrupted = self.sums(points, budget, at_random=at_random, keep=moment is not None)
        if count == 1:
            owns = [
                Own(one.seen, gradients.image, gradients.samples, metric.through(one.seen.view))
                for metric, one in zip(self.metrics, sums, strict=True)
                if one.seen is not None
            ]
        else:
            owns = self.own(self.own_images([self.values], sums)[0])
        results = [
            self.result(
                metric,
                moment(one) if moment else one,
                own,
                budget,
                gradients,
                interrupted=interrupted,
                **info,
            )
            for metric, one, own in zip(self.metrics, sums, owns, strict=True)
        ]
        return self.hand_over(results, interrupted=interrupted)

    def budget(self, points: int, *, pairs: int | None = None) -> Budget:
        """Split the samples over so many points, the first ``pairs`` of which are seen twice or more."""
        settings = self.settings
        budget = Budget.split(settings.spp, settings.replicates, settings.seed, points, pairs=pairs)
        budget = budget.with_pictures(settings.picture_spp, budget.total)
        require_memory(self.renderer, budget.spp, max(budget.passes))
        return budget

    def sums(
        self, points: Iterable[Point], budget: Budget, *, at_random: bool = False, keep: bool = False
    ) -> tuple[list[GradientSum], Gradients, bool]:
        """Sum the gradients of points for each target; say whether Ctrl-C ended it early."""
        with tqdm(
            total=2 * sum(budget.passes),
            disable=not self.settings.show_progress,
            desc=self.metrics[0].name,
            unit="pass",
        ) as bar:
            gradients = Gradients(self.renderer, self.metrics, budget, self.viewer, bar)
            sums, interrupted = sum_gradients(gradients, points, at_random=at_random, keep=keep)
        return sums, gradients, interrupted

    def own(self, images: Sequence[torch.Tensor], samples: int | None = None) -> list[Own]:
        """Let every metric see the inputs themselves, in pictures of so many samples per pixel in all."""
        image = torch.stack(tuple(images)).mean(0)
        metrics = through_view(self.metrics, images, self.viewer)
        return [Own(jackknife(metric, images), image, samples, metric) for metric in metrics]

    def own_images(
        self, scenes: Sequence[Mapping[str, torch.Tensor]], sums: Sequence[GradientSum]
    ) -> list[list[torch.Tensor]]:
        """Render scenes in independent passes, all under the same seeds: their differences have less noise.

        ``sums`` tell whether every metric is linear.
        """
        settings, spp = self.settings, self.settings.spp
        if spp is not None:
            linear = all(one.seen is not None and one.seen.is_linear for one in sums)
            spp = max(math.ceil(spp / OWN), 1 if linear else LEAST_SEEN)
        seed = int(np.random.SeedSequence([settings.seed, 1]).generate_state(1)[0])
        budget = Budget.split(spp, settings.replicates, seed)
        return [pictures(self.renderer, values, budget.seeds[0], budget.spp[0]) for values in scenes]

    def result(
        self,
        metric: TargetedMetric,
        found: GradientSum,
        own: Own,
        budget: Budget,
        gradients: Gradients,
        *,
        interrupted: bool,
        **info: Any,
    ) -> SceneAttribution:
        """Put one result together."""
        seen = own.adjoints
        interval = metric_interval(seen.value, seen.standard_error, found.replicates)
        attribution = make_attribution(
            self.renderer,
            found,
            seen,
            values=self.values,
            image=own.image,
            info={
                "method": self.method,
                "metric": metric.name,
                "seed": self.settings.seed,
                "spp": budget.total,
                "budget": _budget_info(budget, gradients),
                "picture": describe_picture(
                    seen.view,
                    seen.value,
                    seen.drift,
                    own.samples,
                    denoised=seen.denoised,
                    interval=interval,
                    half_class=getattr(metric.metric, "half_class", None),
                ),
                "interrupted": interrupted,
                **self.watch.record,
                **info,
            },
        )
        return attribution if self.members is None else add_up(attribution, self.members)

    def hand_over(self, results: list[SceneAttribution], *, interrupted: bool) -> Result:
        """Return the results as they were asked for, or raise them where Ctrl-C ended it early."""
        if interrupted:
            raise AttributionInterrupted(*results)
        return results if self.several else results[0]


def _budget_info(budget: Budget, gradients: Gradients) -> dict[str, Any]:
    """Say how the samples were split."""
    counts = [one for one in budget.spp if one is not None]
    return {
        "points": gradients.points,
        "passes_per_point": [min(budget.passes), max(budget.passes)],
        "spp_per_pass": [min(counts), max(counts)] if counts else None,
        "spp_added_for_the_metric": gradients.extra,
    }


class GradientMethod:
    """Base of the methods that take gradients.

    Parameters
    ----------
    renderer
        A ``SceneRenderer``, or any callable ``renderer(inputs, *, seed, spp)`` that returns an image torch can
        differentiate.
    metric
        A torch function from the image to a scalar, or to a vector of which ``target`` names an element.
    """

    def __init__(self, renderer: Any, metric: Metric) -> None:
        self.renderer = renderer
        self.metric = metric

    def _start(self, inputs: Mapping[str, torch.Tensor] | None, target: Targets, settings: Settings) -> Run:
        spp = getattr(self.renderer, "spp", None) if settings.spp is None else settings.spp
        values, groups = input_values(self.renderer, inputs), settings.groups
        return Run(
            method=type(self).__name__,
            renderer=with_checkpoint(self.renderer, settings.checkpoint),
            values=values,
            members=None if groups is None else resolve_groups(self.renderer, values, groups),
            metrics=[TargetedMetric(self.metric, one) for one in listed(target)],
            several=isinstance(target, list),
            settings=dataclasses.replace(settings, spp=spp),
        )


def listed(target: Targets) -> list[Target]:
    """Return the targets as a list."""
    if target == []:
        raise SceneCaptumError("target is an empty list: name at least one element of the metric's output.")
    return target if isinstance(target, list) else [target]
