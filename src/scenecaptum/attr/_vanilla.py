"""Plain gradients."""

from __future__ import annotations

import inspect
import time
from collections.abc import Mapping
from typing import Any

import torch
from tqdm import tqdm

from ..errors import SceneCaptumError
from ._attribution import SceneAttribution, make_attribution
from ._interruption import AttributionInterrupted
from ._metric import Metric, Target, TargetedMetric
from ._passes import DEFAULT_PASSES, Adjoints, Budget, Spread, jackknife


class VanillaSceneGradient:
    """The gradient of a metric with respect to scene parameters, ``∂M(R(θ))/∂θ``.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", inputs="emitters", resolution=(32, 32), spp=16)
    >>> attribution = VanillaSceneGradient(renderer, metrics.MeanLuminance()).attribute(seed=0)
    >>> attribution["light.emitter.radiance.value"].shape
    torch.Size([3])

    Parameters
    ----------
    renderer
        A ``SceneRenderer``, or any callable ``renderer(inputs, *, seed, spp)`` that returns an image torch can
        differentiate.
    metric
        A torch function from the image to a scalar, or to a vector of which ``target`` names an element.

    References
    ----------
    Beresna and Fiume, "Scene Parameter Saliency via Differentiable Light Transport".
    Simonyan, Vedaldi and Zisserman, "Deep Inside Convolutional Networks", 2013.
    """

    def __init__(self, renderer: Any, metric: Metric) -> None:
        self.renderer = renderer
        self.metric = metric

    def attribute(
        self,
        inputs: Mapping[str, torch.Tensor] | None = None,
        target: Target = None,
        *,
        seed: int = 0,
        spp: int | None = None,
        replicates: int = DEFAULT_PASSES,
        show_progress: bool = False,
    ) -> SceneAttribution:
        """Attribute the metric to each input.

        Parameters
        ----------
        inputs
            Values by parameter name; the renderer's own by default.
        target
            Which element of the metric's output is meant, where it is not a scalar.
        seed
            Seed from which those of all passes are drawn.
        spp
            Total samples per pixel, split over the passes; the renderer's by default. The backward passes take
            as many again, with seeds of their own.
        replicates
            Least number of independent passes. Their spread gives the standard errors; with 1 there are none,
            and no correction of the bias that a noisy image puts into a non-linear metric.
        show_progress
            Whether to show a progress bar.

        Returns
        -------
        SceneAttribution
            Signed gradients per unit of each parameter, with standard errors.

        Raises
        ------
        SceneCaptumError
            Where the inputs are unphysical or the metric is not a scalar that depends on the image.
        AttributionInterrupted
            On Ctrl-C after at least one backward pass, with the result so far.
        """
        start = time.perf_counter()
        values = _values(self.renderer, inputs)
        metric = TargetedMetric(self.metric, target)
        total = getattr(self.renderer, "spp", None) if spp is None else spp
        budget = Budget.split(total, replicates, seed)
        leaves = {name: value.detach().requires_grad_() for name, value in values.items()}
        spreads = {name: Spread(value) for name, value in values.items()}
        bias: dict[str, torch.Tensor] | None = None
        interrupted = False

        with tqdm(
            total=2 * len(budget.seeds), disable=not show_progress, desc=metric.name, unit="pass"
        ) as bar:
            images, graphs = _render(self.renderer, leaves, budget, bar)
            adjoints = jackknife(metric, images)
            try:
                for graph, adjoint in zip(graphs, adjoints.passes, strict=True):
                    for name, gradient in _pull_back(graph, leaves, adjoint).items():
                        spreads[name].add(gradient)
                    bar.update()
                bias = _bias(graphs[0], leaves, adjoints)
            except KeyboardInterrupt:
                if not all(spread.totals for spread in spreads.values()):
                    raise
                interrupted = True

        attribution = make_attribution(
            self.renderer,
            spreads,
            adjoints,
            bias,
            image=torch.stack(images).mean(0),
            info={
                "method": type(self).__name__,
                "metric": metric.name,
                "seed": seed,
                "spp": None if budget.spp is None else budget.spp * len(budget.seeds),
                "passes": len(budget.seeds),
                "interrupted": interrupted,
                "seconds": time.perf_counter() - start,
            },
        )
        if interrupted:
            raise AttributionInterrupted(attribution)
        return attribution


def _values(renderer: Any, inputs: Mapping[str, torch.Tensor] | None) -> dict[str, torch.Tensor]:
    values = getattr(renderer, "inputs", None) if inputs is None else inputs
    if not values:
        raise SceneCaptumError(
            "There is nothing to attribute to: give inputs=, a dict from parameter name to tensor."
        )
    return dict(values)


def _render(
    renderer: Any, leaves: dict[str, torch.Tensor], budget: Budget, bar: Any
) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """Render every pass: the images that the metric sees, and the same as graphs to be differentiated.

    A renderer that cannot replay its backward pass with another seed is called twice.
    """
    replays = "seed_grad" in inspect.signature(getattr(renderer, "forward", renderer)).parameters
    images, graphs = [], []
    for seed, gradient_seed in zip(budget.seeds, budget.gradient_seeds, strict=True):
        if replays:
            graph = renderer(leaves, seed=seed, spp=budget.spp, seed_grad=gradient_seed)
            images.append(graph.detach())
        else:
            graph = renderer(leaves, seed=gradient_seed, spp=budget.spp)
            images.append(renderer(leaves, seed=seed, spp=budget.spp).detach())
        graphs.append(graph)
        bar.update()
    return images, graphs


def _pull_back(
    graph: torch.Tensor, leaves: dict[str, torch.Tensor], adjoint: torch.Tensor
) -> dict[str, torch.Tensor]:
    gradients = torch.autograd.grad(
        graph, list(leaves.values()), adjoint, retain_graph=True, allow_unused=True
    )
    return {
        name: torch.zeros_like(leaf) if gradient is None else gradient
        for (name, leaf), gradient in zip(leaves.items(), gradients, strict=True)
    }


def _bias(
    graph: torch.Tensor, leaves: dict[str, torch.Tensor], adjoints: Adjoints
) -> dict[str, torch.Tensor] | None:
    """Return the bias that the image's noise would have put into each gradient, from the samples of one pass."""
    if adjoints.bias is None:
        return None
    if adjoints.bias_adjoint is None:
        return {name: leaf.new_zeros(()).expand_as(leaf) for name, leaf in leaves.items()}
    return _pull_back(graph, leaves, adjoints.bias_adjoint)
