"""Gradients averaged over noisy scenes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Literal

import numpy as np
import torch

from ..checkpoint import Folder
from ..errors import SceneCaptumError, check_seed, whole_number
from ._gradients import GradientSum, Point, PointGradient
from ._groups import Groups
from ._method import GradientMethod, Result, Settings, Targets
from ._passes import DEFAULT_PASSES, Spread
from ._ranges import Noise
from ._view import Denoise

NoiseType = Literal["smoothgrad", "smoothgrad_sq", "vargrad"]

_QUANTITIES = {
    "smoothgrad": "mean gradient",
    "smoothgrad_sq": "mean squared gradient",
    "vargrad": "variance of the gradient",
}


class SmoothGradScene(GradientMethod):
    """The mean, mean square or variance of the gradient over scenes whose parameters are noisy.

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
        As for ``VanillaSceneGradient``. The renderer must tell its ``bounds``, unless ``nt_samples`` is 1.

    References
    ----------
    Smilkov et al., "SmoothGrad: removing noise by adding noise", 2017.
    Adebayo et al., "Local Explanation Methods for Deep Neural Networks Lack Sensitivity to Parameter Values", 2018
    (VarGrad).
    """

    def attribute(  # noqa: PLR0913 -- those of every method, and four of its own
        self,
        inputs: Mapping[str, torch.Tensor] | None = None,
        target: Targets = None,
        *,
        nt_type: NoiseType = "smoothgrad",
        nt_samples: int = 25,
        stdevs: float | Mapping[str, float] = 0.1,
        noise_free_last: bool = True,
        groups: Groups = None,
        seed: int = 0,
        spp: int | None = None,
        picture_spp: int | None = None,
        replicates: int = DEFAULT_PASSES,
        denoise: Denoise = "auto",
        checkpoint: Folder = None,
        show_progress: bool = False,
    ) -> Result:
        """Attribute the metric to each input.

        Parameters
        ----------
        inputs
            Values by parameter name; the renderer's own by default.
        target
            Which element of the metric's output is meant, where it is not a scalar; a list of them gives a list
            of results from the same renders.
        nt_type
            ``"smoothgrad"``: the mean of the gradients; ``"smoothgrad_sq"``: of their squares; ``"vargrad"``:
            their variance. The noise of rendering is taken out of the last two: where ``stdevs`` is 0 the variance
            is 0 within its error, and may come out negative.
        nt_samples
            How many scenes.
        stdevs
            Standard deviation of the noise as a fraction of each parameter's physical range (where that is
            infinite, of its largest value): a number, or a mapping from names, globs or kinds. What the noise
            carries beyond a bound is reflected there.
        noise_free_last
            Whether the last scene has no noise, so that ``nt_samples=1`` gives the plain gradient.
        groups
            ``"kind"``, ``"material"``, ``"object"``, or a mapping from a group's name to the names or globs of its
            members: the result has the sum of each group, and every other parameter alone.
        seed
            Seed from which those of all passes and the noise are drawn.
        spp
            Total samples per pixel, split over the scenes. A metric that is not linear sees at least 16 at each;
            an eighth more shows it the inputs themselves (``info["budget"]``).
        picture_spp
            Samples per pixel, over all scenes, of the pictures that a metric sees which is not linear; by default
            no more than it must see.
        replicates
            Least number of independent passes in all.
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
            With standard errors from the spread of the scenes, which holds both the noise that was added and that
            of rendering; a list of them for a list of targets.

        Raises
        ------
        SceneCaptumError
            Where a setting does not fit, or as ``VanillaSceneGradient``.
        AttributionInterrupted
            On Ctrl-C after the first scene, with the mean over the scenes so far.
        """
        if nt_type not in _QUANTITIES:
            raise SceneCaptumError(f"nt_type must be one of {', '.join(_QUANTITIES)}, not {nt_type!r}.")
        count = whole_number("nt_samples", nt_samples)
        if nt_type != "smoothgrad" and whole_number("replicates", replicates) == 1:
            raise SceneCaptumError(
                f"nt_type={nt_type!r} takes replicates of 2 or more, to tell the noise of rendering."
            )
        run = self._start(
            inputs,
            target,
            Settings(seed, spp, replicates, show_progress, groups, checkpoint, denoise, picture_spp),
        )
        noisy = count - 1 if noise_free_last else count
        noise = Noise(self.renderer, run.values, stdevs if noisy else 0.0)
        return run.finish(
            (Point(values, 1 / count) for values in _scenes(noise, noisy, count, seed)),
            count,
            at_random=True,
            moment=_MOMENTS[nt_type],
            nt_type=nt_type,
            quantity=f"{_QUANTITIES[nt_type]} per unit",
        )


def _scenes(noise: Noise, noisy: int, count: int, seed: int) -> Iterator[dict[str, torch.Tensor]]:
    seeds = np.random.SeedSequence([check_seed("seed", seed), 2]).generate_state(count).tolist()
    for number in range(count):
        yield noise.draw(seeds[number]) if number < noisy else dict(noise.values)


def _mean_square(found: GradientSum) -> GradientSum:
    return _second_moment(found, {name: torch.zeros_like(mean) for name, mean in found.mean.items()}, 1.0)


def _variance(found: GradientSum) -> GradientSum:
    """Return the variance of the points: it divides by their number, as Captum's vargrad does."""
    count = len(found.kept or ())
    # Every point is part of the mean from which it deviates.
    return _second_moment(found, {n: mean / found.share for n, mean in found.mean.items()}, 1 - 1 / count)


def _second_moment(found: GradientSum, centre: dict[str, torch.Tensor], noise: float) -> GradientSum:
    """Return the mean over points of the squared distance from a centre, less what the noise of rendering adds."""
    squares = GradientSum(found.mean, at_random=True)
    for point in found.kept or ():
        spreads = {}
        for name, spread in point.spreads.items():
            square = (spread.mean - centre[name]).square_()
            spreads[name] = Spread()
            spreads[name].add(
                square.sub_(spread.error().square_(), alpha=noise) if point.passes > 1 else square
            )
        squares.add(PointGradient(spreads, point.adjoints, point.share))
    return squares


_MOMENTS: dict[str, Callable[[GradientSum], GradientSum] | None] = {
    "smoothgrad": None,
    "smoothgrad_sq": _mean_square,
    "vargrad": _variance,
}
