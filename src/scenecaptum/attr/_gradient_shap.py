"""Gradient SHAP: gradients at random points between baseline scenes and noisy inputs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from typing import Any

import torch

from ..checkpoint import Folder
from ..errors import SceneCaptumError, whole_number
from ..estimation import DEFAULT_REPLICATES, Denoise, Point, Stream, interpolated_point, random_generator
from ..protocols import ResultKind
from ._baseline_words import describe_baselines, describe_several
from ._baselines import Baselines, resolve_baselines
from ._completeness import metric_difference, return_with_delta, with_convergence
from ._groups import Groups
from ._method import GradientMethod, Result, Settings, Targets
from ._ranges import Noise


class GradientShapScene(GradientMethod):
    """The expectation of ``(θ + ε − θ₀) · ∂M(θ₀ + α(θ + ε − θ₀))/∂θ`` over baselines θ₀, fractions α and noise ε.

    It approximates SHAP values with respect to a distribution of baselines. The attributions add up to ``M(θ)``
    minus the mean of ``M(θ₀)``, within the error.

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
        *,
        target: Targets = None,
        baselines: Baselines | list[Baselines] = None,
        n_samples: int = 25,
        stdevs: float | Mapping[str, float] = 0.0,
        return_convergence_delta: bool = False,
        groups: Groups = None,
        seed: int = 0,
        spp: int | None = None,
        picture_spp: int | None = None,
        replicates: int = DEFAULT_REPLICATES,
        denoise: Denoise = "auto",
        checkpoint: Folder = None,
        executor: Executor | None = None,
        show_progress: bool = False,
    ) -> Result:
        """Attribute the metric's difference from the baselines to each input.

        Parameters
        ----------
        baselines
            A baseline as for ``IntegratedGradientsScene``, or a list of baselines with equal probability. Inputs
            that a mapping does not name take the default, 0 for emitters and reflectances.
        n_samples
            Number of random scenes.
        stdevs
            Noise on the inputs, as in ``SmoothGradScene``.
        return_convergence_delta
            Return ``(attribution, delta)``.
        inputs, target, groups, seed, spp, picture_spp, replicates, denoise, checkpoint, executor, show_progress
            As for ``SmoothGradScene``.

        Returns
        -------
        SceneAttribution
            Signed contributions with standard errors from the variance between scenes; a list of them for a list
            of targets.

        Raises
        ------
        SceneCaptumError
            If a setting is invalid, or as for ``VanillaSceneGradient``.
        AttributionInterrupted
            On Ctrl-C after the first scene, with the mean over the scenes so far.
        """
        count = whole_number("n_samples", n_samples)
        settings = Settings(
            seed, spp, replicates, show_progress, picture_spp, groups, checkpoint, denoise, executor
        )
        run = self._start(inputs, target, settings)
        given: list[Any] = baselines if isinstance(baselines, list) else [baselines]
        if not given:
            raise SceneCaptumError("baselines is an empty list: give at least one scene to compare with.")
        starts = [resolve_baselines(self.renderer, run.values, baseline) for baseline in given]
        info = {
            "quantity": ResultKind.CONTRIBUTION.value,
            "n_samples": count,
            **(
                describe_several(self.renderer, run.values, given, starts)
                if len(given) > 1
                else describe_baselines(self.renderer, run.values, given[0], starts[0])
            ),
        }
        noise = Noise(self.renderer, run.values, stdevs)
        points = _points(noise, starts, count, seed)
        sums, gradients, interrupted = run.sums(points, count, pairs=1, random_points=True)
        images, *references = run.render_scenes([run.values, *starts], gradients)
        results = [
            with_convergence(
                run.result(metric, total, evaluation, gradients, interrupted, **info),
                metric_difference(evaluation.metric, images, references),
            )
            for metric, total, evaluation in zip(run.metrics, sums, run.evaluate_inputs(images), strict=True)
        ]
        return return_with_delta(run, results, interrupted=interrupted, with_delta=return_convergence_delta)


def _points(noise: Noise, starts: list[dict[str, torch.Tensor]], count: int, seed: int) -> Iterator[Point]:
    rng = random_generator(seed, Stream.RANDOM_POINTS)
    for _ in range(count):
        start, fraction = starts[rng.integers(len(starts))], rng.uniform()
        yield interpolated_point(start, noise.sample(int(rng.integers(2**32))), fraction, 1 / count)
