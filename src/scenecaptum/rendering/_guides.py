"""Guide images for a denoiser without noise: albedo, shading normals, and the light of visible lamps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
import torch

from ..denoising import Guides
from ..scene import Moved
from ._live_scene import LiveScene
from ._visibility import RAYS, batches, camera_rays, film_position, follow_specular, rays_from, rays_in

# Rays in a pixel where a lamp ends. The rays of other pixels resolve a sixteenth of one: the light that they miss
# is noise to the denoiser, and biased the derivative of a rating of glare by 1.5 %.
EDGE_RAYS = 256


class Shown(NamedTuple):
    """What guides depend on: the poses and lights that differ from those of the scene as loaded."""

    moved: Moved
    lit: Mapping[str, torch.Tensor]

    def is_same(self, other: Shown) -> bool:
        """Whether poses and lights are the same."""
        return (
            self.moved == other.moved
            and self.lit.keys() == other.lit.keys()
            and all(torch.equal(value, other.lit[name]) for name, value in self.lit.items())
        )


@dataclass(eq=False)
class LastGuides:
    """The guides of a renderer's pictures, kept for the poses and lights they were last traced with.

    ``stacked`` pictures have a dimension of sensors.
    """

    scenes: Sequence[LiveScene]  # of each sensor
    stacked: bool
    emission: bool  # as for ``trace_guides``
    _last: tuple[Shown, Guides] | None = None

    def of(self, values: Mapping[str, torch.Tensor], shown: Shown) -> Guides:
        """Return the guides with the poses and lights of ``values``; these are named in ``shown``."""
        if self._last is None or not self._last[0].is_same(shown):
            changed = {name: values[name] for name in (*dict(shown.moved), *shown.lit)}
            guides = [self._trace(live, changed) for live in self.scenes]
            self._last = shown, Guides.stacked(guides) if self.stacked else guides[0]
        return self._last[1]

    def _trace(self, live: LiveScene, values: Mapping[str, torch.Tensor]) -> Guides:
        with live.with_values(values):
            return trace_guides(live.scene, live.sensor, live.resolution, emission=self.emission)


def trace_guides(scene: Any, sensor: Any, resolution: tuple[int, int], *, emission: bool) -> Guides:
    """Trace camera rays through mirrors and glass to the first surface that scatters light.

    With ``emission``, the guides have the light of the visible lamps and the background, unless a lens blurs it.

    Each pixel averages the same stratified rays at every call, so the guides have no noise. Emitters and the
    background have an albedo of 1, as Open Image Denoise's documentation requires; outside a fisheye's circle it
    is 0.
    """
    width, height = resolution
    parts = [_guide_rays(scene, sensor, resolution, *pixels) for pixels in batches(resolution)]
    albedo, normal = (np.concatenate(part).reshape(height, width, 3) for part in zip(*parts, strict=True))
    light = _emission(scene, sensor, resolution) if emission and not sensor.needs_aperture_sample() else None
    return Guides(torch.from_numpy(albedo), torch.from_numpy(normal), light)


def _emission(scene: Any, sensor: Any, resolution: tuple[int, int]) -> torch.Tensor:
    """Return the light of the lamps and the background that rays meet first, through the film's filter."""
    width, height = resolution
    block = mi.ImageBlock(resolution, (0, 0), 4, rfilter=sensor.film().rfilter(), border=False)
    with dr.suspend_grad():
        means = torch.cat([_mean_light(scene, sensor, resolution, *pixels) for pixels in batches(resolution)])
        edge = _edges(means.reshape(height, width, 3)).flatten().numpy()
        for pixel, point in rays_in((~edge).nonzero()[0], RAYS):
            light = dr.gather(mi.Color3f, mi.Float(means.flatten().numpy()), pixel)
            _put(block, film_position(resolution, pixel, point), light, RAYS)
        for pixel, point in rays_in(edge.nonzero()[0], EDGE_RAYS):
            position = film_position(resolution, pixel, point, EDGE_RAYS)
            light = _light(scene, *rays_from(sensor, resolution, position))
            _put(block, position, light, EDGE_RAYS)
        filtered: torch.Tensor = block.tensor().torch().cpu()
    return filtered[..., :3] / filtered[..., 3:]


def _put(block: Any, position: Any, light: Any, rays: int) -> None:
    """Add rays of pixels to a block; all pixels have the same weight, for filters wider than a pixel."""
    block.put(position, [*(light / rays), mi.Float(1 / rays)])
    dr.eval(block.tensor())


def _mean_light(scene: Any, sensor: Any, resolution: tuple[int, int], first: int, count: int) -> torch.Tensor:
    """Return the mean light that the rays of some pixels meet first, ``(count, 3)``."""
    ray, weight, _, _ = camera_rays(sensor, resolution, first, count)
    light = _light(scene, ray, weight)
    dr.eval(light)  # in one kernel; each sum would have one of its own
    means = [dr.block_reduce(dr.ReduceOp.Add, mi.Float(channel), RAYS) / RAYS for channel in light]
    return torch.from_numpy(np.stack([np.broadcast_to(mean.numpy(), count) for mean in means], -1))


def _light(scene: Any, ray: Any, weight: Any) -> Any:
    si = scene.ray_intersect_preliminary(ray, coherent=True).compute_surface_interaction(ray)
    return weight * si.emitter(scene).eval(si)


def _edges(light: torch.Tensor) -> torch.Tensor:
    """Return which pixels of an image ``(H, W, 3)`` differ by a tenth from one beside them, ``(H, W)``."""
    brightest = light.amax(-1)[None]
    pooled = [torch.nn.functional.max_pool2d(sign * brightest, 3, 1, 1)[0] for sign in (1, -1)]
    return pooled[0] > -1.1 * pooled[1]


def _guide_rays(
    scene: Any, sensor: Any, resolution: tuple[int, int], first: int, count: int
) -> tuple[Any, Any]:
    """Return the mean albedo and normal of some pixels, two arrays ``(count, 3)``."""
    with dr.suspend_grad():
        ray, weight, pixel, point = camera_rays(sensor, resolution, first, count)
        hit = scene.ray_intersect_preliminary(ray, coherent=True)
        followed = follow_specular(scene, ray, hit, pixel, point)
        si = followed.hit.compute_surface_interaction(followed.ray)
        valid = dr.max(weight) > 0  # not outside a fisheye's circle
        albedo = dr.select(valid, _albedo(si), 0)
        normal = dr.select(valid & si.is_valid(), si.sh_frame.n, 0)
        dr.eval(albedo, normal)  # in one kernel; each sum would have one of its own
        means = [
            dr.block_reduce(dr.ReduceOp.Add, mi.Float(channel), RAYS) / RAYS
            for guide in (albedo, normal)
            for channel in guide
        ]
        dr.eval(means)
    columns = [np.broadcast_to(mean.numpy(), count) for mean in means]
    return np.stack(columns[:3], -1), np.stack(columns[3:], -1)


def _albedo(si: Any) -> Any:
    """Return the diffuse reflectance, clipped to [0, 1]; 1 for emitters and the background.

    Surfaces without a diffuse lobe have the weight of one BSDF sample instead.
    """
    context, bsdf = mi.BSDFContext(), si.bsdf()
    reflects = si.is_valid() & ~si.shape.is_emitter()
    diffuse = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse)
    _, glossy = bsdf.sample(context, si, 0.5, mi.Point2f(0.5), reflects & ~diffuse)
    reflected = dr.select(diffuse, bsdf.eval_diffuse_reflectance(si, reflects & diffuse), glossy)
    return dr.select(reflects, dr.clip(reflected, 0, 1), 1)
