"""Gradients at random places between baseline scenes and noisy inputs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch

from ..checkpoint import Folder
from ..errors import SceneCaptumError, check_seed, whole_number
from ._baselines import Baselines, resolve_baselines
from ._completeness import completed, difference, hand_over
from ._gradients import Point, between
from ._groups import Groups
from ._method import GradientMethod, Result, Settings, Targets
from ._passes import DEFAULT_PASSES
from ._ranges import Noise
from ._view import Denoise


class GradientShapScene(GradientMethod):
    """The expectation of ``(θ + ε − θ₀) · ∂M(θ₀ + α(θ + ε − θ₀))/∂θ`` over baselines θ₀, places α and noise ε.

    It approximates SHAP values where the baselines are a distribution: "compared with the rooms that it might have
    been". The attributions add up to ``M(θ)`` less the mean of ``M(θ₀)``, within the error.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", inputs="reflectance", resolution=(16, 16), spp=64)
    >>> method = GradientShapScene(renderer, metrics.MeanLuminance())
    >>> attribution = method.attribute(baselines=[0.2, 0.4, 0.6], n_samples=8)
    >>> attribution["floor.reflectance.value"].shape
    torch.Size([3])

    Parameters
    ----------
    renderer, metric
        As for ``VanillaSceneGradient``.

    References
    ----------
    Lundberg and Lee, "A Unified Approach to Interpreting Model Predictions", 2017; Erion et al., "Improving
    Performance of Deep Learning Models with Axiomatic Attribution Priors and Expected Gradients", 2021.
    """

    def attribute(  # noqa: PLR0913 -- those of every method, and four of its own
        self,
        inputs: Mapping[str, torch.Tensor] | None = None,
        target: Targets = None,
        *,
        baselines: Baselines | list[Baselines] = None,
        n_samples: int = 25,
        stdevs: float | Mapping[str, float] = 0.0,
        return_convergence_delta: bool = False,
        groups: Groups = None,
        seed: int = 0,
        spp: int | None = None,
        picture_spp: int | None = None,
        replicates: int = DEFAULT_PASSES,
        denoise: Denoise = "auto",
        checkpoint: Folder = None,
        show_progress: bool = False,
    ) -> Result:
        """Attribute the metric's difference from the baselines to each input.

        Parameters
        ----------
        inputs
            Values by parameter name; the renderer's own by default.
        target
            Which element of the metric's output is meant, where it is not a scalar; a list of them gives a list
            of results from the same renders.
        baselines
            A list of scenes to compare with, each as ``IntegratedGradientsScene`` takes it, or a single one. All
            are equally likely.
        n_samples
            How many random scenes.
        stdevs
            Noise on the inputs, as in ``SmoothGradScene``.
        return_convergence_delta
            Return ``(attribution, delta)``.
        groups, seed, spp, picture_spp, replicates, denoise, checkpoint, show_progress
            As in ``SmoothGradScene``.

        Returns
        -------
        SceneAttribution
            Signed contributions with standard errors from the spread of the scenes; a list of them for a list of
            targets.

        Raises
        ------
        SceneCaptumError
            Where a setting does not fit, or as ``VanillaSceneGradient``.
        AttributionInterrupted
            On Ctrl-C after the first scene, with the mean over the scenes so far.
        """
        count = whole_number("n_samples", n_samples)
        run = self._start(
            inputs,
            target,
            Settings(seed, spp, replicates, show_progress, groups, checkpoint, denoise, picture_spp),
        )
        given: list[Any] = baselines if isinstance(baselines, list) else [baselines]
        if not given:
            raise SceneCaptumError("baselines is an empty list: give at least one scene to compare with.")
        starts = [resolve_baselines(self.renderer, run.values, one) for one in given]
        noise = Noise(self.renderer, run.values, stdevs)
        budget = run.budget(count, pairs=1)
        sums, gradients, interrupted = run.sums(_points(noise, starts, count, seed), budget, at_random=True)
        images, *references = run.own_images([run.values, *starts], sums)
        results = [
            completed(
                run.result(metric, one, own, budget, gradients, interrupted=interrupted),
                difference(own.metric, images, references),
            )
            for metric, one, own in zip(run.metrics, sums, run.own(images), strict=True)
        ]
        return hand_over(run, results, interrupted=interrupted, with_delta=return_convergence_delta)


def _points(noise: Noise, starts: list[dict[str, torch.Tensor]], count: int, seed: int) -> Iterator[Point]:
    rng = np.random.default_rng([check_seed("seed", seed), 3])
    for _ in range(count):
        start, place = starts[rng.integers(len(starts))], rng.uniform()
        yield between(start, noise.draw(int(rng.integers(2**62))), place, 1 / count)
