"""Plain gradients."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Executor
from typing import Any

import torch

from ..checkpoint import Folder
from ..estimation import DEFAULT_REPLICATES, DEFAULT_SHARE, Denoise, Goal, Point
from ..protocols import ResultKind
from ._groups import Groups
from ._method import GradientMethod, Result, Settings, Targets
from ._ranges import extents


class VanillaSceneGradient(GradientMethod):
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
        A torch function from the image to a scalar, or to a vector indexed by ``target``.

    References
    ----------
    Beresna and Fiume, "Scene Parameter Saliency via Differentiable Light Transport".
    Simonyan, Vedaldi and Zisserman, "Deep Inside Convolutional Networks", 2013.
    """

    def attribute(  # noqa: PLR0913 -- those of every method, and six of its own
        self,
        inputs: Mapping[str, torch.Tensor] | None = None,
        *,
        target: Targets = None,
        groups: Groups = None,
        seed: int = 0,
        spp: int | None = None,
        picture_spp: int | None = None,
        replicates: int = DEFAULT_REPLICATES,
        denoise: Denoise = "auto",
        tolerance: float | None = None,
        share: float = DEFAULT_SHARE,
        top: int | None = None,
        time_limit: float | None = None,
        against: Any = None,
        checkpoint: Folder = None,
        executor: Executor | None = None,
        show_progress: bool = False,
    ) -> Result:
        """Attribute the metric to each input, with a fixed number of samples or as many as a goal requires.

        Parameters
        ----------
        inputs
            Values by parameter name; by default those of all inputs of the renderer. The result has only the names
            that are given, and the others keep their values in the scene. To set one value and attribute to all
            inputs, pass ``{**renderer.inputs, name: value}``.
        target
            Element of the metric's output to attribute, if it is not a scalar: its index, or for the metric of a
            classifier the name of a class. A list gives a list of results from the same renders.
        groups
            ``"kind"``, ``"material"``, ``"object"``, or a mapping from a group's name to the names or globs of its
            members: the result has the sum of each group. Parameters in no group stay separate.
        seed
            Random seed, from which the seeds of all replicates are derived.
        spp
            Total samples per pixel, split over the replicates; the renderer's by default. The backward passes use
            as many again, with their own seeds. With a goal, the samples of the first round, which a pilot chooses
            if they are not given here.
        picture_spp
            Samples per pixel of the metric image, for non-linear metrics. By default twice ``spp``, four times
            if the image is denoised, and 16 times for a smoothed metric, because they are cheaper than those of a
            backward pass. With a goal, those of the first round; later rounds use the same ratio. With a time
            limit, a small pilot chooses the ratio for a smoothed metric, and the number of draws.
        replicates
            Minimum number of independent replicates, whose variance gives the standard errors. With 1 there are no
            errors, and no correction of the bias that image noise causes in a non-linear metric.
        tolerance
            Goal: sample until the 95 % half-width of every parameter with at least ``share`` of the total saliency
            is below ``tolerance`` times its saliency, simultaneously for all these parameters. A parameter is
            excluded only if the upper limit of its saliency is below the share. Stops after ten rounds or 131 072
            samples per pixel even if the goal is not reached.
        share
            See ``tolerance``; relative to the lower limit of the total saliency.
        top
            Goal: sample until the order of the first ``top`` parameters is resolved: each is above the next, and
            the last above all others, by more than the half-width of the difference. Parameters that differ by
            less than ``tolerance`` (default 0.05) are tied.
        time_limit
            Stop after this many seconds, excluding kernel compilation, and return the best estimate; earlier if
            another goal is reached.
        against
            Another renderer of the same parameters, such as ``renderer.replace(max_depth=-1)``: after the goal,
            the change of the gradients with this renderer is measured with common random numbers.
        denoise
            Whether non-linear metrics are evaluated on denoised images (Open Image Denoise). ``"auto"`` estimates
            from two halves of the samples whether this reduces the error; ``info["picture"]`` has the outcome.
        checkpoint
            A folder that caches finished renders and backward passes: an interrupted job resumes if it is run
            again with the same arguments. ``info["checkpoint"]`` counts the reused results.
        executor
            A ``concurrent.futures.Executor`` whose workers are processes, such as ``executors.process_pool()`` or
            ``Client.get_executor()`` of Dask: they compute the replicates. On several machines, give a
            ``checkpoint`` folder that all of them share.
        show_progress
            Whether to show a progress bar.

        Returns
        -------
        SceneAttribution
            Signed gradients with standard errors; a list of them for a list of targets. With a goal,
            ``info["planner"]`` has whether it was ``reached`` and what ``stopped`` it, the half-widths of all
            parameters that may have the share, the order with its ties, each round, and the changes with
            ``against``.

        Raises
        ------
        SceneCaptumError
            If the inputs are unphysical or the metric is not a scalar that depends on the image.
        AttributionInterrupted
            On Ctrl-C after at least one backward pass, with the result so far.
        """
        settings = Settings(
            seed, spp, replicates, show_progress, picture_spp, groups, checkpoint, denoise, executor
        )
        run = self._start(inputs, target, settings)
        goal = Goal(tolerance, share, top, time_limit)
        factors = extents(self.renderer, run.values) or None
        point, quantity = Point(run.values), ResultKind.GRADIENT
        return run.attribute_point(point, goal, factors, spp, against, quantity=quantity)
