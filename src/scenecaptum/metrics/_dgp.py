"""Daylight glare probability (Wienold and Christoffersen)."""

from __future__ import annotations

import dataclasses
import warnings
from typing import Literal

import torch

from ..camera import Camera
from ._glare import Background, GlareRating, Grouping, check_choice
from ._measure import DGP, Band
from ._sources import Sources

Constants = Literal["evalglare", "published"]

_COEFFICIENTS = {"evalglare": (5.87e-5, 0.092, 0.159), "published": (5.87e-5, 0.0918, 0.16)}
PARTIAL_VIEW = "DGP is defined for a view of 180°, and this camera sees less: its values are too low"
FISHEYE = 'Use SceneRenderer(…, sensor="fisheye").'
# A value that is too low shows that there is at least so much glare, and never that there is little.
_AT_LEAST = ("", "at least perceptible glare", "at least disturbing glare")
_MIN_ILLUMINANCE = 1e-6  # lux; keeps the quotient finite for a source at 90° from the line of sight


class DaylightGlareProbability(GlareRating):
    """Daylight glare probability, ``DGP = c₁ Ev + c₂ log10(1 + Σ L² ω / (Ev^1.87 P²)) + c₃``, at most 1.

    Ev is the vertical illuminance at the eye in lux; L, ω and P are a source's luminance, solid angle and
    position index. The formula is valid for 180° images, ``Ev`` above 380 lux and values from 0.2 to 0.8.
    Without a source it is ``c₁ Ev + c₃``. Of a camera that sees less than 180° the values are too low: they have a
    class only above a limit, such as "at least disturbing glare". It does not depend on the background:
    ``background`` is accepted for consistency and has no effect.

    Parameters
    ----------
    camera, threshold, relaxation, threshold_factor, grouping, background, efficacy, task
        As for every `GlareRating`.
    low_light
        Multiply by ``e / (1 + e)`` with ``e = exp(0.024 Ev − 4)`` where Ev is below 1000 lux (Wienold 2009), as
        ``evalglare -C l+`` does.
    constants
        ``"evalglare"``: c₁ = 5.87e-5, c₂ = 0.092, c₃ = 0.159, as in evalglare 3.06; ``"published"``: 0.0918 and
        0.16, as in the paper.

    Notes
    -----
    Wienold and Christoffersen, Energy and Buildings 38 (2006), 743–757.
    """

    measure = DGP
    rates_sources_alone = False  # the illuminance at the eye counts as well

    def __init__(  # noqa: PLR0913 -- options shared by all ratings, plus two of its own
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
        low_light: bool = False,
        constants: Constants = "evalglare",
    ) -> None:
        super().__init__(
            camera,
            threshold=threshold,
            relaxation=relaxation,
            threshold_factor=threshold_factor,
            grouping=grouping,
            background=background,
            efficacy=efficacy,
            task=task,
        )
        if not camera.sees_hemisphere:
            warnings.warn(f"{PARTIAL_VIEW}. {FISHEYE}", stacklevel=2)
            bands = [Band(band.upper, least) for band, least in zip(DGP.bands, _AT_LEAST, strict=True)]
            self.measure = dataclasses.replace(self.measure, bands=tuple(bands))
        self.low_light = low_light
        self.constants = check_choice("constants", constants, tuple(_COEFFICIENTS))

    @property
    def caution(self) -> str | None:
        """Why the values are not valid, or None."""
        return None if self.camera.sees_hemisphere else PARTIAL_VIEW

    def _rate(self, luminance: torch.Tensor, sources: Sources | None) -> torch.Tensor:
        c1, c2, c3 = _COEFFICIENTS[self.constants]
        illuminance = (self.pixels.projected.to(luminance) * luminance.flatten()).sum()
        dgp = c1 * illuminance + c3
        if sources is not None:
            total = (sources.luminance**2 * sources.solid_angle / sources.position_index**2).sum()
            dgp = dgp + c2 * torch.log10(1 + total / illuminance.clamp(min=_MIN_ILLUMINANCE) ** 1.87)
        dgp = dgp.clamp(max=1.0)
        if self.low_light and illuminance < 1000:
            dgp = dgp * torch.sigmoid(0.024 * illuminance - 4)
        return dgp
