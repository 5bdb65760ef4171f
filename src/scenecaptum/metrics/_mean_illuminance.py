"""Mean illuminance of a sensor grid."""

from __future__ import annotations

import torch

from ..grid import GridPoints
from ._checks import cast_like
from ._grid_metric import GridMetric
from ._measure import Measure


class MeanIlluminance(GridMetric):
    """Mean illuminance of the points of a sensor grid in lux.

    Example
    -------
    >>> MeanIlluminance()(torch.ones(4, 8, 3))
    tensor(179.)

    Over a work plane, this is the mean illuminance of EN 12464-1; on ``SensorGrid(surface=…)`` that of a surface;
    on ``SensorGrid.cylindrical(…)`` the mean cylindrical illuminance; on a point with a horizontal normal the
    vertical illuminance there.

    Parameters
    ----------
    grid
        The points of the renderer, ``renderer.grid``: those that are not inside the room do not count. By default
        every pixel counts.
    efficacy
        Luminous efficacy in lm/W that converts irradiance to illuminance: 179 as in Radiance; 1 for the mean
        irradiance.

    Raises
    ------
    SceneCaptumError
        If no point is inside. From ``forward``, if the picture does not have the shape of the grid, or has values
        that are negative or not finite.

    References
    ----------
    EN 12464-1:2021, Light and lighting of work places.
    """

    def __init__(self, grid: GridPoints | None = None, efficacy: float = 179.0) -> None:
        super().__init__(grid, efficacy)

    @property
    def measure(self) -> Measure:
        """Name, unit and direction."""
        if self.efficacy == 1:
            return Measure("mean irradiance", unit="W/m²", better="higher")
        return Measure("mean illuminance", unit="lx", better="higher")

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return the mean over the points of a picture ``(H, W, 3)``, a 0-d tensor."""
        return cast_like(self.illuminance(image).mean(), image)
