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
from genre_tasks.srgb import srgb_to_linear

# Left and right of a street, a car, a person: signs of a coordinate that points to the left.
SIDES = (1, -1)


@dataclass(frozen=True)
class Mesh:
    """Triangles that share no vertices.

    Attributes:
        vertices: [T, 3, 3] metres.
        texture: [T, 3, 3] texture coordinates of the vertices, metres.
        material: [T] numbers of ``Material``.
        colour: [T, 3] linear RGB.
        parameters: [T, 4] of the texture; what they mean is up to the material.
    """

    vertices: Float64
    texture: Float32
    material: NDArray[np.uint8]
    colour: Float32
    parameters: Float32

    def __len__(self) -> int:
        return len(self.vertices)

    def transformed(self, outer_SE3_mesh: Float64) -> Mesh:
        """Moves the mesh rigidly; texture coordinates stay.

        Args:
            outer_SE3_mesh: [4, 4].

        Returns:
            The mesh in outer coordinates.
        """
        # Textures must not move with the world: a brick keeps its place on the wall.
        vertices = self.vertices @ outer_SE3_mesh[:3, :3].T + outer_SE3_mesh[:3, 3]
        return replace(self, vertices=vertices)


@dataclass(frozen=True)
class Surface:
    """What covers primitives: one for all of them, or a row for each.

    Attributes:
        material: number of a ``Material``.
        colour: [3] or [primitives, 3], sRGB in [0, 1].
        parameters: [4] or [primitives, 4], of the material's texture.
    """

    material: int
    colour: ArrayLike
    parameters: ArrayLike = (0, 0, 0, 0)

    def repeated(self, primitives: int, times: int) -> Surface:
        """Spreads the surface of primitives over the faces that each is made of.

        Args:
            primitives: how many there are.
            times: how many faces each has.

        Returns:
            A surface with a row a face.
        """
        # In float64 until the mesh is made, so that a colour is rounded once however many faces share it.
        colour = np.broadcast_to(np.asarray(self.colour, np.float64), (primitives, 3))
        parameters = np.broadcast_to(np.asarray(self.parameters, np.float64), (primitives, 4))
        return Surface(self.material, colour.repeat(times, 0), parameters.repeat(times, 0))


def join_meshes(meshes: Sequence[Mesh]) -> Mesh:
    """Puts meshes one behind the other.

    Args:
        meshes: any number; none gives a mesh without triangles.

    Returns:
        All their triangles, in order.

    >>> len(join_meshes([box_mesh((0, 0, 0), (1, 1, 1), Surface(0, (1, 1, 1))), join_meshes([])]))
    12
    """
    if not meshes:
        return triangle_mesh(np.zeros((0, 3, 3)), None, Surface(0, (0, 0, 0)))
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.texture for mesh in meshes]),
        np.concatenate([mesh.material for mesh in meshes]),
        np.concatenate([mesh.colour for mesh in meshes]),
        np.concatenate([mesh.parameters for mesh in meshes]),
    )


def triangle_mesh(
    vertices: ArrayLike,  # [T, 3, 3]
    texture: ArrayLike | None,  # [T, 3, 3]
    surface: Surface,
) -> Mesh:
    """Makes a mesh of triangles.

    Args:
        vertices: [T, 3, 3] metres.
        texture: [T, 3, 3] texture coordinates; ``None``: the vertices themselves.
        surface: one, or a row a triangle.

    Returns:
        T triangles.
    """
    positions = np.asarray(vertices, np.float64)
    count = len(positions)
    colour = srgb_to_linear(surface.colour).astype(np.float32)
    parameters = np.asarray(surface.parameters, np.float32)
    return Mesh(
        positions,
        np.array(positions if texture is None else texture, np.float32),
        np.full(count, surface.material, np.uint8),
        np.broadcast_to(colour, (count, 3)).astype(np.float32),
        np.broadcast_to(parameters, (count, 4)).astype(np.float32),
    )


def quad_mesh(
    corners: ArrayLike,  # [Q, 4, 3]
    texture: ArrayLike | None,  # [Q, 4, 3]
    surface: Surface,
) -> Mesh:
    """Makes two triangles of every quad.

    Args:
        corners: [Q, 4, 3] metres, in turn around the quad.
        texture: [Q, 4, 3] texture coordinates; ``None``: the corners themselves.
        surface: one, or a row a quad.

    Returns:
        2 Q triangles.
    """
    positions = np.asarray(corners, np.float64).reshape(-1, 4, 3)
    coordinates = positions if texture is None else np.asarray(texture, np.float64).reshape(-1, 4, 3)
    # Both triangles start at the same corner; their texture coordinates meet along the diagonal.
    order = [[0, 1, 2], [0, 2, 3]]
    return triangle_mesh(
        positions[:, order].reshape(-1, 3, 3),
        coordinates[:, order].reshape(-1, 3, 3),
        surface.repeated(len(positions), 2),
    )


# Faces of the unit cube, corners 0…7 with x as bit 0, y as bit 1, z as bit 2.
_BOX_FACES = np.array([[0, 2, 6, 4], [1, 3, 7, 5], [0, 1, 5, 4], [2, 3, 7, 6], [0, 1, 3, 2], [4, 5, 7, 6]])
_BOX_BITS = np.array([[i & 1, i >> 1 & 1, i >> 2 & 1] for i in range(8)], np.float64)


def box_mesh(
    low: ArrayLike,  # [B, 3] or [3]
    high: ArrayLike,  # [B, 3] or [3]
    surface: Surface,
) -> Mesh:
    """Makes axis-aligned boxes; texture coordinates are the corners.

    Args:
        low: [3] or [B, 3] corner with the smallest coordinates, metres.
        high: [3] or [B, 3] corner with the largest.
        surface: one, or a row a box.

    Returns:
        12 B triangles.

    >>> len(box_mesh((0, 0, 0), (1, 2, 3), Surface(0, (0.5, 0.5, 0.5))))
    12
    """
    lowest = np.atleast_2d(np.asarray(low, float))
    highest = np.atleast_2d(np.asarray(high, float))
    corners = lowest[:, None] + (highest - lowest)[:, None] * _BOX_BITS
    faces = corners[:, _BOX_FACES].reshape(-1, 4, 3)
    return quad_mesh(faces, None, surface.repeated(len(corners), len(_BOX_FACES)))


def wall_mesh(low: ArrayLike, high: ArrayLike, surface: Surface) -> Mesh:
    """Makes boxes with the texture of a wall: x + y along it, z as its height.

    Args:
        low: [3] or [B, 3] corner with the smallest coordinates, metres.
        high: [3] or [B, 3] corner with the largest.
        surface: one, or a row a box.

    Returns:
        12 B triangles.
    """
    mesh = box_mesh(low, high, surface)
    x, y, z = np.moveaxis(mesh.texture, -1, 0)
    return replace(mesh, texture=np.stack([x + y, z, np.zeros_like(x)], -1))


def tube_mesh(
    path: ArrayLike,  # [K, 3]
    radius: ArrayLike,  # [K]
    sides: int,
    surface: Surface,
) -> Mesh:
    """Makes a closed tube around a polyline: a cylinder, a cone, a wheel.

    Args:
        path: [K, 3] metres; the cross-sections are perpendicular to the line from the first to the last point.
        radius: [K] metres.
        sides: faces around the tube.
        surface: one for the tube and its caps.

    Returns:
        2 K · ``sides`` triangles; texture x runs around the tube, z along it.
    """
    points = np.asarray(path, float)
    radii = np.asarray(radius, float)
    axis = points[-1] - points[0]
    axis /= np.linalg.norm(axis)
    # Any direction that is not the axis will do to start the frame of the cross-sections.
    side = np.cross(axis, [0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    up = np.cross(axis, side)
    angle = np.arange(sides + 1) * (2 * np.pi / sides)
    ring = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * up
    grid = points[:, None] + radii[:, None, None] * ring
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    around = np.broadcast_to(angle * float(radii.mean()), (len(points), sides + 1))
    # By the path alone: a cone is textured like a cylinder of its mean radius.
    along = np.broadcast_to(length[:, None], around.shape)
    texture = np.stack([around, np.zeros_like(around), along], -1)
    caps = [
        np.stack([np.broadcast_to(points[end], (sides, 3)), grid[end, :-1], grid[end, 1:]], 1)
        for end in (0, len(points) - 1)
    ]
    return join_meshes([grid_mesh(grid, texture, surface), triangle_mesh(np.concatenate(caps), None, surface)])


def grid_quads(grid: Float64) -> Float64:
    """Cuts a surface over a grid of points into quads.

    Args:
        grid: [K, M, 3] points.

    Returns:
        [(K - 1) (M - 1), 4, 3] corners, in turn around each quad.

    >>> grid_quads(np.zeros((3, 4, 3))).shape
    (6, 4, 3)
    """
    return np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], 2).reshape(-1, 4, 3)


def grid_mesh(
    grid: Float64,  # [K, M, 3]
    texture: Float64,  # [K, M, 3]
    surface: Surface,
) -> Mesh:
    """Makes a surface over a grid of points.

    Args:
        grid: [K, M, 3] metres.
        texture: [K, M, 3] texture coordinates.
        surface: one, or a row a quad.

    Returns:
        2 (K - 1) (M - 1) triangles.
    """
    return quad_mesh(grid_quads(grid), grid_quads(texture), surface)


# Every tree, person and car has some of them.
@lru_cache(maxsize=4)
def _unit_sphere(level: int) -> Float64:
    """[20·4^level, 3, 3] triangles of the subdivided icosahedron."""
    golden = (1 + 5**0.5) / 2
    vertices = np.array(
        [
            *([-1, golden, 0], [1, golden, 0], [-1, -golden, 0], [1, -golden, 0]),
            *([0, -1, golden], [0, 1, golden], [0, -1, -golden], [0, 1, -golden]),
            *([golden, 0, -1], [golden, 0, 1], [-golden, 0, -1], [-golden, 0, 1]),
        ]
    )
    faces = (
        "0 11 5 0 5 1 0 1 7 0 7 10 0 10 11 1 5 9 5 11 4 11 10 2 10 7 6 7 1 8 3 9 4 3 4 2 3 2 6 3 6 8 3 8 9 4 9 5 2 4 "
        "11 6 2 10 8 6 7 9 8 1"
    )
    triangles = vertices[np.array(faces.split(), int).reshape(-1, 3)]
    for _ in range(level):
        a, b, c = np.moveaxis(triangles, 1, 0)
        ab = (a + b) / 2
        bc = (b + c) / 2
        ca = (c + a) / 2
        quarters = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
        triangles = np.concatenate([np.stack(corners, 1) for corners in quarters])
    return triangles / np.linalg.norm(triangles, axis=-1, keepdims=True)


def ellipsoid_mesh(centre: ArrayLike, radii: ArrayLike, surface: Surface, level: int = 1) -> Mesh:
    """Makes an ellipsoid: a subdivided icosahedron, stretched.

    Args:
        centre: [3] metres.
        radii: [3] metres along x, y, z.
        surface: one for the body.
        level: how often every triangle is cut into four.

    Returns:
        20 · 4^``level`` triangles.
    """
    vertices = _unit_sphere(level) * np.asarray(radii, float) + np.asarray(centre, float)
    return triangle_mesh(vertices, None, surface)
