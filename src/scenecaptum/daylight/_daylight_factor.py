"""Daylight factor."""

from __future__ import annotations

from typing import Literal

import torch

from ..errors import SceneCaptumError
from ..metrics import Measure
from ._checks import choice
from ._metric import PointMetric
from ._sky_matrix import SkyMatrix

Statistic = Literal["mean", "median"]


class DaylightFactor(PointMetric):
    """Daylight factor in %: indoor over unobstructed outdoor horizontal illuminance under an overcast sky.

    Example
    -------
    >>> sky = SkyMatrix.cie_overcast()
    >>> outdoors = sky.patches.projected_solid_angles.float()[None, :, None].expand(1, -1, 3)
    >>> DaylightFactor(sky)(outdoors).round(decimals=2)
    tensor(100.)

    Parameters
    ----------
    sky
        `SkyMatrix.cie_overcast`, or another sky of one hour. Its illuminance cancels.
    statistic
        ``"mean"`` over the points, or their ``"median"`` (of an even number, the mean of the middle two), whose
        derivative is that of the middle points only.

    Raises
    ------
    SceneCaptumError
        If the sky has several hours or is black, or the statistic is unknown.

    References
    ----------
    CIE 16-1970, "Daylight"; EN 17037 and ISO 15469 for the sky.
    """

    levels = (0.5, 1.0, 2.0, 3.0, 5.0, 10.0, 20.0)

    def __init__(self, sky: SkyMatrix, statistic: Statistic = "mean") -> None:
        if sky.hours != 1:
            raise SceneCaptumError(
                f"A daylight factor is for one overcast sky, and this one has {sky.hours} hours: use "
                "SkyMatrix.cie_overcast()."
            )
        super().__init__(sky, during="all", relaxation=0.0)
        self.statistic = choice("statistic", statistic, ("mean", "median"))
        self.outdoors = sky.horizontal_illuminance().item()
        if not self.outdoors > 0:
            raise SceneCaptumError("A daylight factor needs a sky that is not black.")

    @property
    def measure(self) -> Measure:
        """Name and unit."""
        return Measure(
            f"{self.statistic} daylight factor",
            "DF",
            unit="%",
            better="higher",
            definition=f"illuminance under an overcast sky in % of that outdoors, {self.statistic} of the points",
        )

    def _map_name(self) -> str:
        return "daylight factor"

    def _of_points(self, values: torch.Tensor, relaxation: float) -> torch.Tensor:
        return 100 * values[:, 0].double() / self.outdoors

    def _value(self, values: torch.Tensor, relaxation: float) -> torch.Tensor:
        factors = self._of_points(values, relaxation)
        return factors.mean() if self.statistic == "mean" else factors.quantile(0.5)

    def extra_repr(self) -> str:
        """Show the sky and the statistic."""
        return f"{self.sky!r}, statistic={self.statistic!r}"
