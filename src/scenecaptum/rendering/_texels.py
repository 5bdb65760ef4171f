"""Which texels of a texture, or rows of a mesh attribute, contribute at a point, in NumPy."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import torch
from numpy.typing import NDArray

from ..projection import TexelMap
from ._live_scene import LiveScene
from ._registry import shape_index

Floats = NDArray[np.float32]
Indices = NDArray[np.int64]

WRAP_MODES = ("repeat", "clamp", "mirror")

# If the rays of an entry hit more texels than this, each ray counts the nearest texel instead of the four of a
# bilinear filter. This bounds the number of items, however fine the texture is.
MAX_BILINEAR_TEXELS = 4


@dataclass(frozen=True)
class Lookup:
    """How a texture looks up its texels: ``(x, y)`` is element ``y * stride + x + first`` of the parameter."""

    height: int
    width: int
    nearest: bool  # whether the filter is nearest-neighbour, not bilinear
    wrap_x: str  # one of ``WRAP_MODES``
    wrap_y: str
    stride: int
    first: int
    row_share: Floats  # for each row, the fraction of the whole texture that one of its texels covers

    def nearest_texel(self, x: Floats, y: Floats) -> Indices:
        """Return the nearest texel of each point, ``(N,)``; texel centres have integer coordinates."""
        return self._index(np.floor(x + 0.5).astype(np.int64), np.floor(y + 0.5).astype(np.int64))

    def bilinear_texels(self, x: Floats, y: Floats) -> tuple[Indices, Floats]:
        """Return the four texels around each point and their weights, ``(4, N)``."""
        left, top = np.floor(x), np.floor(y)
        fraction_x, fraction_y = x - left, y - top
        column, row = left.astype(np.int64), top.astype(np.int64)
        index = [self._index(column + dx, row + dy) for dy in (0, 1) for dx in (0, 1)]
        weight = [wy * wx for wy in (1 - fraction_y, fraction_y) for wx in (1 - fraction_x, fraction_x)]
        return np.stack(index), np.stack(weight).astype(np.float32)

    def _index(self, column: Indices, row: Indices) -> Indices:
        column = _wrap(column, self.width, self.wrap_x)
        return _wrap(row, self.height, self.wrap_y) * self.stride + column + self.first

    def shown(self, entry: Indices, coordinates: Sequence[Any], rays: Indices) -> TexelMap:
        """Return the texels that rays hit; ``entry`` is that of each ray, ``rays`` the rays of each entry."""
        x, y = coordinates
        texels = self.height * self.stride
        nearest = self.nearest_texel(x, y)
        if self.nearest:
            key, weight = entry * texels + nearest, np.ones(len(entry), np.float32)
        else:
            hit_entry = np.unique(entry * texels + nearest) // texels
            many = (np.bincount(hit_entry, minlength=len(rays)) > MAX_BILINEAR_TEXELS)[entry]
            bilinear, weights = self.bilinear_texels(x[~many], y[~many])
            key = np.concatenate(
                [(entry * texels + nearest)[many], (entry[~many] * texels + bilinear).ravel()]
            )
            weight = np.concatenate([np.ones(many.sum(), np.float32), weights.ravel()])
        return _sum_by_key(key, weight, texels, rays, lambda texel: self.row_share[texel // self.stride])


@dataclass(frozen=True)
class MeshLookup:
    """How a mesh looks up an attribute of its vertices, or of its faces."""

    rows: Indices  # ``(faces, 3)``, the row of each corner; or ``(faces, 1)``, the row of the face
    share: Floats  # fraction of the surface area that belongs to each row: a vertex has a third of its faces

    @classmethod
    def of(cls, mesh: Any, attribute: str) -> MeshLookup:
        """Read an attribute's lookup from a mesh."""
        corners = mesh.faces_buffer().numpy().reshape(-1, 3).astype(np.int64)
        points = mesh.vertex_positions_buffer().numpy().reshape(-1, 3)[corners]
        area = np.linalg.norm(np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]), axis=-1)
        rows = corners if attribute.startswith("vertex_") else np.arange(len(corners))[:, None]
        weights = np.repeat(area / (area.sum() * rows.shape[1]), rows.shape[1])
        return cls(rows, np.bincount(rows.ravel(), weights=weights).astype(np.float32))

    def shown(self, entry: Indices, coordinates: Sequence[Any], rays: Indices) -> TexelMap:
        """Return the rows that rays hit, as ``Lookup.shown``."""
        face, second, third = coordinates
        rows = self.rows[face]
        weight = (
            np.stack([1 - second - third, second, third]) if rows.shape[1] == 3 else np.ones((1, len(face)))
        )
        key = entry[:, None] * len(self.share) + rows
        return _sum_by_key(key.ravel(), weight.T.ravel(), len(self.share), rays, lambda row: self.share[row])


def _sum_by_key(
    key: Indices, weight: Any, texels: int, rays: Indices, share: Callable[[Indices], Floats]
) -> TexelMap:
    """Sum the weights of rays that hit the same texel in the same entry; a key is ``entry * texels + texel``."""
    keys, inverse = np.unique(key, return_inverse=True)
    entry, texel = keys // texels, keys % texels
    fraction = np.bincount(inverse, weights=weight, minlength=len(keys)) / rays[entry]
    return TexelMap(
        entry=entry.astype(np.int32),
        texel=texel.astype(np.int32),
        weight=(fraction / share(texel)).astype(np.float32),
    )


def _wrap(index: Indices, size: int, mode: str) -> Indices:
    if mode == "clamp":
        return np.clip(index, 0, size - 1)
    if mode == "repeat":
        return index % size
    index = index % (2 * size)
    return np.where(index < size, index, 2 * size - 1 - index)


@dataclass(frozen=True)
class ShownTexture:
    """A texture in a scene, or an attribute of a mesh.

    ``shapes`` are Dr.Jit's indices of those that use it; None for an environment, which rays that hit nothing see.
    ``coordinates`` maps a surface interaction, the preliminary one and the ray's direction to the coordinates that
    ``lookup.shown`` takes, all in Dr.Jit arrays.
    """

    name: str  # of the parameter that holds its texels
    lookup: Lookup | MeshLookup
    shapes: Sequence[int] | None
    coordinates: Callable[[Any, Any, Any], tuple[Any, ...]]


def find_textures(live: LiveScene, shapes: dict[str, tuple[int, ...]]) -> Iterator[ShownTexture]:
    """Describe the named parameters that are texels of a bitmap or environment map, or attributes of a mesh."""
    graph = live.graph
    nodes = {name: node for name, (_, _, node, _) in mi.traverse(graph.scene).properties.items()}
    for name, shape in shapes.items():
        node = nodes[name]
        if node.class_name().startswith("BitmapTexture") and shape[-1] in (1, 3):
            texels = np.random.default_rng(0).random(shape, np.float32)
            with live.with_values({name: torch.from_numpy(texels).to(live.device)}):
                lookup = _bitmap_lookup(node, texels)
            users = [shape_index(shape) for shape in graph.shapes_using(node)]
            yield ShownTexture(name, lookup, users, _on_bitmap(node, lookup))
        elif node.class_name() == "EnvironmentMapEmitter" and node is graph.scene.environment():
            lookup = _environment_lookup(*shape[:2])
            yield ShownTexture(name, lookup, None, _on_environment(node, lookup))
        elif isinstance(node, mi.Mesh):
            of_mesh = MeshLookup.of(node, name.rsplit(".", 1)[-1])
            yield ShownTexture(name, of_mesh, [shape_index(node)], _on_mesh)


def _bitmap_lookup(texture: Any, texels: Floats) -> Lookup:
    """Infer the filter and wrap mode of a bitmap with random texels, which Mitsuba does not expose."""
    height, width, channels = texels.shape
    points = np.random.default_rng(1).uniform(-2.5, 3.5, (2, 256)).astype(np.float32)
    inverse = np.linalg.inv(_to_uv(texture))
    u, v = inverse[:2, :2] @ points + inverse[:2, 2:]
    si = dr.zeros(mi.SurfaceInteraction3f, points.shape[1])
    si.uv = mi.Point2f(u, v)
    expected = texture.eval_1(si).numpy()[None] if channels == 1 else np.array(texture.eval_3(si))

    def error(lookup: Lookup) -> float:
        x, y = points[0] * width - 0.5, points[1] * height - 0.5
        if lookup.nearest:
            found = texels.reshape(-1, channels)[lookup.nearest_texel(x, y)]
        else:
            index, weight = lookup.bilinear_texels(x, y)
            found = (texels.reshape(-1, channels)[index] * weight[..., None]).sum(0)
        return float(np.abs(found - expected.T).mean())

    share = np.full(height, 1 / (height * width), np.float32)
    candidates = [
        Lookup(height, width, nearest, wrap, wrap, width, 0, share)
        for nearest in (False, True)
        for wrap in WRAP_MODES
    ]
    return min(candidates, key=error)


def _to_uv(texture: Any) -> NDArray[np.float64]:
    return np.array(mi.traverse(texture)["to_uv"].matrix, dtype=np.float64).reshape(3, 3)


def _on_mesh(_: Any, hit: Any, __: Any) -> tuple[Any, Any, Any]:
    return hit.prim_index, hit.prim_uv.x, hit.prim_uv.y


def _on_bitmap(texture: Any, lookup: Lookup) -> Callable[[Any, Any, Any], tuple[Any, Any]]:
    (a, b, c), (d, e, f), _ = _to_uv(texture).tolist()

    def coordinates(si: Any, _: Any, __: Any) -> tuple[Any, Any]:
        u, v = a * si.uv.x + b * si.uv.y + c, d * si.uv.x + e * si.uv.y + f
        return u * lookup.width - 0.5, v * lookup.height - 0.5

    return coordinates


def _environment_lookup(height: int, width: int) -> Lookup:
    """Return how Mitsuba 3.9 looks up an environment map: its first and last rows are the poles.

    The parameter has one more column on either side, a copy of the one at the other end.
    """
    step = np.pi / (height - 1)
    # The integral of each row's hat function over the sphere, divided by 2π.
    share = np.sin(step * np.arange(height)) * 2 * (1 - np.cos(step)) / step
    share[[0, -1]] = 1 - np.sin(step) / step
    share = (share / 2 / (width - 2)).astype(np.float32)
    return Lookup(height, width - 2, False, "repeat", "clamp", width, 1, share)


def _on_environment(emitter: Any, lookup: Lookup) -> Callable[[Any, Any, Any], tuple[Any, Any]]:
    to_local = emitter.world_transform().inverse()

    def coordinates(_: Any, __: Any, direction: Any) -> tuple[Any, Any]:
        local = to_local @ mi.Vector3f(direction)
        u = dr.atan2(local.x, -local.z) / dr.two_pi
        v = dr.safe_acos(local.y) / dr.pi
        return (u - dr.floor(u)) * lookup.width - 0.5, v * (lookup.height - 1)

    return coordinates
