"""Where a texture, or a mesh, keeps what it shows at a point, in NumPy.

Imported only once a variant is active (see ``SceneRenderer``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..scene import TexelMap
from ..scene._graph import SceneGraph

Floats = NDArray[np.float32]
Indices = NDArray[np.int64]

WRAPS = ("repeat", "clamp", "mirror")

# An entry whose rays meet more texels than this shows each of them briefly: there the nearest one stands for the
# four that a bilinear filter mixes, so that an entry has few items however fine the texture is.
MANY = 4


@dataclass(frozen=True)
class Lookup:
    """How a texture finds its texels.

    Attributes
    ----------
    height, width
        Of the texture.
    nearest
        Whether its filter takes the nearest texel, not a bilinear mixture of four.
    wrap_x, wrap_y
        What lies beyond its edges: ``"repeat"``, ``"clamp"`` or ``"mirror"``.
    stride, first
        Texel ``(x, y)`` is number ``y * stride + x + first`` of the parameter.
    row_share
        What part of the whole a texel of each row is.
    """

    height: int
    width: int
    nearest: bool
    wrap_x: str
    wrap_y: str
    stride: int
    first: int
    row_share: Floats

    def nearest_texel(self, x: Floats, y: Floats) -> Indices:
        """Return the texel nearest to points whose coordinates are whole at the centres of texels, ``(N,)``."""
        return self._number(np.floor(x + 0.5).astype(np.int64), np.floor(y + 0.5).astype(np.int64))

    def mixed_texels(self, x: Floats, y: Floats) -> tuple[Indices, Floats]:
        """Return the four texels around the points and the weight of each, ``(4, N)``."""
        left, top = np.floor(x), np.floor(y)
        across, down = x - left, y - top
        column, row = left.astype(np.int64), top.astype(np.int64)
        index = [self._number(column + step, row + fall) for fall in (0, 1) for step in (0, 1)]
        weight = [b * a for b in (1 - down, down) for a in (1 - across, across)]
        return np.stack(index), np.stack(weight).astype(np.float32)

    def _number(self, column: Indices, row: Indices) -> Indices:
        column = _wrap(column, self.width, self.wrap_x)
        return _wrap(row, self.height, self.wrap_y) * self.stride + column + self.first

    def shown(self, entry: Indices, place: Sequence[Any], rays: Indices) -> TexelMap:
        """Return the texels that rays show, each of which belongs to an entry that has ``rays`` of them."""
        x, y = place
        texels = self.height * self.stride
        nearest = self.nearest_texel(x, y)
        if self.nearest:
            key, weight = entry * texels + nearest, np.ones(len(entry), np.float32)
        else:
            met = np.unique(entry * texels + nearest) // texels
            many = (np.bincount(met, minlength=len(rays)) > MANY)[entry]
            mixed, shares = self.mixed_texels(x[~many], y[~many])
            key = np.concatenate([(entry * texels + nearest)[many], (entry[~many] * texels + mixed).ravel()])
            weight = np.concatenate([np.ones(many.sum(), np.float32), shares.ravel()])
        return _gathered(key, weight, texels, rays, lambda texel: self.row_share[texel // self.stride])


@dataclass(frozen=True)
class MeshLookup:
    """How a mesh finds an attribute of its vertices, or of its faces.

    Attributes
    ----------
    rows
        ``(faces, 3)``, the row of each corner; or ``(faces, 1)``, that of the face itself.
    share
        What part of the surface's area belongs to each row: a vertex has a third of its faces.
    """

    rows: Indices
    share: Floats

    @classmethod
    def of(cls, mesh: Any, attribute: str) -> MeshLookup:
        """Look at a mesh."""
        corners = mesh.faces_buffer().numpy().reshape(-1, 3).astype(np.int64)
        points = mesh.vertex_positions_buffer().numpy().reshape(-1, 3)[corners]
        area = np.linalg.norm(np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]), axis=-1)
        rows = corners if attribute.startswith("vertex_") else np.arange(len(corners))[:, None]
        part = np.repeat(area / (area.sum() * rows.shape[1]), rows.shape[1])
        return cls(rows, np.bincount(rows.ravel(), weights=part).astype(np.float32))

    def shown(self, entry: Indices, place: Sequence[Any], rays: Indices) -> TexelMap:
        """Return the rows that rays show, each of which belongs to an entry that has ``rays`` of them."""
        face, second, third = place
        rows = self.rows[face]
        weight = (
            np.stack([1 - second - third, second, third]) if rows.shape[1] == 3 else np.ones((1, len(face)))
        )
        key = entry[:, None] * len(self.share) + rows
        return _gathered(key.ravel(), weight.T.ravel(), len(self.share), rays, lambda row: self.share[row])


def _gathered(
    key: Indices, weight: Any, texels: int, rays: Indices, share: Callable[[Indices], Floats]
) -> TexelMap:
    """Add up what several rays show of the same texel; a key is an entry's number times ``texels`` plus one's."""
    items, item = np.unique(key, return_inverse=True)
    entry, texel = items // texels, items % texels
    part = np.bincount(item, weights=weight, minlength=len(items)) / rays[entry]
    return TexelMap(
        entry=entry.astype(np.int32),
        texel=texel.astype(np.int32),
        weight=(part / share(texel)).astype(np.float32),
    )


def _wrap(index: Indices, size: int, how: str) -> Indices:
    if how == "clamp":
        return np.clip(index, 0, size - 1)
    if how == "repeat":
        return index % size
    index = index % (2 * size)
    return np.where(index < size, index, 2 * size - 1 - index)


@dataclass(frozen=True)
class ShownTexture:
    """A texture in a scene, or an attribute of a mesh.

    Attributes
    ----------
    name
        Of the parameter that holds its texels.
    lookup
        How it finds them.
    shapes
        The numbers that Dr.Jit gives the shapes that wear it; None for an environment, seen past all shapes.
    place
        From a surface interaction, the preliminary one and the ray's direction to the coordinates that
        ``lookup`` takes, all in Dr.Jit arrays.
    """

    name: str
    lookup: Lookup | MeshLookup
    shapes: Sequence[int] | None
    place: Callable[[Any, Any, Any], tuple[Any, ...]]


def find_textures(
    graph: SceneGraph, shapes: dict[str, tuple[int, ...]], hold: Callable[[str, Any], Any]
) -> Iterator[ShownTexture]:
    """Describe the named parameters that are texels of a bitmap or environment map, or attributes of a mesh.

    Parameters
    ----------
    shapes
        Their shapes by name.
    hold
        Makes a texture hold other texels, while its context lasts.
    """
    nodes = {name: node for name, (_, _, node, _) in mi.traverse(graph.scene).properties.items()}
    for name, shape in shapes.items():
        node = nodes[name]
        if node.class_name().startswith("BitmapTexture") and shape[-1] in (1, 3):
            texels = np.random.default_rng(0).random(shape, np.float32)
            with hold(name, texels):
                lookup = _bitmap_lookup(node, texels)
            worn_by = [number_of(one) for one in graph.wearers(node)]
            yield ShownTexture(name, lookup, worn_by, _on_bitmap(node, lookup))
        elif node.class_name() == "EnvironmentMapEmitter" and node is graph.scene.environment():
            lookup = _environment_lookup(*shape[:2])
            yield ShownTexture(name, lookup, None, _on_environment(node, lookup))
        elif isinstance(node, mi.Mesh):
            of_mesh = MeshLookup.of(node, name.rsplit(".", 1)[-1])
            yield ShownTexture(name, of_mesh, [number_of(node)], _on_mesh)


def number_of(shape: Any) -> int:
    """Return the number that Dr.Jit gives a shape."""
    return int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0])


def _bitmap_lookup(texture: Any, texels: Floats) -> Lookup:
    """Find out how a bitmap that holds random texels filters and wraps: Mitsuba does not tell."""
    height, width, channels = texels.shape
    points = np.random.default_rng(1).uniform(-2.5, 3.5, (2, 256)).astype(np.float32)
    inverse = np.linalg.inv(_to_uv(texture))
    u, v = inverse[:2, :2] @ points + inverse[:2, 2:]
    si = dr.zeros(mi.SurfaceInteraction3f, points.shape[1])
    si.uv = mi.Point2f(u, v)
    seen = texture.eval_1(si).numpy()[None] if channels == 1 else np.array(texture.eval_3(si))

    def error(lookup: Lookup) -> float:
        x, y = points[0] * width - 0.5, points[1] * height - 0.5
        if lookup.nearest:
            found = texels.reshape(-1, channels)[lookup.nearest_texel(x, y)]
        else:
            index, weight = lookup.mixed_texels(x, y)
            found = (texels.reshape(-1, channels)[index] * weight[..., None]).sum(0)
        return float(np.abs(found - seen.T).mean())

    share = np.full(height, 1 / (height * width), np.float32)
    candidates = [
        Lookup(height, width, nearest, wrap, wrap, width, 0, share)
        for nearest in (False, True)
        for wrap in WRAPS
    ]
    return min(candidates, key=error)


def _to_uv(texture: Any) -> NDArray[np.float64]:
    return np.array(mi.traverse(texture)["to_uv"].matrix, dtype=np.float64).reshape(3, 3)


def _on_mesh(_: Any, hit: Any, __: Any) -> tuple[Any, Any, Any]:
    return hit.prim_index, hit.prim_uv.x, hit.prim_uv.y


def _on_bitmap(texture: Any, lookup: Lookup) -> Callable[[Any, Any, Any], tuple[Any, Any]]:
    (a, b, c), (d, e, f), _ = _to_uv(texture).tolist()

    def place(si: Any, _: Any, __: Any) -> tuple[Any, Any]:
        u, v = a * si.uv.x + b * si.uv.y + c, d * si.uv.x + e * si.uv.y + f
        return u * lookup.width - 0.5, v * lookup.height - 0.5

    return place


def _environment_lookup(height: int, width: int) -> Lookup:
    """Return how Mitsuba 3.9 looks up an environment map: its first and last rows are the poles.

    The parameter has one more column on either side, copies of those at the other end.
    """
    step = np.pi / (height - 1)
    # The integral over a sphere of the hat function of each row, divided by 2π.
    share = np.sin(step * np.arange(height)) * 2 * (1 - np.cos(step)) / step
    share[[0, -1]] = 1 - np.sin(step) / step
    share = (share / 2 / (width - 2)).astype(np.float32)
    return Lookup(height, width - 2, False, "repeat", "clamp", width, 1, share)


def _on_environment(emitter: Any, lookup: Lookup) -> Callable[[Any, Any, Any], tuple[Any, Any]]:
    to_local = emitter.world_transform().inverse()

    def place(_: Any, __: Any, direction: Any) -> tuple[Any, Any]:
        local = to_local @ mi.Vector3f(direction)
        turn = dr.atan2(local.x, -local.z) / dr.two_pi
        height = dr.safe_acos(local.y) / dr.pi
        return (turn - dr.floor(turn)) * lookup.width - 0.5, height * (lookup.height - 1)

    return place
