"""Base class of the glare ratings: settings, source detection and inspection of the sources."""

from __future__ import annotations

import copy
import dataclasses
import math
from abc import abstractmethod
from numbers import Real
from typing import Literal

import torch

from ..camera import Camera
from ..errors import SceneCaptumError
from ._checks import cast_like, photometric_luminance
from ._luminance import luminance as relative_luminance
from ._measure import Measure
from ._sources import GlareSource, PixelGeometry, Sources, find_sources, to_glare_sources

Grouping = Literal["evalglare", "pixel"]
Background = Literal["auto", "hemisphere", "mean"]

NO_SOURCE = "no glare source found"
_CLOSE = 0.05  # of the threshold: a picture may have a source on its other side

# Linear RGB colours of the sources in the check image, before normalization to luminance 1.
_COLORS = (
    (0.0, 1.0, 0.0),
    (1.0, 0.0, 0.0),
    (0.0, 0.0, 1.0),
    (1.0, 1.0, 0.0),
    (1.0, 0.0, 1.0),
    (0.0, 1.0, 1.0),
)


class GlareRating(torch.nn.Module):
    """Base class of the glare ratings: detects the sources of an image and combines them to a rating.

    Luminance uses the Rec. 709 coefficients, the primaries of a render. evalglare assumes Radiance's primaries:
    results agree for colour images after conversion (grey images need none).

    Parameters
    ----------
    camera
        The camera of the images (``renderer.camera``).
    threshold
        Luminance in cd/m² above which a pixel is part of a source (evalglare's ``-b`` above 100).
    relaxation
        Width of the transition, relative to the threshold. The weight of a pixel rises from 0 to 1 as a sigmoid
        (a cubic smoothstep) between ``1 − 3 relaxation`` and ``1 + 3 relaxation`` times the threshold. A pixel
        in that band is grouped into sources like any other. 0 is the hard threshold of evalglare.
    threshold_factor
        If given, the threshold is this factor times the mean luminance (evalglare's ``-b`` up to 100), instead of
        ``threshold``. It depends on the image, and its derivative is part of the rating's: a brighter wall also
        raises the threshold. With ``relaxation=0`` the derivative with respect to the threshold is undefined, and
        left out. ``held_at`` fixes the threshold.
    grouping
        ``"evalglare"``: pixels within 0.1 rad of each other form one source, and parts above 50 000 cd/m² separate
        sources; ``"pixel"``: each pixel is a source.
    background
        ``"hemisphere"``: ``(Ev − Edir) / π`` over the pixels in the image, as in evalglare; ``"mean"``: the
        mean over non-source pixels, weighted by solid angle; ``"auto"``: the first for a camera that sees the
        hemisphere, otherwise the second, because dividing by π would make the rating depend on the field of
        view.
    efficacy
        Luminous efficacy in lm/W that converts radiance to luminance: 179 as in Radiance.
    task
        ``(H, W)`` bool, the task zone: ``threshold_factor`` then multiplies the mean luminance of this zone
        (evalglare's ``-t``).

    Attributes
    ----------
    measure
        Its name, direction and classes.

    Raises
    ------
    SceneCaptumError
        If a setting is unknown or out of range, or the task zone does not fit the camera.
    """

    task: torch.Tensor | None
    measure: Measure
    rates_sources_alone = True  # so that the rating is 0 without one

    def __init__(
        self,
        camera: Camera,
        *,
        threshold: float = 2000.0,
        relaxation: float = 0.1,
        threshold_factor: float | None = None,
        grouping: Grouping = "evalglare",
        background: Background = "auto",
        efficacy: float = 179.0,
        task: torch.Tensor | None = None,
    ) -> None:
        super().__init__()
        self.threshold = check_positive("threshold", threshold)
        self.relaxation = check_positive("relaxation", relaxation, or_zero=True)
        self.threshold_factor = (
            None if threshold_factor is None else check_positive("threshold_factor", threshold_factor)
        )
        self.grouping = check_choice("grouping", grouping, ("evalglare", "pixel"))
        self.background = check_choice("background", background, ("auto", "hemisphere", "mean"))
        self.efficacy = check_positive("efficacy", efficacy)
        self.pixels = PixelGeometry(camera)
        self.register_buffer("task", self._check_task(task), persistent=False)
        if self.threshold_factor is not None:
            zone = "mean luminance" if task is None else "mean luminance of the task zone"
            definition = f"threshold {self.threshold_factor:g} times the {zone}"
            self.measure = dataclasses.replace(self.measure, definition=definition)

    @property
    def camera(self) -> Camera:
        """The camera of the images."""
        return self.pixels.camera

    def forward(self, image: torch.Tensor, *, compared: torch.Tensor | None = None) -> torch.Tensor:
        """Return the rating of an ``(H, W, 3)`` linear-radiance image, a 0-d tensor.

        ``compared`` is the image that is compared with the threshold, ``(H, W, 3)``; by default it is ``image``.

        Raises
        ------
        SceneCaptumError
            If a value is negative, NaN or infinite, or the image does not have the size of the camera.
        """
        return self._rating(image, self.relaxation, compared)

    def hard(self, image: torch.Tensor, *, compared: torch.Tensor | None = None) -> torch.Tensor:
        """Return the rating by the definition: with the hard threshold of evalglare, which ``relaxation`` smooths.

        Both are the same where no pixel is within the transition. ``image``, ``compared``, shapes and errors are
        those of ``forward``.
        """
        return self._rating(image, 0.0, compared)

    def _rating(self, image: torch.Tensor, relaxation: float, compared: torch.Tensor | None) -> torch.Tensor:
        values = photometric_luminance(image, self.efficacy, self.camera)
        seen = None if compared is None else photometric_luminance(compared, self.efficacy, self.camera)
        return cast_like(self._rate(values, self._find_sources(values, relaxation, seen)), image)

    def unrated(self, image: torch.Tensor, *, hard: bool = False) -> str:
        """Return why the rating of an ``image``, ``(H, W, 3)``, has no class, or nothing; ``hard``: by ``hard``.

        Without a glare source a rating of sources alone is 0, which is no finding that there is little glare.
        Where the rating by the definition is in another class, that one is named, or its range where it depends
        on pixels within 5 % of the threshold.
        """
        values = photometric_luminance(image.detach(), self.efficacy, self.camera)
        found = self._find_sources(values, relaxation=0.0 if hard else None)
        if self.rates_sources_alone and found is None:
            return NO_SOURCE
        if hard or not self.is_relaxed_at(image):
            return ""
        low, exact, high = self._around_threshold(image)
        if self._class_of(low) == self._class_of(high):
            return f"relaxed; by the definition {exact:.4g}: {self._class_of(exact)}"
        close = f"pixels are within {100 * _CLOSE:g} % of the threshold"
        return f"relaxed; by the definition {low:.4g} to {high:.4g}: {close}"

    def is_relaxed_at(self, image: torch.Tensor) -> bool:
        """Whether the rating of an ``(H, W, 3)`` image by the definition is, or may be, in another class."""
        if not self.relaxation:
            return False
        with torch.no_grad():
            relaxed = self(image).item()
        return {self._class_of(value) for value in self._around_threshold(image)} != {self._class_of(relaxed)}

    def _around_threshold(self, image: torch.Tensor) -> tuple[float, float, float]:
        """Return the rating by the definition, and its range if close pixels are on either side."""
        with torch.no_grad():
            exact = self.hard(image).item()
            others = [self.hard(image, compared=(1 + s) * image).item() for s in (-_CLOSE, _CLOSE)]
        return min(exact, *others), exact, max(exact, *others)

    def _class_of(self, value: float) -> str:
        return str(self.measure.verdict(value))

    def sources(self, image: torch.Tensor) -> list[GlareSource]:
        """Return the sources of an ``(H, W, 3)`` image, the brightest first; raises like ``forward``."""
        values = photometric_luminance(image.detach(), self.efficacy, self.camera)
        found = self._find_sources(values)
        return [] if found is None else to_glare_sources(found, self.pixels)

    def check_image(self, image: torch.Tensor) -> torch.Tensor:
        """Return the image in grey with the sources in different colours, ``(H, W, 3)``, with unchanged luminance.

        This is evalglare's check file (``-c``), in the unit of the image.
        """
        values = photometric_luminance(image.detach(), 1.0, self.camera)
        result = values[..., None].expand(-1, -1, 3).clone()
        for number, source in enumerate(self.sources(image)):
            rows, columns = source.pixels.unbind(-1)
            color = torch.tensor(_COLORS[number % len(_COLORS)], dtype=values.dtype, device=values.device)
            scale = relative_luminance(color[None, None])[0, 0]
            result[rows, columns] = values[rows, columns, None] * color / scale
        return cast_like(result, image)

    def held_at(self, image: torch.Tensor) -> GlareRating:
        """Return a copy of the rating with a fixed threshold: the one that it computes for an ``(H, W, 3)`` image.

        Its derivative is that of the rating with a constant threshold.
        """
        values = photometric_luminance(image.detach(), self.efficacy, self.camera)
        fixed = copy.deepcopy(self)
        fixed.threshold, fixed.threshold_factor, fixed.task = self._threshold(values).item(), None, None
        return fixed

    def relative_to_mean(self, factor: float) -> GlareRating:
        """Return a copy of the rating whose threshold is a factor times the mean luminance of the image."""
        relative = copy.deepcopy(self)
        relative.threshold_factor, relative.task = check_positive("factor", factor), None
        return relative

    @abstractmethod
    def _rate(self, luminance: torch.Tensor, sources: Sources | None) -> torch.Tensor:
        """Return the rating for the luminance in cd/m², ``(H, W)``, and its sources."""

    def _find_sources(
        self,
        luminance: torch.Tensor,
        relaxation: float | None = None,
        compared: torch.Tensor | None = None,
    ) -> Sources | None:
        return find_sources(
            luminance,
            self.pixels,
            compared=luminance if compared is None else compared,
            threshold=self._threshold(luminance),
            relaxation=self.relaxation if relaxation is None else relaxation,
            grouping=self.grouping,
            background=self._background(),
        )

    def _threshold(self, luminance: torch.Tensor) -> torch.Tensor:
        if self.threshold_factor is None:
            return luminance.new_tensor(self.threshold)
        weight = self.pixels.solid_angle.to(luminance)
        if self.task is not None:
            weight = weight * self.task.to(luminance).flatten()
        return self.threshold_factor * (weight * luminance.flatten()).sum() / weight.sum()

    def _background(self) -> str:
        if self.background == "auto":
            return "hemisphere" if self.camera.sees_hemisphere else "mean"
        return self.background

    def _check_task(self, task: torch.Tensor | None) -> torch.Tensor | None:
        if task is None:
            return None
        if self.threshold_factor is None:
            raise SceneCaptumError(
                "task needs threshold_factor: the threshold as a multiple of the zone's mean luminance, such as 5."
            )
        expected = (self.camera.height, self.camera.width)
        if tuple(task.shape) != expected:
            raise SceneCaptumError(
                f"task has shape {tuple(task.shape)}; the camera's image is {expected} (height, width)."
            )
        if not (task.flatten().to(self.pixels.solid_angle) * self.pixels.solid_angle).sum() > 0:
            raise SceneCaptumError("task selects no pixel that the camera sees.")
        return task

    def __repr__(self) -> str:
        """Show the settings on one line, without the submodule of pixel directions and solid angles."""
        return f"{type(self).__name__}({self.extra_repr()})"

    def extra_repr(self) -> str:
        """Show the camera and the settings of the source detection."""
        limit = (
            f"threshold={self.threshold:g}"
            if self.threshold_factor is None
            else f"threshold_factor={self.threshold_factor:g}"
        )
        return (
            f"{self.camera!r}, {limit}, relaxation={self.relaxation:g}, grouping={self.grouping!r}, "
            f"background={self._background()!r}, efficacy={self.efficacy:g}"
        )


def check_positive(name: str, value: float, *, or_zero: bool = False) -> float:
    limit = "at least 0" if or_zero else "above 0"
    valid = isinstance(value, Real) and math.isfinite(value) and (value > 0 or (or_zero and value == 0))
    if not valid:
        raise SceneCaptumError(f"{name} must be a finite number {limit}, not {value!r}.")
    return float(value)


def check_choice(name: str, value: str, choices: tuple[str, ...]) -> str:
    if value not in choices:
        raise SceneCaptumError(f"{name} must be one of {', '.join(map(repr, choices))}, not {value!r}.")
    return value
