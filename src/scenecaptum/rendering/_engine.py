"""The bridge between torch and Dr.Jit: render, VJP and JVP as pure functions of tensors.

Imported only once a variant is active (see ``SceneRenderer``). ``dr.wrap`` converts arrays, but no derivative
graph outlives a call: each call writes its own values into the scene, and its result does not depend on later
changes of the scene.
"""

from __future__ import annotations

import contextlib
import gc
import operator
import weakref
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, reduce
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import torch

from ..backend import device, dispose, exclusively
from ..errors import SceneCaptumError
from ..projection import SurfaceMap
from ..scene import SceneGraph, SceneParameters
from ._backward import FilmFilter, film_filter
from ._chunks import Chunk, chunks
from ._derivative_routes import (
    FiniteDifference,
    clamp_off_singularity,
    finite_difference,
    is_constant,
    low_roughness_names,
)
from ._pilot import Pilot, find_parameter_groups, run_pilot
from ._pixel_sampling import pixel_probabilities, sample_pixels
from ._plan import RenderPlan
from ._state import SceneState, flat, owned
from .integrators import path  # noqa: F401 -- registers the plugin
from .integrators.light_tracing import (
    CameraAdjoint,
    SampledShapes,
    find_sampled_shapes,
    trace_light_backward,
)
from .integrators.volumetric import VolumetricReplayIntegrator

Values = Mapping[str, torch.Tensor]

# With importance sampling a finite difference takes this many times fewer samples per render: common random
# numbers remove most of its noise.
DIFFERENCE_SPP_DIVISOR = 4

# Mixture weights of the importance maps: noisy pixels, and noisy pixels with equal shares per tracked surface. The
# remaining samples are uniform.
NOISE_WEIGHT, SURFACE_WEIGHT = 0.35, 0.35
NOISE_RENDERS, NOISE_SPP = 8, 2

# Samples for the noise map of low roughnesses: in all, and per pixel at most.
ROUGHNESS_NOISE_SAMPLES, MAX_ROUGHNESS_NOISE_SPP = 2**20, 64

# Samples of a pilot: relative to those of the estimate, and in all at most.
PILOT_FACTOR, MAX_PILOT_SAMPLES = 4, 2**17

# The engine whose scene is tracked, if any. A virtual function call dispatches to the objects of every scene in
# the process, so another scene's tracked values would enter this one's derivatives.
_tracking: weakref.ref[Engine] | None = None


class Engine:
    """Renders a scene and its derivatives for given parameter values.

    Parameters
    ----------
    graph, sensor
        The live scene and one of its sensors.
    state
        The scene's values.
    parameters
        The scene's parameters.
    plan
        How to render.
    resolution
        ``(width, height)`` in pixels.
    surface_map
        Returns the map of the objects that each pixel shows.
    borrowed
        Whether the scene belongs to the caller and must be restored after each call.

    Attributes
    ----------
    device
        The device of images and gradients.
    """

    def __init__(
        self,
        graph: SceneGraph,
        sensor: Any,
        state: SceneState,
        parameters: SceneParameters,
        plan: RenderPlan,
        resolution: tuple[int, int],
        surface_map: Callable[[], SurfaceMap],
        *,
        borrowed: bool,
    ) -> None:
        self._graph = graph
        self._scene = graph.scene
        self._sensor = sensor
        self._state = state
        self._parameters = parameters
        self._resolution = resolution
        self._borrowed = borrowed
        self._variant, self.device = mi.variant(), device()
        self._has_exclusive_scene = False
        self._plan = plan
        self._surface_map = surface_map
        self._sampled_shapes: dict[tuple[str, ...], SampledShapes | None] = {}
        self._importance_maps: dict[Any, Sequence[tuple[float, torch.Tensor]]] = {}
        self._noise_values: Values = {}
        self._pilots: dict[int, Pilot] = {}
        self._integrator = plan.create_integrator()
        self._render, self._render_backward, self._render_backward_pixels = _freeze(
            self._integrator, sensor, state.forget_gradients
        )
        # The last reference may be dropped while another thread records a kernel.
        weakref.finalize(self, dispose, self.__dict__).atexit = False
        # Decoding textures leaves as much memory again in Dr.Jit's allocation cache.
        dr.flush_malloc_cache()

    @property
    def original(self) -> dict[str, torch.Tensor]:
        """The scene's own values."""
        return self._state.original

    @cached_property
    def _film_filter(self) -> FilmFilter | None:
        return film_filter(self._sensor.film())

    def refresh_originals(self) -> None:
        """Read a borrowed scene's own values again, because its owner may have changed them."""
        if self._borrowed:
            with exclusively(self._variant):
                self._state.refresh_originals()

    def describe_pixels(self, pixels: torch.Tensor) -> str:
        """Return a sentence that names the objects on a mask of pixels ``(H, W)``."""
        names = self._surface_map().objects_on(pixels.numpy(force=True))
        more = f" and {len(names) - 3} more" if len(names) > 3 else ""
        return f" They show {', '.join(names[:3])}{more}: look for an extreme value there, or in the lights."

    def primal(self, values: Values, seed: int, spp: int) -> torch.Tensor:
        """Render: ``(H, W, 3)`` linear radiance."""
        with self.exclusive_scene():
            # Values that are still tracked for an earlier VJP do no harm here, and rewriting them would take time.
            tracked = self._state.leaves.keys()
            pending = self._state.pending_writes(values, tracked)

            def render(*arrays: Any) -> Any:
                self._state.write(pending, arrays, tracked)
                with dr.suspend_grad():
                    return _sum(
                        evaluate(
                            self._render(
                                self._scene, dr.opaque(mi.UInt32, chunk.seed), chunk.spp, self._state.scalars
                            )
                            * chunk.weight
                        )
                        for chunk in self._chunks(seed, spp)
                    )

            image: torch.Tensor = call_with_torch(render, *pending.values())
            return image

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
        """Return the vector–Jacobian product: for each tracked parameter ``Σ adjoint · ∂image/∂parameter``.

        With ``importance_sampling``, pixels are sampled in proportion to the adjoint. Otherwise the samples are
        those of the primal with the same seed, so that the result is the derivative of that very image.
        """
        replayed = [name for name in tracked if self._finite_difference(name, values) is None]
        low_roughness = (
            low_roughness_names(self._parameters, {n: values[n] for n in replayed})
            if importance_sampling
            else []
        )
        shapes = self._find_sampled_shapes(tuple(low_roughness)) if low_roughness else None
        if shapes is None:
            gradients = self._replay_backward(
                values, replayed, adjoint, seed, spp, importance_sampling=importance_sampling
            )
        else:
            rest = [name for name in replayed if name not in low_roughness]
            gradients = self._replay_backward(
                values, rest, adjoint, seed, spp, importance_sampling=importance_sampling
            )
            gradients |= self._replay_backward(
                values,
                low_roughness,
                adjoint,
                seed,
                spp,
                importance_sampling=importance_sampling,
                light_traced=shapes,
            )
        difference_spp = max(1, spp // DIFFERENCE_SPP_DIVISOR) if importance_sampling else spp
        for name in tracked:
            if name not in gradients:
                quotient = self._difference_quotient(name, values, seed, difference_spp)
                product = (adjoint * quotient).sum((0, 1))
                # Each channel of the image depends only on the same channel of a colour.
                gradients[name] = product if values[name].ndim else product.sum()
            if is_constant(self._parameters[name], {**self.original, **values}):
                gradients[name] = torch.zeros_like(values[name])
        return tuple(gradients[name].to(values[name]) for name in tracked)

    def jvp(self, values: Values, tangents: Values, seed: int, spp: int) -> torch.Tensor:
        """Return the Jacobian–vector product: the derivative image in the direction of ``tangents``."""
        replayed = {
            name: tangent
            for name, tangent in tangents.items()
            if self._finite_difference(name, values) is None
        }
        width, height = self._resolution
        image = torch.zeros((height, width, 3), device=self.device)
        moving = {n for n in tangents if not is_constant(self._parameters[n], {**self.original, **values})}
        replayed = {name: tangent for name, tangent in replayed.items() if name in moving}
        if replayed:
            image = image + self._replay_forward(values, replayed, seed, spp)
        for name in moving - replayed.keys():
            quotient = self._difference_quotient(name, values, seed, spp)
            image = image + (quotient * tangents[name]).to(image)
        return image

    def cumulants(
        self,
        values: Values,
        tracked: Sequence[str],
        adjoint: torch.Tensor,
        spp: int,
        replicates: int,
    ) -> dict[str, tuple[float, float]]:
        """Return variance and fourth cumulant of the mean over replicates of ``vjp``, estimated by a pilot.

        They are those of the light that each tracked parameter acts on, at the scene's own values. Parameters
        without such light are left out, and so are low roughnesses that are differentiated by light tracing.
        """
        replayed = [name for name in tracked if self._finite_difference(name, values) is None]
        low_roughness = low_roughness_names(self._parameters, {n: values[n] for n in replayed})
        if low_roughness and self._find_sampled_shapes(tuple(low_roughness)) is not None:
            replayed = [name for name in replayed if name not in low_roughness]
        else:
            low_roughness = []
        adjoint = adjoint.detach().float()
        width, height = self._resolution
        with self.exclusive_scene():
            film = self._film_filter
            magnitude = film.rms_adjoint(adjoint) if film else adjoint.norm(dim=-1)
            importance_maps = self._find_importance_maps(values, replayed, None) if film else []
            sampled = pixel_probabilities(magnitude, importance_maps) * (width * height * spp)
            max_spp = MAX_PILOT_SAMPLES // (width * height)
            pilot = self._run_pilot(max(1, min(PILOT_FACTOR * spp * replicates, max_spp)))
        weights = magnitude.cpu().double().numpy().ravel()
        found = {}
        for name in tracked:
            uniform = np.full_like(weights, max(1, spp // DIFFERENCE_SPP_DIVISOR))
            samples = replicates * (sampled if name in replayed else uniform)
            if (
                name not in low_roughness
                and (cumulants := pilot.cumulants(name, weights, samples)) is not None
            ):
                found[name] = cumulants
        return found

    def _finite_difference(self, name: str, values: Values) -> FiniteDifference | None:
        return finite_difference(self._parameters[name], values[name])

    def _difference_quotient(self, name: str, values: Values, seed: int, spp: int) -> torch.Tensor:
        """Return the derivative image per unit of a scalar or colour by a finite difference, float64."""
        difference = self._finite_difference(name, values)
        assert difference is not None
        value = values[name]
        off = {other: torch.zeros_like(self.original[other]) for other in difference.off}
        quotient: torch.Tensor = _sum(
            self.primal({**values, **off, name: value + shift}, seed, spp).double() * weight
            for shift, weight in difference.points
        )
        return quotient

    def _replay_backward(
        self,
        values: Values,
        tracked: Sequence[str],
        adjoint: torch.Tensor,
        seed: int,
        spp: int,
        *,
        importance_sampling: bool,
        light_traced: SampledShapes | None = None,
    ) -> dict[str, torch.Tensor]:
        """Return gradients by path replay, and by light tracing for the parameters of ``light_traced`` shapes."""
        if not tracked:
            return {}
        with self.exclusive_scene():
            film = self._film_filter if importance_sampling else None
            importance_maps = self._find_importance_maps(values, tracked, light_traced) if film else []
            pending = self._state.pending_writes(
                _clamp_off_singularities(values, tracked, self._parameters), tracked
            )

            def backward(*arrays: Any) -> Any:
                self._state.write(pending, arrays, tracked)
                for chunk in self._chunks(seed, spp):
                    chunk_seed, scalars = dr.opaque(mi.UInt32, chunk.seed), self._state.scalars
                    weighted = chunk.weight * adjoint
                    if film is None:
                        image = owned(mi.TensorXf(weighted))
                        self._render_backward(self._scene, image, chunk_seed, chunk.spp, scalars)
                    else:
                        magnitude = film.rms_adjoint(adjoint)
                        pixel, weight = sample_pixels(magnitude, importance_maps, chunk.spp, chunk.seed)
                        samples = owned(mi.UInt32(pixel)), owned(mi.Float(weight))
                        profile = owned(mi.Float(film.profile.to(weight))), film.radius
                        image = owned(mi.TensorXf(weighted / film.filter_weight_sum.to(weight)))
                        self._render_backward_pixels(
                            self._scene, image, chunk_seed, scalars, samples, profile, light_traced
                        )
                    evaluate()
                return [flat(dr.grad(self._state.leaves[name])) for name in tracked]

            adjoint = adjoint.detach().float()
            gradients = call_with_torch(backward, *pending.values())
            return {n: g.reshape(values[n].shape) for g, n in zip(gradients, tracked, strict=True)}

    def _find_sampled_shapes(self, names: tuple[str, ...]) -> SampledShapes | None:
        with self.exclusive_scene():
            if names not in self._sampled_shapes:
                params_by_shape = self._surface_map().parameters
                self._sampled_shapes[names] = find_sampled_shapes(
                    self._graph, params_by_shape, self._sensor, self._plan, names
                )
            return self._sampled_shapes[names]

    def _find_importance_maps(
        self, values: Values, tracked: Sequence[str], light_traced: SampledShapes | None
    ) -> Sequence[tuple[float, torch.Tensor]]:
        """Return importance maps and their mixture weights: the noise, and the noise equalized by surface."""
        # Highlights depend on the roughness, but a factor of 2 is precise enough to cache them.
        octaves = (
            {n: values[n].clamp_min(1e-4).log2().round().exp2() for n in tracked} if light_traced else {}
        )
        if not _equal(self._noise_values, self.original):
            self._noise_values = self.original
            self._importance_maps.clear()
            self._pilots.clear()
            self.__dict__.pop("_noise_map", None)
        key = tuple(tracked), tuple(value.numpy(force=True).tobytes() for value in octaves.values())
        if key not in self._importance_maps:
            noise = self._roughness_noise_map(light_traced, octaves) if light_traced else self._noise_map
            self._importance_maps[key] = (
                (NOISE_WEIGHT, noise),
                (SURFACE_WEIGHT, self._equalized_by_surface(noise, tracked)),
            )
        return self._importance_maps[key]

    def _run_pilot(self, spp: int) -> Pilot:
        if spp not in self._pilots:
            groups = find_parameter_groups(self._graph, self._parameters)
            with self.with_values({}):
                self._pilots[spp] = run_pilot(self._integrator, self._scene, self._sensor, groups, spp, 0)
        return self._pilots[spp]

    def _equalized_by_surface(self, noise: torch.Tensor, tracked: Sequence[str]) -> torch.Tensor:
        """Return the noise map, scaled so that the surfaces of each tracked parameter have the same sum.

        Otherwise small objects would get few samples beside the walls.
        """
        surfaces = [n for n in tracked if self._parameters[n].kind not in ("emitters", "media")]
        masks = (torch.from_numpy(self._surface_map().shown([name])) for name in surfaces)
        masked = [noise * mask for mask in masks]
        return sum((part / part.sum() for part in masked if part.any()), torch.zeros_like(noise))

    def _roughness_noise_map(self, light_traced: SampledShapes, values: Values) -> torch.Tensor:
        """Estimate the noise of each pixel's derivatives that light tracing leaves to path replay."""
        width, height = self._resolution
        spp = max(1, min(MAX_ROUGHNESS_NOISE_SPP, ROUGHNESS_NOISE_SAMPLES // (width * height)))
        pending = self._state.pending_writes({**self.original, **values}, values.keys())

        def rms_derivative(*arrays: Any) -> Any:
            self._state.write(pending, arrays, values.keys())
            self._state.set_tangents({name: mi.TensorXf(1.0, value.shape) for name, value in values.items()})
            render = self._integrator.rms_derivative
            return evaluate(
                render(self._scene, self._sensor, spp, dr.opaque(mi.UInt32, 0), light_traced.mask)
            )

        return _smooth(call_with_torch(rms_derivative, *pending.values()))

    @cached_property
    def _noise_map(self) -> torch.Tensor:
        """Estimate the noise of each pixel from a few renders without directly visible lights.

        The noise of a pixel's derivatives is roughly proportional; directly visible lights have none. The scene's
        own values are rendered, so that the same seed samples the same pixels whatever was rendered before.
        """
        integrator = self._plan.create_integrator(hide_emitters=True)
        render, *_ = _freeze(integrator, self._sensor, self._state.forget_gradients)

        def luminance(seed: int) -> torch.Tensor:
            fixed = dr.opaque(mi.UInt32, seed), NOISE_SPP, self._state.scalars
            image = call_with_torch(lambda: evaluate(render(self._scene, *fixed)))
            brightness: torch.Tensor = image.double().sum(-1)  # whose squares may overflow float32
            return brightness

        with self.with_values({}):
            noise = torch.stack([luminance(seed) for seed in range(NOISE_RENDERS)]).std(0)
        return _smooth(noise)

    def _replay_forward(self, values: Values, tangents: Values, seed: int, spp: int) -> torch.Tensor:
        with self.exclusive_scene():
            tracked = tuple(tangents)
            pending = self._state.pending_writes(
                _clamp_off_singularities(values, tracked, self._parameters), tracked
            )
            split = len(tangents)

            def forward(*arrays: Any) -> Any:
                self._state.write(pending, arrays[split:], tracked)
                self._state.set_tangents(dict(zip(tracked, arrays[:split], strict=True)))
                return _sum(
                    evaluate(
                        self._integrator.render_forward(
                            self._scene,
                            None,
                            self._sensor,
                            seed=dr.opaque(mi.UInt32, chunk.seed),
                            spp=chunk.spp,
                        )
                        * chunk.weight
                    )
                    for chunk in self._chunks(seed, spp)
                )

            image: torch.Tensor = call_with_torch(forward, *tangents.values(), *pending.values())
            return image

    def _chunks(self, seed: int, spp: int) -> Iterator[Chunk]:
        return chunks(seed, spp, self._resolution)

    @contextlib.contextmanager
    def with_values(self, values: Values) -> Iterator[None]:
        """Give the scene these values, untracked, within an ``exclusive_scene``."""
        with self.exclusive_scene():
            pending = self._state.pending_writes(values, ())

            def write(*arrays: Any) -> None:
                self._state.write(pending, arrays, ())

            call_with_torch(write, *pending.values())
            yield

    @contextlib.contextmanager
    def exclusive_scene(self) -> Iterator[None]:
        """Lock Mitsuba for this thread, and restore a borrowed scene afterwards."""
        with exclusively(self._variant), _collector_paused():
            if self._has_exclusive_scene:
                yield
                return
            self._take_over_tracking()
            self.refresh_originals()
            size = _film_size(self._sensor)
            _resize(self._sensor, self._resolution)
            self._has_exclusive_scene = True
            try:
                yield
            finally:
                self._has_exclusive_scene = False
                if self._borrowed:
                    self._state.restore()
                    _resize(self._sensor, size)

    def _take_over_tracking(self) -> None:
        global _tracking  # noqa: PLW0603 -- there is one Dr.Jit, and it tracks for the whole process
        previous = _tracking() if _tracking is not None else None
        # The cameras of one renderer share their state.
        if previous is not None and previous._state is not self._state:
            previous._state.release()
        _tracking = weakref.ref(self)


def _equal(first: Values, second: Values) -> bool:
    return first is second or (
        first.keys() == second.keys() and all(torch.equal(first[n], second[n]) for n in first)
    )


def _smooth(image: torch.Tensor) -> torch.Tensor:
    """Filter an ``(H, W)`` image with a 3×3 box."""
    smooth: torch.Tensor = torch.nn.functional.avg_pool2d(image[None, None], 3, 1, 1, count_include_pad=False)
    return smooth[0, 0]


def _freeze(integrator: Any, sensor: Any, forget: Callable[[], None]) -> tuple[Callable[..., Any], ...]:
    """Return render, backward pass and backward pass of given pixels, as frozen functions where that is safe.

    Tracing a room with dozens of materials in Python takes 0.2 s each time; a frozen function does it once.
    ``scalars`` become literals in kernels, so they are arguments: other values are traced again.
    """

    def render(scene: Any, seed: Any, spp: int, scalars: tuple[float, ...]) -> Any:
        return integrator.render(scene, sensor, seed=seed, spp=spp)

    def render_backward(scene: Any, adjoint: Any, seed: Any, spp: int, scalars: tuple[float, ...]) -> None:
        integrator.render_backward(scene, None, adjoint, sensor, seed=seed, spp=spp)

    def render_backward_pixels(
        scene: Any,
        adjoint: Any,
        seed: Any,
        scalars: tuple[float, ...],
        samples: tuple[Any, Any],
        profile: tuple[Any, int],
        light_traced: SampledShapes | None,
    ) -> None:
        mask = light_traced.mask if light_traced else None
        integrator.render_backward_pixels(scene, sensor, adjoint, samples, profile, seed, mask)
        if light_traced is not None:
            camera = CameraAdjoint(sensor, adjoint, profile)
            trace_light_backward(integrator, scene, camera, light_traced, seed, dr.width(samples[0]))

    functions = (render, render_backward, render_backward_pixels)
    # Frozen functions do not see changes of phase functions: their images would stay the same.
    if isinstance(integrator, VolumetricReplayIntegrator):
        return functions
    return tuple(_FrozenFunction(function, forget) for function in functions)


class _FrozenFunction:
    """A frozen function, or the plain function where a plugin hides objects that freezing would have to see."""

    def __init__(self, function: Callable[..., Any], forget: Callable[[], None]) -> None:
        self._function = function
        self._forget = forget
        self._call = dr.freeze(function, warn_after=1000, limit=8)

    def __call__(self, *arguments: Any) -> Any:
        try:
            return self._call(*arguments)
        except RuntimeError as error:
            if "record()" not in _full_message(error) or _is_detached_error(error):
                raise
            # Gradients that the failed recording has accumulated would count twice.
            self._forget()
            self._call = self._function
            return self._function(*arguments)


def _full_message(error: BaseException | None) -> str:
    """Return the messages of an error and of its causes."""
    return "" if error is None else f"{error} {_full_message(error.__cause__)}"


def evaluate(*images: Any) -> Any:
    """Evaluate and wait: otherwise Dr.Jit would start the next chunk beside this one, with memory of its own."""
    dr.eval(*images)
    dr.sync_thread()
    return images[0] if images else None


def _sum(terms: Iterable[Any]) -> Any:
    """Add images without an initial 0, which would need a type and a shape."""
    return reduce(operator.add, terms)


def _clamp_off_singularities(values: Values, tracked: Collection[str], parameters: SceneParameters) -> Values:
    clamped = {name: clamp_off_singularity(parameters[name], values[name]) for name in tracked}
    return {**values, **clamped}


def call_with_torch(function: Callable[..., Any], *tensors: torch.Tensor) -> Any:
    """Call a function of Dr.Jit tensors with torch tensors."""
    try:
        return dr.wrap(source="torch", target="drjit")(function)(
            *(tensor.detach().to(torch.float32).contiguous() for tensor in tensors)
        )
    except RuntimeError as error:
        if _is_detached_error(error):
            raise SceneCaptumError(NO_DERIVATIVE) from error
        raise


@contextlib.contextmanager
def _collector_paused() -> Iterator[None]:
    """Pause garbage collection: collecting a scene while Dr.Jit records a frozen function aborts the process."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _film_size(sensor: Any) -> tuple[int, int]:
    width, height = sensor.film().crop_size()
    return int(width), int(height)


def _resize(sensor: Any, size: tuple[int, int]) -> None:
    if _film_size(sensor) != size:
        film = mi.traverse(sensor)
        film["film.size"] = list(size)
        film.update()


NO_DERIVATIVE = (
    "No derivative reaches any of the inputs: none of them affects a path that can be differentiated. See "
    "renderer.plan for cautions, and add an input that the image depends on, such as a light."
)


def _is_detached_error(error: BaseException) -> bool:
    """Whether an error was caused by Mitsuba finding nothing attached to the AD graph."""
    return "not attached to the AD graph" in _full_message(error)
