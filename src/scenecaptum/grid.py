"""Sensor grids: points of a room at which irradiance is measured."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path

import torch

from .errors import SceneCaptumError, whole_number

LEED_HEIGHT = 0.76  # of the work plane in LEED, in metres
MAX_SPACING = 10.0  # of EN 12464-1, in metres
FROM_BELOW = ("x", "z")  # axes to the right and up of a plan that would show the room from below, as y is up

Point = tuple[float, float]


@dataclass(frozen=True, eq=False)
class SensorGrid:
    """Points at which irradiance is measured: over a floor, on a surface, or anywhere.

    Example
    -------
    >>> from scenecaptum import SceneRenderer
    >>> renderer = SceneRenderer("office", sensor=SensorGrid(height=0.8, spacing=0.5), spp=16)
    >>> renderer().shape, renderer.grid.inside.sum()
    (torch.Size([9, 7, 3]), tensor(63))

    Each pixel of the picture is a point, and its value the irradiance there, in W/m² where radiances are in
    W·m⁻²·sr⁻¹. Over a floor, columns run along the first horizontal axis and rows against the second one: x to the
    right and y up, where z is up. Points that lie outside the outline, or inside an object, are 0.

    Parameters
    ----------
    height
        Of the points above the floor, in scene units: 0.8 for desks; ``LEED_HEIGHT`` is that of LEED.
    spacing
        Largest distance between neighbouring points; by default that of EN 12464-1, see ``en_12464_spacing``.
    margin
        Distance of the points from the outline of the floor, 0.5 m in EN 12464-1. At most a quarter of the room.
    floor
        The name of the shape that is the floor, or of the material of its pieces; by default the lowest of the
        large level shapes.
    rectangle
        ``((x0, y0), (x1, y1))``, corners in the plane of the floor, in place of its outline.
    surface
        The name of a shape on which the points lie, in place of a floor, with its normals: ``count`` of them,
        spread evenly over its area.
    count
        The number of points on ``surface``.
    facing
        Only points of ``surface`` whose normals are within 45° of this direction: ``(0, 0, 1)`` for the top of a
        table.
    points, normals
        ``(N, 3)`` or ``(H, W, 3)``: the points themselves, in place of a floor, and their normals, which need
        not have length 1.

    Raises
    ------
    SceneCaptumError
        If a number is out of range, or two of ``floor``, ``surface`` and ``points`` are given.

    References
    ----------
    EN 12464-1:2021, Light and lighting of work places, section 4.4 (illuminance grid).
    """

    height: float = 0.8
    spacing: float | None = None
    margin: float = 0.5
    floor: str | None = None
    rectangle: tuple[Point, Point] | None = None
    surface: str | None = None
    count: int = 64
    facing: tuple[float, float, float] | None = None
    points: torch.Tensor | None = field(default=None, repr=False)
    normals: torch.Tensor | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        given = [name for name in ("floor", "surface", "points") if getattr(self, name) is not None]
        if len(given) > 1:
            raise SceneCaptumError(
                f"SensorGrid got {given[0]}= and {given[1]}=: name a floor, a surface, or points."
            )
        for name in ("height", "margin"):
            if not 0 <= getattr(self, name) < math.inf:
                raise SceneCaptumError(
                    f"{name} of a sensor grid must be at least 0, not {getattr(self, name)!r}."
                )
        if self.rectangle is not None:
            _check_rectangle(self.rectangle)
        if self.spacing is not None and not 0 < self.spacing < math.inf:
            raise SceneCaptumError(f"spacing of a sensor grid must be above 0, not {self.spacing!r}.")
        if self.count < 1:
            raise SceneCaptumError(f"count of a sensor grid must be at least 1, not {self.count!r}.")
        if (self.points is None) != (self.normals is None):
            raise SceneCaptumError("points and normals of a SensorGrid belong together: give both or none.")
        if self.points is not None and self.normals is not None:
            _check_points(self.points, self.normals)

    @classmethod
    def from_file(cls, path: str | PathLike[str]) -> SensorGrid:
        """Return the points of a text file with lines ``x y z nx ny nz``, as Radiance's tools read them.

        Raises
        ------
        SceneCaptumError
            If the file cannot be read, or a line does not have six numbers.
        """
        try:
            lines = Path(path).read_text().splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise SceneCaptumError(f"The points in {path} cannot be read: {error}.") from None
        rows = []
        for number, line in enumerate(lines, 1):
            if not line.strip() or line.lstrip().startswith("#"):
                continue
            try:
                rows.append([float(word) for word in line.split()])
            except ValueError:
                rows.append([])
            if len(rows[-1]) != 6:
                raise SceneCaptumError(
                    f"Line {number} of {path} must be six numbers, x y z nx ny nz, not {line.strip()[:60]!r}."
                )
        if not rows:
            raise SceneCaptumError(f"{path} has no points: each line is x y z nx ny nz.")
        table = torch.tensor(rows, dtype=torch.float64)
        return cls(points=table[:, :3], normals=table[:, 3:])

    @classmethod
    def cylindrical(
        cls,
        points: torch.Tensor,
        directions: int = 8,
        *,
        up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    ) -> SensorGrid:
        """Return a grid of the vertical illuminances around points, whose mean is the cylindrical illuminance.

        Each row of the picture is a point, and each column a horizontal direction. If all light came from one
        direction, the mean over 8 would be up to 5.2 % too low or 2.6 % too high; with more it falls as 1/n², and
        an odd number is as good as twice that number. For light from many directions the errors cancel.

        Example
        -------
        >>> faces = torch.tensor([[0.0, 1.5, 1.2]])  # 1.2 m above the floor for people who sit, 1.6 m who stand
        >>> SensorGrid.cylindrical(faces).points.shape
        torch.Size([1, 8, 3])

        Parameters
        ----------
        points
            ``(N, 3)``.
        directions
            The number of directions, evenly spaced, at least 3.
        up
            The axis of the cylinder.

        Raises
        ------
        SceneCaptumError
            If an argument is out of range or has the wrong shape.

        References
        ----------
        EN 12464-1:2021, section 4.6.2: mean cylindrical illuminance, the mean of the vertical illuminance over all
        directions.
        """
        count = whole_number("directions", directions, 3)
        axis = torch.tensor(up, dtype=torch.float64)
        if points.ndim != 2 or points.shape[-1] != 3:
            raise SceneCaptumError(f"SensorGrid.cylindrical takes points (N, 3), not {tuple(points.shape)}.")
        if axis.shape != (3,) or not axis.isfinite().all() or not axis.norm() > 0:
            raise SceneCaptumError(f"up of a cylindrical grid must be a direction, not {up!r}.")
        axis = axis / axis.norm()
        first = torch.eye(3, dtype=torch.float64)[axis.abs().argmin()]
        first = torch.nn.functional.normalize(first - (first @ axis) * axis, dim=0)
        second = torch.linalg.cross(axis, first)
        angle = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
        normals = angle.cos()[:, None] * first + angle.sin()[:, None] * second
        shape = (len(points), count, 3)
        return cls(points=points[:, None].expand(shape), normals=normals.expand(shape))


def _check_rectangle(rectangle: object) -> None:
    try:
        corners = torch.tensor(rectangle)
    except (TypeError, ValueError, RuntimeError):
        corners = torch.empty(0)
    if corners.shape != (2, 2) or not bool(corners.isfinite().all()):
        raise SceneCaptumError(
            f"rectangle of a sensor grid must be finite corners, ((x0, y0), (x1, y1)), not {rectangle!r}."
        )


def _check_points(points: torch.Tensor, normals: torch.Tensor) -> None:
    if (
        points.shape != normals.shape
        or points.ndim not in (2, 3)
        or points.shape[-1] != 3
        or not points.numel()
    ):
        raise SceneCaptumError(
            f"points and normals of a SensorGrid must both be (N, 3) or (H, W, 3), not {tuple(points.shape)} and "
            f"{tuple(normals.shape)}."
        )
    if not (points.isfinite().all() and normals.isfinite().all()):
        raise SceneCaptumError("points and normals of a SensorGrid must be finite.")
    if not (normals.norm(dim=-1) > 0).all():
        raise SceneCaptumError("A normal of a SensorGrid is (0, 0, 0): give each point a direction to face.")


def en_12464_spacing(longer: float, shorter: float) -> float:
    """Return the largest distance between points of a grid by EN 12464-1: ``0.2 · 5^log10(d)``, 10 m at most.

    ``d`` is the longer side of the area, or the shorter one if the longer is twice as long or more.

    Example
    -------
    >>> round(en_12464_spacing(5.0, 4.0), 2)
    0.62

    Parameters
    ----------
    longer, shorter
        The sides of the area in metres.
    """
    side = shorter if longer >= 2 * shorter else longer
    return min(0.2 * 5 ** math.log10(side), MAX_SPACING)


@dataclass(frozen=True, eq=False)
class GridPoints:
    """The points of a sensor grid in a scene: what each pixel of its picture measures.

    Attributes
    ----------
    positions, normals
        ``(H, W, 3)`` float64.
    inside
        ``(H, W)`` bool: whether a pixel is a point. The others are 0 in the picture.
    plan
        ``(H, W, 2)`` float64: the coordinates of the points in the plan of the room, across and up.
    floor, sides, above, material
        The shape or the material of the floor that the points are above, its size across and up, their height
        above it, and the material of the shape; empty of other points.
    open_above
        The number of points above a floor that have nothing straight above them, no ceiling and no glass.
    covered
        The number of points above a floor that are right below a surface that blocks their light, such as a table
        top.
    """

    positions: torch.Tensor = field(repr=False)
    normals: torch.Tensor = field(repr=False)
    inside: torch.Tensor = field(repr=False)
    plan: torch.Tensor = field(repr=False)
    floor: str = ""
    sides: tuple[float, ...] = ()
    above: float = 0.0
    material: str = ""
    open_above: int = 0
    covered: int = 0

    def as_list(self) -> GridPoints:
        """Return the points that are inside, in rows of one point."""
        inside = self.inside
        names = ("positions", "normals", "inside", "plan")
        return replace(self, **{name: getattr(self, name)[inside][:, None] for name in names})

    def spread(self, values: torch.Tensor) -> torch.Tensor:
        """Return values of the points inside, ``(points,)``, in rows and columns, ``(H, W)``, and 0 elsewhere."""
        placed = values.new_zeros(self.inside.shape)
        placed[self.inside] = values
        return placed

    @property
    def axes(self) -> tuple[str, str]:
        """The coordinates of the scene that ``plan`` shows across and up: ``("x", "y")`` where z is up."""
        across, up = (
            [
                axis
                for axis, own in zip("xyz", self.positions.unbind(-1), strict=True)
                if torch.equal(own, shown)
            ]
            for shown in self.plan.unbind(-1)
        )
        return across[0], up[-1]

    @property
    def width(self) -> int:
        """Number of columns."""
        return int(self.positions.shape[1])

    @property
    def height(self) -> int:
        """Number of rows."""
        return int(self.positions.shape[0])
