"""A backward pass whose samples may go to any pixels: what our integrators share.

Imported only once a variant is active (see ``SceneRenderer``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import torch
from mitsuba.python.ad.integrators.common import RBIntegrator


class ChoosingIntegrator(RBIntegrator):
    """A path replay integrator that can be told which pixels to sample."""

    def propagate(
        self, scene: Any, sensor: Any, adjoint: Any, spread: Any, pixel: Any, seed: Any, spp: int
    ) -> None:
        """Carry an adjoint to the tracked parameters, from samples of given pixels.

        Parameters
        ----------
        adjoint
            What a sample of each pixel counts, a ``(H, W, 3)`` tensor.
        spread
            How far from its pixel's centre a sample lies, as a function of a random number: see ``FilmFilter``.
        pixel
            The pixel of each sample, counted along the rows.
        seed, spp
            Seed of the samples, and how many of them the sampler takes for one pixel's.
        """
        with dr.suspend_grad():
            sampler = _seeded(sensor, seed, spp, dr.width(pixel))
            ray, response, inside = _camera_rays(sensor, sampler, pixel, spread)
            emitted = dr.select(inside, response * dr.gather(mi.Color3f, adjoint.array, pixel), 0)
            *_, state = self.sample(
                mode=dr.ADMode.Primal, scene=scene, sampler=sampler.clone(), ray=ray, active=inside
            )
            self.sample(
                mode=dr.ADMode.Backward,
                scene=scene,
                sampler=sampler,
                ray=ray,
                active=inside,
                state_in=state,
                δL=emitted,
            )
            dr.eval()


def _seeded(sensor: Any, seed: Any, spp: int, samples: int) -> Any:
    sampler = sensor.sampler().clone()
    sampler.set_sample_count(spp)
    sampler.set_samples_per_wavefront(spp)
    sampler.seed(seed, samples)
    return sampler


@dataclass(frozen=True)
class FilmFilter:
    """A film's reconstruction filter as a way to draw samples for a pixel.

    Attributes
    ----------
    spread
        How far from the pixel's centre a sample lies along an axis, at 1025 even steps of a random number: the
        inverse of the filter as a distribution.
    caught
        The share of each pixel's filter that lies on the film, ``(H, W, 1)``.
    """

    spread: torch.Tensor
    caught: torch.Tensor


def film_filter(film: Any) -> FilmFilter | None:
    """Return a film's filter, or None where no sample can be drawn for one pixel: it is negative somewhere."""
    places, kernel = _kernel(film.rfilter())
    if film.sample_border() or mi.has_flag(film.flags(), mi.FilmFlags.Special) or (kernel < 0).any():
        return None
    width, height = film.crop_size()
    across, down = (_caught(places, kernel, pixels) for pixels in (width, height))
    return FilmFilter(_spread(places, kernel), torch.outer(down, across)[..., None].float())


def _kernel(rfilter: Any) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the filter at 4096 even points along an axis, as a distribution."""
    # Mitsuba's box is a little wider than a pixel, for the sake of its own way of summing.
    radius = 0.5 if rfilter.is_box_filter() else float(rfilter.radius())
    places = torch.linspace(-1, 1, 2 * 4096 + 1, dtype=torch.float64)[1::2] * radius
    kernel = rfilter.eval(mi.Float(places.float())).torch().double().cpu()
    return places, kernel / kernel.sum()


def _spread(places: torch.Tensor, kernel: torch.Tensor) -> torch.Tensor:
    half = (places[1] - places[0]) / 2
    edges = torch.cat([places - half, places[-1:] + half])
    reached = torch.cat([kernel.new_zeros(1), kernel.cumsum(0)])
    wanted = torch.linspace(0, 1, 1025, dtype=torch.float64)
    right = torch.searchsorted(reached, wanted).clamp(1, len(kernel))
    low, high = reached[right - 1], reached[right]
    share = ((wanted - low) / (high - low)).clamp(0, 1)
    return torch.lerp(edges[right - 1], edges[right], share).float()


def _caught(places: torch.Tensor, kernel: torch.Tensor, pixels: int) -> torch.Tensor:
    point = torch.arange(pixels)[:, None] + 0.5 + places
    return ((point > 0) & (point < pixels)).to(kernel) @ kernel


def _camera_rays(sensor: Any, sampler: Any, pixel: Any, spread: Any) -> tuple[Any, Any, Any]:
    """Return rays through points around pixels, what the sensor makes of them, and which lie on the film."""
    size = sensor.film().crop_size()
    centre = mi.Point2f(pixel % size.x, pixel // size.x) + 0.5
    number = sampler.next_2d()
    point = centre + mi.Point2f(_look_up(spread, number.x), _look_up(spread, number.y))
    inside = dr.all((point > 0) & (point < mi.ScalarPoint2f(size)))
    lens = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    open_for = sensor.shutter_open_time()
    time = sensor.shutter_open() + (sampler.next_1d() * open_for if open_for > 0 else 0)
    wavelength = sampler.next_1d() if mi.is_spectral else mi.Float(0)
    position = point / mi.ScalarPoint2f(size)
    return *sensor.sample_ray_differential(time, wavelength, position, lens), inside


def _look_up(table: Any, number: Any) -> Any:
    last = dr.width(table) - 1
    place = number * last
    index = dr.minimum(mi.UInt32(place), last - 1)
    low, high = (dr.gather(mi.Float, table, index + step) for step in (0, 1))
    return dr.lerp(low, high, place - mi.Float(index))
