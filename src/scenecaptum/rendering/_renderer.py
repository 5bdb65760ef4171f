"""``SceneRenderer``: a scene as a differentiable torch module."""

from __future__ import annotations

import dataclasses
import math
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, NoReturn, cast

import numpy as np
import torch

from .._finite import NotFiniteError
from ..backend import device, exclusively
from ..camera import Camera
from ..checkpoint import Checkpoint, Folder, digest
from ..denoising import Guides
from ..errors import SceneCaptumError, check_seed, near_misses, whole_number
from ..scene import SceneParameters, SurfaceMap, discover, load_scene, select
from ..scene._extremes import check_scale
from ..scene._graph import SceneGraph
from ..scene._loading import SceneLike, XmlParameters, as_text, describe, source_of
from ..scene._selection import Selection
from ._function import RenderCall, render
from ._memory import available, predict, require
from ._plan import STOCK, RenderPlan, make_plan, stock_plan
from ._sensors import choose_sensor, common_resolution

if TYPE_CHECKING:
    from ._checkpointed import CheckpointedEngine
    from ._engine import Engine


class SceneRenderer(torch.nn.Module):
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

    Every call is pure: it carries its own values into its backward pass and leaves a scene that was handed in
    as it found it, but that objects without an id have got one. Any number of renders may live in one graph, and
    a graph may be differentiated any number of times, but only to first order.

    Parameters
    ----------
    scene
        A path to a Mitsuba XML file, the name of a bundled scene, a Mitsuba dict, or an ``mi.Scene``.
    inputs
        What is differentiated: a kind (``"materials"``, ``"reflectance"``, ``"roughness"``, ``"ior"``,
        ``"opacity"``, ``"textures"``, ``"emitters"``, ``"media"``, ``"all"``), a glob over parameter names, an
        exact name, or a list of these.
    resolution
        ``(width, height)`` in pixels; the scene's own by default.
    spp
        Samples per pixel; the scene's own by default.
    max_depth
        Longest path in segments (-1: no limit); the scene's own by default.
    sensor
        Index of the sensor, or ``"fisheye"``: a 180° equidistant fisheye in place of the first one, square unless
        ``resolution`` says otherwise. A list of these renders a stack ``(cameras, H, W, 3)``, which the metric
        reduces; such a result has no heatmap.
    parameters
        Values for the ``$name`` placeholders of an XML file, by name: ``{"spp": 64}`` for ``$spp``.

    Attributes
    ----------
    inputs : dict of str to Tensor
        The selected parameters with the scene's own values: float32, a scalar 0-d, a colour ``(3,)``, a
        texture ``(H, W, C)``.
    plan : RenderPlan
        Which integrator, depth and derivatives were chosen, and why.
    resolution : tuple of int
        ``(width, height)``.
    spp : int
        Samples per pixel of a render, where ``spp=`` does not say otherwise.
    name : str
        What the scene is called in results.
    checkpoint : Checkpoint or None
        The folder of ``with_checkpoint``; its ``reused`` and ``rendered`` count passes.

    Raises
    ------
    SceneCaptumError
        Where the scene cannot be loaded, ``inputs`` selects nothing that can be differentiated, or ``parameters``
        are not those of the file.
    """

    def __init__(
        self,
        scene: SceneLike,
        inputs: Selection = "materials",
        *,
        resolution: tuple[int, int] | None = None,
        spp: int | None = None,
        max_depth: int | None = None,
        sensor: int | str | list[int | str] = 0,
        parameters: XmlParameters | None = None,
    ) -> None:
        super().__init__()
        with exclusively(_variant_of(scene)) as mi:
            self._variant, self._device = mi.variant(), device()
            self._borrowed = isinstance(scene, mi.Scene)
            self.checkpoint: Checkpoint | None = None
            self._granted = 0  # bytes that were found to be available
            try:
                size = self._load(scene, parameters, inputs, sensor, resolution, spp)
                self._prepare(size, self._plan_for(max_depth))
            except SceneCaptumError as error:
                # What was loaded goes now: let go with the error, it would go while another thread renders.
                self.__dict__.clear()
                traceback.clear_frames(error.__traceback__)
                raise

    def _load(
        self,
        scene: SceneLike,
        parameters: XmlParameters | None,
        inputs: Selection,
        sensor: int | str | list[int | str],
        resolution: tuple[int, int] | None,
        spp: int | None,
    ) -> tuple[int, int]:
        """Load the scene, and look at what is in it; return the resolution."""
        from ._state import SceneState  # which needs an active variant

        self.name = describe(scene)
        loaded = load_scene(scene, parameters)
        self._placeholders = as_text(parameters)
        self._source = digest((source_of(scene), self._placeholders))
        check_scale(self.name, loaded)
        self._graph = SceneGraph(loaded)
        self._table = discover(self._graph)
        self._names = select(self._table, inputs)
        self._stacked = isinstance(sensor, list)
        chosen = sensor if isinstance(sensor, list) else [sensor]
        self._sensors = [choose_sensor(loaded, one, resolution) for one in chosen]
        size = common_resolution(self._sensors, resolution)
        self.spp = whole_number("spp", self._sensors[0].sampler().sample_count() if spp is None else spp)
        self._state = SceneState(loaded, {name: p.shape for name, p in self._table.items() if not p.problem})
        return size

    def _plan_for(self, max_depth: int | None) -> RenderPlan:
        if max_depth is not None and max_depth != -1:
            whole_number("max_depth", max_depth, high=2**31 - 1)
        values = {name: self._state.original[name] for name in self._names}
        return make_plan(self._graph, self._table, values, max_depth)

    def _prepare(self, resolution: tuple[int, int], plan: RenderPlan) -> None:
        """Make an engine for each sensor, all on the same scene."""
        from ._engine import Engine
        from ._stock import StockEngine
        from ._visibility import trace_surfaces

        self.resolution = resolution
        self.plan = dataclasses.replace(plan, memory=self.memory(pictures=1))
        self._surface_maps: dict[Any, SurfaceMap] = {}
        self._guides: Guides | None = None
        self._engines: Sequence[Engine | CheckpointedEngine] = [
            (StockEngine if plan.integrator in STOCK else Engine)(
                self._graph,
                one,
                self._state,
                self._table,
                plan,
                resolution,
                partial(
                    _look,
                    self._surface_maps,
                    index,
                    partial(trace_surfaces, self._graph, self._table, one, resolution),
                ),
                borrowed=self._borrowed,
            )
            for index, one in enumerate(self._sensors)
        ]
        self._record()

    def _record(self) -> None:
        """Let the engines keep their passes in the checkpoint, if there is one, and in no other."""
        from ._checkpointed import CheckpointedEngine

        bare = [one.engine if isinstance(one, CheckpointedEngine) else one for one in self._engines]
        self._engines = bare
        if self.checkpoint is not None:
            self._engines = [
                CheckpointedEngine(one, self.checkpoint, fingerprint)
                for one, fingerprint in zip(bare, self._fingerprints(), strict=True)
            ]

    def with_checkpoint(self, checkpoint: Folder) -> SceneRenderer:
        """Return this renderer with every picture and backward pass kept in a folder; None for no folder.

        What is in the folder is not rendered again, in this process or another: a job that was killed goes on
        where it was. ``checkpoint=`` of the attribution methods does this for one call.

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
            Where the folder cannot be written.
        """
        if checkpoint is not None and not isinstance(checkpoint, Checkpoint):
            checkpoint = Checkpoint(checkpoint)
        other = self._twin()
        other.checkpoint = checkpoint
        other._record()
        return other

    def _twin(self) -> SceneRenderer:
        """Return another renderer of the same scene, with hooks of its own."""
        other = type(self).__new__(type(self))
        other.__dict__.update(self.__dict__)
        torch.nn.Module.__init__(other)
        return other

    def memory(self, *, spp: int | None = None, pictures: int = 1) -> int:
        """Return how many bytes rendering and differentiating will take at most, beyond what the process holds.

        Example
        -------
        >>> renderer = SceneRenderer("cornell-box", resolution=(1920, 1080), spp=64)
        >>> renderer.memory(pictures=8) < 4 * 2**30
        True

        Parameters
        ----------
        spp
            Samples per pixel of each picture; the renderer's by default.
        pictures
            How many are held at the same time: the ``replicates`` of an attribution.
        """
        return predict(*self._sizes(spp, pictures))

    def require_memory(self, *, spp: int | None = None, pictures: int = 1) -> None:
        """Raise where ``memory`` is more than is available, with settings that would fit.

        Parameters
        ----------
        spp, pictures
            As for ``memory``.

        Raises
        ------
        SceneCaptumError
            Naming both numbers.
        """
        sizes = self._sizes(spp, pictures)
        if (needed := predict(*sizes)) > self._granted:
            require(*sizes, available() if self._device.type == "cpu" else None)
            # What was taken once is not available, but still there.
            self._granted = needed

    def _sizes(self, spp: int | None, pictures: int) -> tuple[tuple[int, int], int, int, int]:
        width, height = self.resolution
        texels = sum(self._state.original[name].numel() for name in self._names)
        return (width * len(self._sensors), height), self.spp if spp is None else spp, pictures, texels

    def _fingerprints(self) -> list[str]:
        """Return for each sensor a hash of all that its pictures follow from beside values, seed and samples."""
        from ._checkpointed import fingerprint, scene_contents

        plan = self.plan
        settings = {
            "source": self._source,
            "integrator": plan.integrator,
            "depths": (plan.max_depth, plan.rr_depth),
            "hide_emitters": plan.hide_emitters,
            "resolution": self.resolution,
        }
        with self._engines[0].holding({}):
            scene = scene_contents(self._graph.scene)
            return [fingerprint(scene, one, settings) for one in self._sensors]

    def replace(
        self,
        *,
        resolution: tuple[int, int] | None = None,
        max_depth: int | None = None,
        integrator: str | None = None,
    ) -> SceneRenderer:
        """Return a renderer of the same scene and inputs with other settings; both hold one scene.

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
            ``"prb"`` for Mitsuba's own path replay (``prbvolpath`` where there is a medium) with its derivatives
            as they come, wrong ones included: to compare with.

        Raises
        ------
        SceneCaptumError
            Where a setting is wrong.
        """
        if integrator not in (None, "prb"):
            raise SceneCaptumError(f'integrator must be "prb", or left out, not {integrator!r}.')
        with exclusively(self._variant):
            size = self.resolution if resolution is None else common_resolution(self._sensors, resolution)
            plan = self.plan if max_depth is None else self._plan_for(max_depth)
            stock = integrator is not None or self.plan.integrator in STOCK
            if stock and plan.integrator not in STOCK:
                plan = stock_plan(plan)
            other = self._twin()
            other._prepare(size, plan)
        return other

    @property
    def inputs(self) -> dict[str, torch.Tensor]:
        """The selected parameters with the scene's own values, detached copies made afresh at each access."""
        self._engines[0].look()
        return {name: self._engines[0].original[name].clone().to(self._device) for name in self._names}

    def leaves(self) -> dict[str, torch.Tensor]:
        """Return ``inputs`` again as leaves that require grad."""
        return {name: value.requires_grad_() for name, value in self.inputs.items()}

    @property
    def bounds(self) -> dict[str, tuple[float, float]]:
        """The physical bounds of each input, infinite where there are none."""
        return {n: (self._table[n].bounds.low, self._table[n].bounds.high) for n in self._names}

    @property
    def labels(self) -> dict[str, str]:
        """A readable name for each input."""
        return {name: self._table[name].label for name in self._names}

    @property
    def camera(self) -> Camera:
        """Where each pixel looks and how large it is: directions and solid angles.

        Raises
        ------
        SceneCaptumError
            For a list of sensors, whose cameras are ``cameras``.
        """
        if self._stacked:
            raise SceneCaptumError(
                f"This renderer has a list of {len(self._sensors)} sensors: renderer.cameras lists their cameras."
            )
        return self.cameras[0]

    @property
    def cameras(self) -> list[Camera]:
        """The camera of every sensor."""
        with exclusively(self._variant):
            from ._cameras import camera_of  # which registers a sensor under the variant that is active

            found = []
            for engine, sensor in zip(self._engines, self._sensors, strict=True):
                with engine.at_hand():
                    found.append(camera_of(sensor))
            return found

    @property
    def info(self) -> dict[str, Any]:
        """How this renderer renders, in plain values, for the record of a result."""
        return {
            "scene": self.name,
            **({"parameters": self._placeholders.copy()} if self._placeholders else {}),
            "resolution": list(self.resolution),
            "integrator": self.plan.integrator,
            "max_depth": self.plan.max_depth,
            "variant": self._variant,
            "cautions": dict(self.plan.cautions),
            "left_out": {name: p.fault for name, p in self._table.items() if p.fault},
        }

    def parameters_table(self) -> SceneParameters:
        """Return every parameter of the scene with kind, shape, bounds, owner and status; prints as a table."""
        return self._table

    @property
    def surfaces(self) -> SurfaceMap | None:
        """Which objects each pixel shows; None for a list of sensors."""
        return None if self._stacked else self._surfaces_seen_by(0)

    def surfaces_with_texels(self, names: Iterable[str] | None = None) -> SurfaceMap | None:
        """Return ``surfaces`` together with the texels of textures that each pixel shows.

        Parameters
        ----------
        names
            Parameters that are the texels of bitmaps or of the environment map, or attributes of the vertices or
            faces of a mesh, by default all such inputs; others are passed over.
        """
        return None if self._stacked else self._surfaces_seen_by(0, self._textures(names))

    def see_through(self, names: Iterable[str] | None = None) -> SurfaceMap | None:
        """Return what each pixel shows in mirrors and behind glass; None for a list of sensors.

        Rays go on where a surface only mirrors or lets pass, to the first that scatters light or shines, or until
        they have met a dozen. Where a surface does both, its share of a pixel is parted as its light is; what it
        absorbs is not told, so that shares sum to 1. ``heatmap(surfaces=…)`` paints on the map.

        Parameters
        ----------
        names
            Of which textures the map tells the texels, as in ``surfaces_with_texels``.
        """
        return None if self._stacked else self._surfaces_seen_by(0, self._textures(names), through=True)

    @property
    def guides(self) -> Guides:
        """Albedo and normals without noise, for a denoiser: ``(H, W, 3)``, or ``(cameras, H, W, 3)`` for a list.

        They show the first surface that scatters light, in mirrors and behind glass too, with the scene's own
        values.
        """
        from ._guides import trace_guides

        if self._guides is None:
            found = []
            for engine, sensor in zip(self._engines, self._sensors, strict=True):
                with engine.holding({}):
                    found.append(trace_guides(self._graph.scene, sensor, self.resolution))
            stacks = torch.stack([one.albedo for one in found]), torch.stack([one.normal for one in found])
            self._guides = Guides(*stacks) if self._stacked else found[0]
        return self._guides

    def _textures(self, names: Iterable[str] | None) -> tuple[str, ...]:
        wanted = self._names if names is None else tuple(names)
        return tuple(
            n for n in wanted if n in self._engines[0].original and len(self._table[n].shape) in (2, 3)
        )

    def _surfaces_seen_by(
        self, index: int, textures: tuple[str, ...] = (), *, through: bool = False
    ) -> SurfaceMap:
        """Trace what a sensor shows, once: nothing that can be an input moves geometry."""
        from ._texels import find_textures
        from ._visibility import trace_surfaces

        key = (index, textures, through)
        if key not in self._surface_maps:
            engine, sensor = self._engines[index], self._sensors[index]

            def hold(name: str, texels: Any) -> Any:
                return engine.holding({name: torch.from_numpy(texels).to(self._device)})

            with engine.at_hand():
                shapes = {name: self._table[name].shape for name in textures}
                found = list(find_textures(self._graph, shapes, hold))
                self._surface_maps[key] = trace_surfaces(
                    self._graph, self._table, sensor, self.resolution, found, through=through
                )
        return self._surface_maps[key]

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
            Values by parameter name; a parameter that is not named keeps the scene's value.
        seed
            Seed of the samples.
        spp
            Samples per pixel, if not the renderer's.
        seed_grad
            Seed of the samples of the backward pass. By default the same samples are replayed, so that the
            gradient is that of the very image that was rendered. Samples of their own (``seed_grad`` other
            than ``seed``) are spent where the metric's derivative is: pixels are chosen by their adjoint.
        spp_grad
            Samples per pixel of the backward pass, as many as ``spp`` by default.

        Returns
        -------
        Tensor
            ``(H, W, 3)`` linear radiance, float32; ``(cameras, H, W, 3)`` for a list of sensors.

        Raises
        ------
        SceneCaptumError
            Before anything is rendered, where a name is unknown, a shape wrong or a value unphysical.
        """
        given = dict(inputs or {})
        for name, value in given.items():
            self._check_tensor(name, value)
        seed = check_seed("seed", seed)
        seed_grad = seed if seed_grad is None else check_seed("seed_grad", seed_grad)
        spp = whole_number("spp", self.spp if spp is None else spp)
        spp_grad = spp if spp_grad is None else whole_number("spp_grad", spp_grad)
        self.require_memory(spp=max(spp, spp_grad))
        tensors = [value.to(self._device, torch.float32) for value in given.values()]
        try:
            images = [
                render(
                    RenderCall(
                        engine=engine,
                        names=tuple(given),
                        seed=_seed_of_camera(seed, number),
                        seed_grad=_seed_of_camera(seed_grad, number),
                        spp=spp,
                        spp_grad=spp_grad,
                        check=self._check_values,
                    ),
                    *tensors,
                )
                for number, engine in enumerate(self._engines)
            ]
        except NotFiniteError as error:
            raise NotFiniteError(f"{error}{self._suspects()}") from error
        return torch.stack(images) if self._stacked else images[0]

    def _suspects(self) -> str:
        """Name the scene's own values that are not finite or impossible, in sentences."""
        faults = [f" {name!r} may be why: {p.fault}." for name, p in self._table.items() if p.fault]
        return "".join(faults[:3])

    def derivative_image(
        self,
        name: str,
        direction: torch.Tensor | None = None,
        *,
        inputs: Mapping[str, torch.Tensor] | None = None,
        seed: int = 0,
        spp: int | None = None,
    ) -> torch.Tensor:
        """Return by how much each pixel changes with a parameter, ``∂I/∂θ``, in forward mode.

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
            How it moves, of its shape; by default all its channels and texels by 1.
        inputs
            The values at which the derivative is taken, by default the scene's own.
        seed, spp
            As for a render.

        Returns
        -------
        Tensor
            ``(H, W, 3)`` radiance per unit of ``direction``; ``(cameras, H, W, 3)`` for a list of sensors.

        Raises
        ------
        SceneCaptumError
            Where the parameter is unknown or cannot be differentiated, or a shape or value is wrong.
        """
        given = dict(inputs or {})
        self._engines[0].look()
        value = given.pop(name, self._engines[0].original.get(name, torch.zeros(())))
        self._check_tensor(name, value)
        direction = torch.ones_like(value) if direction is None else direction.to(value)
        if direction.shape != value.shape:
            raise SceneCaptumError(
                f"direction has shape {tuple(direction.shape)}, but {name!r} has {tuple(value.shape)}."
            )

        def picture(moving: torch.Tensor) -> torch.Tensor:
            return cast(torch.Tensor, self({**given, name: moving}, seed=seed, spp=spp))

        return cast(torch.Tensor, torch.func.jvp(picture, (value,), (direction,))[1])

    def effective_samples(
        self,
        values: Mapping[str, torch.Tensor],
        adjoint: torch.Tensor,
        *,
        spp: int | None = None,
        replicates: int = 1,
    ) -> dict[str, float]:
        """Return how many samples tell the spread of each gradient, in effect; for few, a spread tells no error.

        A gradient is a sum of contributions of single paths. Where these are many and alike, a few independent
        replicates tell its error; where a few bright paths make up most of the variance, replicates are likely to
        miss them, and to agree with each other all the same. Contributions ``c`` are worth ``(Σc²)² / Σc⁴`` equal
        ones; the inverse is the excess kurtosis of the sum. A pilot counts the light that each parameter acts on,
        at the scene's own values.

        Parameters
        ----------
        values
            The parameters that are differentiated, and where.
        adjoint
            The derivative of a metric with respect to the picture, of its shape.
        spp
            Samples per pixel of a replicate, the renderer's by default.
        replicates
            How many there are.

        Returns
        -------
        dict
            By parameter, 0 where no path of the pilot has met it. Media are left out, and low roughnesses that are
            sampled from their surfaces.

        References
        ----------
        Kish, "Survey Sampling", 1965, section 8.2 (effective sizes of weighted samples).
        """
        spp = whole_number("spp", self.spp if spp is None else spp)
        adjoints = adjoint if self._stacked else [adjoint]
        spreads = [
            engine.spread(values, tuple(values), one, spp, replicates)
            for engine, one in zip(self._engines, adjoints, strict=True)
        ]
        variances, fourths = (
            {name: sum(one[name][index] for one in spreads) for name in spreads[0]} for index in range(2)
        )
        return {
            name: variance**2 / fourths[name] if fourths[name] else 0.0
            for name, variance in variances.items()
        }

    def as_captum(
        self,
        metric: Callable[[torch.Tensor], torch.Tensor],
        *,
        seed: int | None = 0,
        bounds: Literal["raise", "reflect"] = "raise",
        denoise: bool = False,
    ) -> tuple[Callable[..., torch.Tensor], tuple[torch.Tensor, ...]]:
        """Return ``(forward, inputs)``, on which Captum's own classes run.

        Example
        -------
        >>> from captum.attr import IntegratedGradients
        >>> from scenecaptum import metrics
        >>> renderer = SceneRenderer("cornell-box", inputs="emitters", resolution=(16, 16), spp=4)
        >>> forward, inputs = renderer.as_captum(metrics.MeanLuminance(), seed=1)
        >>> attributions = IntegratedGradients(forward).attribute(inputs, n_steps=2)
        >>> dict(zip(renderer.inputs, attributions))["light.emitter.radiance.value"].shape
        torch.Size([1, 3])

        Gradients are those of the very image that was rendered, its noise included; the standard errors and the
        correction for that noise are what the library's own methods add. Methods that look inside a network
        (DeepLift, LRP, layers and neurons) find none here. All rows of a batch share one graph;
        ``internal_batch_size`` and ``nt_samples_batch_size`` bound what that holds.

        Parameters
        ----------
        metric
            A torch function from one image ``(H, W, 3)`` to a scalar, or to a vector that Captum's ``target``
            indexes.
        seed
            Seed of the samples of every row: rows and calls then differ by their values alone. ``None`` draws a
            fresh one for each row of each call from torch's global generator (``torch.manual_seed``).
        bounds
            What becomes of values beyond the physical bounds: ``"raise"`` refuses them, ``"reflect"`` folds them
            back at the bounds before rendering, differentiably. Noise needs that, and so does a baseline of zero
            where zero is unphysical (a roughness); attributions belong to the values before the fold.
        denoise
            Whether the metric sees denoised pictures (Open Image Denoise, with ``guides``). The gradient is taken
            at what it sees and goes through the denoiser unchanged. There is no ``"auto"`` here: Captum sees one
            picture at a time, which tells nothing of its own noise.

        Returns
        -------
        forward : callable
            From one tensor ``(B, …)`` per input to ``(B,)``, or ``(B, K)`` for a metric with K elements.
        inputs : tuple of Tensor
            The renderer's inputs, in their order, with shape ``(1, …)``; a scalar is ``(1,)``.

        Raises
        ------
        SceneCaptumError
            Where an option is wrong. From ``forward``: where the tensors do not fit the inputs, the metric
            returns neither scalar nor vector, or a value is unphysical.
        """
        from ._captum import as_captum

        return as_captum(self, metric, seed=seed, bounds=bounds, denoise=denoise)

    def _check_tensor(self, name: str, value: torch.Tensor) -> None:
        """Refuse what can be refused without looking at the numbers, which a transform may hide."""
        if name not in self._engines[0].original:
            if name in self._table:
                raise SceneCaptumError(f"{name!r} cannot be set: {self._table[name].problem}.")
            raise SceneCaptumError(
                f"The scene has no parameter {name!r}.{near_misses(name, self._engines[0].original)}"
            )
        if not isinstance(value, torch.Tensor) or not value.is_floating_point():
            came = value.dtype if isinstance(value, torch.Tensor) else type(value).__name__
            raise SceneCaptumError(f"{name!r} must be a floating point tensor, not {came}.")
        expected = self._engines[0].original[name].shape
        if value.shape != expected:
            raise SceneCaptumError(
                f"{name!r} has shape {tuple(value.shape)}; the scene expects {tuple(expected)}."
            )

    def _check_values(self, values: Mapping[str, torch.Tensor]) -> None:
        for name, value in values.items():
            # The scene's own values are what Mitsuba accepted (a principled roughness of 0, say).
            if torch.equal(value, self._engines[0].original[name]):
                continue
            low, high = (extreme.item() for extreme in value.aminmax())
            bounds = self._table[name].bounds
            if not (math.isfinite(low) and math.isfinite(high)):
                raise SceneCaptumError(f"{name!r} holds a value that is not finite.")
            if low < bounds.low or high > bounds.high or (bounds.open_low and low == bounds.low):
                worst = high if high > bounds.high else low
                raise SceneCaptumError(
                    f"{name!r} is {worst:.6g}, outside the physical range {bounds} of its kind "
                    f"({self._table[name].kind}). Clamp it before rendering."
                )

    def extra_repr(self) -> str:
        """Show the scene, the size of the picture and the number of inputs."""
        width, height = self.resolution
        return f"{self.name!r}, {len(self._names)} inputs, {width}×{height}, {self.spp} spp"

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        raise SceneCaptumError(
            "A SceneRenderer can be neither copied nor pickled, because a Mitsuba scene cannot. Build it again "
            "from its scene file, in the worker process where there are several (spawn, not fork)."
        )


def _look(maps: dict[Any, SurfaceMap], index: int, trace: Callable[[], SurfaceMap]) -> SurfaceMap:
    """Return what a sensor shows. An engine that held its renderer would keep both, and the scene, in memory."""
    key = (index, (), False)
    if key not in maps:
        maps[key] = trace()
    return maps[key]


def _variant_of(scene: SceneLike) -> str | None:
    """Return the variant that a scene object was made under; what is yet to be loaded has none."""
    variant: str | None = scene.variant_name() if hasattr(scene, "variant_name") else None
    if variant is not None and not variant.endswith("_rgb"):
        raise SceneCaptumError(
            f"The mi.Scene was loaded under {variant}, and only RGB is rendered here. Load it after "
            "scenecaptum.activate('llvm_ad_rgb'), or hand in its file or dict."
        )
    return variant


def _seed_of_camera(seed: int, number: int) -> int:
    """Return the seed of one camera of several, whose noise is its own; the first has the seed itself."""
    return seed if number == 0 else int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
