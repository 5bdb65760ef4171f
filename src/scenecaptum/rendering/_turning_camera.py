"""The rotation and the field of view of a pinhole camera: they only move the picture over the film."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import torch

from ..scene import pose_name
from ._backward import FilmFilter, has_independent_samples
from ._chunks import Chunk
from ._dr_arrays import owned
from ._film_motion import FilmMotion, film_samples, turning
from ._live_scene import LiveScene, Values
from ._sensors import film_corners, is_connectable
from ._state import Snapshot

ROTATION, FOV = pose_name("camera", "rotation"), pose_name("camera", "fov")

# Samples of the light that moves over the film, for each sample of a backward pass.
SAMPLES = 0.25

# Points of the film that are in memory at the same time; each takes about 300 bytes.
MAX_POINTS = 2**19


def turned_names(names: Iterable[str], sensors: Iterable[Any]) -> list[str]:
    """Return which parameters turn or zoom the camera of all sensors without a difference of renders."""
    film_only = all(_is_pinhole(sensor) and has_independent_samples(sensor) for sensor in sensors)
    return [name for name in names if name in (ROTATION, FOV) and film_only]


def _is_pinhole(sensor: Any) -> bool:
    return bool(sensor.class_name() == "PerspectiveCamera")


class TurningCamera:
    """The derivatives of a live scene's picture when its pinhole camera turns or zooms.

    ``film`` is the film's filter, None if its samples cannot be weighted; ``radiance_at`` is that of ``Kernels``.
    """

    def __init__(self, live: LiveScene, film: FilmFilter | None, radiance_at: Callable[..., Any]) -> None:
        self._live = live
        self._film = film
        self._radiance_at = radiance_at
        self._is_pinhole = _is_pinhole(live.sensor)

    def moves(self, name: str) -> bool:
        """Whether a parameter turns or zooms the camera, so that no difference of renders is needed."""
        return name in (ROTATION, FOV) and self._is_pinhole and self._film is not None

    def gradients(
        self, values: Snapshot, names: Sequence[str], adjoint: torch.Tensor, parts: Iterable[Chunk]
    ) -> dict[str, torch.Tensor]:
        """Return the gradients of the rotation and the field of view, from the light that moves."""
        if not names:
            return {}
        motion = self._motion(values)
        total: np.ndarray[Any, np.dtype[np.float64]] = np.zeros(4)
        for chunk in parts:
            total += chunk.weight * self._part(values, motion, adjoint, chunk)
        turned = turning(values[ROTATION].double().cpu().numpy()).T @ total[:3]
        found = {ROTATION: torch.from_numpy(turned), FOV: torch.tensor(total[3])}
        return {name: found[name].to(values[name]) for name in names}

    def _part(self, values: Snapshot, motion: FilmMotion, adjoint: torch.Tensor, chunk: Chunk) -> Any:
        """Return the derivatives from the samples of a chunk."""
        assert self._film is not None
        count = math.ceil(math.prod(self._live.resolution) * chunk.spp * SAMPLES)
        batches = math.ceil(count / MAX_POINTS)
        seeds = np.random.SeedSequence(chunk.seed).generate_state(2 * batches).reshape(batches, 2)
        total: Any = 0.0
        for own, light_seed in seeds.tolist():
            samples = film_samples(motion, self._film, adjoint, math.ceil(count / batches), own)
            points = torch.from_numpy(samples.points).float()
            light = self._live.call(partial(self._light, light_seed), values, None, [points])
            total = total + samples.integrate(light.double().cpu().numpy()) / batches
        return total

    def _light(self, seed: int, points: Any) -> Any:
        """Return the light at points of the film, ``(N, 3)``."""
        array, count = owned(points.array), points.shape[0]
        index = dr.arange(mi.UInt32, count)
        point = mi.Point2f(dr.gather(mi.Float, array, 2 * index), dr.gather(mi.Float, array, 2 * index + 1))
        dr.eval(point)
        scalars = self._live.state.scalars
        light = self._radiance_at(self._live.scene, dr.opaque(mi.UInt32, seed), point, scalars)
        return mi.TensorXf(dr.ravel(light), shape=(count, 3))

    def shown_at(self, place: torch.Tensor, values: Values) -> tuple[torch.Tensor, torch.Tensor] | None:
        """Return where the picture shows a place ``(3,)`` of the scene, in pixels, and how it moves, ``(2, 3)``.

        None outside the picture, or for another camera than a pinhole or a thin lens. ``values`` may move it.
        """
        if not is_connectable(self._live.sensor):
            return None
        with self._live.with_values(values):
            origin = np.array(self._live.sensor.world_transform().matrix).reshape(4, 4, -1)[:3, 3, 0]
            shown = self._motion(values).project(place.numpy() - origin)
        if shown is None or not ((shown[0] >= 0) & (shown[0] <= self._live.resolution)).all():
            return None
        return torch.from_numpy(shown[0]), torch.from_numpy(shown[1])

    def _motion(self, values: Values) -> FilmMotion:
        """Return how points of the film move, for the camera in a pose."""
        known = self._live.snapshot(values)
        found = self._live.call(partial(film_corners, self._live.sensor), known)
        corners, forward = found.cpu().double().split((3, 1))
        return FilmMotion.of(corners.numpy(), forward[0].numpy(), self._live.resolution, known[FOV].item())
