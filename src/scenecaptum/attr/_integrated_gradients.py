"""Integrated gradients: gradients along the path from a baseline scene."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Executor

import torch

from ..checkpoint import Folder
from ..estimation import DEFAULT_REPLICATES, Denoise, Method, interpolated_point, quadrature
from ..protocols import ResultKind
from ._baseline_words import describe_baselines
from ._baselines import Baselines, resolve_baselines
from ._completeness import metric_difference, return_with_delta, with_convergence
from ._groups import Groups
from ._method import GradientMethod, Result, Settings, Targets
from ._quadrature_error import error_of_sum, with_quadrature_error


class IntegratedGradientsScene(GradientMethod):
    """Gradients averaged along the path from a baseline, times the path: ``(θ − θ₀) · ∫ ∂M(θ₀ + α(θ − θ₀)) dα``.

    The attributions add up to ``M(θ) − M(θ₀)``. The remaining difference is ``convergence_delta``, and
    ``info["convergence"]`` says whether it is within the error. All errors include the quadrature error and the
    noise.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", inputs="emitters", resolution=(32, 32), spp=64)
    >>> method = IntegratedGradientsScene(renderer, metrics.MeanLuminance())
    >>> attribution = method.attribute(n_steps=4, spp=1024)
    >>> attribution.info["convergence"]
    'adds up'

    Parameters
    ----------
    renderer, metric
        As for ``VanillaSceneGradient``.

    References
    ----------
    Sundararajan, Taly and Yan, "Axiomatic Attribution for Deep Networks", 2017.
    """

    def attribute(  # noqa: PLR0913 -- those of every method, and three of its own
        self,
        inputs: Mapping[str, torch.Tensor] | None = None,
        *,
        target: Targets = None,
        baselines: Baselines = None,
        n_steps: int = 32,
        method: Method = "gausslegendre",
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
        """Attribute the metric's difference from the baseline to each input.

        Parameters
        ----------
        inputs, target, groups, seed, denoise, checkpoint, executor, show_progress
            As for ``VanillaSceneGradient``.
        baselines
            The scene to compare with: ``"dark"`` (emitters off), ``"black"`` (reflectances 0), ``"grey"`` (each
            reflectance its mean), a number, a mapping from names, globs or kinds to values, or another scene. By
            default emitters and reflectances are 0 and everything else is unchanged, with an attribution of 0.
            Inputs that a mapping does not name take this default too; to leave them unchanged, start from their
            values: ``{**renderer.inputs, "floor.reflectance.value": 0.2}``. ``info["baselines"]`` has what each
            input was compared with.
        n_steps
            Number of quadrature points, each with its own seed. With fewer than 8 the estimated quadrature error
            is large.
        method
            Quadrature rule: ``"gausslegendre"`` or one of the Riemann sums, as in Captum. The weights always sum
            to 1 (Captum 0.9's trapezoid misses 2 % at 50 steps). Riemann sums without a point at an end evaluate
            an additional gradient there, only for the error estimate.
        return_convergence_delta
            Return ``(attribution, delta)``.
        spp
            Total samples per pixel, split over the steps and rounded up to at least one for each replicate: 16 for
            32 steps are 40. Non-linear metrics use at least 16 at each step (``info["budget"]``). Each end of the
            path takes another eighth, for a non-linear metric as many as the pictures of all steps together.
        picture_spp
            Samples per pixel of the metric images over all steps, and of that of each end, for non-linear
            metrics; by default the minimum.
        replicates
            Number of steps, spread over the path, that have two replicates to estimate the noise; 1 for no error
            bars.

        Returns
        -------
        SceneAttribution
            Signed contributions; a list of them for a list of targets.

        Raises
        ------
        SceneCaptumError
            If a baseline does not fit or is outside the physical bounds, or as for ``VanillaSceneGradient``.
        AttributionInterrupted
            On Ctrl-C after the first step, with the integral estimated from the steps so far.
        """
        rule = quadrature(method, n_steps)
        settings = Settings(
            seed, spp, replicates, show_progress, picture_spp, groups, checkpoint, denoise, executor
        )
        run = self._start(inputs, target, settings)
        start = resolve_baselines(self.renderer, run.values, baselines)
        compared = describe_baselines(self.renderer, run.values, baselines, start)
        points = (
            interpolated_point(start, run.values, node, weight)
            for node, weight in zip(rule.nodes, rule.weights, strict=True)
        )
        # The first nodes of a rule are spread over the whole path.
        sums, gradients, interrupted = run.sums(points, len(rule.nodes), pairs=replicates)
        images, reference = run.render_scenes([run.values, start], gradients)
        results = []
        for metric, total, evaluation in zip(run.metrics, sums, run.evaluate_inputs(images), strict=True):
            info = {"quadrature": method, "quantity": ResultKind.CONTRIBUTION.value, **compared}
            result = run.result(metric, total, evaluation, gradients, interrupted, **info)
            result = with_quadrature_error(result, rule, total, run.members)
            explained = metric_difference(evaluation.metric, images, [reference])
            results.append(with_convergence(result, explained, error_of_sum(rule, total)))
        return return_with_delta(run, results, interrupted=interrupted, with_delta=return_convergence_delta)
