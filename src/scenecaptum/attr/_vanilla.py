"""Plain gradients."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import torch

from ..checkpoint import Folder
from ..errors import SceneCaptumError
from ._gradients import Point
from ._groups import Groups
from ._method import GradientMethod, Result, Settings, Targets
from ._passes import DEFAULT_PASSES
from ._planner import SHARE, Goal, reach
from ._ranges import ranges
from ._view import Denoise

Scale = Literal["unit", "range", "value"]

_QUANTITIES = {"unit": "gradient per unit", "range": "gradient × range", "value": "gradient × value"}


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
        A torch function from the image to a scalar, or to a vector of which ``target`` names an element.

    References
    ----------
    Beresna and Fiume, "Scene Parameter Saliency via Differentiable Light Transport".
    Simonyan, Vedaldi and Zisserman, "Deep Inside Convolutional Networks", 2013.
    """

    def attribute(  # noqa: PLR0913 -- those of every method, and six of its own
        self,
        inputs: Mapping[str, torch.Tensor] | None = None,
        target: Targets = None,
        *,
        scale: Scale = "unit",
        groups: Groups = None,
        seed: int = 0,
        spp: int | None = None,
        picture_spp: int | None = None,
        replicates: int = DEFAULT_PASSES,
        denoise: Denoise = "auto",
        tolerance: float | None = None,
        share: float = SHARE,
        top: int | None = None,
        time_limit: float | None = None,
        against: Any = None,
        checkpoint: Folder = None,
        show_progress: bool = False,
    ) -> Result:
        """Attribute the metric to each input, from so many samples or from as many as a goal takes.

        Parameters
        ----------
        inputs
            Values by parameter name; the renderer's own by default.
        target
            Which element of the metric's output is meant, where it is not a scalar; a list of them gives a list
            of results from the same renders.
        scale
            ``"unit"``: per unit of each parameter. ``"range"``: times its physical range, so that an albedo and an
            index of refraction compare; where that is infinite its largest value stands in. ``"value"``: times
            its value, the change per relative change (elasticity).
        groups
            ``"kind"``, ``"material"``, ``"object"``, or a mapping from a group's name to the names or globs of its
            members: the result has the sum of each group, and every other parameter alone.
        seed
            Seed from which those of all passes are drawn.
        spp
            Total samples per pixel, split over the passes; the renderer's by default. The backward passes take
            as many again, with seeds of their own. Where there is a goal, those of the first round.
        picture_spp
            Samples per pixel of the picture that a metric sees which is not linear: twice ``spp`` by default,
            since they are cheaper than those of a backward pass. Where there is a goal, those of the first round;
            later ones have as many for each of their samples.
        replicates
            Least number of independent passes. Their spread gives the standard errors; with 1 there are none,
            and no correction of the bias that a noisy image puts into a non-linear metric.
        tolerance
            Goal: add replicates until the 95 % half-width of every parameter that has at least ``share`` of all
            saliency is within ``tolerance`` times its saliency; they hold for all of these at once. A parameter
            leaves the goal only when the upper limit of its saliency is below the share. After ten rounds or
            131 072 samples per pixel it ends, reached or not.
        share
            See ``tolerance``. Of the lower limit of all saliency.
        top
            Goal: add replicates until the order of the first ``top`` parameters is clear: each is above the next,
            and the last above all others, by more than the half-width of the difference. Two that differ by less
            than ``tolerance`` (0.05 by default) are tied.
        time_limit
            In seconds, without what compiling takes: the best that can be had in that time, or a goal if it is
            reached before.
        against
            Another renderer of the same parameters, such as ``renderer.replace(max_depth=-1)``: after the goal,
            what it would change is measured on shared seeds, instead of assumed to be nothing.
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
            Signed gradients with standard errors; a list of them for a list of targets. Where there was a goal,
            ``info["planner"]`` says whether it is ``reached`` and what ``stopped`` it: the half-widths of all
            parameters that may have the share, the order with its ties, each round, and what ``against`` would
            change.

        Raises
        ------
        SceneCaptumError
            Where the inputs are unphysical or the metric is not a scalar that depends on the image.
        AttributionInterrupted
            On Ctrl-C after at least one backward pass, with the result so far.
        """
        run = self._start(
            inputs,
            target,
            Settings(seed, spp, replicates, show_progress, groups, checkpoint, denoise, picture_spp),
        )
        factors = _factors(scale, self.renderer, run.values)
        point = Point(run.values, factors=factors)
        goal = Goal(tolerance, share, top, time_limit)
        return reach(run, point, goal, spp, against=against, scale=scale, quantity=_QUANTITIES[scale])


def _factors(scale: Scale, renderer: Any, values: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    if scale == "unit":
        return {}
    if scale == "value":
        return dict(values)
    if scale == "range":
        return ranges(renderer, values)
    raise SceneCaptumError(f'scale must be "unit", "range" or "value", not {scale!r}.')
