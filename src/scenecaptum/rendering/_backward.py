"""Backward passes with samples in arbitrary pixels: the base class of our integrators, and the film's filter."""

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

from ._sampler import SobolSampler
from ._sky import PatchIndex, RecordedSky, WeightedSky


class AdjointSampledIntegrator(RBIntegrator):
    """A path replay integrator whose backward pass can sample given pixels, e.g. in proportion to the adjoint.

    ``receiver`` is where the latest rays start on a sensor grid, a surface interaction, and None for cameras:
    ``sample`` adds the direct light there. It is an attribute because Mitsuba's own passes call ``sample_rays``
    and then ``sample``, and pass on nothing but the rays.
    """

    receiver: Any = None

    def sample_rays(self, scene: Any, sensor: Any, sampler: Any) -> tuple[Any, Any, Any]:
        """Return rays through all pixels, their weights, and the points of the film; for Mitsuba's own passes."""
        ray, weight, point = super().sample_rays(scene, sensor, sampler)
        self.receiver = _receiver(sensor, point)
        return one_for_each(ray, point), weight, point

    def random_rays(self, sensor: Any, sampler: Any, pixel: Any) -> tuple[Any, Any, Any]:
        """Return rays through random points of pixels, the sensor response to each, and the points."""
        size = sensor.film().crop_size()
        point = mi.Point2f(pixel % size.x, pixel // size.x) + mi.Point2f(sampler.next_2d())
        return *self.rays_through(sensor, sampler, point), point

    def rays_through(self, sensor: Any, sampler: Any, point: Any) -> tuple[Any, Any]:
        """Return rays through points of the film, in pixels, and the sensor response to each."""
        size = sensor.film().crop_size()
        lens = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
        open_time = sensor.shutter_open_time()
        time = sensor.shutter_open() + (sampler.next_1d() * open_time if open_time > 0 else 0)
        wavelength = sampler.next_1d() if mi.is_spectral else mi.Float(0)
        position = point * dr.rcp(mi.ScalarVector2f(size))  # rounded as in Mitsuba
        ray, response = sensor.sample_ray_differential(time, wavelength, position, lens)
        self.receiver = _receiver(sensor, point)
        return one_for_each(ray, point), response

    def render_samples(self, scene: Any, sensor: Any, seed: Any, pixel: Any) -> Any:
        """Render an image as ``render`` does, given the row-major pixel index of each sample.

        ``render`` itself has the number of samples in its code, where it would have to be recorded for each.
        """
        film = sensor.film()
        with dr.suspend_grad():
            film.prepare([])
            # Seeded here: a sampler in memory takes half as long again as one whose state is computed.
            sampler = sensor.sampler().clone()
            sampler.seed(seed, dr.width(pixel))
            ray, response, point = self.random_rays(sensor, sampler, pixel)
            radiance, valid, *_ = self.sample(
                mode=dr.ADMode.Primal, scene=scene, sampler=sampler, ray=ray, active=mi.Bool(True)
            )
            has_alpha = mi.has_flag(film.flags(), mi.FilmFlags.Alpha)
            alpha = [dr.select(valid, mi.Float(1), mi.Float(0))] if has_alpha else []
            block = film.create_block()
            block.put(point, [*(radiance * response), *alpha, mi.Float(1)])
            film.put_block(block)
            return film.develop()

    def radiance_at(self, scene: Any, sensor: Any, seed: Any, point: Any) -> Any:
        """Return the radiance at points of the film, in pixels: a colour for each."""
        with dr.suspend_grad():
            sampler = sensor.sampler().clone()
            sampler.seed(seed, dr.width(point))
            ray, response = self.rays_through(sensor, sampler, point)
            radiance, *_ = self.sample(
                mode=dr.ADMode.Primal, scene=scene, sampler=sampler, ray=ray, active=mi.Bool(True)
            )
            return radiance * response

    def render_backward_pixels(
        self,
        scene: Any,
        sensor: Any,
        adjoint: Any,
        samples: tuple[Any, Any],
        profile: tuple[Any, int],
        seed: Any,
        light_traced: Any,
    ) -> None:
        """Backpropagate an adjoint image to the tracked parameters with samples in given pixels.

        Parameters
        ----------
        adjoint
            ``∂M/∂I`` divided by each pixel's ``FilmFilter.filter_weight_sum``, a ``(H, W, 3)`` tensor.
        samples
            The row-major pixel index of each sample, and the weight of a sample in each pixel.
        profile
            Profile and radius of the film's filter: see ``FilmFilter``.
        light_traced
            As for ``ReplayIntegrator.sample``, or None.
        """
        pixel, weight = samples
        with dr.suspend_grad():
            sampler = SobolSampler.of(dr.width(pixel), seed)
            ray, response, point = self.random_rays(sensor, sampler, pixel)
            adjoint_radiance = response * dr.gather(mi.Float, weight, pixel)
            adjoint_radiance *= filtered_adjoint(sensor.film(), adjoint, *profile, pixel, point)
            fixed = {"scene": scene, "ray": ray, "active": mi.Bool(True), "light_traced": light_traced}
            *_, state = self.sample(mode=dr.ADMode.Primal, sampler=sampler.clone(), **fixed)
            fixed |= {"state_in": state, "δL": adjoint_radiance}
            self.sample(mode=dr.ADMode.Backward, sampler=sampler, **fixed)
            dr.eval()

    def render_coefficients(
        self, scene: Any, sensor: Any, seed: Any, samples: tuple[Any, Any], index: PatchIndex, *, direct: bool
    ) -> Any:
        """Return daylight coefficients, ``(points, patches, 3)``.

        ``samples`` are the pixel of each sample, whose row is its point, and the weight of a sample. ``direct``
        leaves out the light that surfaces reflect.
        """
        pixel, weight = samples
        points, patches = sensor.film().crop_size().y, index.patches.count
        with dr.suspend_grad():
            sampler = sensor.sampler().clone()
            sampler.seed(seed, dr.width(pixel))
            ray, response, point = self.random_rays(sensor, sampler, pixel)
            target = dr.zeros(mi.Float, 3 * points * patches)
            sky = RecordedSky(index, mi.UInt32(point.y), target, response.x * weight, direct=direct)
            self.sample(
                mode=dr.ADMode.Primal, scene=scene, sampler=sampler, ray=ray, active=mi.Bool(True), sky=sky
            )
            return mi.TensorXf(target, (points, patches, 3))

    def differentiate_coefficients(
        self,
        scene: Any,
        sensor: Any,
        adjoint: Any,
        seed: Any,
        samples: tuple[Any, Any],
        index: PatchIndex,
        *,
        direct: bool,
    ) -> None:
        """Backpropagate an adjoint of daylight coefficients with the samples of ``render_coefficients``."""
        pixel, weight = samples
        with dr.suspend_grad():
            sampler = sensor.sampler().clone()
            sampler.seed(seed, dr.width(pixel))
            ray, response, point = self.random_rays(sensor, sampler, pixel)
            sky = WeightedSky(index, mi.UInt32(point.y), adjoint.array, direct=direct)
            fixed = {"scene": scene, "ray": ray, "active": mi.Bool(True), "sky": sky}
            *_, state = self.sample(mode=dr.ADMode.Primal, sampler=sampler.clone(), **fixed)
            fixed |= {"state_in": state, "δL": response * weight}
            self.sample(mode=dr.ADMode.Backward, sampler=sampler, **fixed)
            dr.eval()

    def rms_derivative(self, scene: Any, sensor: Any, spp: int, seed: Any, light_traced: Any) -> Any:
        """Return each pixel's root mean square of its samples' derivatives in the direction of the tangents.

        A ``(H, W)`` tensor. ``light_traced`` is that of ``render_backward_pixels``.
        """
        width, height = sensor.film().crop_size()
        with dr.suspend_grad():
            pixel = dr.arange(mi.UInt32, width * height * spp) // spp
            sampler = SobolSampler.of(dr.width(pixel), seed)
            ray, response, _ = self.random_rays(sensor, sampler, pixel)
            fixed = {"scene": scene, "ray": ray, "active": mi.Bool(True), "light_traced": light_traced}
            *_, state = self.sample(mode=dr.ADMode.Primal, sampler=sampler.clone(), **fixed)
            derivative, *_ = self.sample(mode=dr.ADMode.Forward, sampler=sampler, state_in=state, **fixed)
            square = dr.zeros(mi.Float, width * height)
            dr.scatter_add(square, dr.squared_norm(response * derivative) / spp, pixel)
            return mi.TensorXf(dr.sqrt(square), (height, width))

    def accumulate_moments(
        self, scene: Any, sensor: Any, seed: Any, pixel: Any, make_moments: Callable[[Any], Any]
    ) -> None:
        """Trace a path from the pixel of each lane and accumulate moments of its vertices' contributions.

        ``make_moments`` returns the accumulator for the sensor response of each lane.
        """
        with dr.suspend_grad():
            sampler = SobolSampler.at(dr.arange(mi.UInt32, dr.width(pixel)), seed)
            ray, response, _ = self.random_rays(sensor, sampler, pixel)
            fixed = {"mode": dr.ADMode.Primal, "scene": scene, "ray": ray, "active": mi.Bool(True)}
            *_, state = self.sample(sampler=sampler.clone(), **fixed)
            self.sample(sampler=sampler, state_in=state, moments=make_moments(response), **fixed)


@dataclass
class CameraAdjoint:
    """A sensor, the adjoint of its image, and its film's filter.

    ``adjoint`` and ``profile`` are those of ``AdjointSampledIntegrator.render_backward_pixels``.
    """

    sensor: Any
    adjoint: Any
    profile: tuple[Any, int]


PROFILE_STEPS = 1024  # intervals of a filter's tabulated profile


@dataclass(frozen=True)
class FilmFilter:
    """A film's reconstruction filter, tabulated.

    ``filter_weight_sum``, ``(H, W, 1)``, is the filter weight that each pixel collects from a uniformly sampled
    film, by which the film normalizes.
    """

    profile: torch.Tensor  # along an axis, at equidistant offsets from 0 to ``radius + 1`` pixels
    radius: int  # how many pixels away from its own pixel a sample contributes
    filter_weight_sum: torch.Tensor

    def rms_adjoint(self, adjoint: torch.Tensor) -> torch.Tensor:
        """Return each pixel's root mean square of the filtered adjoint over its samples, ``(H, W)``."""
        # NumPy, because torch's threads would wait for Dr.Jit's, and this is little work; float64 for the squares.
        image = (adjoint / self.filter_weight_sum.to(adjoint)).cpu().double().numpy()
        offsets = (-0.25, 0.25)
        columns = [self._filter(image, 0, y) for y in offsets]
        squares = sum(np.square(self._filter(column, 1, x)).sum(-1) for column in columns for x in offsets)
        return torch.from_numpy(np.sqrt(squares / 4)).to(adjoint)

    def _filter(self, image: np.ndarray, axis: int, offset: float) -> np.ndarray:
        """Filter an image along an axis, for samples at ``offset`` from the pixel centres."""
        radius, length = self.radius, image.shape[axis]
        border = [(radius, radius) if dim == axis else (0, 0) for dim in range(image.ndim)]
        padded = np.pad(image, border)
        distance = abs(np.arange(-radius, radius + 1) - offset)
        weights = self.profile.numpy()[(distance * PROFILE_STEPS / (radius + 1)).round().astype(int)]
        filtered = np.zeros_like(image)
        for step, weight in enumerate(weights):
            filtered += weight * padded[(slice(None),) * axis + (slice(step, step + length),)]
        return filtered


def has_independent_samples(sensor: Any) -> bool:
    """Whether samples are drawn independently, each for one pixel of the whole film, and can be weighted."""
    film = sensor.film()
    whole = list(film.size()) == list(film.crop_size())
    return whole and _weights_samples(film) and sensor.sampler().class_name() == "IndependentSampler"


def _weights_samples(film: Any) -> bool:
    """Whether a film's samples can be weighted individually."""
    return not film.sample_border() and not mi.has_flag(film.flags(), mi.FilmFlags.Special)


def film_filter(film: Any) -> FilmFilter | None:
    """Return a film's filter, or None for a film whose samples cannot be weighted individually."""
    if not _weights_samples(film):
        return None
    rfilter = film.rfilter()
    # Mitsuba's box filter never contributes to neighbouring pixels, whatever its radius.
    radius = 0 if rfilter.is_box_filter() else math.ceil(rfilter.radius() - 0.5)
    distance = torch.linspace(0, radius + 1, PROFILE_STEPS + 1)
    profile = torch.ones_like(distance)
    if radius:
        profile = torch.where(
            distance < rfilter.radius(), rfilter.eval(mi.Float(distance)).torch().cpu(), torch.zeros(())
        )
    width, height = film.crop_size()
    across, down = (_weight_sum(profile, radius, pixels) for pixels in (width, height))
    return FilmFilter(profile, radius, torch.outer(down, across)[..., None])


def _weight_sum(profile: torch.Tensor, radius: int, pixels: int) -> torch.Tensor:
    """Integrate the filter of each pixel of a row over the row."""
    if not radius:
        return torch.ones(pixels)
    resolution = 64  # points per pixel
    centre = torch.arange(pixels)[:, None] + 0.5
    offset = (torch.arange(2 * (radius + 1) * resolution) + 0.5) / resolution - (radius + 1)
    weight = profile[(offset.abs() * PROFILE_STEPS / (radius + 1)).round().long()] / resolution
    inside = (centre + offset > 0) & (centre + offset < pixels)
    return inside.to(weight) @ weight


def one_for_each(ray: Any, point: Any) -> Any:
    """Return a ray for each point, also of a sensor with a single ray, such as a radiance meter."""
    if dr.width(ray) < dr.width(point):
        ray.o += dr.zeros(mi.Point3f, dr.width(point))
    return ray


def _receiver(sensor: Any, point: Any) -> Any:
    """Return where the rays through points of the film start, if that is a surface of a sensor grid."""
    receiver = getattr(sensor, "receiver", None)
    return None if receiver is None else receiver(point)


def filtered_adjoint(film: Any, adjoint: Any, profile: Any, radius: int, pixel: Any, point: Any) -> Any:
    """Return the adjoint of the radiance at a film point: that of nearby pixels, weighted by the filter."""
    size = film.crop_size()
    home = mi.Point2i(mi.Int32(pixel % size.x), mi.Int32(pixel // size.x))
    offsets = range(-radius, radius + 1)
    across, down = (
        [_interpolate(profile, abs(point[axis] - home[axis] - step - 0.5) / (radius + 1)) for step in offsets]
        for axis in (0, 1)
    )
    total = mi.Color3f(0)
    for x, weight_x in zip(offsets, across, strict=True):
        for y, weight_y in zip(offsets, down, strict=True):
            neighbour = home + mi.Vector2i(x, y)
            on_film = dr.all((neighbour >= 0) & (neighbour < mi.ScalarPoint2i(size)))
            index = mi.UInt32(neighbour.y * size.x + neighbour.x)
            total += weight_x * weight_y * dr.gather(mi.Color3f, adjoint.array, index, on_film)
    return total


def _interpolate(table: Any, x: Any) -> Any:
    """Look up a table over [0, 1] with linear interpolation."""
    position = x * (dr.width(table) - 1)
    index = dr.minimum(mi.UInt32(position), dr.width(table) - 2)
    low, high = (dr.gather(mi.Float, table, index + step) for step in (0, 1))
    return dr.lerp(low, high, position - mi.Float(index))
