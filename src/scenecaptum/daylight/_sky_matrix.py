"""Radiance of the sky patches in each hour."""

from __future__ import annotations

import dataclasses
import math
import os
from dataclasses import dataclass

import numpy as np
import torch

from ..errors import SceneCaptumError
from ..images import LUMINANCE_WEIGHTS
from ._checks import positive, share
from ._gendaymtx import Sun, run_gendaymtx
from ._patches import SkyPatches
from ._radiance_matrix import read_matrix
from ._weather import Weather, check_mask

EFFICACY = 179.0  # lm/W, as in Radiance


@dataclass(frozen=True, eq=False)
class SkyMatrix:
    """Radiance of each sky patch in each hour.

    179 lm/W times the Rec. 709 luminance of a value is the mean luminance of the patch in cd/m².

    Example
    -------
    >>> sky = SkyMatrix.cie_overcast(SkyPatches.tregenza())
    >>> sky.radiance.shape, sky.horizontal_illuminance().round()
    (torch.Size([146, 1, 3]), tensor([10000.]))

    Attributes
    ----------
    radiance
        ``(P, hours, 3)`` float32 in W·m⁻²·sr⁻¹, linear Rec. 709. Row 0 is the ground.
    patches
        The patches of its rows.
    weather
        The weather of its hours, which tells their dates; None if it is unknown.

    Raises
    ------
    SceneCaptumError
        If the shape does not fit the patches or the weather, or a value is negative or not finite.
    """

    radiance: torch.Tensor
    patches: SkyPatches
    weather: Weather | None = None

    def __post_init__(self) -> None:
        shape = tuple(self.radiance.shape)
        if len(shape) != 3 or shape[0] != self.patches.count or shape[1] == 0 or shape[2] != 3:
            raise SceneCaptumError(
                f"The radiance of the sky must have shape ({self.patches.count}, hours, 3), not {shape}."
            )
        if self.weather is not None and len(self.weather) != shape[1]:
            raise SceneCaptumError(
                f"The sky has {shape[1]} hours and the weather {len(self.weather)}; select the same hours of both."
            )
        if not (torch.isfinite(self.radiance).all() and (self.radiance >= 0).all()):
            raise SceneCaptumError("The radiance of the sky has values that are negative or not finite.")

    @classmethod
    def from_weather(
        cls,
        weather: Weather | str | os.PathLike[str],
        patches: SkyPatches | None = None,
        *,
        sun: Sun = "patches",
        north: float = 0.0,
    ) -> SkyMatrix:
        """Return the sky of each hour by the all-weather model of Perez, computed by Radiance's ``gendaymtx``.

        Parameters
        ----------
        weather
            The weather, or the path of an EPW file.
        patches
            By default Tregenza's.
        sun
            ``"patches"``: spread over the four nearest patches; ``"none"``: only the sky, and the ground in the
            light of both; ``"only"``: only the sun, and a black ground. Four Tregenza patches are 2400 times as
            large as the sun and blur its shadows: for direct sunlight, use a fine subdivision.
        north
            Where the scene's y axis points, in degrees clockwise from north: 90 for east.

        Raises
        ------
        SceneCaptumError
            If the file is not valid, ``north`` is not finite, or pyradiance, which bundles ``gendaymtx``, is not
            installed.

        Notes
        -----
        The sky is grey. The ground has a reflectance of 0.2. Luminous efficacies are those of Perez (1990) with
        ``gendaymtx``'s dew point of 11 °C. ``gendaymtx`` scales each sky by the solid angles and centers of its
        patches, so that its horizontal illuminance is up to 0.55 % lower than that of the weather (0.14 % with
        ``SkyPatches(2)``); see `SkyPatches.projected_solid_angles`.

        References
        ----------
        Perez, Seals and Michalsky, "All-weather model for sky luminance distribution", 1993.
        """
        year = weather if isinstance(weather, Weather) else Weather.from_epw(weather)
        patches = patches or SkyPatches.tregenza()
        if not math.isfinite(north):
            raise SceneCaptumError(f"north must be an angle in degrees, not {north!r}.")
        return cls(run_gendaymtx(year, patches, sun, north), patches, year)

    @classmethod
    def from_radiance(
        cls,
        source: torch.Tensor | np.ndarray | str | os.PathLike[str],
        weather: Weather | None = None,
    ) -> SkyMatrix:
        """Return a sky from the file of a matrix that ``gendaymtx`` wrote, or from a tensor or array.

        Parameters
        ----------
        source
            Path of a file in ASCII or binary with a header, or ``(P, hours, 3)`` values.
        weather
            The weather of the hours, if their dates are needed.

        Raises
        ------
        SceneCaptumError
            If the file or the shape is not valid.
        """
        if isinstance(source, np.ndarray):
            source = torch.from_numpy(source)
        radiance = source if isinstance(source, torch.Tensor) else read_matrix(source)
        if radiance.ndim == 0:
            raise SceneCaptumError("The radiance of the sky must have shape (P, hours, 3), not ().")
        return cls(radiance.float(), SkyPatches.with_count(len(radiance)), weather)

    @classmethod
    def cie_overcast(
        cls,
        patches: SkyPatches | None = None,
        horizontal_illuminance: float = 10_000.0,
        *,
        ground_reflectance: float = 0.2,
    ) -> SkyMatrix:
        """Return the CIE standard overcast sky, one hour: three times as bright at the zenith as at the horizon.

        The luminance ``(1 + 2 sin γ) / 3`` at the altitude γ is averaged over each patch, and scaled.

        Parameters
        ----------
        patches
            By default Tregenza's.
        horizontal_illuminance
            Outdoors, by the whole sky, in lx.
        ground_reflectance
            Of the ground, which is diffuse.

        Raises
        ------
        SceneCaptumError
            If the illuminance is not above 0, or the reflectance not from 0 to 1.

        References
        ----------
        CIE S 011 / ISO 15469:2004, sky type 16 (the traditional overcast sky of Moon and Spencer).
        """
        patches = patches or SkyPatches.tregenza()
        sine = patches.projected_solid_angles / patches.solid_angles  # mean over each patch
        return cls._standard((1 + 2 * sine) / 3, patches, horizontal_illuminance, ground_reflectance)

    @classmethod
    def uniform(
        cls,
        patches: SkyPatches | None = None,
        horizontal_illuminance: float = 10_000.0,
        *,
        ground_reflectance: float = 0.2,
    ) -> SkyMatrix:
        """Return a sky of equal luminance everywhere, one hour.

        Parameters
        ----------
        patches, horizontal_illuminance, ground_reflectance
            As for `cie_overcast`.

        Raises
        ------
        SceneCaptumError
            If the illuminance is not above 0, or the reflectance not from 0 to 1.
        """
        patches = patches or SkyPatches.tregenza()
        ones = torch.ones(patches.count, dtype=torch.float64)
        return cls._standard(ones, patches, horizontal_illuminance, ground_reflectance)

    @classmethod
    def _standard(
        cls, relative: torch.Tensor, patches: SkyPatches, illuminance: float, reflectance: float
    ) -> SkyMatrix:
        illuminance = positive("horizontal_illuminance", illuminance)
        reflectance = share("ground_reflectance", reflectance)
        luminance = relative * illuminance / (relative * patches.projected_solid_angles).sum()
        luminance[0] = reflectance * illuminance / math.pi
        radiance = luminance / EFFICACY / sum(LUMINANCE_WEIGHTS)
        return cls(radiance[:, None, None].float().expand(-1, 1, 3).contiguous(), patches)

    @property
    def hours(self) -> int:
        """Number of hours."""
        return self.radiance.shape[1]

    @property
    def ground_reflectance(self) -> float:
        """The reflectance of the ground, which is diffuse: a mean over the hours."""
        luminance = EFFICACY * self.radiance[0] @ self.radiance.new_tensor(LUMINANCE_WEIGHTS)
        return math.pi * (luminance.sum() / self.horizontal_illuminance().sum()).item()

    def select(self, mask: torch.Tensor) -> SkyMatrix:
        """Return the hours of a ``(hours,)`` bool mask, such as ``weather.occupied()``."""
        check_mask(mask, self.hours)
        weather = None if self.weather is None else self.weather.select(mask)
        return dataclasses.replace(self, radiance=self.radiance[:, mask], weather=weather)

    def horizontal_illuminance(self) -> torch.Tensor:
        """Return the illuminance of an unobstructed horizontal point in lx, ``(hours,)`` float32."""
        weights = self.radiance.new_tensor(LUMINANCE_WEIGHTS)
        projected = self.patches.projected_solid_angles.to(self.radiance)
        return EFFICACY * torch.einsum("phc,p,c->h", self.radiance, projected, weights)

    def __repr__(self) -> str:
        """Show numbers of patches and hours, and the place."""
        place = "" if self.weather is None else f", {self.weather.place!r}"
        return f"SkyMatrix({self.patches.count} patches, {self.hours} hours{place})"
