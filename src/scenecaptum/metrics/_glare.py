"""What the glare ratings share: their settings, the detection of sources, and ways to look at them."""

from __future__ import annotations

import copy
import math
from abc import abstractmethod
from numbers import Real
from typing import Literal

import torch

from ..camera import Camera
from ..errors import SceneCaptumError
from ._checks import like_input, photopic
from ._sources import GlareSource, Sources, View, describe, find_sources

Grouping = Literal["evalglare", "pixel"]
Background = Literal["auto", "hemisphere", "mean"]

# The colours of the check image: linear RGB of luminance 1, one source after another.
_COLOURS = (
    (0.0, 1.0, 0.0),
    (1.0, 0.0, 0.0),
    (0.0, 0.0, 1.0),
    (1.0, 1.0, 0.0),
    (1.0, 0.0, 1.0),
    (0.0, 1.0, 1.0),
)


class GlareRating(torch.nn.Module):
    """Base of the glare ratings: a picture's sources, and what they add up to.

    Luminance is weighed with Rec. 709's coefficients, the primaries of a render. evalglare takes a file to have
    Radiance's primaries: it agrees on coloured pictures once they are converted (grey ones need not be).

    Parameters
    ----------
    camera
        The picture's camera (``renderer.camera``).
    threshold
        Luminance in cd/m² above which a pixel is part of a source (evalglare's ``-b`` above 100).
    relaxation
        Width of the transition, relative to the threshold. A pixel's weight rises from 0 to 1 as a sigmoid (a
        cubic smoothstep) between ``1 − 3 relaxation`` and ``1 + 3 relaxation`` times the threshold, and a pixel in
        that band joins a source like any other; with 0 it belongs above the threshold and not below, as in
        evalglare.
    threshold_factor
        If given, the threshold is this times the mean luminance (evalglare's ``-b`` up to 100), instead of
        ``threshold``. It moves with the picture, and its derivative is part of the rating's: a lighter wall raises
        the threshold too. With ``relaxation=0`` no pixel has a derivative by the threshold, and that part is left
        out. ``held_at`` answers the other question.
    grouping
        ``"evalglare"``: pixels within 0.1 rad of each other form one source, and parts above 50 000 cd/m² one of
        their own; ``"pixel"``: each pixel is a source.
    background
        ``"hemisphere"``: ``(Ev − Edir) / π`` over the pixels present, as in evalglare; ``"mean"``: the mean over
        pixels that are not source, weighted by solid angle; ``"auto"``: the first for a camera that sees the
        hemisphere and the second for one that sees less, where dividing by π would make the rating depend on the
        field of view.
    efficacy
        Luminous efficacy in lm/W that turns radiance into luminance: 179 in Radiance.
    task
        ``(H, W)`` bool, the task zone: with it ``threshold_factor`` multiplies the mean luminance of this zone
        (evalglare's ``-t``).

    Attributes
    ----------
    half_class
        Half the width of the classes in which the rating is read: an error beyond it leaves the class open.

    Raises
    ------
    SceneCaptumError
        Where a setting is unknown or out of range, or the task zone does not fit the camera.
    """

    task: torch.Tensor | None
    half_class: float

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
        self.threshold = number("threshold", threshold)
        self.relaxation = number("relaxation", relaxation, zero=True)
        self.threshold_factor = (
            None if threshold_factor is None else number("threshold_factor", threshold_factor)
        )
        self.grouping = choice("grouping", grouping, ("evalglare", "pixel"))
        self.background = choice("background", background, ("auto", "hemisphere", "mean"))
        self.efficacy = number("efficacy", efficacy)
        self.view = View(camera)
        self.register_buffer("task", self._check_task(task), persistent=False)

    @property
    def camera(self) -> Camera:
        """The camera of the pictures that this rates."""
        return self.view.camera

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return the rating of a ``(H, W, 3)`` picture of linear radiance, a 0-d tensor.

        Raises
        ------
        SceneCaptumError
            If a value is negative, NaN or infinite, or the picture has another size than the camera.
        """
        values = photopic(image, self.efficacy, self.camera)
        return like_input(self._rate(values, self._find(values)), image)

    def sources(self, image: torch.Tensor) -> list[GlareSource]:
        """Return the sources of an ``(H, W, 3)`` picture, the brightest first; errors as those of ``forward``."""
        values = photopic(image.detach(), self.efficacy, self.camera)
        found = self._find(values)
        return [] if found is None else describe(found, self.view)

    def check_image(self, image: torch.Tensor) -> torch.Tensor:
        """Return the picture in grey with each source in a colour of its own, ``(H, W, 3)``, luminance unchanged.

        This is evalglare's check file (``-c``), in the unit of the picture.
        """
        values = photopic(image.detach(), 1.0, self.camera)
        painted = values[..., None].expand(-1, -1, 3).clone()
        for number, source in enumerate(self.sources(image)):
            rows, columns = source.pixels.unbind(-1)
            colour = torch.tensor(_COLOURS[number % len(_COLOURS)], dtype=values.dtype, device=values.device)
            painted[rows, columns] = values[rows, columns, None] * colour / _relative_luminance(colour)
        return like_input(painted, image)

    def held_at(self, image: torch.Tensor) -> GlareRating:
        """Return the same rating with the threshold that it has for a picture ``(H, W, 3)``, whatever it sees.

        Its derivative is that of the rating among the sources of this picture, as if its threshold did not move.
        """
        values = photopic(image.detach(), self.efficacy, self.camera)
        held = copy.deepcopy(self)
        held.threshold, held.threshold_factor, held.task = self._threshold(values).item(), None, None
        return held

    @abstractmethod
    def _rate(self, luminance: torch.Tensor, found: Sources | None) -> torch.Tensor:
        """Return the rating for a picture in cd/m², ``(H, W)``, and its sources."""

    def _find(self, luminance: torch.Tensor) -> Sources | None:
        return find_sources(
            luminance,
            self.view,
            threshold=self._threshold(luminance),
            relaxation=self.relaxation,
            grouping=self.grouping,
            background=self._background(),
        )

    def _threshold(self, luminance: torch.Tensor) -> torch.Tensor:
        if self.threshold_factor is None:
            return luminance.new_tensor(self.threshold)
        weight = self.view.solid_angle.to(luminance)
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
                "task needs threshold_factor: how many times the zone's mean luminance makes a source (say 5)."
            )
        expected = (self.camera.height, self.camera.width)
        if tuple(task.shape) != expected:
            raise SceneCaptumError(
                f"task has shape {tuple(task.shape)}; the camera's picture is {expected} (height, width)."
            )
        if not (task.flatten().to(self.view.solid_angle) * self.view.solid_angle).sum() > 0:
            raise SceneCaptumError("task selects no pixel that the camera sees.")
        return task

    def __repr__(self) -> str:
        """Show the settings on one line; what the camera says about each pixel is no setting."""
        return f"{type(self).__name__}({self.extra_repr()})"

    def extra_repr(self) -> str:
        """Show the camera and how sources are found."""
        limit = (
            f"threshold={self.threshold:g}"
            if self.threshold_factor is None
            else f"threshold_factor={self.threshold_factor:g}"
        )
        return (
            f"{self.camera!r}, {limit}, relaxation={self.relaxation:g}, grouping={self.grouping!r}, "
            f"background={self._background()!r}, efficacy={self.efficacy:g}"
        )


def _relative_luminance(colour: torch.Tensor) -> torch.Tensor:
    from ._luminance import luminance

    return luminance(colour[None, None])[0, 0]


def number(name: str, value: float, *, zero: bool = False) -> float:
    least = "at least 0" if zero else "above 0"
    good = isinstance(value, Real) and math.isfinite(value) and (value > 0 or (zero and value == 0))
    if not good:
        raise SceneCaptumError(f"{name} must be a finite number {least}, not {value!r}.")
    return float(value)


def choice(name: str, value: str, known: tuple[str, ...]) -> str:
    if value not in known:
        raise SceneCaptumError(f"{name} must be one of {', '.join(map(repr, known))}, not {value!r}.")
    return value
