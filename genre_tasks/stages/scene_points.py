"""Points of a log without LiDAR, from the surfaces that a scene of Gaussians shows at the poses of the images.

A render's depth is an average of the centres of Gaussians along a ray. On a road at a grazing angle, centres lie metres
before and behind the surface, and a haze of faint Gaussians draws the average towards the camera. So depth is where
rays meet the planes of flat Gaussians, and faint Gaussians are left out of it. Poses suffice for that: no image that
is held out is looked at.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from genre_tasks.errors import InputError
from genre_tasks.fixer.view_surface import unproject_surface
from genre_tasks.logs.types import Float32
from genre_tasks.render.surface import render_surfaces
from genre_tasks.scene.chunk import NO_SWEEP, View
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.projection import project
from genre_tasks.scene.road_completion import complete_road
from genre_tasks.scene.road_smoothing import smooth_road
from genre_tasks.scene.visibility import PointCloud
from genre_tasks.stages.chunk_reading import ChunkReading
from genre_tasks.stages.ingest_points import ChunkPoints
from genre_tasks.stages.scene_file import read_placed_scene

MAX_PIXELS = 4_000_000
"""Of all views, about a third of which become points; views are looked at more coarsely where they have more."""

MAX_PROJECTIONS = 250_000_000
"""Of pixels into all other views, which takes about half a minute: a long chunk of many cameras has fewer points."""

MAX_DEPTH_M = 100.0
"""Farther than LiDAR reaches, a render's depth says little."""

MIN_ALPHA = 0.8
"""A pixel's depth counts where at least so much of its light is accounted for."""

OPACITY_CONTRAST = 4.0
"""Added to the logits of opacities above one half and taken from the others: a ray then ends at its first surface."""

ROAD_FRAMES = 3
"""Road is completed from surfaces that so many moments agree on: a lone point under the road would tilt it."""

_DEPTH_TOLERANCE = 0.1
# Depths take the median of their neighbours where it is this near: noise goes, and outlines stay.
_MEDIAN_PX = 7
_MEDIAN_TOLERANCE = 0.15
_AGREEMENT_CELL_M = 0.25
_MIN_POINTS = 100


def read_points_from_scene(reading: ChunkReading, file: str, views: Sequence[View]) -> ChunkPoints:
    """Makes points of a scene's depth: where views see it, and views of other frames agree.

    A floater before one camera is no surface for the others, so that it gives no points.

    Args:
        reading: the chunk; what stands in for LiDAR is noted in its issues.
        file: of Gaussians, in the coordinates that ``placement`` takes to the world.
        views: source views and held-out ones, whose poses alone are used.

    Returns:
        A background without actors; a point's frame is that of its view, and points that complete the road have none.

    Raises:
        InputError: the file cannot be read, the views see next to nothing of it, or a pose is far away.
    """
    scene = read_placed_scene(file, reading.config.placement, reading.world_SE3_chunk)
    opaque = _sharpen_opacities(scene)
    depths = []
    alphas = []
    for view in views:
        # A render has much that is not needed any more, and there are many views.
        render = render_surfaces(opaque, [view])
        depths.append(_smooth_depth(render.expected_depth()[0]))
        alphas.append(render.alpha[0])
    stride = _choose_stride(views)
    parts = []
    for index, view in enumerate(views):
        points = _unproject(view, depths[index], alphas[index], stride)
        others = [(views[k], depths[k]) for k in range(len(views)) if views[k].frame != view.frame]
        parts.append(points[_is_confirmed(points, others)])
    positions = np.concatenate(parts)
    if len(positions) < _MIN_POINTS:
        raise reading.input_error(
            "the images see next to nothing of the scene",
            "Check that scene and camera poses share their coordinates, and that --up and --scale fit.",
        )
    frames = np.repeat(np.array([view.frame for view in views], np.int16), [len(part) for part in parts])
    detail = f"there is no LiDAR: {len(positions)} points are of the depth of the scene that is to be enhanced"
    reading.add_issue("depth_of_scene", detail)
    try:
        positions = smooth_road(positions, _select_agreed(positions, frames), reading.chunk_SE3_ego)
        road = complete_road(_select_agreed(positions, frames), reading.chunk_SE3_ego)
    except InputError as error:
        raise reading.explain_long_path(error) from error
    frames = np.concatenate([frames, np.full(len(road), NO_SWEEP, np.int16)])
    return ChunkPoints(PointCloud(np.concatenate([positions, road]), frames), [])


def _select_agreed(positions: Float32, frames: NDArray[np.int16]) -> Float32:
    """The points in cells that ``ROAD_FRAMES`` frames have points in."""
    cells = np.floor(positions / _AGREEMENT_CELL_M).astype(np.int64)
    cell_of_point = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
    pairs = np.unique(np.stack([cell_of_point, frames], 1), axis=0)
    return positions[np.bincount(pairs[:, 0])[cell_of_point] >= ROAD_FRAMES]


def _sharpen_opacities(scene: SceneGraph) -> SceneGraph:
    """The scene with its Gaussians nearly opaque or nearly clear."""
    logits = scene.gaussians.logit_opacities
    sharpened = logits + torch.where(logits > 0, OPACITY_CONTRAST, -OPACITY_CONTRAST)
    return replace(scene, gaussians=replace(scene.gaussians, logit_opacities=sharpened))


def _smooth_depth(depth: Tensor) -> Tensor:
    """Replaces depths [H, W] by the median of those around, but for outlines."""
    from scipy.ndimage import median_filter

    known = torch.isfinite(depth) & (depth > 0)
    # What has no depth counts as far away.
    filled = torch.where(known, depth, torch.full_like(depth, 1e9))
    median = torch.from_numpy(median_filter(filled.numpy(), size=_MEDIAN_PX))
    is_noise = known & ((median / filled - 1).abs() < _MEDIAN_TOLERANCE)
    return torch.where(is_noise, median, depth)


def _choose_stride(views: Sequence[View]) -> int:
    """Every so many pixels of a row and of a column, so that pixels and projections stay within their bounds."""
    pixels = sum(view.lens.width_px * view.lens.height_px for view in views)
    bound = min(MAX_PIXELS, MAX_PROJECTIONS / max(len(views), 1))
    return max(1, int(np.ceil(np.sqrt(pixels / bound))))


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
