"""A view: everything that renders a scene through one of its sensors."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import torch

from ..checkpoint import Checkpoint
from ..projection import SurfaceMap
from ..scene import SceneParameters
from ._checkpointed import CheckpointedEngine
from ._engine import Engine, StockEngine
from ._importance_maps import ImportanceMaps
from ._live_scene import LiveScene
from ._pilot import Pilots
from ._plan import RenderPlan


@dataclass(frozen=True)
class View:
    """What renders a scene through one of its sensors."""

    live: LiveScene
    engine: Engine | CheckpointedEngine
    pilots: Pilots | None  # None for Mitsuba's own integrators
    surface_map: Callable[[], SurfaceMap]

    def with_checkpoint(self, checkpoint: Checkpoint | None, fingerprint: str) -> View:
        """Return the view with an engine that uses a checkpoint, or none."""
        engine = self.engine.engine if isinstance(self.engine, CheckpointedEngine) else self.engine
        if checkpoint is None:
            return dataclasses.replace(self, engine=engine)
        checkpointed = CheckpointedEngine(engine, checkpoint, fingerprint, self.live.device)
        return dataclasses.replace(self, engine=checkpointed)

    def describe_pixels(self, pixels: torch.Tensor) -> str:
        """Return a sentence that names the objects on a mask of pixels ``(H, W)``."""
        names = self.surface_map().objects_on(pixels.numpy(force=True))
        more = f" and {len(names) - 3} more" if len(names) > 3 else ""
        return f" They show {', '.join(names[:3])}{more}: look for an extreme value there, or in the lights."


def make_view(
    live: LiveScene, parameters: SceneParameters, plan: RenderPlan, surface_map: Callable[[], SurfaceMap]
) -> View:
    """Create what the plan requires to render a live scene."""
    integrator = plan.create_integrator()
    importance_maps = ImportanceMaps(live, parameters, plan, integrator, surface_map)
    arguments = (live, parameters, plan, integrator, importance_maps)
    if plan.kind.is_stock:
        return View(live, StockEngine(*arguments), None, surface_map)
    pilots = Pilots(live, parameters, integrator, importance_maps)
    return View(live, Engine(*arguments), pilots, surface_map)
