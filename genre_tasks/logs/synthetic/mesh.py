"""Triangle soups with texture coordinates, and the primitives that the street is made of.

Every triangle carries its own texture coordinates (object coordinates in metres, so that a texture moves with its
object), a material, a linear base colour and four free texture parameters. All functions are vectorised over
primitives: a façade is a handful of calls.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from genre_tasks.logs.types import Float32, Float64


@dataclass(frozen=True)
class Mesh:
    """``vertices`` [T, 3, 3] metres, ``texture`` [T, 3, 3] metres, ``material`` [T], ``colour`` [T, 3] linear RGB,
    ``parameters`` [T, 4] (what they mean is up to the material)."""

    vertices: Float64
    texture: Float32
    material: NDArray[np.uint8]
    colour: Float32
    parameters: Float32

    def __len__(self) -> int:
        return len(self.vertices)

    def placed(self, outer_SE3_mesh: Float64) -> Mesh:
        """The mesh moved rigidly; texture coordinates stay."""
        vertices = self.vertices @ outer_SE3_mesh[:3, :3].T + outer_SE3_mesh[:3, 3]
        return Mesh(vertices, self.texture, self.material, self.colour, self.parameters)


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """All triangles in order."""
    if not meshes:
        empty = np.zeros((0, 3, 3))
        return soup(empty, empty, 0, (0, 0, 0))
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.texture for m in meshes]),
        np.concatenate([m.material for m in meshes]),
        np.concatenate([m.colour for m in meshes]),
        np.concatenate([m.parameters for m in meshes]),
    )


def linear(srgb: ArrayLike) -> Float32:
    """sRGB in [0, 1] to linear light (IEC 61966-2-1)."""
    c = np.asarray(srgb, np.float64)
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4).astype(np.float32)


def soup(
    vertices: ArrayLike,  # [T, 3, 3]
    texture: ArrayLike | None,  # [T, 3, 3]; None: the vertices themselves
    material: int,
    colour: ArrayLike,  # [3] or [T, 3], sRGB
    parameters: ArrayLike = (0, 0, 0, 0),  # [4] or [T, 4]
) -> Mesh:
    """Triangles as they are."""
    v = np.asarray(vertices, np.float64)
    n = len(v)
    return Mesh(
        v,
        np.array(v if texture is None else texture, np.float32),
        np.full(n, material, np.uint8),
        np.broadcast_to(linear(colour), (n, 3)).astype(np.float32),
        np.broadcast_to(np.asarray(parameters, np.float32), (n, 4)).astype(np.float32),
    )


def quads(
    corners: ArrayLike,  # [Q, 4, 3], in turn around the quad
    texture: ArrayLike | None,  # [Q, 4, 3]; None: the corners themselves
    material: int,
    colour: ArrayLike,  # [3] or [Q, 3], sRGB
    parameters: ArrayLike = (0, 0, 0, 0),  # [4] or [Q, 4]
) -> Mesh:
    """Two triangles a quad."""
    c = np.asarray(corners, np.float64).reshape(-1, 4, 3)
    t = c if texture is None else np.asarray(texture, np.float64).reshape(-1, 4, 3)
    n = len(c)
    order = [[0, 1, 2], [0, 2, 3]]
    both = np.broadcast_to(np.asarray(colour, np.float64), (n, 3)).repeat(2, 0)
    free = np.broadcast_to(np.asarray(parameters, np.float64), (n, 4)).repeat(2, 0)
    return soup(c[:, order].reshape(-1, 3, 3), t[:, order].reshape(-1, 3, 3), material, both, free)


# Faces of the unit cube, corners 0…7 with x as bit 0, y as bit 1, z as bit 2.
_BOX_FACES = np.array([[0, 2, 6, 4], [1, 3, 7, 5], [0, 1, 5, 4], [2, 3, 7, 6], [0, 1, 3, 2], [4, 5, 7, 6]])
_BOX_BITS = np.array([[i & 1, i >> 1 & 1, i >> 2 & 1] for i in range(8)], np.float64)


def boxes(
    low: ArrayLike,  # [B, 3] or [3]
    high: ArrayLike,  # [B, 3] or [3]
    material: int,
    colour: ArrayLike,  # [3] or [B, 3], sRGB
    parameters: ArrayLike = (0, 0, 0, 0),
) -> Mesh:
    """Axis-aligned boxes; texture coordinates are the corners."""
    lo, hi = np.atleast_2d(np.asarray(low, float)), np.atleast_2d(np.asarray(high, float))
    corners = lo[:, None] + (hi - lo)[:, None] * _BOX_BITS
    n = len(corners)
    tint = np.broadcast_to(np.asarray(colour, float), (n, 3)).repeat(6, 0)
    free = np.broadcast_to(np.asarray(parameters, float), (n, 4)).repeat(6, 0)
    return quads(corners[:, _BOX_FACES].reshape(-1, 4, 3), None, material, tint, free)


def masonry(
    low: ArrayLike, high: ArrayLike, material: int, colour: ArrayLike, parameters: ArrayLike = (0, 0, 0, 0)
) -> Mesh:
    """``boxes`` with the texture of a wall: x + y along it, z as its height."""
    mesh = boxes(low, high, material, colour, parameters)
    t = mesh.texture
    return replace(mesh, texture=np.stack([t[..., 0] + t[..., 1], t[..., 2], np.zeros_like(t[..., 0])], -1))


def tube(
    path: ArrayLike,  # [K, 3]
    radius: ArrayLike,  # [K]
    sides: int,
    material: int,
    colour: ArrayLike,
    parameters: ArrayLike = (0, 0, 0, 0),
) -> Mesh:
    """A closed tube around a polyline (cylinder, cone, wheel); texture x runs around it, z along it."""
    p = np.asarray(path, float)
    r = np.asarray(radius, float)
    axis = p[-1] - p[0]
    axis /= np.linalg.norm(axis)
    side = np.cross(axis, [0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    up = np.cross(axis, side)
    angle = np.arange(sides + 1) * (2 * np.pi / sides)
    ring = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * up
    points = p[:, None] + r[:, None, None] * ring
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    wrapped = np.broadcast_to(angle * float(r.mean()), (len(p), sides + 1))
    tex = np.stack([wrapped, np.zeros_like(wrapped), np.broadcast_to(along[:, None], wrapped.shape)], -1)
    wall = quads(_strip(points), _strip(tex), material, colour, parameters)
    caps = [np.stack([np.broadcast_to(p[k], (sides, 3)), points[k, :-1], points[k, 1:]], 1) for k in (0, len(p) - 1)]
    return joined([wall, soup(np.concatenate(caps), None, material, colour, parameters)])


def _strip(grid: Float64) -> Float64:
    """[K, M, 3] grid points to [(K-1)(M-1), 4, 3] quads."""
    return np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], 2).reshape(-1, 4, 3)


def sheet(
    grid: Float64,  # [K, M, 3]
    texture: Float64,  # [K, M, 3]
    material: int,
    colour: ArrayLike,
    parameters: ArrayLike = (0, 0, 0, 0),
) -> Mesh:
    """A surface over a grid of points."""
    return quads(_strip(grid), _strip(texture), material, colour, parameters)


@lru_cache(maxsize=4)
def _unit_sphere(level: int) -> Float64:
    """[20·4^level, 3, 3] triangles of the subdivided icosahedron."""
    g = (1 + 5**0.5) / 2
    v = np.array(
        [
            *([-1, g, 0], [1, g, 0], [-1, -g, 0], [1, -g, 0], [0, -1, g], [0, 1, g]),
            *([0, -1, -g], [0, 1, -g], [g, 0, -1], [g, 0, 1], [-g, 0, -1], [-g, 0, 1]),
        ]
    )
    f = (
        "0 11 5 0 5 1 0 1 7 0 7 10 0 10 11 1 5 9 5 11 4 11 10 2 10 7 6 7 1 8 3 9 4 3 4 2 3 2 6 3 6 8 3 8 9 4 9 5 2 4 "
        "11 6 2 10 8 6 7 9 8 1"
    )
    t = v[np.array(f.split(), int).reshape(-1, 3)]
    for _ in range(level):
        a, b, c = t[:, 0], t[:, 1], t[:, 2]
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        t = np.concatenate([np.stack(k, 1) for k in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    return t / np.linalg.norm(t, axis=-1, keepdims=True)


def ellipsoid(
    centre: ArrayLike,
    radii: ArrayLike,
    material: int,
    colour: ArrayLike,
    parameters: ArrayLike = (0, 0, 0, 0),
    level: int = 1,
) -> Mesh:
    """A subdivided icosahedron, stretched."""
    v = _unit_sphere(level) * np.asarray(radii, float) + np.asarray(centre, float)
    return soup(v, None, material, colour, parameters)
