"""Frozen kernels: Dr.Jit traces the Python code of an integrator once, then only launches its kernels.

Tracing a room with dozens of materials takes 0.2 s each time. Numbers that Mitsuba stores outside Dr.Jit become
literals in kernels, so they are arguments (``scalars``): with other numbers the code is traced again.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import drjit as dr
import mitsuba as mi

from ._backward import CameraAdjoint
from ._bridge import full_message, is_detached_error
from .integrators.light_tracing import LightPaths, SampledShapes, trace_light_backward
from .integrators.path_differences import MovedMaterials, difference_backward

# Two or three for each finite difference of a number that is a literal in kernels.
MAX_RECORDINGS = 100


@runtime_checkable
class Accumulator(Protocol):
    """An argument of a frozen function that the function accumulates into."""

    def clear(self) -> None:
        """Set the sums to 0."""


class Kernels(NamedTuple):
    """An integrator's render and its backward passes for one sensor."""

    render: Callable[..., Any]
    render_samples: Callable[..., Any]
    radiance_at: Callable[..., Any]
    render_backward: Callable[..., Any]
    render_backward_pixels: Callable[..., Any]
    difference_backward: Callable[..., Any]


def make_kernels(
    integrator: Any, sensor: Any, forget_gradients: Callable[[], None], *, freeze: bool
) -> Kernels:
    """Return the kernels of an integrator, frozen if frozen functions see every change of its scenes.

    ``forget_gradients`` clears the gradients of a recording that has failed.
    """

    def render(sensor: Any, scene: Any, seed: Any, spp: int, scalars: tuple[float, ...]) -> Any:
        return integrator.render(scene, sensor, seed=seed, spp=spp)

    def render_samples(sensor: Any, scene: Any, seed: Any, pixel: Any, scalars: tuple[float, ...]) -> Any:
        return integrator.render_samples(scene, sensor, seed, pixel)

    def radiance_at(sensor: Any, scene: Any, seed: Any, point: Any, scalars: tuple[float, ...]) -> Any:
        return integrator.radiance_at(scene, sensor, seed, point)

    def render_backward(
        sensor: Any, scene: Any, adjoint: Any, seed: Any, spp: int, scalars: tuple[float, ...]
    ) -> None:
        integrator.render_backward(scene, None, adjoint, sensor, seed=seed, spp=spp)

    def render_backward_pixels(  # noqa: PLR0917 -- as its callers pass them
        sensor: Any,
        scene: Any,
        adjoint: Any,
        seed: Any,
        scalars: tuple[float, ...],
        samples: tuple[Any, Any],
        profile: tuple[Any, int],
        light: tuple[SampledShapes, LightPaths] | None,
    ) -> None:
        mask = light[0].mask if light else None
        integrator.render_backward_pixels(scene, sensor, adjoint, samples, profile, seed, mask)
        if light is not None:
            camera = CameraAdjoint(sensor, adjoint, profile)
            trace_light_backward(integrator, scene, camera, *light, seed)

    def differences(  # noqa: PLR0917 -- as above
        sensor: Any,
        scene: Any,
        adjoint: Any,
        seed: Any,
        scalars: tuple[float, ...],
        samples: tuple[Any, Any],
        profile: tuple[Any, int],
        moved: tuple[tuple[Any, Any], MovedMaterials],
    ) -> Any:
        camera = CameraAdjoint(sensor, adjoint, profile)
        return difference_backward(integrator, scene, camera, samples, seed, *moved)

    def reset(*arguments: Any) -> None:
        forget_gradients()
        clear(arguments)

    functions = (render, render_samples, radiance_at, render_backward, render_backward_pixels, differences)
    if not freeze:
        return Kernels(*(partial(function, sensor) for function in functions))
    return Kernels(*(FrozenFunction(function, reset, sensor) for function in functions))


def clear(arguments: Any) -> None:
    """Clear the arrays that a call accumulates into, among its arguments."""
    for argument in arguments:
        if isinstance(argument, Accumulator):
            argument.clear()
        elif isinstance(argument, tuple):
            clear(argument)


def _registries() -> list[Any]:
    """Return pointers of all types that have virtual functions.

    Virtual functions are recorded for every object in the process, in other scenes too, and also for a material
    that no shape uses. Dr.Jit collects the data of all objects of a type if there is a pointer of the type.
    """
    return [
        dr.zeros(kind) for kind in (mi.BSDFPtr, mi.EmitterPtr, mi.ShapePtr, mi.MediumPtr, mi.PhaseFunctionPtr)
    ]


class FrozenFunction:
    """A frozen function, or the plain function where a plugin hides objects that freezing would have to see.

    Its first argument is the sensor. A function that had the sensor in its closure would keep it, since frozen
    functions are cycles of references that wait for the collector. The scene would go before, and a sensor that
    is a part of a shape (an irradiance meter) would point to a shape that is no more: Dr.Jit calls such a sensor
    while it records another scene.
    """

    def __init__(self, function: Callable[..., Any], reset: Callable[..., None], sensor: Any) -> None:
        self._function = function
        self._sensor = sensor

        def state(sensor: Any, *arguments: Any) -> list[Any]:
            # Nor does it see the arrays of a sensor written in Python.
            return [*_registries(), *getattr(sensor, "arrays", ())]

        # Takes the arguments of a recording that has failed, and undoes what it accumulated.
        self._reset = reset
        self._call = dr.freeze(function, state_fn=state, warn_after=1000, limit=MAX_RECORDINGS)

    def __call__(self, *arguments: Any) -> Any:
        try:
            return self._call(self._sensor, *arguments)
        except RuntimeError as error:
            if "record()" not in full_message(error) or is_detached_error(error):
                raise
            # What the failed recording has accumulated would count twice.
            self._reset(*arguments)
            self._call = self._function
            return self._function(self._sensor, *arguments)
