"""A view: everything that renders a scene through one of its sensors."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial

import torch

from ..backend import SceneOwner
from ..checkpoint import Checkpoint
from ..daylight import SkyPatches
from ..projection import SurfaceMap
from ..scene import Moved, SceneParameters
from ..visualization import first_few
from ._checkpointed import CheckpointedEngine
from ._engine import Engine, StockEngine
from ._importance_maps import ImportanceMaps
from ._live_scene import LiveScene
from ._moved_materials import copy_materials, movable_materials
from ._pilot import Pilots
from ._plan import RenderPlan
from ._sky_engine import SkyEngine
from ._texels import find_textures
from ._visibility import Follow, trace_surfaces

# Maps of one scene with and without texels and mirrors, and of a few scenes in which something has moved.
CACHED_MAPS = 8


@dataclass(frozen=True)
class View(SceneOwner):
    """What renders a scene through one of its sensors."""

    live: LiveScene
    engine: Engine | CheckpointedEngine
    pilots: Pilots | None  # None for Mitsuba's own integrators
    # With these texels, through specular surfaces, where objects and the camera are moved.
    surface_map: Callable[[tuple[str, ...], Follow, Moved], SurfaceMap]

    def with_checkpoint(self, checkpoint: Checkpoint | None, fingerprint: str) -> View:
        """Return the view with an engine that uses a checkpoint, or none."""
        engine = self.engine.engine if isinstance(self.engine, CheckpointedEngine) else self.engine
        if checkpoint is None:
            return dataclasses.replace(self, engine=engine)
        checkpointed = CheckpointedEngine(engine, checkpoint, fingerprint, self.live.device)
        return dataclasses.replace(self, engine=checkpointed)

    def describe_pixels(self, pixels: torch.Tensor) -> str:
        """Return a sentence that names the objects on a mask of pixels ``(H, W)``."""
        names = self.surface_map((), "nothing", ()).objects_on(pixels.numpy(force=True))
        return f" They show {first_few(names)}: look for an extreme value there, or in the lights."


def make_view(
    live: LiveScene,
    parameters: SceneParameters,
    plan: RenderPlan,
    sky_patches: SkyPatches | None = None,
    *,
    direct_sky: bool = False,
) -> View:
    """Create what the plan requires to render a live scene, or its daylight coefficients by ``sky_patches``."""

    @lru_cache(maxsize=CACHED_MAPS)
    def surface_map(textures: tuple[str, ...], follow: Follow, moved: Moved) -> SurfaceMap:
        with live.with_values({name: torch.tensor(value) for name, value in moved}):
            lookups = list(find_textures(live, {name: parameters[name].shape for name in textures}))
            return trace_surfaces(
                live.graph, parameters, live.sensor, live.resolution, lookups, follow=follow
            )

    integrator = plan.create_integrator()
    importance_maps = ImportanceMaps(
        live, parameters, plan, integrator, partial(surface_map, (), "nothing", ())
    )
    moved = (
        copy_materials(movable_materials(live.graph, parameters, dict(plan.differences)))
        if plan.kind.path_differences and importance_maps.film and sky_patches is None
        else {}
    )
    arguments = (live, parameters, plan, integrator, importance_maps, moved)
    if sky_patches is not None:
        return View(live, SkyEngine(*arguments, patches=sky_patches, direct=direct_sky), None, surface_map)
    if plan.kind.is_stock:
        return View(live, StockEngine(*arguments), None, surface_map)
    pilots = Pilots(live, parameters, plan, integrator, importance_maps, moved)
    return View(live, Engine(*arguments), pilots, surface_map)
