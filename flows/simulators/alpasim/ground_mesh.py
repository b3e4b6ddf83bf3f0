"""The ground along a run's path as a mesh of triangles, for a simulator's physics to stand vehicles on."""

from __future__ import annotations

import io
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from genre_tasks.logs.types import Float64
from genre_tasks.scene_edits.ground import Ground

REACH_M = 25.0
"""How far from the path the mesh goes: over all lanes, and past both ends of the path."""

TRACK_REACH_M = 8.0
"""How far the mesh goes around other traffic: as far as a simulator may move it off its recorded place."""

NOWHERE = np.zeros((0, 2))
STEP_M = 1.0
MAX_VERTICES = 10_000
"""A longer path gets a wider grid: measuring the ground takes the most of an export's time."""

_MAX_PLACES = 2_000_000


class GroundMesh(NamedTuple):
    """Triangles of the ground.

    Attributes:
        vertices: [V, 3] float64 metres.
        faces: [T, 3] int64 rows of ``vertices``, counter-clockwise seen from above.
    """

    vertices: Float64
    faces: NDArray[np.int64]


def build_ground_mesh(ground: Ground, path: Float64, tracks: Float64 = NOWHERE, step_m: float = STEP_M) -> GroundMesh:
    """Lays a grid along a path and under traffic onto the ground.

    Args:
        ground: what is known of its height.
        path: [P, 2] places of the vehicle in the ground plane, in the ground's coordinates; ``REACH_M`` around them is
            covered.
        tracks: [T, 2] places of other traffic; ``TRACK_REACH_M`` around them is covered.
        step_m: between neighbours of the grid, at least.

    Returns:
        The mesh; cells without a measured height lie at that of the traffic nearby.

    >>> flat = Ground(np.zeros((0, 3)), np.array([[0.0, 0.0, 2.0]]))
    >>> mesh = build_ground_mesh(flat, np.zeros((1, 2)), step_m=10.0)
    >>> mesh.vertices[:, 2].tolist() == [2.0] * len(mesh.vertices), len(mesh.faces) > 8
    (True, True)
    """
    low = np.minimum(path.min(0) - REACH_M, tracks.min(0, initial=np.inf) - TRACK_REACH_M)
    high = np.maximum(path.max(0) + REACH_M, tracks.max(0, initial=-np.inf) + TRACK_REACH_M)
    # A long path that turns has a wide rectangle around it, most of which is far from the path.
    step_m = max(step_m, float(np.sqrt((high - low).prod() / _MAX_PLACES)))
    places, shape, near = _lay_grid(low, high, path, tracks, step_m)
    if near.sum() > MAX_VERTICES:
        step_m *= float(np.sqrt(near.sum() / MAX_VERTICES))
        places, shape, near = _lay_grid(low, high, path, tracks, step_m)
    cells = near.reshape(shape)
    corner = np.argwhere(cells[:-1, :-1] & cells[1:, :-1] & cells[:-1, 1:] & cells[1:, 1:])
    row = corner[:, 0] * shape[1] + corner[:, 1]
    # Both triangles of a square turn the same way, so that their normals point up.
    triangles = np.concatenate(
        [
            np.stack([row, row + shape[1], row + shape[1] + 1], 1),
            np.stack([row, row + shape[1] + 1, row + 1], 1),
        ]
    )
    used, faces = np.unique(triangles, return_inverse=True)
    heights, _ = ground.measure(places[used])
    return GroundMesh(np.column_stack([places[used], heights]), faces.reshape(-1, 3))


def encode_mesh(mesh: GroundMesh) -> bytes:
    """Encodes a mesh as a binary PLY file, its vertices as float32.

    Args:
        mesh: in coordinates near the origin.

    Returns:
        The bytes of the file.
    """
    from plyfile import PlyData, PlyElement

    vertices = np.empty(len(mesh.vertices), [("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
    for k, name in enumerate("xyz"):
        vertices[name] = mesh.vertices[:, k]
    faces = np.empty(len(mesh.faces), [("vertex_indices", "<i4", (3,))])
    faces["vertex_indices"] = mesh.faces
    sink = io.BytesIO()
    elements = [PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")]
    PlyData(elements, byte_order="<").write(sink)
    return sink.getvalue()


def _lay_grid(
    low: Float64, high: Float64, path: Float64, tracks: Float64, step_m: float
) -> tuple[Float64, tuple[int, int], NDArray[np.bool_]]:
    """Places [N, 2] row by row along x, how many there are along x and y, and which of them are covered [N]."""
    shape = (int((high[0] - low[0]) / step_m) + 2, int((high[1] - low[1]) / step_m) + 2)
    along = [low[k] + step_m * np.arange(shape[k]) for k in range(2)]
    places = np.stack(np.meshgrid(*along, indexing="ij"), -1).reshape(-1, 2)
    near = cKDTree(path).query(places, distance_upper_bound=REACH_M)[0] < np.inf
    if len(tracks):
        near |= cKDTree(tracks).query(places, distance_upper_bound=TRACK_REACH_M)[0] < np.inf
    return places, shape, near
