"""Gradients along the way from a baseline scene."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
import torch

from ..checkpoint import Folder
from ..errors import SceneCaptumError, near_misses, whole_number
from ._baselines import Baselines, resolve_baselines
from ._completeness import completed, difference, hand_over
from ._gradients import between
from ._groups import Groups
from ._method import GradientMethod, Result, Settings, Targets
from ._passes import DEFAULT_PASSES
from ._view import Denoise

Quadrature = Literal["gausslegendre", "riemann_left", "riemann_right", "riemann_middle", "riemann_trapezoid"]


class IntegratedGradientsScene(GradientMethod):
    """Gradients averaged on the way from a baseline, times the way: ``(θ − θ₀) · ∫ ∂M(θ₀ + α(θ − θ₀)) dα``.

    The attributions add up to ``M(θ) − M(θ₀)``: how much of the result is due to what, compared with a scene in
    which it is absent. What they miss of it is ``convergence_delta``.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", inputs="emitters", resolution=(32, 32), spp=64)
    >>> attribution = IntegratedGradientsScene(renderer, metrics.MeanLuminance()).attribute(n_steps=4)
    >>> attribution.info["convergence"]
    'consistent with 0'

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
        method: Quadrature = "gausslegendre",
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
            At how many scenes on the way gradients are taken. Each has a seed of its own.
        method
            How these are placed and weighted: ``"gausslegendre"`` or one of the Riemann sums, as in Captum. The
            weights always sum to 1 (Captum 0.9's trapezoid misses 2 % at 50 steps).
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
        places, weights = quadrature(method, n_steps)
        run = self._start(
            inputs,
            target,
            Settings(seed, spp, replicates, show_progress, groups, checkpoint, denoise, picture_spp),
        )
        start = resolve_baselines(self.renderer, run.values, baselines)
        points = (between(start, run.values, *one) for one in zip(places, weights, strict=True))
        # In their order the first are spread over the whole way.
        budget = run.budget(len(places), pairs=replicates)
        sums, gradients, interrupted = run.sums(points, budget)
        images, reference = run.own_images([run.values, start], sums)
        results = [
            completed(
                run.result(metric, one, own, budget, gradients, interrupted=interrupted, quadrature=method),
                difference(own.metric, images, [reference]),
            )
            for metric, one, own in zip(run.metrics, sums, run.own(images), strict=True)
        ]
        return hand_over(run, results, interrupted=interrupted, with_delta=return_convergence_delta)


def quadrature(method: str, n_steps: int) -> tuple[list[float], list[float]]:
    """Return where on [0, 1] to evaluate, and with which weights.

    They are in an order in which any number of them is spread over the whole interval, so that what Ctrl-C leaves
    is an integral as well.
    """
    n = whole_number("n_steps", n_steps)
    k = np.arange(n)
    if method == "gausslegendre":
        nodes, weights = np.polynomial.legendre.leggauss(n)
        places, weights = (nodes + 1) / 2, weights / 2
    elif method == "riemann_trapezoid":
        whole_number("n_steps of a trapezoid", n_steps, 2)
        places, weights = k / (n - 1), np.where((k == 0) | (k == n - 1), 0.5, 1.0) / (n - 1)
    elif method in RIEMANN:
        places, weights = (k + RIEMANN[method]) / n, np.full(n, 1 / n)
    else:
        known = ("gausslegendre", "riemann_trapezoid", *RIEMANN)
        raise SceneCaptumError(
            f"method={method!r} is no quadrature.{near_misses(method, known)} Known are {', '.join(known)}."
        )
    spread = sorted(range(n), key=lambda number: _reversed_bits(number, n))
    return places[spread].tolist(), weights[spread].tolist()


RIEMANN = {"riemann_left": 0.0, "riemann_middle": 0.5, "riemann_right": 1.0}


def _reversed_bits(number: int, count: int) -> int:
    return int(f"{number:0{max(1, (count - 1).bit_length())}b}"[::-1], 2)
