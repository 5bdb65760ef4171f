"""Render, vector–Jacobian and Jacobian–vector products as pure functions of tensors.

Each call writes its own values into the scene; later changes of the scene do not affect its result.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, partial, reduce
from typing import Any

import drjit as dr
import mitsuba as mi
import torch
from torch.nn.functional import pad

from ..errors import SceneCaptumError
from ..scene import SceneParameters
from ._backward import AdjointSampledIntegrator, has_independent_samples
from ._bridge import evaluate, full_message
from ._chunks import Chunk, chunks
from ._derivative_routes import (
    DIFFERENCE_SPP_DIVISOR,
    FiniteDifference,
    Routes,
    by_scene,
    derivative_routes,
    pose_difference,
    replayed_names,
    uncorrected_routes,
)
from ._dr_arrays import flat, owned
from ._frozen import make_kernels
from ._importance_maps import ImportanceMaps, Maps, ReplayGroup
from ._live_scene import LiveScene, Values
from ._moved_materials import MovedParameter, batches, move
from ._pixel_sampling import sample_pixels
from ._plan import RenderPlan
from ._state import Snapshot
from ._turning_camera import TurningCamera
from .integrators.light_tracing import LightPaths
from .integrators.path_differences import MovedMaterials, working_arrays

# Relative: sums over two images that differ by less are those of equal images, but for rounding.
EQUAL = 1e-7


class Engine:
    """Renders a scene and its derivatives for given parameter values, by a plan and its integrator."""

    def __init__(
        self,
        live: LiveScene,
        parameters: SceneParameters,
        plan: RenderPlan,
        integrator: Any,
        importance_maps: ImportanceMaps,
        moved: Mapping[str, MovedParameter],
    ) -> None:
        self._live = live
        self._parameters = parameters
        self._integrator = integrator
        self._importance_maps = importance_maps
        self._moved = moved
        self._latest_routes: tuple[Snapshot, Routes] = Snapshot(), {}
        self._latest_adjoint: tuple[torch.Tensor, torch.Tensor] | None = None  # and its magnitude
        self._kernels = make_kernels(
            integrator, live.sensor, live.state.forget_gradients, freeze=plan.kind.freezable
        )
        self.camera = TurningCamera(
            live, importance_maps.film if self._has_independent_samples else None, self._kernels.radiance_at
        )
        # Decoding textures leaves as much memory again in Dr.Jit's allocation cache.
        dr.flush_malloc_cache()

    def primal(self, values: Values, seed: int, spp: int, tracked: Sequence[str] = ()) -> torch.Tensor:
        """Render: ``(H, W, 3)`` linear radiance.

        ``tracked`` are the parameters that will be differentiated. They are tracked from the first render on,
        because a frozen kernel would be recorded again after the first backward pass otherwise.
        """

        def render() -> Any:
            with dr.suspend_grad():
                return _sum(
                    evaluate(self._render_chunk(chunk) * chunk.weight) for chunk in self._chunks(seed, spp)
                )

        if tracked and not self._live.state.leaves and not self._live.is_borrowed:
            values = self._live.snapshot(values)
            names = replayed_names(self._find_routes(values, tracked))
            image: torch.Tensor = self._live.call(render, values, names)
        else:
            image = self._live.call(render, values)
        return image

    def _render_chunk(self, chunk: Chunk) -> Any:
        scene, scalars = self._live.scene, self._live.state.scalars
        if not self._has_independent_samples:
            return self._kernels.render(scene, opaque_seed(chunk), chunk.spp, scalars)
        width, height = self._live.resolution
        samples = width * height * chunk.spp
        lane = dr.arange(mi.UInt32, samples + 1)
        # A sample far from the film, see ``_pixel_arguments``.
        pixel = dr.select(
            lane < samples, lane // dr.opaque(mi.UInt32, chunk.spp), 2 * width * height + 16 * width
        )
        dr.eval(pixel)
        # The first render would otherwise be the only one of a film without pixels.
        self._live.sensor.film().prepare([])
        return self._kernels.render_samples(scene, opaque_seed(chunk), pixel, scalars)

    @cached_property
    def _has_independent_samples(self) -> bool:
        """Whether samples are drawn independently, each for one pixel of the whole film."""
        return isinstance(self._integrator, AdjointSampledIntegrator) and has_independent_samples(
            self._live.sensor
        )

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
        adjoint = adjoint.detach().float()
        if not adjoint.any():  # such as that of a camera that the metric's target leaves out
            return tuple(torch.zeros_like(values[name]) for name in tracked)
        values = self._live.snapshot(values)
        routes = self._find_routes(values, tracked)
        gradients: dict[str, torch.Tensor] = {}
        if importance_sampling and self._importance_maps.film:
            turned = [name for name in routes if self.camera.moves(name)]
            gradients |= self.camera.gradients(values, turned, adjoint, self._chunks(seed, spp))
            for group in self._importance_maps.groups(values, routes):
                gradients |= self._replay_sampled_pixels(values, routes, group, adjoint, seed, spp)
            moved = [name for name in self._moved if name in routes and routes[name].difference is not None]
            for names in batches(moved, self._moved):
                gradients |= self._difference_of_paths(values, routes, names, adjoint, seed, spp)
        else:
            gradients |= self._replay_all_pixels(values, routes, adjoint, seed, spp)
        for name, route in routes.items():
            if route.is_constant:
                gradients[name] = torch.zeros_like(values[name])
            elif name not in gradients and route.difference is not None:
                fewer = max(1, spp // DIFFERENCE_SPP_DIVISOR) if importance_sampling else spp
                (gradients[name],) = self._difference_vjps(
                    name, route.difference, values, adjoint, [seed], fewer
                )
        return tuple(gradients[name].to(values[name]) for name in tracked)

    def jvp(self, values: Values, tangents: Values, seed: int, spp: int) -> torch.Tensor:
        """Return the Jacobian–vector product: the derivative image in the direction of ``tangents``."""
        values = self._live.snapshot(values)
        routes = self._find_routes(values, tangents)
        routes = {name: route for name, route in routes.items() if not route.is_constant}
        replayed = {name: tangents[name] for name in replayed_names(routes)}
        width, height = self._live.resolution
        image = torch.zeros((height, width, 3), device=self._live.device)
        for names in by_scene(routes, replayed):
            tangents_of = {name: replayed[name] for name in names}
            image = image + self._replay_forward(values, routes, tangents_of, seed, spp)
        for name in [name for name in routes if name not in replayed]:
            difference = routes[name].difference
            assert difference is not None
            tangent = tangents[name].reshape(-1) if difference.by_element else tangents[name][None]
            quotients = self._difference_quotients(name, difference, values, seed, spp)
            for quotient, element in zip(quotients, tangent, strict=True):
                image = image + (quotient * element).to(image)
        return image

    def _find_routes(self, values: Snapshot, tracked: Iterable[str]) -> Routes:
        """Return the routes of the tracked parameters, the latest ones if these are of the same tensors.

        A texture with black texels is copied for its route, which takes time, as does writing the copy.
        """
        names = tuple(tracked)
        known, routes = self._latest_routes
        if tuple(routes) != names or any(known.get(name) is not value for name, value in values.items()):
            routes = derivative_routes(self._parameters, values, names)
            self._latest_routes = values, routes
        return routes

    def _difference_vjps(
        self,
        name: str,
        difference: FiniteDifference,
        values: Snapshot,
        adjoint: torch.Tensor,
        seeds: Sequence[int],
        spp: int,
    ) -> torch.Tensor:
        """Return the gradients of ``⟨adjoint, image⟩`` by a finite difference, one for each seed."""
        weighted = adjoint.double()

        def products(point: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            images = self._moved_images(name, difference, values, point, seeds, spp)
            sums = [
                (one.sum((0, 1)), one.abs().sum((0, 1))) for one in (weighted * image for image in images)
            ]
            return torch.stack([total for total, _ in sums]), torch.stack([size for _, size in sums])

        def gradient(points: Sequence[tuple[torch.Tensor, torch.Tensor]]) -> torch.Tensor:
            weights = [weight for _, weight in points]
            totals, sizes = zip(*(products(point) for point, _ in points), strict=True)
            total: torch.Tensor = _sum(map(operator.mul, totals, weights))
            rounding = EQUAL * _sum(size * weight.abs() for size, weight in zip(sizes, weights, strict=True))
            return torch.where(total.abs() > rounding, total, 0)

        gradients = [gradient(points) for points in self._moved_points(difference, values[name])]
        if difference.by_element:
            totals = torch.stack([gradient.sum(-1) for gradient in gradients], 1)
            return totals.reshape(len(seeds), *values[name].shape)
        # Each channel of the image depends only on the same channel of a colour.
        return gradients[0] if values[name].ndim else gradients[0].sum(-1)

    def step_changes(
        self, values: Values, names: Iterable[str], adjoint: torch.Tensor, seeds: Sequence[int], spp: int
    ) -> dict[str, torch.Tensor]:
        """Return for each pose by how much its gradients change if the step of the difference is doubled.

        There is one for each seed.
        """
        values = self._live.snapshot(values)
        changes = {}
        for name in names:
            own, double = (
                self._difference_vjps(
                    name,
                    pose_difference(self._parameters[name], values[name], factor),
                    values,
                    adjoint,
                    seeds,
                    spp,
                )
                for factor in (1.0, 2.0)
            )
            changes[name] = double - own
        return changes

    def range_changes(
        self,
        values: Values,
        directions: Mapping[str, torch.Tensor],
        adjoint: torch.Tensor,
        seeds: Sequence[int],
        spp: int,
    ) -> dict[str, torch.Tensor]:
        """Return for each pose the mean gradient over its range in a direction, one for each seed."""
        values = self._live.snapshot(values)
        weighted = adjoint.double()
        changes = {}
        for name, direction in directions.items():
            difference = pose_difference(self._parameters[name], values[name])
            products = []
            for shift, weight in difference.points:
                point = values[name] + direction.to(values[name]) * shift
                images = self._moved_images(name, difference, values, point, seeds, spp)
                sums = torch.stack([(weighted * image).sum() for image in images])
                products.append(sums * weight.reshape(-1)[0])
            changes[name] = _sum(products)
        return changes

    def _difference_quotients(
        self, name: str, difference: FiniteDifference, values: Snapshot, seed: int, spp: int
    ) -> Iterator[torch.Tensor]:
        """Yield the derivative images per unit by a finite difference, float64.

        There is one for a scalar or colour, or one for each element.
        """
        for points in self._moved_points(difference, values[name]):
            quotient: torch.Tensor = _sum(
                image.double() * weight
                for point, weight in points
                for image in self._moved_images(name, difference, values, point, [seed], spp)
            )
            yield quotient

    def _moved_points(
        self, difference: FiniteDifference, value: torch.Tensor
    ) -> Iterator[list[tuple[torch.Tensor, torch.Tensor]]]:
        """Yield the values of a difference with their weights: once, or for each element."""
        ones = torch.ones_like(value)
        units = (
            torch.eye(value.numel()).reshape(-1, *value.shape).to(value) if difference.by_element else [ones]
        )
        for unit in units:
            yield [
                (value + unit * shift, weight.reshape(-1)[0] if difference.by_element else weight)
                for shift, weight in difference.points
            ]

    def _moved_images(
        self,
        name: str,
        difference: FiniteDifference,
        values: Snapshot,
        point: torch.Tensor,
        seeds: Sequence[int],
        spp: int,
    ) -> Iterator[torch.Tensor]:
        """Yield the images with another value of a parameter, one for each seed.

        The seeds come last, because moving an object takes as long as a small render.
        """
        off = {other: torch.zeros_like(self._live.original[other]) for other in difference.off}
        moved = values.replace({**off, name: point})
        for seed in seeds:
            yield self.primal(moved, seed, spp)

    def _replay_all_pixels(
        self, values: Snapshot, routes: Routes, adjoint: torch.Tensor, seed: int, spp: int
    ) -> dict[str, torch.Tensor]:
        """Return gradients by path replay of the primal's samples."""

        def replay(chunk: Chunk) -> None:
            image = owned(mi.TensorXf(chunk.weight * adjoint))
            self._kernels.render_backward(
                self._live.scene, image, opaque_seed(chunk), chunk.spp, self._live.state.scalars
            )

        return self._replay(replay, values, routes, replayed_names(routes), seed, spp)

    def _replay_sampled_pixels(
        self, values: Snapshot, routes: Routes, group: ReplayGroup, adjoint: torch.Tensor, seed: int, spp: int
    ) -> dict[str, torch.Tensor]:
        """Return gradients by path replay of importance-sampled pixels, and by light tracing."""
        arguments = self._pixel_arguments(adjoint, group.maps)

        def replay(chunk: Chunk) -> None:
            samples = chunk.spp * math.prod(self._live.resolution)
            light = (
                (group.light_traced, LightPaths.beside(samples, self._integrator.max_depth))
                if group.light_traced
                else None
            )
            self._kernels.render_backward_pixels(self._live.scene, *arguments(chunk), light)

        return self._replay(replay, values, routes, group.names, seed, spp)

    def _difference_of_paths(
        self,
        values: Snapshot,
        routes: Routes,
        names: Sequence[str],
        adjoint: torch.Tensor,
        seed: int,
        spp: int,
    ) -> dict[str, torch.Tensor]:
        """Return gradients by differences of paths through one of the ``batches`` of moved materials.

        There are ``DIFFERENCE_SPP_DIVISOR`` times fewer paths than samples.
        """
        maps = self._importance_maps.find_maps(values, names, None)
        arguments = self._pixel_arguments(adjoint, maps, DIFFERENCE_SPP_DIVISOR)
        differences = [route.difference for name in names if (route := routes[name]).difference]

        def difference(chunk: Chunk, moved: MovedMaterials) -> Any:
            fixed = arguments(chunk)
            arrays = working_arrays(dr.width(fixed[3][0]))
            return self._kernels.difference_backward(self._live.scene, *fixed, (arrays, moved))

        def differentiate() -> Any:
            moved = move([self._moved[name] for name in names], [values[name] for name in names], differences)
            return _sum(evaluate(difference(chunk, moved)) for chunk in self._chunks(seed, spp))

        # The scene is that of path replay, so that its textures are not written twice in each backward pass.
        shared = [name for name in replayed_names(routes) if not routes[name].has_own_scene]
        scene = values.replace(_replay_values(routes, shared))
        # Of the three channels of each parameter, all of which are numbers.
        gradients = self._live.call(differentiate, scene).reshape(-1, 3).sum(1)
        return dict(zip(names, gradients, strict=True))

    def _pixel_arguments(
        self, adjoint: torch.Tensor, maps: Maps, divisor: int = 1
    ) -> Callable[[Chunk], tuple[Any, ...]]:
        """Return the arguments of a backward pass of importance-sampled pixels, for each chunk.

        The samples are those of the chunk, divided by ``divisor``.
        """
        film = self._importance_maps.film
        assert film is not None
        # A linear metric has the same adjoint for all replicates.
        if self._latest_adjoint is None or not torch.equal(self._latest_adjoint[0], adjoint):
            # A copy: the caller may change its own.
            self._latest_adjoint = adjoint.clone(), film.rms_adjoint(adjoint)
        magnitude = self._latest_adjoint[1]

        def arguments(chunk: Chunk) -> tuple[Any, ...]:
            count = math.ceil(math.prod(self._live.resolution) * chunk.spp / divisor)
            pixel, weight = sample_pixels(magnitude, maps, count, chunk.seed)
            # One more sample, of weight 0: a kernel is recorded again where two of its arrays that had different
            # lengths have the same, and the number of samples would sometimes be that of pixels or channels.
            pixel, weight = pad(pixel, (0, 1), value=len(weight)), pad(weight, (0, 2))
            samples = owned(mi.UInt32(pixel)), owned(mi.Float(weight))
            profile = owned(mi.Float(film.profile.to(weight))), film.radius
            image = owned(mi.TensorXf(chunk.weight * adjoint / film.filter_weight_sum.to(weight)))
            return image, opaque_seed(chunk), self._live.state.scalars, samples, profile

        return arguments

    def _replay(
        self,
        replay: Callable[[Chunk], None],
        values: Snapshot,
        routes: Routes,
        names: Iterable[str],
        seed: int,
        spp: int,
    ) -> dict[str, torch.Tensor]:
        """Return the gradients that ``replay`` accumulates over all chunks, in one scene after the other."""

        def backward(together: Sequence[str]) -> Any:
            for chunk in self._chunks(seed, spp):
                replay(chunk)
                evaluate()
            return [flat(dr.grad(self._live.state.leaves[name])) for name in together]

        gradients: dict[str, torch.Tensor] = {}
        for together in by_scene(routes, names):
            scene = values.replace(_replay_values(routes, together))
            found = self._live.call(partial(backward, together), scene, together)
            gradients |= {n: g.reshape(values[n].shape) for g, n in zip(found, together, strict=True)}
        return gradients

    def _replay_forward(
        self, values: Snapshot, routes: Routes, tangents: Values, seed: int, spp: int
    ) -> torch.Tensor:
        def forward(*arrays: Any) -> Any:
            self._live.state.set_tangents(dict(zip(tangents, arrays, strict=True)))
            return _sum(
                evaluate(
                    self._integrator.render_forward(
                        self._live.scene, None, self._live.sensor, seed=opaque_seed(chunk), spp=chunk.spp
                    )
                    * chunk.weight
                )
                for chunk in self._chunks(seed, spp)
            )

        replay_values = values.replace(_replay_values(routes, tangents))
        image: torch.Tensor = self._live.call(forward, replay_values, tangents.keys(), tangents.values())
        return image

    def _chunks(self, seed: int, spp: int) -> Iterable[Chunk]:
        return chunks(seed, spp, self._live.resolution)


class StockEngine(Engine):
    """Plain path replay: uniform samples, no corrections, and 0 for parameters that Mitsuba does not track.

    The scene is still loaded by this package, with its own smooth and rough plastics.
    """

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
        """Return the vector–Jacobian product; ``importance_sampling`` is ignored."""
        values = self._live.snapshot(values)
        routes = uncorrected_routes(self._parameters, values, tracked)
        try:
            gradients = self._replay_all_pixels(values, routes, adjoint.detach().float(), seed, spp)
        except RuntimeError as error:
            if "invalid gradient size" not in full_message(error):
                raise
            raise SceneCaptumError(
                f"Mitsuba's own integrators cannot differentiate the image of a {self._live.sensor.class_name()}, "
                "which has a single ray: leave integrator= out."
            ) from None
        zeros = {name: torch.zeros_like(values[name]) for name in tracked}
        return tuple((zeros | gradients)[name].to(values[name]) for name in tracked)


def _replay_values(routes: Routes, names: Iterable[str]) -> Values:
    return {name: routes[name].replay_value for name in names}


def opaque_seed(chunk: Chunk) -> Any:
    """Return a chunk's seed as an array, which is not compiled into kernels."""
    return dr.opaque(mi.UInt32, chunk.seed)


def _sum(terms: Iterable[Any]) -> Any:
    """Add images without an initial 0, which would need a type and a shape."""
    return reduce(operator.add, terms)
