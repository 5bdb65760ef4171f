"""Designs of a scene: rendered with common random numbers, and measured."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch

from ..denoising import denoise as denoised
from ..errors import SceneCaptumError, whole_number
from ..estimation import (
    Denoise,
    Metric,
    Stream,
    Target,
    TargetedMetric,
    TransformSelector,
    at_values,
    check_renderer_and_metric,
    derived_seeds,
    input_values,
    mean_and_error,
    pseudo_values,
    with_image_transform,
)
from ..rendering import SceneRenderer
from ._sliders import Design, make_slider

REPLICATES = 4  # few, since each takes an evaluation of the metrics
ROUGH_PIXELS = 160 * 90
ROUGH_SPP = 4


@dataclass(frozen=True)
class Measured:
    """A ``design``, ``images``, ``(replicates, H, W, 3)``, and what the metrics are of them.

    ``of_mean``, ``(metrics,)``, are those of the mean image; ``values``, ``(replicates, metrics)``, pseudo-values.
    """

    design: Design
    images: torch.Tensor
    of_mean: torch.Tensor
    values: torch.Tensor

    @property
    def image(self) -> torch.Tensor:
        """The mean of the pictures."""
        return self.images.mean(0)

    def value(self, metric: int) -> tuple[float, float]:
        """Return a metric with its standard error."""
        return _with_error(self.of_mean[metric], self.values[:, metric])

    def change(self, metric: int, start: Measured) -> tuple[float, float]:
        """Return the change of a ``metric`` from another design, ``start``, with its standard error.

        Most of the noise cancels in the difference.
        """
        change = self.of_mean[metric] - start.of_mean[metric]
        return _with_error(change, self.values[:, metric] - start.values[:, metric])


class Designs:
    """Renders the designs of a scene and measures metrics on them.

    A design has the places of sliders by the names of their parameters; others stay where they are in the scene.

    Parameters
    ----------
    renderer
        A ``SceneRenderer`` with one camera.
    metrics
        Metrics of its images.
    inputs
        The values of the scene; by default the renderer's own.
    target
        Element of the metrics' output, if they return vectors.
    seed
        Random seed: all designs are rendered with the same random numbers.
    spp
        Samples per pixel of a design.
    denoise
        Whether metrics are evaluated on denoised images, as for ``VanillaSceneGradient``; decided once.
    pause
        Called before every render and every evaluation of the metrics; what it raises ends the work.

    Attributes
    ----------
    sliders : dict of str to Slider
        Of all parameters that can be moved.

    Raises
    ------
    SceneCaptumError
        If the renderer does not have one picture, or an option is invalid.
    """

    def __init__(
        self,
        renderer: SceneRenderer,
        metrics: Sequence[Metric],
        *,
        inputs: Mapping[str, torch.Tensor] | None = None,
        target: Target = None,
        seed: int = 0,
        spp: int = 32,
        denoise: Denoise = "auto",
        pause: Callable[[], None] = lambda: None,
    ) -> None:
        for metric in metrics:
            check_renderer_and_metric(renderer, metric)
        if not isinstance(renderer, SceneRenderer) or renderer.surfaces is None:
            raise SceneCaptumError(
                "This needs a SceneRenderer with one camera, not a list of sensors or a grid."
            )
        self.renderer, self.pause, self.seed = renderer, pause, seed
        self.inputs = input_values(renderer, inputs)
        self.metrics = [TargetedMetric(metric, target) for metric in metrics]
        self.sliders = {
            name: make_slider(parameter, renderer.own_value(name), self.inputs.get(name))
            for name, parameter in renderer.parameters.items()
            if not parameter.problem and parameter.is_used
        }
        self.seeds = derived_seeds(seed, Stream.SCENES, REPLICATES)
        self._spp = math.ceil(whole_number("spp", spp) / REPLICATES)
        smoothed = all(metric.is_smoothed for metric in self.metrics)
        self._selector: TransformSelector | None = TransformSelector(
            denoise, renderer, self.inputs, smoothed=smoothed
        )
        self._rough = _smaller(renderer)

    def values(self, design: Design) -> dict[str, torch.Tensor]:
        """Return the inputs, and the parameters of a design, with its values."""
        return {**self.inputs, **{name: self.sliders[name].tensor(place) for name, place in design.items()}}

    def render(self, design: Design, seed: int) -> torch.Tensor:
        """Return the replicate of the picture of a ``design`` that has this ``seed``."""
        self.pause()
        with torch.no_grad():
            image: torch.Tensor = self.renderer(self.values(design), seed=seed, spp=self._spp)
        return image.detach()

    def render_roughly(self, design: Design) -> torch.Tensor:
        """Return a denoised picture of few pixels with few samples."""
        with torch.no_grad():
            image = self._rough(self.values(design), seed=self.seeds[0], spp=ROUGH_SPP).detach()
        return denoised(image, self._rough.guides_of(self.values(design)).keeping_lamps())

    def denoised(self, image: torch.Tensor, design: Design) -> torch.Tensor:
        """Return a picture without noise: an ``image`` of a ``design``."""
        return denoised(image, self.renderer.guides_of(self.values(design)).keeping_lamps())

    def metrics_of(self, design: Design) -> list[TargetedMetric]:
        """Return the metrics for pictures of a design, whose poses a denoiser has to know."""
        values = self.values(design)
        return [at_values(metric, self.renderer, values) for metric in self.metrics]

    def measure(self, design: Design) -> Measured:
        """Render a design and measure the metrics; the first one decides whether they are of denoised images."""
        images = torch.stack([self.render(design, seed) for seed in self.seeds])
        if self._selector is not None:
            self.metrics = with_image_transform(self.metrics, list(images), self._selector)
            self._selector = None
        metrics = self.metrics_of(design)

        def values(images: torch.Tensor) -> torch.Tensor:
            self.pause()
            mean = images.mean(0)
            found = [metric.check_value(metric.value(mean)) for metric in metrics]
            return torch.tensor(found, dtype=torch.float64)

        of_mean, count = values(images), len(images)
        pseudo = pseudo_values(lambda kept: values(images[kept]) if len(kept) < count else of_mean, count)
        return Measured(design, images, of_mean, pseudo)


def _with_error(value: torch.Tensor, pseudo: torch.Tensor) -> tuple[float, float]:
    """Return a value with its standard error, of which the size of its bias is a part.

    A metric that responds to single bright pixels may have a larger bias than spread.
    """
    unbiased, error = mean_and_error(pseudo)
    return value.item(), math.hypot(error, unbiased - value.item())


def _smaller(renderer: SceneRenderer) -> SceneRenderer:
    """Return a renderer of fewer pixels, or the same if it has few."""
    width, height = renderer.resolution
    shrink = math.sqrt(width * height / ROUGH_PIXELS)
    if shrink <= 1:
        return renderer
    return renderer.replace(resolution=(max(8, round(width / shrink)), max(8, round(height / shrink))))
