"""Points of a log without LiDAR, from the depth that a scene of Gaussians shows in the source views."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from genre_tasks.fixer.view_surface import unproject_surface
from genre_tasks.logs.types import Float32
from genre_tasks.render import render_views
from genre_tasks.scene.chunk import View
from genre_tasks.scene.projection import project
from genre_tasks.scene.visibility import PointCloud
from genre_tasks.stages.chunk_reading import ChunkReading
from genre_tasks.stages.ingest_points import ChunkPoints
from genre_tasks.stages.scene_file import read_placed_scene

MAX_POINTS = 1_500_000
"""About as many as the sweeps of a chunk have; views are looked at more coarsely where they have more pixels."""

MAX_DEPTH_M = 100.0
"""Farther than LiDAR reaches, a render's depth says little."""

MIN_ALPHA = 0.8
"""A pixel's depth counts where at least so much of its light is accounted for."""

_DEPTH_TOLERANCE = 0.05
_MIN_POINTS = 100


def read_points_from_scene(reading: ChunkReading, file: str, sources: Sequence[View]) -> ChunkPoints:
    """Makes points of a scene's depth: where source views see it, and views of other frames agree.

    A floater before one camera is no surface for the others, so that it gives no points.

    Args:
        reading: the chunk; what stands in for LiDAR is noted in its issues.
        file: of Gaussians, in the coordinates that ``placement`` takes to the world.
        sources: the source views.

    Returns:
        A background without actors; a point's frame is that of its view.

    Raises:
        InputError: the file cannot be read, or the source views see next to nothing of it.
    """
    scene = read_placed_scene(file, reading.config.placement, reading.world_SE3_chunk)
    with torch.no_grad():
        renders = [render_views(scene, [view]) for view in sources]
    depths = [render.expected_depth()[0] for render in renders]
    alphas = [render.alpha[0] for render in renders]
    stride = _choose_stride(sources)
    parts = []
    for index, view in enumerate(sources):
        points = _unproject(view, depths[index], alphas[index], stride)
        others = [(sources[k], depths[k]) for k in range(len(sources)) if sources[k].frame != view.frame]
        parts.append(points[_is_confirmed(points, others)])
    positions = np.concatenate(parts)
    if len(positions) < _MIN_POINTS:
        raise reading.input_error(
            "the images see next to nothing of the scene",
            "Check that scene and camera poses share their coordinates, and that --up and --scale fit.",
        )
    frames = np.repeat(np.array([view.frame for view in sources], np.int16), [len(part) for part in parts])
    detail = f"there is no LiDAR: {len(positions)} points are of the depth of the scene that is to be enhanced"
    reading.add_issue("depth_of_scene", detail)
    return ChunkPoints(PointCloud(positions, frames), [])


def _choose_stride(sources: Sequence[View]) -> int:
    """Every so many pixels of a row and of a column, so that points stay within ``MAX_POINTS``."""
    pixels = sum(view.lens.width_px * view.lens.height_px for view in sources)
    return max(1, int(np.ceil(np.sqrt(pixels / MAX_POINTS))))


def _unproject(view: View, depth: Tensor, alpha: Tensor, stride: int) -> Float32:
    """Points [P, 3] in chunk coordinates of every ``stride``-th pixel whose depth counts."""
    surface = unproject_surface(depth, alpha, view.chunk_SE3_camera, view.lens, (), view.frame)
    chosen = surface.known & (alpha >= MIN_ALPHA) & (depth < MAX_DEPTH_M)
    rows = slice(stride // 2, None, stride)
    points = surface.points[rows, rows][chosen[rows, rows]]
    return np.ascontiguousarray(points.numpy(), np.float32)


def _is_confirmed(points: Float32, others: Sequence[tuple[View, Tensor]]) -> NDArray[np.bool_]:
    """[P] whether at least as many views of other frames have the point on their surface as look through it."""
    agreeing = np.zeros(len(points), np.int64)
    looking_through = np.zeros(len(points), np.int64)
    for view, depth in others:
        inside = project(points, view.chunk_SE3_camera, view.lens)
        rows = inside.uv[:, 1].astype(np.int64)
        surface = depth.numpy()[rows, inside.uv[:, 0].astype(np.int64)]
        # A pixel without any light has no depth, and agrees with nothing.
        error = np.where(np.isfinite(surface), (inside.depth - surface) / inside.depth, np.inf)
        np.add.at(agreeing, inside.index, np.abs(error) < _DEPTH_TOLERANCE)
        np.add.at(looking_through, inside.index, error < -_DEPTH_TOLERANCE)
    confirmed: NDArray[np.bool_] = (agreeing > 0) & (agreeing >= looking_through)
    return confirmed
