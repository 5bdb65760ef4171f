"""A backward pass whose samples may go to any pixels: what our integrators share.

Imported only once a variant is active (see ``SceneRenderer``).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import torch
from mitsuba.python.ad.integrators.common import RBIntegrator

from ._passes import SAMPLES
from ._sampler import SobolSampler


class ChoosingIntegrator(RBIntegrator):
    """A path replay integrator that can be told which pixels to sample."""

    def propagate(
        self,
        scene: Any,
        sensor: Any,
        adjoint: Any,
        samples: tuple[Any, Any],
        profile: tuple[Any, int],
        seed: Any,
        seen: Any,
    ) -> None:
        """Carry an adjoint to the tracked parameters, from samples inside given pixels.

        Parameters
        ----------
        adjoint
            ``∂M/∂I`` divided by what each pixel has ``caught``, a ``(H, W, 3)`` tensor.
        samples
            The pixel of each sample, counted along the rows, and what a sample inside each pixel counts.
        profile
            Profile and reach of the film's filter: see ``FilmFilter``.
        seed
            Seed of the samples.
        seen
            Marks of shapes, to propagate to nothing but where the camera sees these, directly or by specular
            reflection; or None.
        """
        pixel, weight = samples
        with dr.suspend_grad():
            sampler = SobolSampler.of(dr.width(pixel), seed)
            ray, response, point = _camera_rays(sensor, sampler, pixel)
            emitted = response * dr.gather(mi.Float, weight, pixel)
            emitted *= read_adjoint(sensor.film(), adjoint, *profile, pixel, point)
            *_, state = self.sample(
                mode=dr.ADMode.Primal,
                scene=scene,
                sampler=sampler.clone(),
                ray=ray,
                active=mi.Bool(True),
                seen=seen,
            )
            self.sample(
                mode=dr.ADMode.Backward,
                scene=scene,
                sampler=sampler,
                ray=ray,
                active=mi.Bool(True),
                state_in=state,
                δL=emitted,
                seen=seen,
            )
            dr.eval()

    def strength(self, scene: Any, sensor: Any, spp: int, seed: Any, seen: Any) -> Any:
        """Return the root mean square over samples inside each pixel of the derivative along the tangents.

        A ``(H, W)`` tensor. ``seen`` is that of ``propagate``.
        """
        width, height = sensor.film().crop_size()
        with dr.suspend_grad():
            pixel = dr.arange(mi.UInt32, width * height * spp) // spp
            sampler = SobolSampler.of(dr.width(pixel), seed)
            ray, response, _ = _camera_rays(sensor, sampler, pixel)
            fixed = {"scene": scene, "ray": ray, "active": mi.Bool(True), "seen": seen}
            *_, state = self.sample(mode=dr.ADMode.Primal, sampler=sampler.clone(), **fixed)
            derivative, *_ = self.sample(mode=dr.ADMode.Forward, sampler=sampler, state_in=state, **fixed)
            square = dr.zeros(mi.Float, width * height)
            dr.scatter_add(square, dr.squared_norm(response * derivative) / spp, pixel)
            return mi.TensorXf(dr.sqrt(square), (height, width))

    def count(self, scene: Any, sensor: Any, spp: int, seed: int, counter: Callable[[Any, Any], Any]) -> None:
        """Tell the light of the vertices of ``spp`` paths from each pixel.

        ``counter`` makes what is told, for the pixel of each lane and what the sensor makes of its radiance.
        """
        width, height = sensor.film().crop_size()
        pixels, most = width * height, max(1, SAMPLES // spp)
        with dr.suspend_grad():
            for number, first in enumerate(range(0, pixels, most)):
                lanes = spp * min(most, pixels - first)
                pixel = dr.opaque(mi.UInt32, first) + dr.arange(mi.UInt32, lanes) // spp
                sampler = SobolSampler.of(lanes, dr.opaque(mi.UInt32, seed + number))
                ray, response, _ = _camera_rays(sensor, sampler, pixel)
                fixed = {"mode": dr.ADMode.Primal, "scene": scene, "ray": ray, "active": mi.Bool(True)}
                *_, state = self.sample(sampler=sampler.clone(), **fixed)
                self.sample(sampler=sampler, state_in=state, counter=counter(pixel, response), **fixed)
                dr.eval()
                dr.sync_thread()


STEPS = 1024  # of a filter's profile


@dataclass(frozen=True)
class FilmFilter:
    """How a film spreads a sample over pixels.

    Attributes
    ----------
    profile
        The filter along an axis, at even distances from 0 to ``reach + 1`` pixels.
    reach
        How many pixels away from its own a sample counts.
    caught
        The weight that each pixel catches of an evenly sampled film, by which the film divides, ``(H, W, 1)``.
    """

    profile: torch.Tensor
    reach: int
    caught: torch.Tensor

    def strength(self, adjoint: torch.Tensor) -> torch.Tensor:
        """Return the root mean square of the adjoint of samples inside each pixel, ``(H, W)``."""
        # In NumPy: torch's threads would wait for Dr.Jit's, and this is little work. In float64, for the squares.
        image = (adjoint / self.caught.to(adjoint)).cpu().double().numpy()
        quarters = (-0.25, 0.25)
        columns = [self._spread(image, 0, y) for y in quarters]
        squares = sum(np.square(self._spread(one, 1, x)).sum(-1) for one in columns for x in quarters)
        return torch.from_numpy(np.sqrt(squares / 4)).to(adjoint)

    def _spread(self, image: np.ndarray, axis: int, shift: float) -> np.ndarray:
        """Weigh each pixel's neighbours along an axis, for samples at ``shift`` from its centre."""
        reach, length = self.reach, image.shape[axis]
        border = [(reach, reach) if along == axis else (0, 0) for along in range(image.ndim)]
        padded = np.pad(image, border)
        distance = abs(np.arange(-reach, reach + 1) - shift)
        weights = self.profile.numpy()[(distance * STEPS / (reach + 1)).round().astype(int)]
        spread = np.zeros_like(image)
        for step, weight in enumerate(weights):
            spread += weight * padded[(slice(None),) * axis + (slice(step, step + length),)]
        return spread


def film_filter(film: Any) -> FilmFilter | None:
    """Return a film's filter, or None where samples cannot be weighted one by one: the film is a special one."""
    if film.sample_border() or mi.has_flag(film.flags(), mi.FilmFlags.Special):
        return None
    rfilter = film.rfilter()
    # Mitsuba gives its box no share of the neighbours, however wide it is.
    reach = 0 if rfilter.is_box_filter() else math.ceil(rfilter.radius() - 0.5)
    distance = torch.linspace(0, reach + 1, STEPS + 1)
    profile = torch.ones_like(distance)
    if reach:
        profile = torch.where(
            distance < rfilter.radius(), rfilter.eval(mi.Float(distance)).torch().cpu(), torch.zeros(())
        )
    width, height = film.crop_size()
    across, down = (_caught(profile, reach, pixels) for pixels in (width, height))
    return FilmFilter(profile, reach, torch.outer(down, across)[..., None])


def _caught(profile: torch.Tensor, reach: int, pixels: int) -> torch.Tensor:
    """Integrate the filter of each pixel of a row, cut off at the ends of the row."""
    if not reach:
        return torch.ones(pixels)
    fine = 64  # points per pixel
    centre = torch.arange(pixels)[:, None] + 0.5
    offset = (torch.arange(2 * (reach + 1) * fine) + 0.5) / fine - (reach + 1)
    weight = profile[(offset.abs() * STEPS / (reach + 1)).round().long()] / fine
    inside = (centre + offset > 0) & (centre + offset < pixels)
    return inside.to(weight) @ weight


def _camera_rays(sensor: Any, sampler: Any, pixel: Any) -> tuple[Any, Any, Any]:
    """Return rays through random points of pixels, what the sensor makes of them, and the points."""
    size = sensor.film().crop_size()
    point = mi.Point2f(pixel % size.x, pixel // size.x) + mi.Point2f(sampler.next_2d())
    lens = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    open_for = sensor.shutter_open_time()
    time = sensor.shutter_open() + (sampler.next_1d() * open_for if open_for > 0 else 0)
    wavelength = sampler.next_1d() if mi.is_spectral else mi.Float(0)
    position = point / mi.ScalarPoint2f(size)
    return *sensor.sample_ray_differential(time, wavelength, position, lens), point


def read_adjoint(film: Any, adjoint: Any, profile: Any, reach: int, pixel: Any, point: Any) -> Any:
    """Return the adjoint of the radiance at a point: those of the pixels near it, weighted by the filter."""
    size = film.crop_size()
    home = mi.Point2i(mi.Int32(pixel % size.x), mi.Int32(pixel // size.x))
    offsets = range(-reach, reach + 1)
    across, down = (
        [_look_up(profile, abs(point[axis] - home[axis] - step - 0.5) / (reach + 1)) for step in offsets]
        for axis in (0, 1)
    )
    total = mi.Color3f(0)
    for x, along in zip(offsets, across, strict=True):
        for y, downwards in zip(offsets, down, strict=True):
            near = home + mi.Vector2i(x, y)
            on_film = dr.all((near >= 0) & (near < mi.ScalarPoint2i(size)))
            index = mi.UInt32(near.y * size.x + near.x)
            total += along * downwards * dr.gather(mi.Color3f, adjoint.array, index, on_film)
    return total


def _look_up(profile: Any, share: Any) -> Any:
    """Read a table over [0, 1] between its entries."""
    place = share * (dr.width(profile) - 1)
    index = dr.minimum(mi.UInt32(place), dr.width(profile) - 2)
    low, high = (dr.gather(mi.Float, profile, index + step) for step in (0, 1))
    return dr.lerp(low, high, place - mi.Float(index))
