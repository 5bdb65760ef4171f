"""Subdivision of the sky into patches, in Radiance's order."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch

from ..errors import SceneCaptumError, whole_number

# Patches in each row of Tregenza's sky, from the horizon up; the zenith is a patch of its own.
_TREGENZA_ROWS = (30, 30, 24, 24, 18, 12, 6)


@dataclass(frozen=True)
class PatchRows:
    """The rows of a sky from the horizon up, which determine the index of a direction in closed form.

    A direction ``(x, y, z)`` with z ≥ 0 is in row ``r`` if ``altitudes[r] ≤ asin(z) < altitudes[r + 1]``, and its
    patch is ``first[r] + floor(azimuth / (2π) · counts[r] + ½) mod counts[r]`` with ``azimuth = atan2(x, y)``.
    The last row is the zenith. With z < 0 it is patch 0, the ground.

    Attributes
    ----------
    altitudes
        Lower edge of each row in radians, and π / 2 as the upper edge of the zenith: one more than there are rows.
    counts
        Number of patches in each row.
    first
        Index of the first patch in each row, whose center is north.
    """

    altitudes: tuple[float, ...]
    counts: tuple[int, ...]
    first: tuple[int, ...]


@dataclass(frozen=True)
class SkyPatches:
    """The ground and the patches of the sky, in the order of Radiance's ``gendaymtx -m`` and ``reinhart.cal``.

    Patch 0 is the ground, the lower half space. The others follow in rows from the horizon up, each from north
    over east, and the zenith is the last. x is east, y north and z up.

    Example
    -------
    >>> SkyPatches.tregenza().count, SkyPatches.reinhart().count
    (146, 578)
    >>> SkyPatches.tregenza().index(torch.tensor([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])).tolist()
    [0, 1, 145]

    Parameters
    ----------
    subdivision
        Reinhart's factor, which divides each of Tregenza's patches in both directions: 1 for 145 patches above
        the horizon, 2 for 577, 4 for 2305.

    Raises
    ------
    SceneCaptumError
        If the subdivision is not a whole number from 1 to 16.

    References
    ----------
    Tregenza, "Subdivision of the sky hemisphere for luminance measurements", 1987; Bourgeois, Reinhart and Ward,
    "A standard daylight coefficient model for dynamic daylighting simulations", 2008.
    """

    subdivision: int = 1

    def __post_init__(self) -> None:
        whole_number("subdivision", self.subdivision, 1, 16)

    @classmethod
    def tregenza(cls) -> SkyPatches:
        """Return Tregenza's 145 patches and the ground."""
        return cls(1)

    @classmethod
    def reinhart(cls, subdivision: int = 2) -> SkyPatches:
        """Return Reinhart's subdivision of Tregenza's patches, and the ground."""
        return cls(subdivision)

    @classmethod
    def with_count(cls, count: int) -> SkyPatches:
        """Return the patches of which there are ``count`` with the ground; raise if no subdivision has so many."""
        for subdivision in range(1, 17):
            if (patches := cls(subdivision)).count == count:
                return patches
        raise SceneCaptumError(
            f"No subdivision of the sky has {count} patches: expected 146 (gendaymtx -m 1), 578 (-m 2), "
            "2306 (-m 4) or another 144 m² + 2."
        )

    @property
    def count(self) -> int:
        """Number of patches with the ground."""
        return 144 * self.subdivision**2 + 2

    @cached_property
    def rows(self) -> PatchRows:
        """Edges, sizes and first patches of the rows."""
        m = self.subdivision
        height = math.pi / 2 / (len(_TREGENZA_ROWS) * m + 0.5)  # the zenith has half of a row's height
        counts = (*(m * count for count in _TREGENZA_ROWS for _ in range(m)), 1)
        edges = (*(row * height for row in range(len(counts))), math.pi / 2)
        return PatchRows(edges, counts, tuple(1 + sum(counts[:row]) for row in range(len(counts))))

    @cached_property
    def directions(self) -> torch.Tensor:
        """Unit vectors to the centers of the patches, ``(P, 3)`` float64; straight down for the ground."""
        low = self._per_patch(self.rows.altitudes[:-1])
        altitude = (low + self._per_patch(self.rows.altitudes[1:])) / 2
        altitude[-1] = math.pi / 2
        columns = torch.cat([torch.arange(count) for count in self.rows.counts])
        azimuth = 2 * math.pi * columns / self._per_patch(self.rows.counts)
        sky = torch.stack(
            [altitude.cos() * azimuth.sin(), altitude.cos() * azimuth.cos(), altitude.sin()], dim=-1
        )
        return torch.cat([sky.new_tensor([[0.0, 0.0, -1.0]]), sky])

    @cached_property
    def solid_angles(self) -> torch.Tensor:
        """Solid angles of the patches in steradians, ``(P,)`` float64: 2π for the ground, 2π for the sky."""
        low, high = self._sines()
        ring = 2 * math.pi * (high - low)
        return torch.cat([ring.new_tensor([2 * math.pi]), ring / self._per_patch(self.rows.counts)])

    @cached_property
    def projected_solid_angles(self) -> torch.Tensor:
        """Integrals of the cosine to the zenith over the patches, ``(P,)`` float64: 0 for the ground, in total π.

        The illuminance of an unobstructed horizontal point is their sum weighted by luminance. They are smaller
        than the solid angle times the cosine of the center, which ``gendaymtx`` uses, by up to 0.55 % with
        ``subdivision=1`` and 0.14 % with 2.
        """
        low, high = self._sines()
        ring = math.pi * (high**2 - low**2)
        return torch.cat([ring.new_zeros(1), ring / self._per_patch(self.rows.counts)])

    def index(self, directions: torch.Tensor) -> torch.Tensor:
        """Return the patch of each direction.

        Parameters
        ----------
        directions
            ``(N, 3)``, of length 1.

        Returns
        -------
        Tensor
            ``(N,)`` int64.

        Raises
        ------
        SceneCaptumError
            If the shape is another one, or a direction is not of length 1.
        """
        x, y, z = _unit_vectors(directions).unbind(-1)
        rows = self.rows
        inner = x.new_tensor(rows.altitudes[1:-1])
        row = torch.bucketize(z.clamp(-1, 1).asin(), inner, right=True)
        count = torch.tensor(rows.counts, device=x.device)[row]
        column = (torch.atan2(x, y) / (2 * math.pi) * count + 0.5).floor().long() % count
        patch = torch.tensor(rows.first, device=x.device)[row] + column
        return torch.where(z < 0, 0, patch)

    def _sines(self) -> tuple[torch.Tensor, torch.Tensor]:
        low, high = self._per_patch(self.rows.altitudes[:-1]), self._per_patch(self.rows.altitudes[1:])
        return low.sin(), high.sin()

    def _per_patch(self, values: tuple[float, ...]) -> torch.Tensor:
        """Repeat a value of each row for its patches, ``(P − 1,)``, without the ground."""
        return torch.tensor(values, dtype=torch.float64).repeat_interleave(torch.tensor(self.rows.counts))


def _unit_vectors(directions: torch.Tensor) -> torch.Tensor:
    if directions.ndim != 2 or directions.shape[-1] != 3:
        raise SceneCaptumError(f"directions must have shape (N, 3), not {tuple(directions.shape)}.")
    vectors = directions.double()
    if not ((vectors.norm(dim=-1) - 1).abs() < 1e-3).all():
        raise SceneCaptumError("directions must be unit vectors: divide each by its length.")
    return vectors
