"""Shared implementation of the gradient methods: from the arguments of ``attribute`` to its results."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias, cast

import torch

from ..checkpoint import Folder, Stopwatch
from ..errors import SceneCaptumError
from ..estimation import (
    MIN_METRIC_SPP,
    Adjoints,
    Budget,
    Compared,
    Denoise,
    Goal,
    GradientEstimator,
    GradientSum,
    Metric,
    Planner,
    Point,
    Progress,
    Rounds,
    SampleOption,
    Sampling,
    Stream,
    Target,
    TargetedMetric,
    TransformSelector,
    check_renderer_and_metric,
    derived_seeds,
    describe_picture,
    input_values,
    jackknife,
    relative_noise,
    render_images,
    require_memory,
    scaled,
    sum_gradients,
    with_image_transform,
)
from ..executors import spread
from ..protocols import Capabilities, Renderer, ResultKind
from ._attribution import SceneAttribution, make_attribution, surfaces_of
from ._data import Tensors, metric_interval
from ._groups import Groups, resolve_groups, sum_groups
from ._steps import step_errors

Targets: TypeAlias = "Target | torch.Tensor | list[Target]"  # a tensor of one integer, as for Captum

# A ``SceneAttribution``, or a list of them where ``target`` is a list.
Result: TypeAlias = Any

# If gradients are evaluated at other points, the metric at the inputs gets this fraction of the samples.
INPUT_SAMPLE_FRACTION = 1 / 8
# Of the noise that a smoothed metric tolerates: a picture with more is noisier than the smoothing, and its bias
# falls more slowly with the samples than the jackknife assumes.
UNCORRECTED = 3.0


@dataclass(frozen=True)
class Settings(Sampling):
    """Arguments common to all methods."""

    groups: Groups = None
    checkpoint: Folder = None
    denoise: Denoise = "auto"
    executor: Executor | None = None


class NamedMethod(NamedTuple):
    """A method in the registry of the command line, and a few words for its help text."""

    create: Any  # from a renderer and a metric to an object with ``attribute``
    description: str


class AttributionInterrupted(KeyboardInterrupt):
    """Raised on Ctrl-C during an attribution if the finished replicates already give a result.

    Attributes
    ----------
    partial
        The attribution from the finished replicates, with its standard errors.
    partials
        One such attribution for each target; ``partial`` is the first.
    """

    def __init__(self, partial: SceneAttribution, *others: SceneAttribution) -> None:
        super().__init__("interrupted; .partial has the result of the finished replicates")
        self.partial = partial
        self.partials = (partial, *others)


@dataclass(frozen=True)
class InputEvaluation:
    """The metric at the inputs, and their image."""

    adjoints: Adjoints
    image: torch.Tensor
    spp: int | None  # of the image, if known
    metric: TargetedMetric  # with the image transform that was used
    noise: float | None = None  # relative noise of the image's pixels, if known
    pixel_error: float | None = None  # standard error of its pixels, if known


@dataclass
class Run:
    """One call of ``attribute``."""

    method: str
    renderer: Renderer
    values: dict[str, torch.Tensor]  # of the inputs to attribute to
    metrics: list[TargetedMetric]  # one for each target
    returns_list: bool  # the targets were given as a list
    members: dict[str, tuple[str, ...]] | None  # the parameters of each group
    settings: Settings
    watch: Stopwatch = field(init=False)
    transform_selector: TransformSelector = field(init=False)

    def __post_init__(self) -> None:
        self.watch = Stopwatch(self.renderer)
        self.transform_selector = TransformSelector(
            self.settings.denoise, self.renderer, self.values, smoothed=self.metrics[0].is_smoothed
        )

    def attribute(
        self,
        points: Iterable[Point],
        count: int = 1,
        *,
        quantity: ResultKind,
        random_points: bool = False,
        moment: Callable[[GradientSum], GradientSum] | None = None,
        **info: Any,
    ) -> Result:
        """Sum the gradients of ``count`` points and return the result of ``attribute``.

        ``quantity`` says what the sum is: tables multiply a gradient per unit by the range of its parameter, and
        nothing else. ``moment`` computes another statistic from all points, each of which then has several
        replicates.
        """
        info["quantity"] = quantity.value
        pairs = 1 if random_points and moment is None else count
        sums, gradients, interrupted = self.sums(
            points, count, pairs=pairs, random_points=random_points, keep_points=moment is not None
        )
        if count == 1:
            evaluations = self._evaluations(sums, gradients)
        else:
            evaluations = self.evaluate_inputs(self.render_scenes([self.values], gradients)[0])
        results = [
            self.result(
                metric, moment(total) if moment else total, evaluation, gradients, interrupted, **info
            )
            for metric, total, evaluation in zip(self.metrics, sums, evaluations, strict=True)
        ]
        return self.return_results(results, interrupted=interrupted)

    def attribute_point(
        self,
        point: Point,
        goal: Goal,
        factors: Tensors | None,
        first_spp: int | None,
        against: Any = None,
        *,
        quantity: ResultKind,
    ) -> Result:
        """Return the result of ``attribute`` for a single point, in rounds if there is a goal.

        The goal refers to effects: sums over the channels times their ``factors``; without these, to norms.
        ``first_spp`` are the samples per pixel of the first round. ``against`` is another renderer, with which the
        gradients are compared at the end.
        """
        if self.settings.executor is not None and goal.time_limit is not None:
            raise SceneCaptumError(
                "time_limit= measures the time of this process: leave out executor=, or give tolerance= or top=."
            )
        if goal.is_set:
            return self._attribute_to_goal(point, goal, factors, first_spp, against, quantity)
        if against is not None:
            raise SceneCaptumError("against= requires a goal: give tolerance=, top= or time_limit= as well.")
        return self.attribute([point], quantity=quantity)

    def _attribute_to_goal(
        self,
        point: Point,
        goal: Goal,
        factors: Tensors | None,
        first_spp: int | None,
        against: Any,
        quantity: ResultKind,
    ) -> Result:
        planner = Planner(
            self.renderer,
            self.metrics,
            self.transform_selector,
            point,
            Compared(factors, self.members, frozenset(Capabilities(self.renderer).vectors or ())),
            goal,
            dataclasses.replace(self.settings, spp=first_spp),
            against=against,
            prepare=lambda: surfaces_of(self.renderer, self.values, self.values),
            unranked=self._without_derivative,
        )
        interrupted, rounds = planner.run(), planner.rounds
        evaluated = zip(self.metrics, planner.sums, self._evaluations(planner.sums, rounds), strict=True)
        results = []
        for number, arguments in enumerate(evaluated):
            report = planner.report(number, interrupted=interrupted)
            info = {"quantity": quantity.value, "planner": report}
            results.append(self.result(*arguments, rounds, interrupted, **info))
        return self.return_results(results, interrupted=interrupted)

    def _without_derivative(
        self, names: Collection[str], total: GradientSum, adjoint: torch.Tensor, spp: int
    ) -> tuple[Collection[str], Mapping[str, Sequence[float]]]:
        """Return which of these poses have no derivative, and the directions that others have none in: 0 or 1."""
        mean = {name: scaled(value, 1 / total.weight) for name, value in total.mean.items()}
        samples = dict.fromkeys(names, float(spp))
        found = step_errors(self.renderer, mean, self.values, adjoint, samples, self.settings.seed)
        return found.jumps, found.kept_directions

    def _evaluations(
        self, sums: Sequence[GradientSum], gradients: GradientEstimator
    ) -> list[InputEvaluation]:
        """Return the metrics at the inputs, the only point where gradients were estimated."""
        image, spp = gradients.image, gradients.total_image_spp
        return [
            InputEvaluation(
                adjoints,
                image,
                spp,
                metric.with_transform(adjoints.transform),
                noise=_uncorrected_noise(metric, gradients.pixel_noise),
                pixel_error=gradients.pixel_error,
            )
            for metric, total in zip(self.metrics, sums, strict=True)
            if (adjoints := total.adjoints) is not None
        ]

    def sums(
        self,
        points: Iterable[Point],
        count: int,
        *,
        pairs: int,
        random_points: bool = False,
        keep_points: bool = False,
    ) -> tuple[list[GradientSum], GradientEstimator, bool]:
        """Sum the gradients of ``count`` points for each target; also return whether Ctrl-C interrupted it.

        The samples are split over the points, of which the first ``pairs`` have at least two replicates.
        """
        settings = self.settings
        budget = Budget.split(settings.spp, settings.replicates, settings.seed, count, pairs=pairs)
        budget = budget.with_picture_spp(settings.picture_spp, budget.total)
        require_memory(self.renderer, budget.spp, max(budget.replicates))
        with Progress(self.metrics[0].label, show=settings.show_progress) as bar:
            bar.expect(sum(budget.replicates))
            gradients = GradientEstimator(self.renderer, self.metrics, budget, self.transform_selector, bar)
            sums, interrupted = sum_gradients(
                gradients, points, random_points=random_points, keep_points=keep_points
            )
        return sums, gradients, interrupted

    def evaluate_inputs(self, images: Sequence[torch.Tensor]) -> list[InputEvaluation]:
        """Evaluate every metric on images of the inputs."""
        image = torch.stack(tuple(images)).mean(0)
        metrics = with_image_transform(self.metrics, images, self.transform_selector)
        seeds = derived_seeds(self.settings.seed, Stream.INPUT_METRIC, len(images))
        noise = relative_noise(images)
        adjoints = [jackknife(metric, images, draws=metric.split_draws(seeds)) for metric in metrics]
        return [
            InputEvaluation(each, image, None, metric, noise)
            for each, metric in zip(adjoints, metrics, strict=True)
        ]

    def render_scenes(
        self, scenes: Sequence[Mapping[str, torch.Tensor]], gradients: GradientEstimator
    ) -> list[list[torch.Tensor]]:
        """Render independent replicates of each scene, with common random numbers for all scenes.

        A non-linear metric gets as many samples as in the pictures of all points together: its value, and the
        difference that the effects explain, would be biased by a noisier picture.
        """
        spp = self.settings.spp
        if spp is not None:
            few = math.ceil(spp * INPUT_SAMPLE_FRACTION)
            spp = few if gradients.is_linear else max(few, MIN_METRIC_SPP, gradients.total_image_spp or 0)
        (seed,) = derived_seeds(self.settings.seed, Stream.INPUT_METRIC, 1)
        budget = Budget.split(spp, self.settings.replicates, seed)
        return [render_images(self.renderer, values, budget.seeds[0], budget.spp[0]) for values in scenes]

    def result(
        self,
        metric: TargetedMetric,
        total: GradientSum,
        evaluation: InputEvaluation,
        gradients: GradientEstimator,
        interrupted: bool,
        **info: Any,
    ) -> SceneAttribution:
        """Build the result for one target."""
        adjoints = evaluation.adjoints
        interval = metric_interval(adjoints.value, adjoints.standard_error, total.replicates)
        attribution = make_attribution(
            self.renderer,
            total,
            adjoints,
            metric=evaluation.metric,
            values=self.values,
            image=evaluation.image,
            info={
                "method": self.method,
                **evaluation.metric.describe(adjoints.value, evaluation.image),
                "seed": self.settings.seed,
                "spp": gradients.budget.total,
                "budget": _budget_info(gradients),
                "picture": describe_picture(
                    adjoints.transform,
                    adjoints.value,
                    adjoints.drift,
                    evaluation.spp,
                    denoised=adjoints.denoised,
                    interval=interval,
                    noise=evaluation.noise,
                    standard_error=evaluation.pixel_error,
                    metric=metric,
                    image=evaluation.image,
                    option=self._sample_option(gradients, evaluation),
                    shows_a_view=Capabilities(self.renderer).shows_a_view is not False,
                ),
                "interrupted": interrupted,
                **self.watch.info,
                **info,
            },
        )
        return attribution if self.members is None else sum_groups(attribution, self.members)

    def _sample_option(
        self, gradients: GradientEstimator, evaluation: InputEvaluation
    ) -> SampleOption | None:
        """Return the option to set for more samples of the picture at the inputs; None if they are not counted.

        ``picture_spp=`` is that of the picture alone. Without it, the picture of a single point has a multiple of
        ``spp=``, and that of many all samples of their pictures. With a goal, ``spp=`` is of the first round only.
        """
        samples = gradients.total_image_spp
        if samples is None:
            return None
        has_goal = isinstance(gradients, Rounds)
        instead = " in place of a goal" if has_goal else ""
        keyword, given = "picture_spp", self.settings.picture_spp
        if given is None:
            keyword, given = "spp", self.settings.spp
        if gradients.n_points > 1 and not has_goal and given is not None:
            least, has = given + 1, max(samples, MIN_METRIC_SPP)
            needed = gradients.picture_spp_for if keyword == "picture_spp" else gradients.spp_for
            return SampleOption(keyword, given, needed=lambda factor: max(least, needed(factor * has)))
        if keyword == "picture_spp":
            return SampleOption(keyword, samples, instead)
        adjoints = evaluation.adjoints
        ratio = 1.0 if adjoints.is_linear else gradients.default_ratio(denoises=adjoints.transform.denoises)
        return SampleOption("spp", samples / ratio, instead)

    def return_results(self, results: list[SceneAttribution], *, interrupted: bool) -> Result:
        """Return one result or a list, as requested; raise AttributionInterrupted after an interruption."""
        if interrupted:
            raise AttributionInterrupted(*results)
        return results if self.returns_list else results[0]


def _uncorrected_noise(metric: TargetedMetric, noise: float | None) -> float | None:
    """Return the noise of a picture whose bias of a smoothed metric the jackknife does not correct."""
    tolerated = metric.tolerated_noise if metric.is_smoothed else None
    return noise if noise and tolerated and noise > UNCORRECTED * tolerated else None


def _budget_info(gradients: GradientEstimator) -> dict[str, Any]:
    budget = gradients.budget
    counts = [spp for spp in budget.spp if spp is not None]
    return {
        "points": gradients.n_points,
        "replicates_per_point": [min(budget.replicates), max(budget.replicates)],
        "spp_per_replicate": [min(counts), max(counts)] if counts else None,
        "spp_added_for_the_metric": gradients.extra_spp,
    }


class GradientMethod:
    """Base class of the gradient methods; the parameters are those of ``VanillaSceneGradient``."""

    def __init__(self, renderer: Renderer, metric: Metric) -> None:
        check_renderer_and_metric(renderer, metric)
        self.renderer = renderer
        self.metric = metric

    def _start(self, inputs: Mapping[str, torch.Tensor] | None, target: Targets, settings: Settings) -> Run:
        spp = Capabilities(self.renderer).spp if settings.spp is None else settings.spp
        values, groups = input_values(self.renderer, inputs), settings.groups
        return Run(
            method=type(self).__name__,
            renderer=spread(self.renderer, settings.executor, settings.checkpoint),
            values=values,
            members=None if groups is None else resolve_groups(self.renderer, values, groups),
            metrics=[TargetedMetric(self.metric, element) for element in target_list(target)],
            returns_list=isinstance(target, list),
            settings=dataclasses.replace(settings, spp=spp),
        )


def target_list(target: Targets) -> list[Target]:
    """Return the targets as a list."""
    if isinstance(target, list) and not target:
        raise SceneCaptumError("target is an empty list: give at least one element of the metric's output.")
    return target if isinstance(target, list) else [cast(Target, target)]
