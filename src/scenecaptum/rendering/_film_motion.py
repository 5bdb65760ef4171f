"""Derivatives with respect to the rotation and the field of view of a pinhole camera, without a second render.

The light along a ray does not depend on them: they move the picture over the film. With the velocity ``v`` of its
points, the adjoint ``a`` of the film's points, and the divergence theorem,

    d/dδ ∫ a L = −∫ a v·∇L = ∫ L div(a v) − ∮ a L v·n,

which needs no derivative of the light ``L``. With a box filter ``a`` is constant within pixels, and the integral
over its jumps is one over the pixels' edges. Otherwise its gradient is that of the filter, and only the border of
the film remains.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from ._backward import PROFILE_STEPS, FilmFilter
from ._pixel_sampling import sample_pixels

Array = npt.NDArray[np.float64]

# Of the samples, those on edges, where most of the derivative arises.
EDGE_SAMPLES = 0.5
# Of the samples, those that follow the adjoint; the others are uniform.
IMPORTANCE = 0.8
_PROBES = np.array([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]])  # points of a pixel


@dataclass(frozen=True)
class FilmSamples:
    """Points of the film, and the weights of the light there in each derivative.

    ``points`` are ``(N, 2)`` in pixels, ``weights`` ``(derivatives, N, 3)``: three of the rotation, one of the
    field of view.
    """

    points: Array
    weights: Array

    def integrate(self, light: Array) -> Array:
        """Return the derivatives, given the light ``(N, 3)``.

        They are 0 for light that is the same everywhere: the sum of the weights is 0 on average. As much of it is
        subtracted as lowers the variance most.
        """
        terms = self.weights * light
        spread = self.weights - self.weights.mean(1, keepdims=True)
        shared = (spread * terms).sum(1) / np.maximum((spread**2).sum(1), 1e-300)
        return np.asarray((terms.sum(1) - shared * self.weights.sum(1)).sum(-1))


@dataclass(frozen=True)
class FilmMotion:
    """How points of the film of a pinhole camera move while it turns or zooms, for light that stays.

    The direction of a point ``(x, y)`` is that of ``corner + x · across + y · down``. Zooming leaves ``centre``
    where it is; ``zoom`` is the relative change of all distances from it per degree of the field of view.
    """

    corner: Array
    across: Array
    down: Array
    centre: Array
    zoom: float

    @classmethod
    def of(cls, corners: Array, forward: Array, resolution: tuple[int, int], fov: float) -> FilmMotion:
        """Return that of a camera, from the directions of the film's corners at the left top, right and bottom."""
        plane = corners / (corners @ forward)[:, None]
        width, height = resolution
        across, down = (plane[1] - plane[0]) / width, (plane[2] - plane[0]) / height
        offset = forward - plane[0]
        centre = np.array([offset @ across / (across @ across), offset @ down / (down @ down)])
        return cls(plane[0], across, down, centre, -math.radians(1) / math.sin(math.radians(fov)))

    def project(self, place: Array) -> tuple[Array, Array] | None:
        """Return where the film shows a place relative to the camera, and its derivative ``(2, 3)``.

        None for a place behind the camera.
        """
        normal = np.cross(self.across, self.down)
        depth = float(normal @ place) / float(normal @ self.corner)
        if depth <= 0:
            return None
        volume = float(normal @ normal)
        duals = np.stack([np.cross(self.down, normal), np.cross(normal, self.across)]) / volume
        point = duals @ (place / depth - self.corner)
        along = np.outer(place, normal) / float(normal @ place)
        return point, duals @ (np.eye(3) - along) / depth

    def velocity(self, points: Array) -> tuple[Array, Array]:
        """Return the velocities ``(4, N, 2)`` of points, and their divergences ``(4, N)``."""
        place = self.corner + points[:, :1] * self.across + points[:, 1:] * self.down
        normal = np.cross(self.across, self.down)
        volume = float(normal @ self.corner)
        faces = np.cross(self.down, place), np.cross(place, self.across)
        velocities, divergences = [], []
        for axis in np.eye(3):
            turned = -np.cross(axis, place)
            # Cramer's rule: of the change of direction, what moves across the film.
            velocities.append(np.stack([(turned * face).sum(1) / volume for face in faces], 1))
            slopes = (
                -(faces[0] @ np.cross(axis, self.across)) - turned @ normal,
                -(faces[1] @ np.cross(axis, self.down)) - turned @ normal,
            )
            divergences.append((slopes[0] + slopes[1]) / volume)
        velocities.append(self.zoom * (points - self.centre))
        divergences.append(np.full(len(points), 2 * self.zoom))
        return np.stack(velocities), np.stack(divergences)


def film_samples(
    motion: FilmMotion, film: FilmFilter, adjoint: torch.Tensor, count: int, seed: int
) -> FilmSamples:
    """Distribute ``count`` samples over the film and its edges."""
    random = np.random.default_rng(seed)
    own = (adjoint.cpu().double() / film.filter_weight_sum.double()).numpy()
    on_edges = max(1, round(EDGE_SAMPLES * count))
    parts = [
        _inside(motion, film, own, max(1, count - on_edges), random),
        _on_edges(motion, film, own, on_edges, random),
    ]
    return FilmSamples(
        np.concatenate([part.points for part in parts]), np.concatenate([part.weights for part in parts], 1)
    )


def _inside(
    motion: FilmMotion, film: FilmFilter, adjoint: Array, count: int, random: np.random.Generator
) -> FilmSamples:
    width = adjoint.shape[1]
    pixels = np.arange(adjoint[..., 0].size)
    corners = np.stack([pixels % width, pixels // width], 1).astype(float)
    sizes = [np.linalg.norm(_divergence(motion, film, adjoint, corners + at), axis=-1) for at in _PROBES]
    size = np.sqrt(np.mean(np.square(sizes), 0))
    # Each derivative counts by the size of its own.
    size = (size / np.maximum(size.mean(1, keepdims=True), 1e-30)).max(0)
    index, weight = _choose(torch.from_numpy(size), count, random)
    points = corners[index] + random.random((count, 2))
    return FilmSamples(points, _divergence(motion, film, adjoint, points) * weight[:, None])


def _divergence(motion: FilmMotion, film: FilmFilter, adjoint: Array, points: Array) -> Array:
    """Return the divergences of adjoint times velocity inside pixels, ``(4, N, 3)``."""
    velocity, divergence = motion.velocity(points)
    value, slope = _filtered(film, adjoint, points)
    change: Array = divergence[:, :, None] * value
    if film.radius:
        change = change + velocity[:, :, :1] * slope[0] + velocity[:, :, 1:] * slope[1]
    return change


def _on_edges(
    motion: FilmMotion, film: FilmFilter, adjoint: Array, count: int, random: np.random.Generator
) -> FilmSamples:
    """Return samples on the edges of pixels, across which the adjoint jumps, or on the border of the film."""
    height, width, _ = adjoint.shape
    upright, level = _edges(width, height)
    half = np.array([0.0, 0.5])
    middles = np.concatenate([upright + half, level + half[::-1]])
    is_upright: npt.NDArray[np.bool_] = np.arange(len(middles)) < len(upright)
    if film.radius:
        on_border = np.flatnonzero(
            np.where(is_upright, middles[:, 0] % width == 0, middles[:, 1] % height == 0)
        )
        middles, is_upright = middles[on_border], is_upright[on_border]
    jumps = _jumps(film, adjoint, middles, is_upright)
    velocity = motion.velocity(middles)[0]
    across = np.abs(np.where(is_upright, velocity[..., 0], velocity[..., 1]))
    sizes = across * np.linalg.norm(jumps, axis=-1)
    size = (sizes / np.maximum(sizes.mean(1, keepdims=True), 1e-30)).max(0)
    index, weight = _choose(torch.from_numpy(size), count, random)
    along = (random.random(count) - 0.5)[:, None] * np.where(is_upright[index, None], [0.0, 1.0], [1.0, 0.0])
    points = middles[index] + along
    velocity = motion.velocity(points)[0]
    flow = np.where(is_upright[index], velocity[..., 0], velocity[..., 1])
    jump = _jumps(film, adjoint, points, is_upright[index])
    return FilmSamples(points, flow[:, :, None] * jump * weight[:, None])


def _edges(width: int, height: int) -> tuple[Array, Array]:
    """Return the upper ends of the upright edges of all pixels, and the left ends of the level ones."""
    upright = np.stack(np.meshgrid(np.arange(width + 1.0), np.arange(height)), -1).reshape(-1, 2)
    level = np.stack(np.meshgrid(np.arange(width), np.arange(height + 1.0)), -1).reshape(-1, 2)
    return upright, level


def _jumps(film: FilmFilter, adjoint: Array, points: Array, is_upright: npt.NDArray[np.bool_]) -> Array:
    """Return by how much the adjoint is larger to the right of edges, or below them; outside the film it is 0."""
    step = 1e-9 * np.where(is_upright[:, None], [1.0, 0.0], [0.0, 1.0])
    after, before = (_filtered(film, adjoint, points + sign * step)[0] for sign in (1, -1))
    return np.asarray(after - before)


def _filtered(film: FilmFilter, adjoint: Array, points: Array) -> tuple[Array, tuple[Array, Array]]:
    """Return the adjoint of the light at points of the film, ``(N, 3)``, and its slopes; 0 outside the film."""
    height, width, _ = adjoint.shape
    on_film = np.all((points > 0) & (points < [width, height]), axis=1, keepdims=True)
    home = np.floor(points).astype(int)
    profile = film.profile.double().numpy()
    value = np.zeros((len(points), 3))
    slopes = np.zeros((2, len(points), 3))
    steps: Sequence[int] = range(-film.radius, film.radius + 1)
    for x in steps:
        for y in steps:
            column, row = home[:, 0] + x, home[:, 1] + y
            inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            own = adjoint[row.clip(0, height - 1), column.clip(0, width - 1)] * inside[:, None]
            across, slope_x = _profile(profile, film.radius, points[:, 0] - column - 0.5)
            down, slope_y = _profile(profile, film.radius, points[:, 1] - row - 0.5)
            value += (across * down)[:, None] * own
            slopes[0] += (slope_x * down)[:, None] * own
            slopes[1] += (across * slope_y)[:, None] * own
    return value * on_film, (slopes[0] * on_film, slopes[1] * on_film)


def _profile(profile: Array, radius: int, offset: Array) -> tuple[Array, Array]:
    """Return the filter along an axis at offsets in pixels, and its slope."""
    if not radius:
        return np.ones_like(offset), np.zeros_like(offset)
    position = np.abs(offset) * PROFILE_STEPS / (radius + 1)
    index = np.minimum(position.astype(int), PROFILE_STEPS - 1)
    rise = profile[index + 1] - profile[index]
    value = profile[index] + (position - index) * rise
    return value, np.sign(offset) * rise * PROFILE_STEPS / (radius + 1)


def _choose(
    magnitude: torch.Tensor, count: int, random: np.random.Generator
) -> tuple[npt.NDArray[np.int64], Array]:
    """Choose pixels or edges in proportion to a magnitude; return them with the weight of each sample."""
    uniform = torch.ones_like(magnitude)
    index, weight = sample_pixels(magnitude, [(IMPORTANCE, uniform)], count, int(random.integers(2**32)))
    chosen = index.numpy().astype(np.int64)
    return chosen, weight.double().numpy()[chosen]


def turning(rotation: Array) -> Array:
    """Return the ``(3, 3)`` matrix from changes of an axis–angle vector to small rotations of what it has turned.

    References
    ----------
    Solà, Deray and Atchuthan, "A micro Lie theory for state estimation in robotics", 2018: the left Jacobian of
    SO(3).
    """
    angle = float(np.linalg.norm(rotation))
    if angle < 1e-6:
        return np.eye(3)
    axis = rotation / angle
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    sine, cosine = math.sin(angle) / angle, (1 - math.cos(angle)) / angle
    return sine * np.eye(3) + (1 - sine) * np.outer(axis, axis) + cosine * cross
