"""Camera models: the direction and the solid angle of each pixel."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from numbers import Real

import torch

from .errors import SceneCaptumError, whole_number

_NODES = (-math.sqrt(0.6), 0.0, math.sqrt(0.6))  # Gauss–Legendre on [-1, 1], exact to degree 5
_WEIGHTS = (5 / 9, 8 / 9, 5 / 9)
_PANELS = 16  # for pixels that the fisheye's image circle crosses; other pixels need one


@dataclass(frozen=True, eq=False)
class Camera:
    """Directions and exact solid angles of the pixels of an image.

    Example
    -------
    >>> Camera.perspective(320, 180, fov_x=60).solid_angles.shape
    torch.Size([180, 320])

    Attributes
    ----------
    width, height
        Image size in pixels.
    projection
        The type of camera: ``"perspective"``, ``"fisheye"``.
    fov
        Field of view in degrees: horizontal for a perspective camera, across the image circle for a fisheye.
    directions
        ``(H, W, 3)``, float64: unit vectors to the pixel centres; x right, y up, z forward, row 0 at the top.
    solid_angles
        ``(H, W)``, float64, in steradians; 0 outside a fisheye's image circle.
    sees_hemisphere
        Whether the image covers the whole front hemisphere: a fisheye of 180° or more.

    Notes
    -----
    The solid angle of a pixel on a fisheye's image circle is that of the part inside the circle; its centre, and
    hence its direction, may lie outside.

    Raises
    ------
    SceneCaptumError
        If a size or an angle is out of range.
    """

    width: int
    height: int
    projection: str
    fov: float
    directions: torch.Tensor = field(repr=False)
    solid_angles: torch.Tensor = field(repr=False)
    sees_hemisphere: bool = field(default=False, repr=False)

    @classmethod
    def perspective(
        cls,
        width: int,
        height: int,
        fov_x: float,
        *,
        principal_point_offset: tuple[float, float] = (0.0, 0.0),
    ) -> Camera:
        """Return a pinhole camera with square pixels.

        Parameters
        ----------
        width, height
            Image size in pixels.
        fov_x
            Horizontal field of view in degrees, above 0 and below 180.
        principal_point_offset
            Offset of the principal point from the image centre: a fraction of the width to the right, and of the
            height downward.
        """
        width, height = whole_number("width", width), whole_number("height", height)
        fov = _angle("fov_x", fov_x, below=180.0, of="perspective camera")
        pitch = 2 * math.tan(math.radians(fov) / 2) / width
        right, down = principal_point_offset
        x = pitch * (_edges(width) - width * right)
        y = -pitch * (_edges(height) - height * down)
        up, across = _centres(y, x)
        rays = torch.stack([across, up, torch.ones_like(up)], -1)
        return cls(width, height, "perspective", fov, _unit(rays), _rectangles(x, y))

    @classmethod
    def fisheye(cls, width: int, height: int, fov: float = 180.0) -> Camera:
        """Return an equidistant fisheye: the angle from the axis is proportional to the distance from the centre.

        Pixels are square and the diameter of the image circle is the shorter side of the image (for a square
        image, ``-vta`` in Radiance).

        Parameters
        ----------
        width, height
            Image size in pixels.
        fov
            Field of view across the image circle, in degrees, above 0 and at most 360.
        """
        width, height = whole_number("width", width), whole_number("height", height)
        angle = _angle("fov", fov, below=math.nextafter(360.0, math.inf), of="fisheye")
        radius = min(width, height) / 2
        scale = math.radians(angle) / 2 / radius
        x, y = _edges(width), -_edges(height)
        up, across = _centres(y, x)
        directions, solid_angles = _from_disc(across, up, scale), _disc_pixels(across, up, radius, scale)
        return cls(width, height, "fisheye", angle, directions, solid_angles, sees_hemisphere=angle >= 180.0)


@dataclass(frozen=True)
class View:
    """A camera that a scene does not have: one of its pinhole cameras, turned, moved or zoomed.

    Example
    -------
    >>> from scenecaptum import SceneRenderer
    >>> left = SceneRenderer("office", resolution=(32, 18), sensor=View(turn=-30))
    >>> left.camera.projection
    'perspective'

    Attributes
    ----------
    turn
        Degrees to the right about the camera's own vertical axis.
    tilt
        Degrees upward, after the turn.
    move
        Distances to the right, up and forward along the axes of the scene's camera, in scene units.
    fov
        Horizontal field of view in degrees; that of the scene's camera by default.
    sensor
        Index of the scene's camera.
    """

    turn: float = 0.0
    tilt: float = 0.0
    move: tuple[float, float, float] = (0.0, 0.0, 0.0)
    fov: float | None = None
    sensor: int = 0

    def matrix(self) -> torch.Tensor:
        """Return the pose in the frame of the scene's camera, ``(4, 4)`` in float64: x left, y up, z forward.

        Raises
        ------
        SceneCaptumError
            If a number is not finite.
        """
        numbers = torch.tensor([self.turn, self.tilt, *self.move], dtype=torch.float64)
        if len(numbers) != 5 or not numbers.isfinite().all():
            raise SceneCaptumError(f"turn, tilt and the three numbers of move must be finite, not {self!r}.")
        turn, tilt = numbers[:2].deg2rad()
        one, zero = torch.ones_like(turn), torch.zeros_like(turn)
        around_y = torch.stack([turn.cos(), zero, -turn.sin(), zero, one, zero, turn.sin(), zero, turn.cos()])
        around_x = torch.stack([one, zero, zero, zero, tilt.cos(), tilt.sin(), zero, -tilt.sin(), tilt.cos()])
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = around_y.reshape(3, 3) @ around_x.reshape(3, 3)
        pose[:3, 3] = numbers[2:] * torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
        return pose


def _angle(name: str, value: float, *, below: float, of: str) -> float:
    if not isinstance(value, Real) or not 0 < value < below:
        limit = "below 180" if below == 180 else "at most 360"
        raise SceneCaptumError(f"{name} of a {of} must be above 0 and {limit} degrees, not {value!r}.")
    return float(value)


def _edges(count: int) -> torch.Tensor:
    """Return the ``count + 1`` pixel edges, in pixels from the centre."""
    return torch.arange(count + 1, dtype=torch.float64) - count / 2


def _centres(y: torch.Tensor, x: torch.Tensor) -> tuple[torch.Tensor, ...]:
    return torch.meshgrid((y[1:] + y[:-1]) / 2, (x[1:] + x[:-1]) / 2, indexing="ij")


def _unit(vectors: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.normalize(vectors, dim=-1)


def _rectangles(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Return the solid angles of a grid of rectangles on the plane z = 1, seen from the origin.

    The rectangle from the axis to the point (x, y) subtends ``atan(x y / √(1 + x² + y²))``; the solid angle of a
    pixel is the mixed difference of this over its corners.
    """
    b, a = torch.meshgrid(y, x, indexing="ij")
    corner = torch.atan(a * b / torch.sqrt(1 + a * a + b * b))
    return corner.diff(dim=0).diff(dim=1).abs()


def _from_disc(x: torch.Tensor, y: torch.Tensor, scale: float) -> torch.Tensor:
    angle = scale * torch.hypot(x, y)
    lateral = torch.sinc(angle / math.pi) * scale  # sin(angle) / distance, finite on the axis
    return _unit(torch.stack([lateral * x, lateral * y, torch.cos(angle)], -1))


def _disc_pixels(x: torch.Tensor, y: torch.Tensor, radius: float, scale: float) -> torch.Tensor:
    """Integrate the solid angle per unit area, ``scale² sin(θ)/θ``, over each pixel's part inside the circle."""
    far = torch.hypot(x.abs() + 0.5, y.abs() + 0.5)
    near = torch.hypot((x.abs() - 0.5).clamp(min=0), (y.abs() - 0.5).clamp(min=0))
    crossed = (far > radius) & (near < radius)
    solid_angles = torch.zeros_like(x)
    whole = far <= radius
    solid_angles[whole] = _quadrature(x[whole], y[whole], radius, scale, panels=1)
    solid_angles[crossed] = _quadrature(x[crossed], y[crossed], radius, scale, panels=_PANELS)
    return solid_angles


def _quadrature(
    x: torch.Tensor, y: torch.Tensor, radius: float, scale: float, *, panels: int
) -> torch.Tensor:
    # By symmetry each pixel is mapped to the octant 0 ≤ a ≤ b, where the slope of the circle over a is bounded.
    a, b = torch.minimum(x.abs(), y.abs())[:, None], torch.maximum(x.abs(), y.abs())[:, None]
    starts = torch.arange(panels, dtype=torch.float64) / panels - 0.5
    nodes = torch.tensor(_NODES, dtype=torch.float64)
    weights = torch.tensor(_WEIGHTS, dtype=torch.float64) / 2
    across = a + (starts[:, None] + (nodes + 1) / 2 / panels).flatten()
    height = torch.sqrt((radius**2 - across**2).clamp(min=0))
    low = b - 0.5
    length = (torch.minimum(b + 0.5, height) - low).clamp(min=0)
    along = low[..., None] + length[..., None] * (nodes + 1) / 2
    density = torch.sinc(scale * torch.hypot(across[..., None], along) / math.pi) * scale**2
    strips = (density * weights).sum(-1) * length
    return (strips * weights.repeat(panels)).sum(-1) / panels
