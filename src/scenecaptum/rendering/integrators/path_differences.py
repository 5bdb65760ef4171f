"""Finite differences of single paths, for parameters that path replay does not differentiate.

An index of refraction turns refracted paths, so that all later vertices move. Each path is traced again with the
same random numbers and with one parameter moved. Until the path meets the material of that parameter it stays the
same, so the parameters of materials that it does not meet need no second path: the work does not grow with their
number. A path that meets several materials takes the parameter of one of them at random.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .._backward import CameraAdjoint, filtered_adjoint
from .._sampler import SobolSampler

MAX_MATERIALS = 32  # bits of a number
POINTS = 3  # of a finite difference, at most


@dataclass
class MovedMaterials:
    """Materials, ``MAX_MATERIALS`` at most, and copies of them with one parameter moved, ``POINTS`` for each.

    Arrays of Dr.Jit, with the parameters sorted by material.
    """

    position: Any  # for each of Dr.Jit's BSDF indices: that in the list of materials, or MAX_MATERIALS
    first: Any  # of each material: the first of its parameters
    count: Any  # of each material: the number of its parameters
    index: Any  # of each material: Dr.Jit's BSDF index
    copies: Any  # of each parameter: the BSDF indices of its copies
    weights: Any  # of each parameter: the weights of their images


def working_arrays(lanes: int) -> tuple[Any, Any]:
    """Return zeros for the paths, and the index of each point of each path, in Dr.Jit's memory.

    They are arguments of ``difference_backward`` because a frozen function can only guess the sizes of arrays that
    it creates itself, and guesses wrong.
    """
    zeros, index = dr.zeros(mi.UInt32, lanes), dr.arange(mi.UInt32, POINTS * lanes)
    dr.make_opaque(zeros, index)
    return zeros, index


def difference_backward(
    integrator: Any,
    scene: Any,
    camera: CameraAdjoint,
    samples: tuple[Any, Any],
    seed: Any,
    arrays: tuple[Any, Any],
    moved: MovedMaterials,
) -> Any:
    """Return ``Σ adjoint · ∂image/∂parameter`` by channel, three numbers for each parameter.

    ``samples`` are those of ``AdjointSampledIntegrator.render_backward_pixels``, and ``arrays`` the
    ``working_arrays`` of as many lanes.
    """
    pixel, pixel_weight = samples
    met, point = arrays
    lanes = dr.width(pixel)
    with dr.suspend_grad():
        sampler = SobolSampler.of(lanes, seed)
        ray, *_ = integrator.random_rays(camera.sensor, sampler, pixel)
        integrator.sample(
            mode=dr.ADMode.Primal,
            scene=scene,
            sampler=sampler.clone(),
            ray=ray,
            active=mi.Bool(True),
            met=(met, moved.position, dr.arange(mi.UInt32, lanes)),
        )
        choice = sampler.fork().next_2d()
        dr.eval(met)
        material, materials = _choose_bit(met, choice.x, dr.width(moved.first))
        count_there = dr.gather(mi.UInt32, moved.count, material, materials > 0)
        parameter = dr.gather(mi.UInt32, moved.first, material, materials > 0)
        parameter += dr.minimum(mi.UInt32(choice.y * count_there), dr.maximum(count_there, 1) - 1)
        factor = mi.Float(materials * count_there)
        dr.eval(material, parameter, factor)

        # Every point of the difference is a lane, with the random numbers of the path.
        lane = point // POINTS
        copy = dr.gather(mi.UInt32, parameter, lane) * POINTS + point % POINTS
        weight = dr.gather(mi.Float, moved.weights, copy) * dr.gather(mi.Float, factor, lane)
        active = weight != 0
        sampler = SobolSampler.at(lane, seed)
        pixel = dr.gather(mi.UInt32, pixel, lane)
        ray, response, film_point = integrator.random_rays(camera.sensor, sampler, pixel)
        original = dr.gather(mi.UInt32, moved.index, dr.gather(mi.UInt32, material, lane), active)
        radiance, *_ = integrator.sample(
            mode=dr.ADMode.Primal,
            scene=scene,
            sampler=sampler,
            ray=ray,
            active=active,
            moved=(original, dr.gather(mi.UInt32, moved.copies, copy, active)),
        )
        radiance *= response * weight * dr.gather(mi.Float, pixel_weight, pixel)
        radiance *= filtered_adjoint(camera.sensor.film(), camera.adjoint, *camera.profile, pixel, film_point)
        gradient = dr.zeros(mi.Float, 3 * dr.width(moved.weights) // POINTS)
        for channel in range(3):
            dr.scatter_add(gradient, radiance[channel], copy // POINTS * 3 + channel, active)
        return gradient


def _choose_bit(bits: Any, random: Any, width: int) -> tuple[Any, Any]:
    """Return the position of one of the bits that are set, at random, and their number."""
    number = dr.popcnt(bits)
    wanted = mi.UInt32(random * number)
    position, seen = mi.UInt32(0), mi.UInt32(0)
    for candidate in range(width):
        is_set = (bits >> candidate) & 1
        position = dr.select((is_set == 1) & (seen == wanted), candidate, position)
        seen += is_set
    return position, number


def moved_bsdf(bsdf: Any, moved: tuple[Any, Any]) -> Any:
    """Return a material, or the copy that replaces it on a path."""
    original, copy = moved
    index = dr.reinterpret_array(mi.UInt32, bsdf)
    return dr.reinterpret_array(mi.BSDFPtr, dr.select(index == original, copy, index))


def mark_met(met: tuple[Any, Any, Any], bsdf: Any, active: Any) -> None:
    """Set the bit of a path's material, if it is one of those with moved copies."""
    bits, position, lane = met
    index = dr.reinterpret_array(mi.UInt32, bsdf)
    active = active & (index < dr.width(position))
    place = dr.gather(mi.UInt32, position, index, active)
    active &= place < MAX_MATERIALS
    bit, mode = mi.UInt32(1) << place, dr.ReduceMode.NoConflicts
    dr.scatter_reduce(dr.ReduceOp.Or, bits, bit, lane, active, mode)
