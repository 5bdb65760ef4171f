"""Gradients along the way from a baseline scene."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from ..checkpoint import Folder
from ._baselines import Baselines, resolve_baselines
from ._completeness import completed, difference, hand_over
from ._gradients import between
from ._groups import Groups
from ._method import GradientMethod, Result, Settings, Targets
from ._passes import DEFAULT_PASSES
from ._quadrature import Method, quadrature
from ._quadrature_error import error_of_sum, with_quadrature_error
from ._view import Denoise


class IntegratedGradientsScene(GradientMethod):
    """Gradients averaged on the way from a baseline, times the way: ``(θ − θ₀) · ∫ ∂M(θ₀ + α(θ − θ₀)) dα``.

    The attributions add up to ``M(θ) − M(θ₀)``: how much of the result is due to what, compared with a scene in
    which it is absent. What they miss of it is ``convergence_delta``; ``info["convergence"]`` says what to make of
    it. All errors hold that of the quadrature as well as the noise.

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
        target: Targets = None,
        *,
        baselines: Baselines = None,
        n_steps: int = 32,
        method: Method = "gausslegendre",
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
        """Attribute the metric's difference from the baseline to each input.

        Parameters
        ----------
        inputs
            Values by parameter name; the renderer's own by default.
        target
            Which element of the metric's output is meant, where it is not a scalar; a list of them gives a list
            of results from the same renders.
        baselines
            The scene to compare with: ``"dark"`` (lights off), ``"black"`` (reflectances 0), ``"grey"`` (each
            reflectance its mean), a number, a mapping from names, globs or kinds to values, or another scene. By
            default lights and reflectances are 0 and everything else stays: it is attributed 0.
        n_steps
            At how many scenes on the way gradients are taken. Each has a seed of its own. Fewer than 8 tell too
            little of their own error, which is then large.
        method
            How these are placed and weighted: ``"gausslegendre"`` or one of the Riemann sums, as in Captum. The
            weights always sum to 1 (Captum 0.9's trapezoid misses 2 % at 50 steps). A Riemann sum without a point
            at an end takes a gradient there too, which tells the error only.
        return_convergence_delta
            Return ``(attribution, delta)``.
        groups
            ``"kind"``, ``"material"``, ``"object"``, or a mapping from a group's name to the names or globs of its
            members: the result has the sum of each group, and every other parameter alone.
        seed
            Seed from which those of all passes are drawn.
        spp
            Total samples per pixel, split over the steps. A metric that is not linear sees at least 16 at each;
            an eighth more goes to either end (``info["budget"]``).
        picture_spp
            Samples per pixel, over all scenes, of the pictures that a metric sees which is not linear; by default
            no more than it must see.
        replicates
            At how many of the steps, spread over the way, the noise is told by two passes; 1 for no error bars.
        denoise
            Whether a metric that is not linear sees denoised pictures (Open Image Denoise). ``"auto"`` measures on
            two halves of the samples whether that brings them nearer to the truth; ``info["picture"]`` says what
            was done.
        checkpoint
            A folder that keeps every finished pass: a job that was killed goes on from there when it is started
            again with the same arguments. ``info["checkpoint"]`` counts the passes that came from it.
        show_progress
            Whether to show a progress bar.

        Returns
        -------
        SceneAttribution
            Signed contributions; a list of them for a list of targets.

        Raises
        ------
        SceneCaptumError
            Where a baseline does not fit or lies outside the physical bounds, or as ``VanillaSceneGradient``.
        AttributionInterrupted
            On Ctrl-C after the first step: the steps so far stand for all.
        """
        rule = quadrature(method, n_steps)
        run = self._start(
            inputs,
            target,
            Settings(seed, spp, replicates, show_progress, groups, checkpoint, denoise, picture_spp),
        )
        start = resolve_baselines(self.renderer, run.values, baselines)
        points = (between(start, run.values, *one) for one in zip(rule.places, rule.weights, strict=True))
        # In their order the first are spread over the whole way.
        budget = run.budget(len(rule.places), pairs=replicates)
        sums, gradients, interrupted = run.sums(points, budget)
        images, reference = run.own_images([run.values, start], sums)
        results = []
        for metric, one, own in zip(run.metrics, sums, run.own(images), strict=True):
            found = run.result(
                metric, one, own, budget, gradients, interrupted=interrupted, quadrature=method
            )
            found = with_quadrature_error(found, rule, one, run.members)
            explained = difference(own.metric, images, [reference])
            results.append(completed(found, explained, error_of_sum(rule, one)))
        return hand_over(run, results, interrupted=interrupted, with_delta=return_convergence_delta)
