"""Points on what LiDAR does not reach, such as crowns of trees and upper floors, by multi-view stereo.

Without them these surfaces would be painted on the distant shell, where they do not move as the vehicle passes. A depth
counts where the depth map of another image confirms it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.types import Float32, Float64
from genre_tasks.scene.box_projection import project_box
from genre_tasks.scene.chunk import NO_SWEEP, Chunk, Points, View
from genre_tasks.scene.image_decoding import decode_pixels
from genre_tasks.scene.plane_sweep import SweepImage, compute_depth_map, unproject_pixels
from genre_tasks.scene.projection import project, splat_depth
from genre_tasks.threads import map_single_threaded

SWEEP_PIXELS = 16_000
"""Images are compared at about so many pixels, whatever their size: the points' colours are coarser than the image's
texture anyway, which the optimiser adds."""

NEIGHBOURS = 4
"""An image is compared with at most so many others."""

BASELINE_M = 1.5
"""Images from about so far away are compared first: nearer ones have little parallax, farther ones look different."""

MIN_BASELINE_M = 0.2
"""Images from nearer by are not compared."""

MIN_OVERLAP = 0.35
"""Share of an image that its neighbour has to see, too."""

AGREEMENT = 0.03
"""A depth is confirmed where another image's differs by at most this fraction."""

FARTHEST_POINT_M = 120.0
"""Farther points have too little parallax, and belong to the distant region."""

LIDAR_FOOTPRINT_M = 0.15
"""Half the square around a LiDAR point in which no other point is needed."""

# Overlap is judged by points of the image at this distance: that of the houses along a street.
_TYPICAL_DEPTH_M = 15.0
_OVERLAP_GRID = (9, 7)
# What is nearer to a camera is behind it, or the vehicle itself.
_NEAR_M = 1.0


def choose_sweep_width(view: View) -> int:
    """Chooses the width at which images are compared, such that an image has about ``SWEEP_PIXELS``.

    Args:
        view: of the chunk.

    Returns:
        Pixels; at most the width of the view itself.
    """
    lens = view.lens
    return min(lens.width_px, round((SWEEP_PIXELS * lens.width_px / lens.height_px) ** 0.5))


def find_neighbours(view: View, others: Sequence[View]) -> list[int]:
    """Chooses the views that a view is compared with.

    Args:
        view: whose depth is asked for.
        others: candidates; may contain the view itself.

    Returns:
        Indices of at most ``NEIGHBOURS`` of them; none where no other view sees the same from another place.
    """
    lens = view.lens
    u, v = np.meshgrid(
        np.linspace(0, lens.width_px, _OVERLAP_GRID[0]), np.linspace(0, lens.height_px, _OVERLAP_GRID[1])
    )
    rays = np.stack([(u - lens.cx_px) / lens.fx_px, (v - lens.cy_px) / lens.fy_px, np.ones_like(u)], -1).reshape(-1, 3)
    pose = view.chunk_SE3_camera
    points = (_TYPICAL_DEPTH_M * rays @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32)
    candidates = []
    for k, other in enumerate(others):
        baseline_m = float(np.linalg.norm(other.chunk_SE3_camera[:3, 3] - pose[:3, 3]))
        if other is view or baseline_m < MIN_BASELINE_M:
            continue
        overlap = len(project(points, other.chunk_SE3_camera, other.lens).index) / len(points)
        if overlap > MIN_OVERLAP:
            candidates.append((abs(baseline_m - BASELINE_M), k))
    return [k for _, k in sorted(candidates)[:NEIGHBOURS]]


def find_unscanned_pixels(chunk: Chunk, view: View, width_px: int) -> NDArray[np.bool_]:
    """Finds the pixels that show neither a LiDAR point of the background nor a moving actor.

    Args:
        chunk: with its points.
        view: of the chunk.
        width_px: of the mask.

    Returns:
        [H, W].
    """
    lens = view.lens.resized_to_width(width_px)
    returns = project(chunk.static.positions, view.chunk_SE3_camera, lens)
    unscanned: NDArray[np.bool_] = np.isinf(splat_depth(returns, lens, LIDAR_FOOTPRINT_M))
    scale = width_px / view.lens.width_px
    for actor in chunk.actors:
        # Something that moves has another depth in each image, and its own points.
        (left, top), (right, bottom) = (np.floor(corner * scale).astype(int) for corner in project_box(actor, view))
        unscanned[top : bottom + 1, left : right + 1] &= right <= left or bottom <= top
    return unscanned


def find_stereo_points(chunk: Chunk, views: Sequence[View]) -> Points:
    """Finds points of the background where LiDAR has none.

    Args:
        chunk: with its LiDAR points and actors.
        views: source views.

    Returns:
        Points with the colours of the images that they come from; none where no two views overlap.

    Raises:
        InputError: an image cannot be decoded.
    """
    neighbours = {k: find_neighbours(view, views) for k, view in enumerate(views)}
    # A view without neighbours has no depth, and confirms no other's.
    images = map_single_threaded(lambda view: SweepImage.from_view(view, choose_sweep_width(view)), views)
    compared = [k for k, others in neighbours.items() if others]

    def compute_depth(k: int) -> Float32:
        return compute_depth_map(images[k], [images[other] for other in neighbours[k]])

    depth_maps = dict(zip(compared, map_single_threaded(compute_depth, compared), strict=True))
    positions = [np.empty((0, 3), np.float32)]
    colors = [np.empty((0, 3), np.uint8)]

    def take_points(k: int) -> tuple[Float32, NDArray[np.uint8]]:
        others = [(images[other], depth_maps[other]) for other in depth_maps if other != k]
        surface, is_confirmed = _confirm(images[k], depth_maps[k], others)
        lens = images[k].lens
        kept = is_confirmed & find_unscanned_pixels(chunk, views[k], lens.width_px)
        return surface[kept].astype(np.float32), decode_pixels(views[k].image, lens.width_px, lens.height_px)[kept]

    for position, color in map_single_threaded(take_points, compared):
        positions.append(position)
        colors.append(color)
    return _collect_points(np.concatenate(positions), np.concatenate(colors))


def _confirm(
    image: SweepImage, depth: Float32, others: Sequence[tuple[SweepImage, Float32]]
) -> tuple[Float64, NDArray[np.bool_]]:
    """The surface [H, W, 3] that a depth map shows, and where another map has it at the same place [H, W]."""
    pose = image.chunk_SE3_camera
    points = unproject_pixels(image.lens) * depth[..., None] @ pose[:3, :3].T + pose[:3, 3]
    flat = points.reshape(-1, 3).astype(np.float32)
    confirmed = np.zeros(len(flat), bool)
    for other, other_depth in others:
        inside = project(flat, other.chunk_SE3_camera, other.lens)
        column = inside.uv[:, 0].astype(np.int64)
        row = inside.uv[:, 1].astype(np.int64)
        agrees = np.abs(other_depth[row, column] / inside.depth - 1) < AGREEMENT
        confirmed[inside.index] |= agrees & (inside.depth > _NEAR_M)
    return points, confirmed.reshape(depth.shape) & (depth < FARTHEST_POINT_M)


def _collect_points(positions: Float32, colors: NDArray[np.uint8]) -> Points:
    count = len(positions)
    return Points(positions, colors, np.ones(count, bool), np.full(count, NO_SWEEP, np.int16))
