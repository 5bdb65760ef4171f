"""SmoothGrad: gradients averaged over noisy scenes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor
from typing import Literal

import torch

from ..checkpoint import Folder
from ..errors import SceneCaptumError, whole_number
from ..estimation import (
    DEFAULT_REPLICATES,
    Denoise,
    GradientSum,
    Point,
    PointGradient,
    ReplicateStatistics,
    Stream,
    derived_seeds,
)
from ..protocols import ResultKind
from ._groups import Groups
from ._method import GradientMethod, Result, Settings, Targets
from ._ranges import Noise

NoiseType = Literal["smoothgrad", "smoothgrad_sq", "vargrad"]

_KINDS = {
    "smoothgrad": ResultKind.MEAN_GRADIENT,
    "smoothgrad_sq": ResultKind.MEAN_SQUARED_GRADIENT,
    "vargrad": ResultKind.GRADIENT_VARIANCE,
}


class SmoothGradScene(GradientMethod):
    """The mean, mean square or variance of the gradient over scenes with noisy parameters.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", inputs="reflectance", resolution=(16, 16), spp=16)
    >>> attribution = SmoothGradScene(renderer, metrics.MeanLuminance()).attribute(nt_samples=4, stdevs=0.05)
    >>> attribution.info["nt_type"]
    'smoothgrad'

    Parameters
    ----------
    renderer, metric
        As for ``VanillaSceneGradient``. The renderer must have ``bounds``, unless ``nt_samples`` is 1.

    References
    ----------
    Smilkov et al., "SmoothGrad: removing noise by adding noise", 2017.
    Adebayo et al., "Local Explanation Methods for Deep Neural Networks Lack Sensitivity to Parameter Values", 2018
    (VarGrad).
    """

    def attribute(  # noqa: PLR0913 -- those of every method, and four of its own
        self,
        inputs: Mapping[str, torch.Tensor] | None = None,
        *,
        target: Targets = None,
        nt_type: NoiseType = "smoothgrad",
        nt_samples: int = 25,
        stdevs: float | Mapping[str, float] = 0.1,
        noise_free_last: bool = True,
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
        """Attribute the metric to each input.

        Parameters
        ----------
        inputs, target, groups, denoise, checkpoint, executor, show_progress
            As for ``VanillaSceneGradient``.
        nt_type
            ``"smoothgrad"``: the mean of the gradients; ``"smoothgrad_sq"``: of their squares; ``"vargrad"``:
            their variance. The last two are corrected for the rendering noise, so that estimates of small values
            may be negative.
        nt_samples
            Number of scenes.
        stdevs
            Standard deviation of the noise as a fraction of each parameter's physical range (or, if that is
            infinite, of its largest value): a number, or a mapping from names, globs or kinds. Noisy values are
            reflected at the bounds.
        noise_free_last
            Whether the last scene is without noise, so that ``nt_samples=1`` gives the plain gradient.
        seed
            Random seed, for the noise and all replicates.
        spp
            Total samples per pixel, split over the scenes. Non-linear metrics use at least 16 for each scene.
            Another eighth is used to evaluate the metric at the inputs, for a non-linear metric as many as for the
            pictures of all scenes together (``info["budget"]``).
        picture_spp
            Samples per pixel of the metric images over all scenes, and of that of the inputs, for non-linear
            metrics; by default the minimum.
        replicates
            Minimum number of independent replicates in total.

        Returns
        -------
        SceneAttribution
            With standard errors from the variance between scenes, which includes the rendering noise; a list of
            them for a list of targets.

        Raises
        ------
        SceneCaptumError
            If a setting is invalid, or as for ``VanillaSceneGradient``.
        AttributionInterrupted
            On Ctrl-C after the first scene, with the mean over the scenes so far.
        """
        if nt_type not in _KINDS:
            raise SceneCaptumError(f"nt_type must be one of {', '.join(_KINDS)}, not {nt_type!r}.")
        count = whole_number("nt_samples", nt_samples)
        if nt_type != "smoothgrad" and whole_number("replicates", replicates) == 1:
            raise SceneCaptumError(
                f"nt_type={nt_type!r} requires replicates of 2 or more, to estimate the rendering noise."
            )
        settings = Settings(
            seed, spp, replicates, show_progress, picture_spp, groups, checkpoint, denoise, executor
        )
        run = self._start(inputs, target, settings)
        noisy_count = count - 1 if noise_free_last else count
        noise = Noise(self.renderer, run.values, stdevs if noisy_count else 0.0)
        return run.attribute(
            (Point(values, 1 / count) for values in _scenes(noise, noisy_count, count, seed)),
            count,
            random_points=True,
            moment=_MOMENTS[nt_type],
            nt_type=nt_type,
            quantity=_KINDS[nt_type],
        )


def _scenes(noise: Noise, noisy_count: int, count: int, seed: int) -> Iterator[dict[str, torch.Tensor]]:
    seeds = derived_seeds(seed, Stream.NOISY_SCENES, count)
    for number in range(count):
        yield noise.sample(seeds[number]) if number < noisy_count else dict(noise.values)


def _mean_square(total: GradientSum) -> GradientSum:
    return _second_moment(total, {name: torch.zeros_like(mean) for name, mean in total.mean.items()}, 1.0)


def _variance(total: GradientSum) -> GradientSum:
    """Return the variance over the points, divided by their number as in Captum's vargrad."""
    count = len(total.points or ())
    # The factor 1 − 1/n: every point is part of the mean.
    return _second_moment(total, {n: mean / total.weight for n, mean in total.mean.items()}, 1 - 1 / count)


def _second_moment(total: GradientSum, centre: dict[str, torch.Tensor], noise_factor: float) -> GradientSum:
    """Return the mean squared distance of the points from a centre, corrected for the rendering noise."""
    squares = GradientSum(total.mean, random_points=True)
    for point in total.points or ():
        statistics = {}
        for name, gradient in point.statistics.items():
            square = (gradient.mean - centre[name]).square_()
            if point.replicates > 1:
                square.addcmul_(gradient.error, gradient.error, value=-noise_factor)
            statistics[name] = ReplicateStatistics()
            statistics[name].add(square)
        squares.add(PointGradient(statistics, point.adjoints, point.weight))
    return squares


_MOMENTS: dict[str, Callable[[GradientSum], GradientSum] | None] = {
    "smoothgrad": None,
    "smoothgrad_sq": _mean_square,
    "vargrad": _variance,
}
