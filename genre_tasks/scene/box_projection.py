"""Where the boxes of actors are in images."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.brown_conrady import distort
from genre_tasks.logs.types import Float64
from genre_tasks.scene.chunk import Actor, View
from genre_tasks.scene.lens_distortion import fold_radius
from genre_tasks.scene.novel_views import NovelView
from genre_tasks.scene.projection import NEAR_M

# Of an edge that a distorting lens bends.
_EDGE_POINTS = 17
AnyView = View | NovelView

# Pairs of corners that differ along one axis; a corner's number has a bit for each axis.
_EDGES = np.array([(k, k | bit) for bit in (1, 2, 4) for k in range(8) if not k & bit])


def project_box(actor: Actor, view: AnyView) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Finds the rectangle of pixels that an actor's box covers in a view.

    What is behind the camera plane is cut off there, edge by edge. Of a distorting lens, edges become curves, and what
    lies beyond the angle where it folds back is left out.

    Args:
        actor: with its poses in the chunk.
        view: recorded or novel.

    Returns:
        The first pixel (x, y) of the rectangle, and the one after its last: equal where the box is not in the image.
    """
    index = np.flatnonzero(actor.frames == view.frame)
    nothing = np.zeros(2, np.int64)
    if not len(index):
        return nothing, nothing
    corners = np.stack(np.meshgrid(*[(-s / 2, s / 2) for s in actor.size_m], indexing="ij"), -1).reshape(-1, 3)
    camera_SE3_box = np.linalg.inv(view.chunk_SE3_camera) @ actor.chunk_SE3_box[index[0]]
    points = corners @ camera_SE3_box[:3, :3].T + camera_SE3_box[:3, 3]
    lens = view.lens
    distorts = any(lens.coefficients)
    points = _sample_edges(points) if distorts else _cut_behind_camera(points)
    x = points[:, 0] / points[:, 2]
    y = points[:, 1] / points[:, 2]
    if distorts:
        is_seen = np.hypot(x, y) < fold_radius(lens.coefficients)
        x, y = (np.asarray(part) for part in distort(x[is_seen], y[is_seen], lens.coefficients))
    if not len(x):
        return nothing, nothing
    u = (x * lens.fx_px + lens.cx_px).clip(0, lens.width_px)
    v = (y * lens.fy_px + lens.cy_px).clip(0, lens.height_px)
    return np.array([round(u.min()), round(v.min())]), np.array([round(u.max()), round(v.max())])


def _sample_edges(corners: Float64) -> Float64:
    """Points [K, 3] along the edges of a box [8, 3], of what lies ahead of the camera plane."""
    first, last = corners[_EDGES].swapaxes(0, 1)
    part = np.linspace(0.0, 1.0, _EDGE_POINTS)[:, None, None]
    points = (first + part * (last - first)).reshape(-1, 3)
    return np.concatenate([points[points[:, 2] >= NEAR_M], _cut_behind_camera(corners)])


def _cut_behind_camera(corners: Float64) -> Float64:
    """Corners [K, 3] of the part of a box [8, 3] that lies ahead of the camera plane, in camera axes."""
    ends = corners[_EDGES]  # [12, 2, 3]
    depth = ends[:, :, 2] - NEAR_M
    crosses = (depth < 0).any(1) & (depth > 0).any(1)
    # Corners that were merely moved onto the plane would lie far from where the edges meet it.
    fraction = depth[crosses, 0] / (depth[crosses, 0] - depth[crosses, 1])
    first = ends[crosses, 0]
    cuts = first + fraction[:, None] * (ends[crosses, 1] - first)
    # Rounding can leave a cut a little off the plane.
    cuts[:, 2] = NEAR_M
    return np.concatenate([corners[corners[:, 2] >= NEAR_M], cuts])
