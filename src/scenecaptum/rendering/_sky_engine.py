"""Daylight coefficients: the irradiance at each point of a grid, by the patch of the sky that it comes from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import torch

from ..daylight import SkyPatches
from ..errors import SceneCaptumError
from ..scene import SceneParameters, plugin_name
from ._bridge import evaluate
from ._chunks import Chunk
from ._derivative_routes import Routes, replayed_names
from ._dr_arrays import owned
from ._engine import Engine, opaque_seed
from ._frozen import FrozenFunction
from ._grid import up_axis
from ._live_scene import Values
from ._sky import PatchIndex
from ._state import Snapshot


class SkyEngine(Engine):
    """Renders daylight coefficients and their derivatives: ``(points, patches, 3)`` pictures.

    The scene's sky has a radiance of 1, and only its light counts. Every sample of a point serves all patches.
    ``direct`` leaves out the light that surfaces reflect.
    """

    def __init__(self, *arguments: Any, patches: SkyPatches, direct: bool) -> None:
        super().__init__(*arguments)
        self._sky = sky_of(self._live.scene, self._parameters)
        index, integrator = PatchIndex(patches, up_axis(self._live.scene)), self._integrator

        def render(sensor: Any, scene: Any, seed: Any, samples: Any, scalars: tuple[float, ...]) -> Any:
            return integrator.render_coefficients(scene, sensor, seed, samples, index, direct=direct)

        def differentiate(
            sensor: Any, scene: Any, adjoint: Any, seed: Any, samples: Any, scalars: tuple[float, ...]
        ) -> None:
            integrator.differentiate_coefficients(scene, sensor, adjoint, seed, samples, index, direct=direct)

        # Not a reference to the engine itself, which would keep the engine and its scene alive for ever.
        forget_gradients = self._live.state.forget_gradients

        def reset(*arguments: Any) -> None:
            forget_gradients()

        self._render_kernel = FrozenFunction(render, reset, self._live.sensor)
        self._differentiate_kernel = FrozenFunction(differentiate, reset, self._live.sensor)

    def primal(self, values: Values, seed: int, spp: int, tracked: Sequence[str] = ()) -> torch.Tensor:
        """Render the coefficients: irradiance per radiance of each patch, ``(points, patches, 3)``."""
        return super().primal(self._under_unit_sky(values), seed, spp, tracked)

    def vjp(
        self,
        values: Values,
        tracked: Sequence[str],
        adjoint: torch.Tensor,
        seed: int,
        spp: int,
        *,
        importance_sampling: bool = False,
    ) -> tuple[torch.Tensor, ...]:
        """Return the vector–Jacobian product; the samples of a point serve all patches, in any case."""
        return super().vjp(self._under_unit_sky(values), tracked, adjoint, seed, spp)

    def jvp(self, values: Values, tangents: Values, seed: int, spp: int) -> torch.Tensor:
        """Refuse: daylight coefficients have no forward mode."""
        raise SceneCaptumError(
            "Daylight coefficients have no forward mode: use backward() or an attribution method."
        )

    def _under_unit_sky(self, values: Values) -> Snapshot:
        """Return the values with a sky of radiance 1."""
        known = self._live.snapshot(values)
        ones = torch.ones_like(self._live.original[self._sky])
        return known if torch.equal(known[self._sky], ones) else known.replace({self._sky: ones})

    def _render_chunk(self, chunk: Chunk) -> Any:
        scalars = self._live.state.scalars
        return self._render_kernel(self._live.scene, opaque_seed(chunk), self._samples(chunk), scalars)

    def _samples(self, chunk: Chunk) -> tuple[Any, Any]:
        """Return the pixel that each sample starts from, whose row is its point, and the weight of a sample."""
        width, height = self._live.resolution
        lane = dr.arange(mi.UInt32, width * height * chunk.spp)
        pixel = lane // dr.opaque(mi.UInt32, chunk.spp)
        weight = dr.opaque(mi.Float, 1 / (width * chunk.spp))
        dr.eval(pixel)
        return pixel, weight

    def _replay_all_pixels(
        self, values: Snapshot, routes: Routes, adjoint: torch.Tensor, seed: int, spp: int
    ) -> dict[str, torch.Tensor]:
        """Return gradients by path replay of the primal's samples."""

        def replay(chunk: Chunk) -> None:
            image = owned(mi.TensorXf(chunk.weight * adjoint))
            scene, scalars = self._live.scene, self._live.state.scalars
            self._differentiate_kernel(scene, image, opaque_seed(chunk), self._samples(chunk), scalars)
            evaluate()

        return self._replay(replay, values, routes, replayed_names(routes), seed, spp)


def sky_of(scene: Any, parameters: SceneParameters) -> str:
    """Return the name of the radiance of a scene's sky; raise if it has none that is the same everywhere."""
    sky = scene.environment()
    if sky is None:
        raise SceneCaptumError(
            f"Daylight coefficients need a sky, and the scene has none{_so_called(parameters)}: add a constant "
            'emitter to it, {"type": "constant"}, in XML <emitter type="constant"/>.'
        )
    if sky.class_name() != "ConstantBackgroundEmitter":
        raise SceneCaptumError(
            "Daylight coefficients need a sky of the same radiance everywhere, which is not what "
            f'`{sky.id()}` ({plugin_name(sky)}) is: replace it by <emitter type="constant"/>; the weather file '
            "supplies the sky and the sun."
        )
    return next(
        name for name, one in parameters.items() if one.plugin == sky.class_name() and one.role == "radiance"
    )


def _so_called(parameters: SceneParameters) -> str:
    """Return that an emitter with such a name is none, for a scene without an environment."""
    for one in parameters.values():
        name = one.owners[0] if one.owners else ""
        if one.kind == "emitters" and "sky" in name.lower():
            kind = "an area light" if one.plugin == "AreaLight" else "another emitter"
            return f" (its `{name}` is {kind}, not a constant emitter)"
    return ""
