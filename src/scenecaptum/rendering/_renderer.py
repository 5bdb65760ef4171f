"""``SceneRenderer``: a scene as a differentiable torch module."""

from __future__ import annotations

import dataclasses
import math
import traceback
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, NoReturn, TypeVar, cast

import numpy as np
import torch

from ..backend import SceneOwner, device, exclusively, warn_unless_rgb
from ..camera import Camera, View
from ..checkpoint import Checkpoint, Folder, digest
from ..daylight import SkyPatches
from ..denoising import Guides
from ..errors import INPUT_NAMES, SceneCaptumError, check_seed, near_misses, whole_number
from ..finite import NotFiniteError
from ..grid import GridPoints, SensorGrid
from ..projection import SurfaceMap
from ..scene import (
    OPEN_MARGIN,
    Moved,
    Objects,
    SceneGraph,
    SceneLike,
    SceneParameters,
    Selection,
    XmlParameters,
    camera_parameters,
    check_scale,
    check_spectra,
    choose_ranges,
    discover,
    find_objects,
    format_parameters,
    has_point_lamps,
    hashable_source,
    load_scene,
    moved_pivot,
    overlaps,
    portable,
    pose_parameters,
    restored,
    scene_name,
    select,
    touching,
)
from ..visualization import pluralize
from ._autograd import RenderCall, render
from ._integrators import register_integrators
from ._memory import available, predict, require
from ._plan import RenderPlan, make_plan, with_integrator
from ._seen_lamps import FILLED, Reflection, SmallLamp
from ._sensors import (
    GRID_SIZE,
    SensorLike,
    camera_of,
    choose_sensor,
    common_resolution,
    describe_sensor,
    grid_of,
    is_grid,
    shows_a_view,
)

if TYPE_CHECKING:
    from ._visibility import Follow

T = TypeVar("T")

_NO_LAMPS = (
    "daylight coefficients are per unit radiance of the sky, which the weather sets, and leave lamps out"
)


class SceneRenderer(SceneOwner, torch.nn.Module):
    """A scene as a torch function from named parameters to an image.

    Example
    -------
    >>> renderer = SceneRenderer("cornell-box", inputs="reflectance", resolution=(32, 32), spp=4)
    >>> x = renderer.leaves()
    >>> image = renderer(x, seed=1)
    >>> image.shape
    torch.Size([32, 32, 3])
    >>> image.mean().backward()
    >>> x["left_wall.reflectance.value"].grad.shape
    torch.Size([3])

    Every call is pure: its backward pass uses the values of its own forward pass, and an ``mi.Scene`` that was
    passed in is restored, except that objects without an id get one. A graph may contain any number of renders
    and may be differentiated any number of times, but only to first order.

    Parameters
    ----------
    scene
        A path to a Mitsuba XML file, the name of a bundled scene, a Mitsuba dict, or an ``mi.Scene``.
    inputs
        The parameters to differentiate, by default ``"materials"``: a kind (``"materials"``, ``"reflectance"``,
        ``"roughness"``, ``"ior"``, ``"opacity"``, ``"surface"`` for what else materials have, such as metallic,
        sheen and clearcoat, ``"textures"``, ``"emitters"``, ``"media"``, ``"poses"``, ``"camera"``, or ``"all"``
        but the last two), a glob over parameter names, an exact name, or a list of these.
    resolution
        ``(width, height)`` in pixels; the scene's own by default. Another aspect ratio keeps the horizontal field
        of view of the scene's film and changes the vertical one, whatever the ``fov_axis`` of the sensor.
    spp
        Samples per pixel; the scene's own by default.
    max_depth
        Longest path in segments (-1: no limit); the scene's own by default.
    sensor
        Index or id of the sensor; a `View`, such as ``View(turn=30)``, a camera of the scene that is turned, moved
        or zoomed; or a type of sensor, which gets the pose of the first one and is square unless ``resolution`` is
        given: ``"fisheye"``, a 180° equidistant fisheye. A list of these renders a stack ``(cameras, H, W, 3)``,
        which the metric reduces; its results have no heatmap. ``"grid"`` or a ``SensorGrid``: irradiance at
        points of the room, a pixel for each.
    parameters
        Values for the ``$name`` placeholders of an XML file, by name: ``{"spp": 64}`` for ``$spp``.
    ranges
        Intervals ``(low, high)`` over which results compare the effects of parameters, by name, glob or kind, in
        place of those in ``parameters_table()``: ``{"wall.reflectance.*": (0.3, 0.8)}``. The derivative with
        respect to a pose is a mean over its range.
    objects
        Names or globs of shapes that move as one, by the name of the object: ``{"lamp": ["lamp_*", "bulb"]}``.
        Other shapes are grouped by the first word of their names.
    sky_patches
        With a sensor grid: the picture is then the daylight coefficients, ``(points, patches, 3)``, the irradiance
        at each point of the grid per unit radiance of each patch of the sky. See ``scenecaptum.daylight`` for
        metrics of a year. The scene needs a constant emitter as its sky; other lamps do not count, and no
        emitter is an input.
    direct_sky
        With ``sky_patches``: only the light that no surface reflects, as annual sunlight exposure needs. Panes,
        and cloth with an opacity, let it through.
    values
        Values that become the scene's own, by the name of any parameter that can be set, an input or not. What a
        pose moves is then loaded in its new place, from which that pose is 0 again. Not for an ``mi.Scene``.

    Attributes
    ----------
    inputs : dict of str to Tensor
        The selected parameters with the scene's own values: float32, a scalar 0-d, a colour ``(3,)``, a
        texture ``(H, W, C)``.
    plan : RenderPlan
        The chosen integrator, path depth and derivative methods, with reasons.
    resolution : tuple of int
        ``(width, height)``.
    spp : int
        Default samples per pixel of a render.
    name : str
        The scene's name in results.
    values : dict of str to Tensor
        Those of ``values=``.
    checkpoint : Checkpoint or None
        The folder of ``with_checkpoint``; its ``reused`` and ``rendered`` count renders and backward passes.

    Raises
    ------
    SceneCaptumError
        If the scene cannot be loaded, ``inputs`` selects nothing differentiable, ``parameters`` does not match the
        file's placeholders, or ``ranges`` has a name that matches nothing or an invalid interval.
    """

    def __init__(  # noqa: PLR0913 -- what a scene, its inputs and its picture are
        self,
        scene: SceneLike,
        inputs: Selection = "materials",
        *,
        resolution: tuple[int, int] | None = None,
        spp: int | None = None,
        max_depth: int | None = None,
        sensor: SensorLike | list[int | str | View] = 0,
        parameters: XmlParameters | None = None,
        ranges: Mapping[str, tuple[float, float]] | None = None,
        objects: Objects | None = None,
        sky_patches: SkyPatches | None = None,
        direct_sky: bool = False,
        values: Mapping[str, torch.Tensor] | None = None,
    ) -> None:
        super().__init__()
        self._arguments: dict[str, Any] = {
            "scene": scene,
            "inputs": inputs,
            "resolution": resolution,
            "spp": spp,
            "max_depth": max_depth,
            "sensor": sensor,
            "parameters": parameters,
            "ranges": ranges,
            "objects": objects,
            "sky_patches": sky_patches,
            "direct_sky": direct_sky,
            "values": values,
        }
        self.values = dict(values or {})
        self._replaced: dict[str, Any] = {}
        variant = _variant_of(scene)
        if variant is None:
            warn_unless_rgb()
        with exclusively(variant) as mi:
            self._variant, self._device = mi.variant(), device()
            self._borrowed = isinstance(scene, mi.Scene)
            self.checkpoint: Checkpoint | None = None
            self._granted_memory = 0  # bytes that were found to be available
            self.sky_patches, self.direct_sky = sky_patches, direct_sky
            if direct_sky and sky_patches is None:
                raise SceneCaptumError(
                    "direct_sky=True needs sky_patches=: it selects light of daylight coefficients."
                )
            try:
                size = self._load(scene, parameters, sensor, resolution, spp)
                self._find_parameters(inputs, ranges, objects)
                if self.values:
                    self._change_scene(self.values, size)
                    self._find_parameters(inputs, ranges, objects)
                self._prepare(size, self._plan_for(max_depth))
            except SceneCaptumError as error:
                # Free the scene now: freed together with the error, it could go while another thread renders.
                self.__dict__.clear()
                traceback.clear_frames(error.__traceback__)
                raise

    def _load(
        self,
        scene: SceneLike,
        parameters: XmlParameters | None,
        sensor: SensorLike | list[int | str | View],
        resolution: tuple[int, int] | None,
        spp: int | None,
    ) -> tuple[int, int]:
        """Load the scene with its sensors; return the resolution."""
        self.name = scene_name(scene)
        register_integrators()
        loaded = load_scene(scene, parameters)
        self._placeholders = format_parameters(parameters)
        self._source = digest((hashable_source(scene), self._placeholders))
        check_scale(self.name, loaded)
        self._graph = SceneGraph(loaded)
        check_spectra(self.name, self._graph.class_names())
        self._stacked = isinstance(sensor, list)
        chosen: list[Any] = sensor if isinstance(sensor, list) else [sensor]
        if len(chosen) > 1 and any(which == "grid" or isinstance(which, SensorGrid) for which in chosen):
            raise SceneCaptumError(
                "A sensor grid is a renderer's only sensor: create another renderer for views."
            )
        self._sensors = [choose_sensor(loaded, which, resolution, self.sky_patches) for which in chosen]
        size = common_resolution(self._sensors, resolution)
        self.spp = whole_number("spp", self._sensors[0].sampler().sample_count() if spp is None else spp)
        return size

    def _find_parameters(
        self, inputs: Selection, ranges: Mapping[str, tuple[float, float]] | None, objects: Objects | None
    ) -> None:
        """List the parameters of the scene and what can be moved, and select the inputs."""
        from ._poses import Poses, moving_camera, moving_objects  # which need an active variant
        from ._state import SceneState

        found = find_objects(self._graph, objects)
        camera = moving_camera(self._sensors)
        in_scene = discover(self._graph, found)
        moving = [*found, camera.object]
        self._objects = {one.name: one for one in moving}
        table = SceneParameters(
            [*in_scene.values(), *pose_parameters(found), *camera_parameters(camera.object)]
        )
        if self.sky_patches is not None:
            table = table.without_derivatives("emitters", _NO_LAMPS)
        self._names = select(table, inputs)
        self._ranges = choose_ranges(table, self._names, ranges or {})
        self._table = table.with_ranges(self._ranges)
        writable = {name: p for name, p in in_scene.items() if not p.problem}
        self._state = SceneState(
            self._graph.scene,
            {name: p.shape for name, p in writable.items()},
            [name for name, p in writable.items() if not p.is_used],
            Poses([*moving_objects(self._graph.scene, found), camera]),
        )
        self._state.enable_lobes([name for name, p in writable.items() if p.plugin.startswith("Principled")])

    def _change_scene(self, values: Mapping[str, torch.Tensor], size: tuple[int, int]) -> None:
        """Make these values the scene's own, as if it had been loaded with them."""
        from ._live_scene import LiveScene

        if self._borrowed:
            raise SceneCaptumError(
                "values= changes the scene, and an mi.Scene belongs to you: set its values with mi.traverse."
            )
        for name, value in values.items():
            self._check_tensor(name, value)
        self._check_values(values)
        live = LiveScene(self._graph, self._sensors[0], self._state, size, borrowed=False)
        with live.with_values(values):
            pass  # the scene keeps them
        self._graph = SceneGraph(self._graph.scene)

    def _plan_for(self, max_depth: int | None) -> RenderPlan:
        if max_depth is not None and max_depth != -1:
            whole_number("max_depth", max_depth, high=2**31 - 1)
        return make_plan(
            self._graph, self._table, self._state.original, self._names, max_depth, self._sensors
        )

    def _prepare(self, resolution: tuple[int, int], plan: RenderPlan) -> None:
        """Create a view for each sensor, all on the same scene."""
        from ._guides import LastGuides
        from ._live_scene import LiveScene
        from ._view import make_view

        if self.has_grid and not plan.kind.sensor_grids:
            raise SceneCaptumError(
                f"A sensor grid cannot be rendered by {plan.integrator}: use a scene without participating media, "
                "and the default integrator."
            )
        self.resolution = resolution
        self.plan = dataclasses.replace(plan, memory=self.memory(pictures=1))
        self._views = [
            make_view(
                LiveScene(self._graph, sensor, self._state, resolution, borrowed=self._borrowed),
                self._table,
                self.plan,
                self.sky_patches,
                direct_sky=self.direct_sky,
            )
            for sensor in self._sensors
        ]
        # A medium attenuates the light of lamps.
        shows_lamps = not (plan.hide_emitters or plan.kind.media)
        self._guides = LastGuides([view.live for view in self._views], self._stacked, shows_lamps)
        self._attach_checkpoint()

    def _attach_checkpoint(self) -> None:
        """Let the engines use this renderer's checkpoint, or none."""
        fingerprints = self._fingerprints() if self.checkpoint is not None else [""] * len(self._views)
        self._views = [
            view.with_checkpoint(self.checkpoint, fingerprint)
            for view, fingerprint in zip(self._views, fingerprints, strict=True)
        ]

    def with_checkpoint(self, checkpoint: Folder) -> SceneRenderer:
        """Return this renderer with a folder that stores every render and backward pass; None for no folder.

        Stored results are not computed again, in this process or another, so that a killed job can be resumed.
        ``checkpoint=`` of the attribution methods does this for one call.

        Example
        -------
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     renderer = SceneRenderer("cornell-box", resolution=(8, 8), spp=1).with_checkpoint(folder)
        ...     _ = renderer(seed=1), renderer(seed=1), renderer(seed=2)
        >>> renderer.checkpoint.rendered, renderer.checkpoint.reused
        (2, 1)

        Raises
        ------
        SceneCaptumError
            If the folder cannot be written.
        """
        if checkpoint is not None and not isinstance(checkpoint, Checkpoint):
            checkpoint = Checkpoint(checkpoint)
        other = self._shallow_copy()
        other.checkpoint = checkpoint
        other._attach_checkpoint()
        return other

    def _shallow_copy(self) -> SceneRenderer:
        """Return another renderer of the same scene, with its own module hooks."""
        other = type(self).__new__(type(self))
        other.__dict__.update(self.__dict__)
        torch.nn.Module.__init__(other)
        return other

    def memory(self, *, spp: int | None = None, pictures: int = 1) -> int:
        """Return an upper bound on the bytes that rendering and differentiating will allocate.

        Example
        -------
        >>> renderer = SceneRenderer("cornell-box", resolution=(1920, 1080), spp=64)
        >>> renderer.memory(pictures=8) < 4 * 2**30
        True

        Parameters
        ----------
        spp
            Samples per pixel of each image; the renderer's by default.
        pictures
            Number of images held at the same time: the ``replicates`` of an attribution.
        """
        return predict(*self._sizes(spp, pictures))

    def require_memory(self, *, spp: int | None = None, pictures: int = 1) -> None:
        """Raise if ``memory`` with ``spp`` and ``pictures`` exceeds what is available; name what would fit."""
        sizes = self._sizes(spp, pictures)
        if (needed := predict(*sizes)) > self._granted_memory:
            require(*sizes, available() if self._device.type == "cpu" else None)
            # Memory allocated by an earlier call counts as used but can be reused.
            self._granted_memory = needed

    def _sizes(self, spp: int | None, pictures: int) -> tuple[tuple[int, int], int, int, list[int]]:
        width, height = self.resolution
        sizes = [self._state.original[name].numel() for name in self._names]
        return (width * len(self._sensors), height), self.spp if spp is None else spp, pictures, sizes

    def _fingerprints(self) -> list[str]:
        """Return for each sensor a hash of everything that its images depend on, except values, seed and spp."""
        from ._checkpointed import fingerprint, scene_contents

        plan = self.plan
        settings = {
            "source": self._source,
            "integrator": plan.integrator,
            "depths": (plan.max_depth, plan.rr_depth),
            "hide_emitters": plan.hide_emitters,
            "resolution": self.resolution,
            **({"direct_sky": True} if self.direct_sky else {}),
            "poses": {
                n: (self._ranges[n], self._table[n].shapes) for n in self._names if self._table[n].moves
            },
        }
        with self._views[0].live.with_values({}):
            scene = scene_contents(self._graph.scene)
            return [fingerprint(scene, sensor, settings) for sensor in self._sensors]

    def replace(
        self,
        *,
        resolution: tuple[int, int] | None = None,
        max_depth: int | None = None,
        integrator: str | None = None,
    ) -> SceneRenderer:
        """Return a renderer with other settings that shares this renderer's scene and inputs.

        Example
        -------
        >>> renderer = SceneRenderer("cornell-box", resolution=(32, 32), max_depth=6)
        >>> renderer.replace(max_depth=2).plan.max_depth
        2

        Parameters
        ----------
        resolution, max_depth
            As for the constructor; this renderer's by default.
        integrator
            The name of a Mitsuba plugin: ``"prb"`` for Mitsuba's own path replay (``prbvolpath`` where there is a
            medium) and its uncorrected derivatives, for comparison; or an integrator of your own, see the page on
            extending.

        Raises
        ------
        SceneCaptumError
            If a setting is invalid.
        """
        with exclusively(self._variant):
            if resolution is not None and self.has_grid:
                raise SceneCaptumError(GRID_SIZE)
            size = self.resolution if resolution is None else common_resolution(self._sensors, resolution)
            given = {"resolution": resolution, "max_depth": max_depth, "integrator": integrator}
            replaced = {**self._replaced, **{k: v for k, v in given.items() if v is not None}}
            depth = replaced.get("max_depth", self._arguments["max_depth"])
            # From the start: a plan for another integrator lacks what that does not need.
            unchanged = max_depth is None and integrator is None
            plan = self.plan if unchanged else self._plan_for(depth)
            wanted = self.plan.integrator if integrator is None else integrator
            if wanted != plan.integrator:
                surfaces = [name for name in self._names if self._table[name].is_of_surface]
                plan = with_integrator(plan, wanted, surfaces)
            other = self._shallow_copy()
            other._replaced = replaced
            other._prepare(size, plan)
        return other

    @property
    def recipe(self) -> Callable[[], SceneRenderer]:
        """A function that makes the same renderer in another process; it can be pickled.

        Raises
        ------
        SceneCaptumError
            If the scene is an ``mi.Scene``, or has something that cannot be sent.
        """
        arguments = {**self._arguments, "scene": portable(self._arguments["scene"])}
        return partial(_make, arguments, self._replaced, self._variant)

    @property
    def inputs(self) -> dict[str, torch.Tensor]:
        """The selected parameters with the scene's own values, as new detached copies at each access."""
        values = self._own_values()
        return {name: values[name].clone().to(self._device) for name in self._names}

    def _own_values(self) -> dict[str, torch.Tensor]:
        """Return the scene's own values, which the owner of a borrowed scene may have changed."""
        self._views[0].live.refresh_originals()
        return self._state.original

    def own_value(self, name: str) -> torch.Tensor:
        """Return the scene's own value of any parameter that can be set, an input or not, as a detached copy.

        Raises
        ------
        SceneCaptumError
            If the scene has no such parameter, or it cannot be set.
        """
        own = self._own_values()
        self._check_tensor(name, own.get(name, torch.zeros(())))
        return own[name].clone().to(self._device)

    def held_values(self, values: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Return equal tensors that the renderer holds, for many renders: it need not compare them each time.

        Do not change them.
        """
        for name, value in values.items():
            self._check_tensor(name, value)
        tensors = {n: value.detach().to(self._device, torch.float32) for n, value in values.items()}
        snapshot = self._views[0].live.snapshot(tensors)
        return {name: snapshot[name].to(value.dtype) for name, value in values.items()}

    def leaves(self) -> dict[str, torch.Tensor]:
        """Return ``inputs`` as leaves that require grad."""
        return {name: value.requires_grad_() for name, value in self.inputs.items()}

    def clamp_(self, leaves: Mapping[str, torch.Tensor]) -> None:
        """Move values beyond the physical bounds back to these, in place: after each step of an optimizer.

        Example
        -------
        >>> renderer = SceneRenderer("cornell-box", inputs="reflectance", resolution=(16, 16), spp=1)
        >>> leaves = renderer.leaves()
        >>> with torch.no_grad():
        ...     leaves["left_wall.reflectance.value"] += 2.0
        >>> renderer.clamp_(leaves)
        >>> leaves["left_wall.reflectance.value"].max()
        tensor(1., grad_fn=<MaxBackward1>)

        An open bound, such as 0 of a roughness, is kept at a small distance.

        Raises
        ------
        SceneCaptumError
            If a name is not that of a parameter.
        """
        for name, value in leaves.items():
            bounds = self._table[name].bounds
            low = bounds.low + (OPEN_MARGIN if bounds.open_low else 0.0)
            with torch.no_grad():
                value.clamp_(low, bounds.high)

    @property
    def bounds(self) -> dict[str, tuple[float, float]]:
        """The physical bounds of each input, infinite where there are none."""
        return {n: (self._table[n].bounds.low, self._table[n].bounds.high) for n in self._names}

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """The interval over which the effect of each input is compared.

        An infinite one stands for 0 to the value of the input, or 0 to 1 if that is 0.
        """
        return dict(self._ranges)

    @property
    def labels(self) -> dict[str, str]:
        """A readable name for each input."""
        return {name: self._table[name].label for name in self._names}

    def shown_moves(
        self, names: Iterable[str] | None = None, values: Mapping[str, torch.Tensor] | None = None
    ) -> dict[str, tuple[list[float], list[list[float]]]]:
        """Return where the picture shows the objects of translations, and how these move them there.

        Parameters
        ----------
        names
            Parameters; those that are no translations of objects in the picture are left out. All inputs by
            default.
        values
            Values by parameter name: objects and the camera are where their poses move them.

        Returns
        -------
        dict
            By name: a point in pixels, and its ``(2, 3)`` derivative with respect to the translation. Empty for
            a list of sensors, a sensor grid, and other cameras than a pinhole or a thin lens.
        """
        if self._stacked or not self.shows_a_view:
            return {}
        poses = {name: torch.tensor(value) for name, value in self._moved(values)}
        moves: dict[str, tuple[list[float], list[list[float]]]] = {}
        wanted = self._names if names is None else names
        for parameter in (self._table[name] for name in wanted if name in self._table):
            one = self._objects.get(parameter.owners[0]) if parameter.role == "translation" else None
            if parameter.moves and one is not None and one.name != "camera":
                place, along = moved_pivot(one, self._objects, poses)
                if shown := self._views[0].engine.camera.shown_at(place, poses):
                    moves[parameter.name] = shown[0].tolist(), (shown[1] @ along).tolist()
        return moves

    @property
    def rendered_separately(self) -> tuple[str, ...]:
        """The inputs whose derivatives take renders of their own: poses."""
        return tuple(
            n for n in self._names if self._table[n].moves and not self._views[0].engine.camera.moves(n)
        )

    @property
    def vectors(self) -> tuple[str, ...]:
        """The inputs that are vectors in space: translations and rotations."""
        return tuple(name for name in self._names if self._table[name].moves and self._table[name].shape)

    @property
    def camera(self) -> Camera:
        """Ray direction and solid angle of each pixel.

        Raises
        ------
        SceneCaptumError
            For a list of sensors: use ``cameras``.
        """
        if self._stacked:
            raise SceneCaptumError(
                f"This renderer has a list of {len(self._sensors)} sensors: renderer.cameras lists their cameras."
            )
        return self.cameras[0]

    @property
    def grid(self) -> GridPoints:
        """The points of a renderer with a sensor grid: what each pixel measures.

        Of daylight coefficients, each row of the picture is a point inside, in the order of the grid.

        Raises
        ------
        SceneCaptumError
            If the renderer has another sensor.
        """
        return grid_of(self._sensors[0])

    @property
    def up(self) -> int:
        """The axis of the scene that points up, 0 (x) to 2 (z): the nearest to the first camera's up vector.

        A camera is taken as loaded, wherever a pose may have turned it.
        """
        from ._grid import up_axis

        with self._views[0].live.with_values({}):
            return up_axis(self._graph.scene)

    @property
    def shows_a_view(self) -> bool:
        """Whether neighbouring pixels show neighbouring directions, as in a picture.

        Those of a sensor grid and of an irradiance meter do not.
        """
        return all(shows_a_view(sensor) for sensor in self._sensors)

    @property
    def has_point_lamps(self) -> bool:
        """Whether the scene has point, spot or IES lamps, which light it and which no camera sees."""
        with exclusively(self._variant):
            return has_point_lamps(self._graph.scene)

    def small_lamps(self, values: Mapping[str, torch.Tensor] | None = None) -> dict[str, SmallLamp]:
        """Return the lamps that the camera sees, through panes too, but that cover less than half of any pixel.

        By the names of their objects; none where ``surfaces`` is None. Objects, camera and lights are as in
        ``values``.
        """
        from ._lamps import visible_lamps

        if (surfaces := self._surface_map((), values, follow="transmitted")) is None:
            return {}
        moved = {name: torch.tensor(value) for name, value in self._moved(values)}
        live = self._views[0].live
        with live.with_values(moved | self._lit(values or {})):
            small = {
                name: shape for name, shape in self._lamps().items() if surfaces.mask(name).max() < FILLED
            }
            return visible_lamps(self._graph.scene, live.sensor, camera_of(live.sensor), small)

    def lamp_coverage(self, values: Mapping[str, torch.Tensor] | None = None) -> dict[str, torch.Tensor]:
        """Return the fraction of each pixel that each lamp and the sky cover, ``(H, W)``, but for ``small_lamps``.

        Also through panes, without what these reflect, and in mirrors. The sky has the name of its emitter.
        ``values`` are as in ``small_lamps``.
        """
        if (surfaces := self._surface_map((), values, follow="transmitted")) is None:
            return {}
        with exclusively(self._variant):
            masks = {name: torch.from_numpy(surfaces.mask(name)) for name in self._lamps()}
            sky = self._graph.background()
        if sky:
            masks[_sky_name(surfaces)] = torch.from_numpy(surfaces.mask(surfaces.objects[-1]))
        return {name: mask for name, mask in masks.items() if mask.max() >= FILLED}

    def direct_light(self, values: Mapping[str, torch.Tensor] | None = None) -> dict[str, torch.Tensor]:
        """Return the radiance that each lamp and the sky send to each pixel directly, ``(H, W, 3)``.

        Also through panes and by way of mirrors, with what these absorb. By the names of the objects that
        ``see_through`` shows; empty where that is None. ``values`` are as for a render.
        """
        from ._direct_light import trace_light

        return self._traced(trace_light, values)

    def reflections(self, values: Mapping[str, torch.Tensor] | None = None) -> dict[str, Reflection]:
        """Return what the camera sees of lamps and the sky by way of panes, which transmit light, too.

        By the names of ``lamp_coverage``. ``values`` are as for a render.
        """
        from ._direct_light import trace_reflections

        if (surfaces := self.surfaces) is None:
            return {}
        names = {surfaces.objects[-1]: _sky_name(surfaces)}
        reflections = self._traced(trace_reflections, values)
        return {names.get(name, name): one for name, one in reflections.items()}

    def _traced(
        self,
        trace: Callable[[SceneGraph, Any, tuple[int, int]], dict[str, T]],
        values: Mapping[str, torch.Tensor] | None,
    ) -> dict[str, T]:
        if self._stacked or not self.shows_a_view:
            return {}
        live = self._views[0].live
        with live.with_values(self._changed(values or {})):
            return trace(self._graph, live.sensor, live.resolution)

    def _changed(self, values: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Return the values among ``values`` that differ from those of the scene as loaded."""
        return {
            name: value.detach().clone()
            for name, value in values.items()
            if name in self._state.original and not self._state.is_original(name, value)
        }

    def _lamps(self) -> dict[str, Any]:
        """Return the shapes that emit light, by name."""
        return {name: shape for name, shape, _ in self._graph.shapes() if shape.is_emitter()}

    @property
    def has_grid(self) -> bool:
        """Whether the pixels are the points of a sensor grid, ``grid``."""
        return is_grid(self._sensors[0])

    @property
    def cameras(self) -> list[Camera]:
        """The camera of every sensor, as loaded."""
        return self._of_sensors(camera_of, {})

    def _of_sensors(self, describe: Callable[[Any], T], values: Mapping[str, torch.Tensor] | None) -> list[T]:
        """Describe every sensor where the poses among ``values`` move it."""
        moved = {name: torch.tensor(value) for name, value in self._moved(values)}
        described = []
        for view in self._views:
            with view.live.with_values(moved):
                described.append(describe(view.live.sensor))
        return described

    @property
    def info(self) -> dict[str, Any]:
        """The settings of this renderer as plain values, for the ``info`` of results."""
        return self.info_of({})

    def info_of(self, values: Mapping[str, torch.Tensor]) -> dict[str, Any]:
        """Return ``info`` with the camera where the poses among ``values`` move it."""
        sensors = "; ".join(self._of_sensors(describe_sensor, values)) if self.shows_a_view else ""
        return {
            "scene": self.name,
            **({"parameters": self._placeholders.copy()} if self._placeholders else {}),
            **({"values": {n: _mean_of_texels(v) for n, v in self.values.items()}} if self.values else {}),
            "resolution": list(self.resolution),
            **({"sensor": sensors} if sensors else {}),
            "integrator": self.plan.integrator,
            "max_depth": self.plan.max_depth,
            "variant": self._variant,
            "cautions": dict(self.plan.cautions),
            "noisy_roughness": list(self.plan.noisy_roughness),
            "left_out": {name: p.why_left_out for name, p in self._table.items() if p.why_left_out},
        }

    @property
    def parameters(self) -> SceneParameters:
        """All parameters of the scene with kind, shape, bounds, owner and status; prints as a table."""
        return self._table

    def parameters_table(self) -> SceneParameters:
        """Return ``parameters``."""
        return self._table

    def _apply(self, fn: Callable[[torch.Tensor], torch.Tensor], recurse: bool = True) -> SceneRenderer:
        """Refuse another type or device than that of images; torch calls this for ``to``, ``double`` and more."""
        own = torch.zeros((), device=self._device)
        wanted = fn(own)
        if (wanted.dtype, wanted.device) != (own.dtype, own.device):
            raise SceneCaptumError(
                f"A SceneRenderer with the variant {self._variant} renders in {own.dtype} on {own.device}, not in "
                f"{wanted.dtype} on {wanted.device}. Convert the image instead, or load it under another variant."
            )
        return self

    @property
    def surfaces(self) -> SurfaceMap | None:
        """The objects that each pixel shows; None for a list of sensors, a sensor grid or an irradiance meter."""
        return self._surface_map(())

    def mask(self, objects: str | Collection[str]) -> torch.Tensor:
        """Return the fraction of each pixel that shows these objects, for metrics with a ``mask``.

        Example
        -------
        >>> from scenecaptum import metrics
        >>> renderer = SceneRenderer("cornell-box", resolution=(32, 32), spp=4)
        >>> of_the_boxes = metrics.MeanLuminance(mask=renderer.mask("*_box_shape"))
        >>> of_the_boxes(renderer()).shape
        torch.Size([])

        Parameters
        ----------
        objects
            Name of an object, a glob over names such as ``"chair*"``, or several of these.

        Returns
        -------
        Tensor
            ``(H, W)``, from 0 to 1; ``(cameras, H, W)`` for a list of sensors.

        Raises
        ------
        SceneCaptumError
            If a name matches no object of the scene.
        """
        if not self.shows_a_view:
            raise SceneCaptumError("The pixels of this sensor show no objects, so it has no mask of them.")
        maps = [view.surface_map((), "nothing", ()) for view in self._views]
        masks = torch.stack([torch.from_numpy(surfaces.mask(objects)) for surfaces in maps]).to(self._device)
        return masks if self._stacked else masks[0]

    def surfaces_with_texels(
        self, names: Iterable[str] | None = None, values: Mapping[str, torch.Tensor] | None = None
    ) -> SurfaceMap | None:
        """Return ``surfaces`` with the texels that each pixel shows, of the named parameters, or of all inputs.

        Parameters
        ----------
        names
            Parameters with texels of bitmaps or of the environment map, or with attributes of a mesh;
            others are ignored. All inputs by default.
        values
            Values by parameter name: objects and the camera are where their poses move them.
        """
        return self._surface_map(names, values)

    def see_through(
        self, names: Iterable[str] | None = None, values: Mapping[str, torch.Tensor] | None = None
    ) -> SurfaceMap | None:
        """Return the objects that each pixel shows in mirrors and behind glass; None for a list of sensors.

        Rays continue at specular surfaces, up to 12 times, to the first surface that scatters or emits light.
        Where a surface reflects and transmits, its fraction of a pixel is split as its light is. Absorption is
        ignored, so that fractions sum to 1. ``heatmap(surfaces=…)`` paints on the map. ``names`` and
        ``values`` are as in ``surfaces_with_texels``.
        """
        return self._surface_map(names, values, follow="split")

    @property
    def guides(self) -> Guides:
        """Images without noise, for a denoiser: ``(H, W, 3)``, or ``(cameras, H, W, 3)`` for a list.

        Albedo and normals are those of the first surface that scatters light, through mirrors and glass; the
        emission is that of the first surface. All have the scene's own values.
        """
        return self.guides_of({})

    def guides_of(self, values: Mapping[str, torch.Tensor]) -> Guides:
        """Return ``guides`` with objects, camera and lights as in ``values``; materials are the scene's own."""
        from ._guides import Shown

        return self._guides.of(values, Shown(self._moved(values), self._lit(values)))

    def _lit(self, values: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Return the values of lights among ``values`` that differ from those of the scene as loaded."""
        return {
            name: value
            for name, value in self._changed(values).items()
            if self._table[name].kind == "emitters" and not self._table[name].moves
        }

    def _moved(self, values: Mapping[str, torch.Tensor] | None) -> Moved:
        """Return the poses among ``values`` that differ from those of the scene as loaded."""
        return tuple(
            (name, tuple(value.tolist()) if value.ndim else value.item())
            for name, value in (values or {}).items()
            if name in self._table and self._table[name].moves and not self._state.is_original(name, value)
        )

    def _surface_map(
        self,
        names: Iterable[str] | None,
        values: Mapping[str, torch.Tensor] | None = None,
        *,
        follow: Follow = "nothing",
    ) -> SurfaceMap | None:
        """Return the sensor's surface map with the texels of these inputs; None where pixels show no view."""
        if self._stacked or not self.shows_a_view:
            return None
        wanted = self._names if names is None else names
        in_scene = (name for name in wanted if name in self._state.original)
        textures = tuple(name for name in in_scene if len(self._table[name].shape) in (2, 3))
        return self._views[0].surface_map(textures, follow, self._moved(values))

    def forward(
        self,
        inputs: Mapping[str, torch.Tensor] | None = None,
        *,
        seed: int = 0,
        spp: int | None = None,
        seed_grad: int | None = None,
        spp_grad: int | None = None,
    ) -> torch.Tensor:
        """Render the scene.

        Parameters
        ----------
        inputs
            Values by parameter name; other parameters keep the scene's values.
        seed
            Seed of the samples.
        spp
            Samples per pixel; the renderer's by default.
        seed_grad
            Seed of the backward pass. By default the same samples are replayed, so that the gradient is that of
            the very image that was rendered. With a ``seed_grad`` other than ``seed``, the backward pass has
            independent samples, and importance-samples pixels by the adjoint. Pass one to fit a target: with the
            same samples, the gradient of a loss that is not linear in each pixel, such as
            ``((image - target) ** 2).mean()``, is biased by the noise, and the fit converges to wrong values.
        spp_grad
            Samples per pixel of the backward pass; ``spp`` by default.

        Returns
        -------
        Tensor
            ``(H, W, 3)`` linear radiance, float32; ``(cameras, H, W, 3)`` for a list of sensors.

        Raises
        ------
        SceneCaptumError
            Before anything is rendered, if a name is unknown, a shape is wrong or a value is unphysical.
        """
        if inputs is not None and not isinstance(inputs, Mapping):
            raise SceneCaptumError(
                f"A renderer takes a dict from parameter name to tensor, such as renderer.inputs, not "
                f"{type(inputs).__name__}."
            )
        given = dict(inputs or {})
        for name, value in given.items():
            self._check_tensor(name, value)
        seed = check_seed("seed", seed)
        seed_grad = seed if seed_grad is None else check_seed("seed_grad", seed_grad)
        spp = whole_number("spp", self.spp if spp is None else spp)
        spp_grad = spp if spp_grad is None else whole_number("spp_grad", spp_grad)
        self.require_memory(spp=max(spp, spp_grad))
        tensors = [value.to(self._device, torch.float32) for value in given.values()]
        is_tracked = torch.is_grad_enabled()
        tracked = tuple(name for name, value in given.items() if is_tracked and value.requires_grad)
        try:
            images = [
                render(
                    RenderCall(
                        view=view,
                        names=tuple(given),
                        seed=_seed_of_camera(seed, number),
                        seed_grad=_seed_of_camera(seed_grad, number),
                        spp=spp,
                        spp_grad=spp_grad,
                        importance_sampling=seed_grad != seed,
                        tracked=tracked,
                        check=self._check_values,
                    ),
                    *tensors,
                )
                for number, view in enumerate(self._views)
            ]
        except NotFiniteError as error:
            causes = [f" {name!r} may be the cause: {p.fault}." for name, p in self._table.items() if p.fault]
            raise NotFiniteError(f"{error}{''.join(causes[:3])}") from error
        return torch.stack(images) if self._stacked else images[0]

    def derivative_image(
        self,
        name: str,
        direction: torch.Tensor | None = None,
        *,
        inputs: Mapping[str, torch.Tensor] | None = None,
        seed: int = 0,
        spp: int | None = None,
    ) -> torch.Tensor:
        """Return the derivative of each pixel with respect to a parameter, ``∂I/∂θ``, in forward mode.

        Example
        -------
        >>> renderer = SceneRenderer("cornell-box", resolution=(32, 32), spp=4)
        >>> renderer.derivative_image("floor.reflectance.value", torch.tensor([1.0, 0.0, 0.0])).shape
        torch.Size([32, 32, 3])

        It is the derivative of the very image that ``renderer(inputs, seed=seed, spp=spp)`` returns.

        Parameters
        ----------
        name
            The parameter: an input, or any other that can be differentiated.
        direction
            Direction of the derivative, of the parameter's shape; ones by default.
        inputs
            Values at which the derivative is computed; the scene's own by default.
        seed, spp
            As for a render.

        Returns
        -------
        Tensor
            Like a render, per unit of ``direction``.

        Raises
        ------
        SceneCaptumError
            If the parameter is unknown or not differentiable, or a shape or value is wrong.
        """
        given = dict(inputs or {})
        value = given.pop(name, self._own_values().get(name, torch.zeros(())))
        self._check_tensor(name, value)
        direction = torch.ones_like(value) if direction is None else direction.to(value)
        if direction.shape != value.shape:
            raise SceneCaptumError(
                f"direction has shape {tuple(direction.shape)}, but {name!r} has {tuple(value.shape)}."
            )

        def image(moving: torch.Tensor) -> torch.Tensor:
            return cast(torch.Tensor, self({**given, name: moving}, seed=seed, spp=spp))

        return cast(torch.Tensor, torch.func.jvp(image, (value,), (direction,))[1])

    def effective_samples(
        self,
        values: Mapping[str, torch.Tensor],
        adjoint: torch.Tensor,
        *,
        spp: int | None = None,
        replicates: int = 1,
    ) -> dict[str, float]:
        """Return the effective number of samples behind the variance of each gradient.

        A gradient is a sum of contributions of single paths. If these are many and similar, the spread of a few
        replicates estimates its error. If most of the variance comes from a few bright paths, replicates are
        likely to miss them and still agree with each other, so a low number means that the standard error is
        unreliable. Contributions ``c`` have an effective number of ``(Σc²)² / Σc⁴``, the inverse of the excess
        kurtosis of their sum. It is estimated from a pilot render of the light that each parameter acts on, at
        the scene's own values; black surfaces and lamps that are off have small values instead.

        Parameters
        ----------
        values
            The differentiated parameters and their values.
        adjoint
            The derivative of a metric with respect to the image, of the image's shape.
        spp, replicates
            Samples per pixel of a replicate, the renderer's by default, and number of replicates.

        Returns
        -------
        dict
            By parameter; 0 if no path of the pilot hit it. Media are left out, and low roughnesses that are
            differentiated by light tracing.

        References
        ----------
        Kish, "Survey Sampling", 1965, section 8.2 (effective sizes of weighted samples).
        """
        spp = whole_number("spp", self.spp if spp is None else spp)
        adjoints = adjoint if self._stacked else [adjoint]
        cumulants = [
            view.pilots.cumulants(values, tuple(values), camera_adjoint, spp, replicates)
            if view.pilots
            else {}
            for view, camera_adjoint in zip(self._views, adjoints, strict=True)
        ]
        variances, fourths = (
            {name: sum(camera[name][index] for camera in cumulants) for name in cumulants[0]}
            for index in range(2)
        )
        return {
            name: variance**2 / fourths[name] if fourths[name] else 0.0
            for name, variance in variances.items()
        }

    def step_changes(
        self,
        values: Mapping[str, torch.Tensor],
        adjoint: torch.Tensor,
        *,
        seeds: Sequence[int],
        spp: int,
        names: Collection[str] | None = None,
    ) -> dict[str, torch.Tensor]:
        """Return by how much the gradient of each pose changes if the step of its difference is doubled.

        Parameters
        ----------
        values
            The differentiated parameters and their values.
        adjoint
            The derivative of a metric with respect to the image.
        seeds, spp
            The seed of each replicate, and the samples per pixel of each.
        names
            The poses to measure; by default all that are among ``values``.

        Returns
        -------
        dict
            ``(replicates, …)`` tensors by the names of the poses among ``values``, with the shapes of the poses.
        """
        engine = self._views[0].engine
        wanted = values if names is None else [name for name in values if name in names]
        moving = [name for name in wanted if self._table[name].moves and not engine.camera.moves(name)]
        return engine.step_changes(values, moving, adjoint, seeds, spp) if moving else {}

    def range_changes(
        self,
        values: Mapping[str, torch.Tensor],
        directions: Mapping[str, torch.Tensor],
        adjoint: torch.Tensor,
        *,
        seeds: Sequence[int],
        spp: int,
    ) -> dict[str, torch.Tensor]:
        """Return the mean gradient over the range of each pose whose gradient is that at its value.

        Parameters
        ----------
        values
            The differentiated parameters and their values.
        directions
            A unit vector for each pose, 1 or -1 for a number. Only the rotation and the field of view of a pinhole
            camera have gradients at their values; other poses are left out.
        adjoint
            The derivative of a metric with respect to the image.
        seeds, spp
            The seed of each replicate, and the samples per pixel of each.

        Returns
        -------
        dict
            ``(replicates,)`` tensors: derivatives in the directions, from the differences over the ranges.
        """
        engine = self._views[0].engine
        local = {name: one for name, one in directions.items() if engine.camera.moves(name)}
        return engine.range_changes(values, local, adjoint, seeds, spp) if local else {}

    def collisions(self, values: Mapping[str, torch.Tensor]) -> list[tuple[str, str]]:
        """Return the poses among ``values`` of objects whose bounds overlap others, each with the other's name."""
        own = {name: value for name, value in self._own_values().items() if self._table[name].moves}
        owners = {name: self._table[name].owners[0] for name in values if self._table[name].moves}
        if not owners:
            return []
        pairs = overlaps(self._objects.values(), {**own, **values}, set(owners.values()))
        return [(name, other) for name, owner in owners.items() for mover, other in pairs if mover == owner]

    def touching(self, name: str) -> list[str]:
        """Return the objects whose bounds touch those of the object that a pose moves, within twice its range."""
        parameter = self._table[name]
        mover = self._objects[parameter.owners[0]]
        # From the middle of the range; also an object at exactly this distance, in spite of rounding.
        reach = 1.001 * (parameter.range.high - parameter.range.low)
        if parameter.role != "translation" and mover.box is not None:
            # Radians, or parts of the size: at the far end of the object.
            reach *= float(np.linalg.norm(mover.box[1] - mover.box[0])) / 2
        return touching(self._objects.values(), mover, reach)

    def as_captum(
        self,
        metric: Callable[[torch.Tensor], torch.Tensor],
        *,
        seed: int | None = 0,
        bounds: Literal["raise", "reflect"] = "raise",
        denoise: bool = False,
    ) -> tuple[Callable[..., torch.Tensor], tuple[torch.Tensor, ...]]:
        """Return ``(forward, inputs)`` for Captum's own classes.

        Example
        -------
        >>> from captum.attr import IntegratedGradients
        >>> from scenecaptum import metrics
        >>> renderer = SceneRenderer("cornell-box", inputs="emitters", resolution=(16, 16), spp=4)
        >>> forward, inputs = renderer.as_captum(metrics.MeanLuminance(), seed=1)
        >>> attributions = IntegratedGradients(forward).attribute(inputs, n_steps=2)
        >>> dict(zip(renderer.inputs, attributions))["light.emitter.radiance.value"].shape
        torch.Size([1, 3])

        Gradients are those of the very image that was rendered, including its noise. Only the library's own
        methods add standard errors and correct the bias from that noise. Methods that need a network's layers
        (DeepLift, LRP, layer and neuron attribution) do not apply. All rows of a batch share one graph;
        ``internal_batch_size`` and ``nt_samples_batch_size`` limit its memory.

        Parameters
        ----------
        metric
            A torch function from one image ``(H, W, 3)`` to a scalar, or to a vector that Captum's ``target``
            indexes.
        seed
            Seed of the samples of every row, so that rows and calls differ by their values alone. ``None`` draws a
            new seed for each row of each call from torch's global generator (``torch.manual_seed``).
        bounds
            How values beyond the physical bounds are handled: ``"raise"`` refuses them, ``"reflect"`` reflects
            them at the bounds before rendering, differentiably. Methods that add noise need this, and so does a
            baseline of zero where zero is unphysical (a roughness). Attributions refer to the values before
            reflection: the gradient of a value that was reflected once has the opposite sign, unlike in
            ``SmoothGradScene``, which takes it at the reflected value.
        denoise
            Whether to evaluate the metric on denoised images (Open Image Denoise, with ``guides``). The
            gradient is that at the denoised image and passes through the denoiser unchanged (straight-through).
            There is no ``"auto"``, because the noise cannot be estimated from the single image that Captum
            renders at a time.

        Returns
        -------
        forward : callable
            From one tensor ``(B, …)`` per input to ``(B,)``, or ``(B, K)`` for a metric with K elements.
        inputs : tuple of Tensor
            The renderer's inputs, in their order, with shape ``(1, …)``; a scalar is ``(1,)``.

        Raises
        ------
        SceneCaptumError
            If an option is invalid. From ``forward``: if the tensors do not match the inputs, the metric returns
            neither scalar nor vector, or a value is unphysical.
        """
        from ._captum import as_captum

        return as_captum(self, metric, seed=seed, bounds=bounds, denoise=denoise)

    def _check_tensor(self, name: str, value: torch.Tensor) -> None:
        """Check name, type and shape, but not the values, which a torch transform may hide."""
        if name not in self._state.original:
            if name in self._table:
                raise SceneCaptumError(f"{name!r} cannot be set: {self._table[name].problem}.")
            raise SceneCaptumError(
                f"The scene has no parameter {name!r}."
                f"{near_misses(name, self._state.original, instead=INPUT_NAMES)}"
            )
        expected = self._state.original[name].shape
        if not isinstance(value, torch.Tensor) or not value.is_floating_point():
            came = value.dtype if isinstance(value, torch.Tensor) else type(value).__name__
            fill = f"torch.full({tuple(expected)}, 0.2)" if expected else "torch.tensor(0.2)"
            raise SceneCaptumError(
                f"{name!r} must be a floating point tensor, not {came}: give {fill}, for example."
            )
        if value.shape != expected:
            raise SceneCaptumError(
                f"{name!r} has shape {tuple(value.shape)}; the scene expects {tuple(expected)}."
            )

    def _check_values(self, values: Mapping[str, torch.Tensor]) -> None:
        for name, value in values.items():
            # The scene's own values were accepted by Mitsuba (e.g. a principled roughness of 0).
            if self._state.is_original(name, value):
                continue
            low, high = (extreme.item() for extreme in value.aminmax())
            bounds = self._table[name].bounds
            if not (math.isfinite(low) and math.isfinite(high)):
                raise SceneCaptumError(f"{name!r} contains a value that is not finite.")
            if low < bounds.low or high > bounds.high or (bounds.open_low and low == bounds.low):
                worst = high if high > bounds.high else low
                raise SceneCaptumError(
                    f"{name!r} is {worst:.6g}, outside the physical range {bounds} of its kind "
                    f"({self._table[name].kind}). Clamp it before rendering, with renderer.clamp_(inputs). "
                    'For noise that Captum adds: renderer.as_captum(metric, bounds="reflect"). For ablations and '
                    "paths of Captum, whose baselines are 0 by default: pass it baselines=."
                )

    def extra_repr(self) -> str:
        """Show the scene, the number of inputs, the resolution and the samples per pixel."""
        width, height = self.resolution
        return f"{self.name!r}, {pluralize(len(self._names), 'input')}, {width}×{height}, {self.spp} spp"

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        raise SceneCaptumError(
            "A SceneRenderer can be neither copied nor pickled, because a Mitsuba scene cannot. Create it again "
            "from its scene file; with several processes, in each worker (spawn, not fork)."
        )


def _variant_of(scene: SceneLike) -> str | None:
    """Return the variant that a scene object was loaded under; None for a path, name or dict."""
    variant: str | None = scene.variant_name() if hasattr(scene, "variant_name") else None
    if variant is not None and not variant.endswith("_rgb"):
        raise SceneCaptumError(
            f"The mi.Scene was loaded under {variant}, and only RGB variants are supported. Load it after "
            "scenecaptum.activate('llvm_ad_rgb'), or pass its file or dict."
        )
    return variant


def _mean_of_texels(value: torch.Tensor) -> Any:
    return (value.flatten(0, -2).mean(0) if value.ndim > 1 else value).tolist()


def _seed_of_camera(seed: int, number: int) -> int:
    """Return an independent seed for each camera; the first has the seed itself."""
    return seed if number == 0 else int(np.random.SeedSequence([seed, number]).generate_state(1)[0])


def _make(arguments: Mapping[str, Any], replaced: Mapping[str, Any], variant: str) -> SceneRenderer:
    """Make the renderer of a recipe."""
    with exclusively(variant):
        renderer = SceneRenderer(**{**arguments, "scene": restored(arguments["scene"])})
    return renderer.replace(**replaced) if replaced else renderer


def _sky_name(surfaces: SurfaceMap) -> str:
    """Return the name of the emitter that the background is, the last object of a map."""
    return next((used.split(".")[0] for used in surfaces.parameters[-1]), surfaces.objects[-1])
