"""How the time of a planned run is divided among the picture, the draws of noise, and the backward passes.

The error of the gradient of a smoothed metric has three parts: the noise of the picture, that of a finite number
of draws, and that of the backward passes. Each falls with its own number of samples, and each has its own price.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter

import torch

from ..protocols import Renderer
from ._autograd import gradients_enabled
from ._goal import Compared
from ._gradients import GradientEstimator, Point, Tensors, vjp
from ._metric import TargetedMetric
from ._metric_image import TransformSelector
from ._progress import Progress
from ._replicates import Budget, channel_totals
from ._seeds import Stream, random_generator

REPLICATES = 4
DRAWS = 4  # of each replicate
_COMBINATIONS = 2  # of the deviations of the replicates, with random signs
MAX_PICTURE_RATIO = 64.0
_MIN_PART = 0.01  # of all variance, at the least: a part that seems smaller may be unlucky


@dataclass(frozen=True)
class Part:
    """A part of the variance of a gradient, and its price."""

    variance: float  # of a single sample; it falls with their number
    seconds: float  # for a sample


@dataclass(frozen=True)
class Mix:
    """What a sample per pixel of the backward pass is accompanied by."""

    picture: float  # samples per pixel of the picture
    draws: float  # draws of noise
    seconds_per_draw: float  # with all evaluations of the metric

    @classmethod
    def best(cls, backward: Part, picture: Part, draws: Part) -> Mix:
        """Return the mix with the smallest variance in a given time.

        The sum of ``variance / n`` with a given sum of ``seconds · n`` is smallest if each ``n`` is proportional
        to ``√(variance / seconds)`` (Neyman's allocation). A picture needs at least the samples of the backward
        pass, which are rendered in any case.
        """
        least = _MIN_PART * max(part.variance / part.seconds for part in (backward, picture, draws))
        numbers = [math.sqrt(max(part.variance / part.seconds, least)) for part in (backward, picture, draws)]
        picture_ratio = min(max(1.0, numbers[1] / numbers[0]), MAX_PICTURE_RATIO)
        return cls(picture_ratio, numbers[2] / numbers[0], draws.seconds)

    @classmethod
    def from_integers(cls, picture: int, draws: int, seconds_per_draw: int) -> Mix:
        """Return the mix that these thousandths stand for; a checkpoint stores decisions as integers."""
        return cls(picture / 1000, draws / 1000, seconds_per_draw / 1000)

    def to_integers(self) -> tuple[int, int, int]:
        """Return thousandths, rounded up."""
        numbers = (self.picture, self.draws, self.seconds_per_draw)
        picture, draws, seconds = (math.ceil(1000 * number) for number in numbers)
        return picture, draws, seconds

    def draws_of(self, spp: int) -> int:
        """Return the draws for a replicate, an even number."""
        return 2 * max(1, round(self.draws * spp / 2))


class Pilot(GradientEstimator):
    """A small run, not part of the result, that measures the parts of the variance and their prices."""

    def __init__(
        self,
        renderer: Renderer,
        metrics: Sequence[TargetedMetric],
        transform_selector: TransformSelector,
        spp: int,
        seed: int,
        images: int,
    ) -> None:
        # The later rounds evaluate each draw on the mean image and on so many other means.
        self._more_images = (1 + images) / (1 + REPLICATES)
        budget = Budget.split(None, REPLICATES, seed)
        super().__init__(
            renderer,
            [metric.with_draws({0: DRAWS * REPLICATES}) for metric in metrics],
            Budget((spp,), budget.seeds, budget.gradient_seeds),
            transform_selector,
            Progress("", show=False),
        )
        self._signs = random_generator(seed, Stream.PILOT)

    @gradients_enabled()
    def measure(self, point: Point, compared: Compared) -> tuple[Part, Part, Part]:
        """Return the parts of the variance of the effects that a goal refers to: backward, picture, draws."""
        leaves, (spp,) = self._held(point), self.budget.spp
        for value in leaves.values():
            value.requires_grad_()
        start = perf_counter()
        images, graphs = self._render(0, leaves)
        rendered = perf_counter()
        adjoints = self._evaluate_metrics(0, point.values, images)[0]
        evaluated = perf_counter()

        def propagate(adjoint: torch.Tensor) -> torch.Tensor:
            """Return the effects ``(replicates, effects)``."""
            return torch.stack([_effects(vjp(graph(), leaves, adjoint, point), compared) for graph in graphs])

        total = torch.stack(adjoints.per_replicate)
        backward = propagate(total.mean(0)).var(0).sum().item()
        seconds = perf_counter() - evaluated
        noise = torch.zeros_like(total) if adjoints.draw_noise is None else adjoints.draw_noise
        picture = self._variance(total - total.mean(0) - noise, propagate)
        draws = self._variance(noise, propagate)
        samples = (spp or 1) * REPLICATES
        return (
            Part((spp or 1) * backward, seconds / samples),
            Part((spp or 1) * picture, (rendered - start) / samples),
            Part(DRAWS * draws, self._more_images * (evaluated - rendered) / (DRAWS * REPLICATES)),
        )

    def _variance(self, deviations: torch.Tensor, propagate: Callable[[torch.Tensor], torch.Tensor]) -> float:
        """Return the variance of the effects of a replicate whose adjoint has these deviations.

        Products of different backward passes, which are independent: their own noise averages out.
        """
        count, products = len(deviations), []
        for signs in self._signs.choice([-1.0, 1.0], (_COMBINATIONS, count)):
            signed = torch.from_numpy(signs).to(deviations) / math.sqrt(count - 1)
            effects = propagate(torch.tensordot(signed, deviations, 1))
            product = effects.sum(0).square().sum() - effects.square().sum()
            products.append(product.item() / (len(effects) * (len(effects) - 1)))
        return max(0.0, sum(products) / len(products))


def _effects(gradients: Tensors, compared: Compared) -> torch.Tensor:
    """Return the effects that a goal refers to; without factors, the channel totals."""
    totals = {name: channel_totals(gradient).double() for name, gradient in gradients.items()}
    if compared.factors is None:
        return torch.cat(list(totals.values()))
    return torch.stack([total @ compared.factors[name].double() for name, total in totals.items()])
