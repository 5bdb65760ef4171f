"""The expectation of a metric over noise of the picture: a metric whose gradient is smooth."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping

import torch

from ..errors import SceneCaptumError, check_callable
from ..training_mode import warn_of_training_mode
from ._measure import Measure
from ._noise import DEFAULT_DRAWS, NoiseKind, PictureNoise, smoothed_measure, without_smoothing

# Measured by benchmarks/network.py.
DEFAULT_SIGMA = 0.3


class Smoothed(torch.nn.Module):
    """Expectation of a metric over noise of the picture, ``E[M(I ⊙ ε)]``, as the mean over ``n`` draws.

    The gradient of a network at a picture is rough: it jumps wherever a unit of the network switches on or off, so
    that a little noise of the picture changes it more than the scene does. The expectation over noise has a smooth
    gradient: the mean gradient of the metric over a neighbourhood of the picture. The attribution is that of the
    expectation, whose value differs from the metric's; ``verdict`` says the value without smoothing.

    Example
    -------
    >>> from scenecaptum import metrics
    >>> logit = metrics.ClassLogit(metrics.ShapeClassifier.pretrained(), target="cube")
    >>> Smoothed(logit, sigma=0.3, n=16)(torch.rand(48, 48, 3)).shape
    torch.Size([])

    Parameters
    ----------
    metric
        Any metric of an ``(H, W, 3)`` image. If it has a method ``of_batch``, from ``(N, H, W, 3)`` images to
        ``(N, …)`` values, noisy pictures are evaluated in batches.
    sigma
        Strength of the noise, see ``noise``.
    n
        Number of draws, even: each is used with both signs. Attribution methods split them among their replicates,
        so that standard errors include the error of a finite number of draws. With ``time_limit=`` they choose the
        number themselves.
    noise
        ``"lognormal"``: each pixel is multiplied by ``exp(σ z − σ² / 2)`` with a standard normal ``z``, which
        keeps hues, black pixels and the mean. ``"gaussian"``: ``σ z`` is added to each channel of the sRGB
        picture, where 1 is white; negative values are reflected.
    seed
        Of the draws, which are the same for all images of one size.

    Raises
    ------
    SceneCaptumError
        If a setting is invalid or, from ``forward``, the tensor is not an image.

    Notes
    -----
    Noise has the size of a pixel: render at the size that the network sees. Memory does not depend on ``n``.

    References
    ----------
    Smilkov et al., "SmoothGrad: removing noise by adding noise", 2017, for the mean gradient over noise.
    """

    def __init__(
        self,
        metric: Callable[[torch.Tensor], torch.Tensor],
        sigma: float = DEFAULT_SIGMA,
        n: int = DEFAULT_DRAWS,
        *,
        noise: NoiseKind = "lognormal",
        seed: int = 0,
    ) -> None:
        super().__init__()
        check_callable("metric", metric)
        if getattr(metric, "n_draws", 0):
            raise SceneCaptumError(
                f"{type(metric).__name__} is smoothed already: give the metric without smoothing."
            )
        warn_of_training_mode(metric)
        self.metric = metric
        self.noise = PictureNoise.create(sigma, n, noise, seed)

    @property
    def __name__(self) -> str:
        """Name for results, where the metric has no measure: that of the function, or of the metric's class."""
        return f"smoothed {getattr(self.metric, '__name__', type(self.metric).__name__)}"

    @property
    def tolerated_noise(self) -> float | None:
        """Relative noise of the pixels above which it biases the value; None if it is not known."""
        return self.noise.tolerated

    @property
    def n_draws(self) -> int:
        """Number of draws of noise."""
        return self.noise.n

    def with_draws(self, draws: Mapping[int, int]) -> Smoothed:
        """Return the same expectation from other draws: a number of them for each seed, rounded up to even."""
        other = copy.copy(self)
        other.noise = self.noise.with_draws(draws)
        return other

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return the mean over all draws for an ``(H, W, 3)`` image, with the shape of the metric's output."""
        return self.noise.mean(self._of_batch, image)

    def _of_batch(self, images: torch.Tensor) -> torch.Tensor:
        of_batch = getattr(self.metric, "of_batch", None)
        values: torch.Tensor
        values = (
            torch.stack([self.metric(image) for image in images]) if of_batch is None else of_batch(images)
        )
        return values

    def target_index(self, name: str) -> int:
        """Return the element of the output for a class, by its name; raise if the metric knows no such class."""
        find = getattr(self.metric, "target_index", None)
        if find is None:
            raise SceneCaptumError(
                f"The elements of {type(self.metric).__name__} have no names, such as {name!r}: give an index."
            )
        index: int = find(name)
        return index

    @property
    def classes(self) -> tuple[str, ...]:
        """The names of the metric's classes; empty if it has none."""
        found: tuple[str, ...] = getattr(self.metric, "classes", ())
        return found

    @property
    def n_classes(self) -> int:
        """The number of the metric's classes; 0 if it has none, or it is not known yet."""
        return int(getattr(self.metric, "n_classes", 0))

    def measure_of(self, target: int | tuple[int, ...] | None) -> Measure | None:
        """Return what an element of the output measures."""
        of_element = getattr(self.metric, "measure_of", None)
        return self.measure if of_element is None else smoothed_measure(of_element(target))

    @property
    def measure(self) -> Measure | None:
        """What is measured, if the metric says it."""
        found: Measure | None = getattr(self.metric, "measure", None)
        return None if found is None else smoothed_measure(found)

    def verdict(self, image: torch.Tensor, target: int | tuple[int, ...] | None = None) -> str:
        """Return the value of an ``(H, W, 3)`` ``image`` without smoothing, and what it means.

        ``target`` is the index of the element of a vector.
        """
        with torch.no_grad():
            output = self.metric(image)
        value = (output if target is None else output[target]).item()
        measure, own = getattr(self.metric, "measure", None), getattr(self.metric, "verdict", None)
        meaning = own(image, target) if own is not None else "" if measure is None else measure.verdict(value)
        return without_smoothing(value, meaning)

    def extra_repr(self) -> str:
        """Show the settings."""
        return f"sigma={self.noise.sigma:g}, n={self.noise.n}, noise={self.noise.kind!r}"
