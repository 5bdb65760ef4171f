"""Input × gradient."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Executor

import torch

from ..checkpoint import Folder
from ..estimation import DEFAULT_REPLICATES, DEFAULT_SHARE, Denoise, Goal, Point, channel_totals
from ..protocols import ResultKind
from ._groups import Groups
from ._method import GradientMethod, Result, Settings, Targets


class InputXGradientScene(GradientMethod):
    """The gradient times the input, ``θ · ∂M(R(θ))/∂θ``: the contribution of a parameter under a linear model.

    For an emitter's radiance and a metric that is linear in the image, it is exactly the contribution of the
    emitter.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", inputs="emitters", resolution=(32, 32), spp=256)
    >>> attribution = InputXGradientScene(renderer, metrics.MeanLuminance()).attribute()
    >>> share = sum(attribution["light.emitter.radiance.value"]) / attribution.metric_value
    >>> bool(abs(share - 1) < 0.1)
    True

    Parameters
    ----------
    renderer, metric
        As for ``VanillaSceneGradient``.

    References
    ----------
    Shrikumar et al., "Not Just a Black Box: Learning Important Features Through Propagating Activation
    Differences", 2016.
    """

    def attribute(  # noqa: PLR0913 -- as VanillaSceneGradient's
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
        checkpoint: Folder = None,
        executor: Executor | None = None,
        show_progress: bool = False,
    ) -> Result:
        """Attribute the metric to each input.

        Parameters
        ----------
        inputs, target, groups, seed, spp, picture_spp, replicates, denoise, tolerance, share, top
            As for ``VanillaSceneGradient``.
        time_limit, checkpoint, executor, show_progress
            As for ``VanillaSceneGradient``.

        Returns
        -------
        SceneAttribution
            Signed products in the metric's unit, with standard errors; a list of them for a list of targets.

        Raises
        ------
        SceneCaptumError, AttributionInterrupted
            As ``VanillaSceneGradient``.
        """
        settings = Settings(
            seed, spp, replicates, show_progress, picture_spp, groups, checkpoint, denoise, executor
        )
        run = self._start(inputs, target, settings)
        goal = Goal(tolerance, share, top, time_limit)
        point = Point(run.values, factors=run.values)
        factors = {name: torch.ones_like(channel_totals(value)) for name, value in run.values.items()}
        return run.attribute_point(point, goal, factors, spp, quantity=ResultKind.INPUT_X_GRADIENT)
