"""A metric of every picture of a stack of cameras."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias, cast

import torch

from ..errors import SceneCaptumError
from ..training_mode import warn_of_training_mode
from ._measure import Measure

Metric: TypeAlias = Callable[[torch.Tensor], torch.Tensor]
Target: TypeAlias = "int | tuple[int, ...] | None"


class PerCamera(torch.nn.Module):
    """A metric of each picture of a stack of cameras, a vector that ``attribute(target=)`` indexes.

    Example
    -------
    >>> from scenecaptum import metrics
    >>> images = torch.stack([torch.ones(4, 8, 3), 2 * torch.ones(4, 8, 3)])
    >>> PerCamera(metrics.MeanLuminance())(images)
    tensor([179., 358.])

    ``attribute(target=[0, 1])`` gives one result for each camera, all from the same renders, and
    ``attr.mean_effects`` their mean and their spread. The first element of a ``target`` is the camera; with a
    metric that returns a vector, ``target=(camera, element)``.

    Parameters
    ----------
    metric
        A metric of ``(H, W, 3)`` images, or a list with one for each camera, such as glare ratings, which need
        their camera.

    Raises
    ------
    SceneCaptumError
        If it is no metric. From ``forward``, if the tensor is not a stack ``(cameras, H, W, 3)``, or there are not
        as many metrics as cameras.

    Notes
    -----
    Smoothing is that of the metric inside: ``PerCamera(Smoothed(metric))``.
    """

    def __init__(self, metric: Metric | Sequence[Metric]) -> None:
        super().__init__()
        self.metrics = tuple(metric) if isinstance(metric, Sequence) else (metric,)
        if not self.metrics or not all(map(callable, self.metrics)):
            raise SceneCaptumError(
                f"metric must be a metric, or a list with one for each camera, not {metric!r}."
            )
        for one in self.metrics:
            warn_of_training_mode(one)
        # Registered, so that their parameters and buffers are those of this module.
        self.registered = torch.nn.ModuleList(m for m in self.metrics if isinstance(m, torch.nn.Module))

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Return the metric of each picture of a stack ``(cameras, H, W, 3)``, ``(cameras, …)``."""
        if images.ndim != 4:
            raise SceneCaptumError(
                f"PerCamera takes a stack (cameras, H, W, 3), not {tuple(images.shape)}: render it with "
                "SceneRenderer(…, sensor=[0, 1]), or use the metric itself."
            )
        if len(self.metrics) not in (1, len(images)):
            raise SceneCaptumError(
                f"There are {len(self.metrics)} metrics for {len(images)} cameras: give one, or one for each."
            )
        return torch.stack([self._metric_of(camera)(image) for camera, image in enumerate(images)])

    def _metric_of(self, camera: int) -> Metric:
        return self.metrics[0] if len(self.metrics) == 1 else self.metrics[camera]

    @property
    def n_draws(self) -> int:
        """Number of draws of noise of the metric, 0 without smoothing."""
        return max(int(getattr(metric, "n_draws", 0)) for metric in self.metrics)

    def with_draws(self, draws: Mapping[int, int]) -> PerCamera:
        """Return the same metrics with other draws of noise: a number of them for each seed."""
        return PerCamera(
            [cast(Any, m).with_draws(draws) if getattr(m, "n_draws", 0) else m for m in self.metrics]
        )

    @property
    def caution(self) -> str | None:
        """Why a metric is not valid for these images, if one says so."""
        cautions = (getattr(metric, "caution", None) for metric in self.metrics)
        return next(filter(None, cautions), None)

    def caution_of(self, images: torch.Tensor, target: Target = None) -> str:
        """Return why the value of one camera of a stack ``images`` means nothing, if its metric says so.

        ``target`` is as for ``verdict``.
        """
        camera, element = _split(target)
        of_image = None if camera is None else getattr(self._metric_of(camera), "caution_of", None)
        return "" if of_image is None else str(of_image(images[camera], element))

    def measure_of(self, target: Target) -> Measure | None:
        """Return what an element of the output measures, with its camera, if the metric says it."""
        camera, element = _split(target)
        if camera is None:
            return None
        metric = self._metric_of(camera)
        of_element = None if element is None else getattr(metric, "measure_of", None)
        measure: Measure | None
        measure = getattr(metric, "measure", None) if of_element is None else of_element(element)
        return measure and dataclasses.replace(measure, name=f"{measure.name} of camera {camera}")

    def verdict(self, images: torch.Tensor, target: Target = None) -> str:
        """Return what the value of one camera of a stack ``images`` means, if the metric says it.

        ``target`` is the camera, or the camera and the element of the metric's vector.
        """
        camera, element = _split(target)
        if camera is None:
            return ""
        metric = self._metric_of(camera)
        own, measure = getattr(metric, "verdict", None), getattr(metric, "measure", None)
        if own is not None:
            return str(own(images[camera], element))
        if measure is None:
            return ""
        unrated = getattr(metric, "unrated", None)
        if unrated is not None and (reason := unrated(images[camera])):
            return str(reason)
        with torch.no_grad():
            return str(measure.verdict(metric(images[camera]).item()))


def _split(target: Target) -> tuple[int | None, tuple[int, ...] | None]:
    """Return the camera, and the element of its metric."""
    if isinstance(target, tuple):
        return target[0], target[1:] or None
    return target, None
