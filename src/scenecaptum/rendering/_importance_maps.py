"""How the samples of a backward pass are distributed: importance maps of pixels, and light-traced surfaces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import torch

from ..projection import SurfaceMap
from ..scene import SceneParameters
from ._backward import FilmFilter, film_filter
from ._bridge import call_with_torch, evaluate
from ._derivative_routes import Routes, by_scene, low_roughness_names, replayed_names
from ._frozen import make_kernels
from ._live_scene import LiveScene, Values
from ._plan import RenderPlan
from .integrators.light_tracing import SampledShapes, find_sampled_shapes

# Mixture weights of the importance maps: noisy pixels, and noisy pixels with equal shares per tracked surface. The
# remaining samples are uniform.
NOISE_WEIGHT, SURFACE_WEIGHT = 0.35, 0.35
NOISE_RENDERS, NOISE_SPP = 8, 2

# Samples for the noise map of low roughnesses: in all, and per pixel at most.
ROUGHNESS_NOISE_SAMPLES, MAX_ROUGHNESS_NOISE_SPP = 2**20, 64

# Pairs of a mixture weight and a map ``(H, W)``.
Maps = Sequence[tuple[float, torch.Tensor]]


class ReplayGroup(NamedTuple):
    """Parameters whose backward pass takes the same samples.

    ``light_traced`` are the shapes from whose surfaces light tracing starts, or None for path replay alone.
    """

    names: list[str]
    maps: Maps
    light_traced: SampledShapes | None


@dataclass(eq=False, repr=False)
class ImportanceMaps:
    """The importance maps of a scene, for one sensor; cached until the scene's own values change."""

    live: LiveScene
    parameters: SceneParameters
    plan: RenderPlan
    integrator: Any
    surface_map: Callable[[], SurfaceMap]
    _sampled_shapes: dict[tuple[str, ...], SampledShapes | None] = field(default_factory=dict)
    _maps: dict[Any, Maps] = field(default_factory=dict)
    _originals: Values = field(default_factory=dict)  # those of the cached maps

    @cached_property
    def film(self) -> FilmFilter | None:
        """The film's filter; None for a film whose samples cannot be weighted individually, but are uniform."""
        with self.live.exclusive():  # which gives the film its size
            return film_filter(self.live.sensor.film())

    def groups(self, values: Values, routes: Routes) -> list[ReplayGroup]:
        """Divide the replayed parameters into groups: low roughnesses that are light traced, and the others.

        What has a scene of its own is a group of its own.
        """
        names, low_roughness = replayed_names(routes), low_roughness_names(routes)
        shapes = self._find_sampled_shapes(tuple(low_roughness)) if self.film and low_roughness else None
        rest = [name for name in names if shapes is None or name not in low_roughness]
        groups = [ReplayGroup(one, self.find_maps(values, one, None), None) for one in by_scene(routes, rest)]
        if shapes is not None:
            groups.append(ReplayGroup(low_roughness, self.find_maps(values, low_roughness, shapes), shapes))
        return groups

    def _find_sampled_shapes(self, names: tuple[str, ...]) -> SampledShapes | None:
        with self.live.exclusive():
            if names not in self._sampled_shapes:
                params_by_shape = self.surface_map().parameters
                self._sampled_shapes[names] = find_sampled_shapes(
                    self.live.graph, params_by_shape, self.live.sensor, self.plan, names
                )
            return self._sampled_shapes[names]

    def find_maps(self, values: Values, names: Sequence[str], light_traced: SampledShapes | None) -> Maps:
        """Return importance maps and their mixture weights: the noise, and the noise equalized by surface."""
        if not names or self.film is None:
            return []
        with self.live.exclusive():
            # Highlights depend on the roughness, but a factor of 2 is precise enough to cache them.
            octaves = (
                {n: values[n].clamp_min(1e-4).log2().round().exp2() for n in names} if light_traced else {}
            )
            if self._originals is not self.live.original:
                self._originals = self.live.original
                self._maps.clear()
                self.__dict__.pop("_noise", None)
            key = tuple(names), tuple(value.numpy(force=True).tobytes() for value in octaves.values())
            if key not in self._maps:
                noise = self._roughness_noise(light_traced, octaves) if light_traced else self._noise
                self._maps[key] = (
                    (NOISE_WEIGHT, noise),
                    (SURFACE_WEIGHT, self._equalized_by_surface(noise, names)),
                )
            return self._maps[key]

    def _equalized_by_surface(self, noise: torch.Tensor, names: Sequence[str]) -> torch.Tensor:
        """Return the noise map, scaled so that the surfaces of each parameter have the same sum.

        Otherwise small objects would get few samples beside the walls.
        """
        surfaces = [n for n in names if self.parameters[n].kind not in ("emitters", "media")]
        masks = (torch.from_numpy(self.surface_map().shown([name])).to(noise.device) for name in surfaces)
        masked = [noise * mask for mask in masks]
        return sum((part / part.sum() for part in masked if part.any()), torch.zeros_like(noise))

    def _roughness_noise(self, light_traced: SampledShapes, values: Values) -> torch.Tensor:
        """Estimate the noise of each pixel's derivatives that light tracing leaves to path replay."""
        width, height = self.live.resolution
        spp = max(1, min(MAX_ROUGHNESS_NOISE_SPP, ROUGHNESS_NOISE_SAMPLES // (width * height)))
        scene, sensor, state = self.live.scene, self.live.sensor, self.live.state

        def rms_derivative() -> Any:
            state.set_tangents({name: dr.ones(mi.TensorXf, value.shape) for name, value in values.items()})
            render = self.integrator.rms_derivative
            return evaluate(render(scene, sensor, spp, dr.opaque(mi.UInt32, 0), light_traced.mask))

        return _smooth(self.live.call(rms_derivative, values, values.keys()))

    @cached_property
    def _noise(self) -> torch.Tensor:
        """Estimate the noise of each pixel from a few renders without directly visible lights.

        The noise of a pixel's derivatives is roughly proportional; directly visible lights have none. The scene's
        own values are rendered, so that the same seed samples the same pixels whatever was rendered before.
        """
        live, plan = self.live, self.plan
        render = make_kernels(
            plan.create_integrator(hide_emitters=True),
            live.sensor,
            live.state.forget_gradients,
            freeze=plan.kind.freezable,
        ).render

        def luminance(seed: int) -> torch.Tensor:
            fixed = dr.opaque(mi.UInt32, seed), NOISE_SPP, live.state.scalars
            image = call_with_torch(lambda: evaluate(render(live.scene, *fixed)))
            brightness: torch.Tensor = image.double().sum(-1)  # whose squares may overflow float32
            return brightness

        with live.with_values({}):
            noise = torch.stack([luminance(seed) for seed in range(NOISE_RENDERS)]).std(0)
        return _smooth(noise)


def _smooth(image: torch.Tensor) -> torch.Tensor:
    """Filter an ``(H, W)`` image with a 3×3 box."""
    smooth: torch.Tensor = torch.nn.functional.avg_pool2d(image[None, None], 3, 1, 1, count_include_pad=False)
    return smooth[0, 0]
