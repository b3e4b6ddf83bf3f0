"""Façades and trees above the LiDAR's reach, as columns of points over the structures that it saw.

A roof LiDAR ends some fifteen degrees above the horizon: a house beside the road has a ground floor and no more, and
what is above it would be painted on the distant shell, with the wrong parallax. What stands usually goes on upwards,
and the images tell how far: a point on a surface has one colour in all views that see it, while a point on the wrong
surface looks in each view at something else. Points are coloured from the images like all others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.types import Float32, Float64
from genre_tasks.scene.chunk import View
from genre_tasks.scene.image_decoding import decode_pixels
from genre_tasks.scene.projection import project
from genre_tasks.scene.road_completion import measure_height_over_road
from genre_tasks.scene.transforms import distance_to_path

REACH_M = 45.0
"""Only this near to the path: farther away the LiDAR itself looks twelve metres up."""

CELL_M = 0.4
"""Columns stand on cells of this width."""

STEP_M = 0.4
"""Heights of columns are judged in such steps."""

LOWEST_TOP_M = 2.2
"""Above the road: what ends below is a car or a fence, and complete."""

HIGHEST_M = 16.0
"""Above the road: no column goes higher."""

SPACING_M = 0.15
"""Between the points that are added."""

# A column's points lie above its LiDAR points within this of its top.
_CROWN_M = 1.5
# Evidence is averaged over the columns around: a single column's is noise.
_NEIGHBOURHOOD_M = 1.2
# Images are compared at this width: a cell is several pixels wide.
_WIDTH_PX = 320
# And blurred by this standard deviation: a pose is never exact.
_BLUR_PX = 1.5
# Of two colours in [0, 1]; more says nothing more.
_MOST_DIFFERENCE = 0.2
# A view that sees a point with so many more metres a pixel than the best one does not judge it.
_COARSER = 3.0
# Subtracted from each step's evidence: plain sky is evidence of nothing.
_MARGIN = 0.035
# What the sum of a column's evidence has to reach.
_ENOUGH = 0.105
_UNSEEN_MARGIN = 0.3 * _MARGIN
_FAR_M = 5000.0
# Points times views that are compared at a time; each takes 16 bytes and more. More views see other places.
_BLOCK_VALUES = 2**24


@dataclass(frozen=True)
class Columns:
    """C columns that may grow over LiDAR points.

    Attributes:
        xy: [C, 2] metres, where they stand.
        road: [C] height of the road there.
        top: [C] metres above the road at which LiDAR left them.
    """

    xy: Float64
    road: Float64
    top: Float64

    def candidates(self) -> tuple[Float32, NDArray[np.bool_]]:
        """Lists the points by which the columns may grow, upwards from their tops.

        Returns:
            Points [C, N, 3], and which of them are below ``HIGHEST_M`` [C, N].
        """
        above = self.top[:, None] + STEP_M * (np.arange(round(HIGHEST_M / STEP_M)) + 0.5)
        z = self.road[:, None] + above
        xy = np.broadcast_to(self.xy[:, None], (*z.shape, 2))
        return np.concatenate([xy, z[..., None]], -1).astype(np.float32), above < HIGHEST_M


def complete_facades(positions: Float32, chunk_SE3_ego: Float64, views: Sequence[View]) -> Float32:
    """Adds points above structures that LiDAR saw from below, as high as the images confirm.

    Deterministic.

    Args:
        positions: [P, 3] LiDAR points of the background, chunk coordinates.
        chunk_SE3_ego: [F, 4, 4].
        views: source views.

    Returns:
        Points [M, 3]; none without structures, or without views whose images overlap.
    """
    # In float64: heights over the road are differences of numbers far larger than they are.
    near = positions[distance_to_path(positions, chunk_SE3_ego) < REACH_M].astype(np.float64)
    height = measure_height_over_road(near, chunk_SE3_ego)
    columns = _find_columns(near, height)
    if not len(columns.xy) or len(views) < 2:
        return np.empty((0, 3), np.float32)
    points, allowed = columns.candidates()
    evidence = np.zeros((2, *allowed.shape))
    evidence[:, allowed] = _compare_colors(points[allowed], views)
    extent = _choose_extents(columns, evidence[0], evidence[1])
    return _fill_columns(near, height, columns, extent)


def _find_columns(points: Float64, height: Float64) -> Columns:
    # Finds cells whose points reach high enough; a column stands at the mean position of the upper points.
    cells, cell_of = np.unique(_cell_keys(points, CELL_M), return_inverse=True)
    count = len(cells)
    top = np.full(count, -np.inf)
    np.maximum.at(top, cell_of, height)
    # Only the upper metre: a parked car before a house is not where the house stands.
    upper = (height > top[cell_of] - 1.0).astype(np.float64)
    base = np.column_stack([points[:, :2], points[:, 2] - height])
    sums = np.column_stack([np.bincount(cell_of, upper * base[:, k], count) for k in range(3)])
    mean = sums / np.maximum(np.bincount(cell_of, upper, count), 1)[:, None]
    tall = top > LOWEST_TOP_M
    return Columns(mean[tall, :2], mean[tall, 2], top[tall])


def _cell_keys(points: Float64, size_m: float) -> NDArray[np.int64]:
    # One number for each cell seen from above: np.unique sorts rows ten times slower.
    cell = np.floor(points[:, :2] / size_m).astype(np.int64)
    return cell[:, 0] * 2**32 + cell[:, 1]


def _compare_colors(points: Float32, views: Sequence[View]) -> tuple[Float64, Float64]:
    """Judges candidates by their colours: a point on a surface has one colour in all views that see it.

    A point's colours are compared with the colour in the view that resolves it best. So are the colours of points far
    away on that view's ray, since a sky of one colour would agree with anything.

    Args:
        points: [K, 3].
        views: source views.

    Returns:
        By how much the colours at the point agree better than those far away [K], a mean over the other views, and
        whether any other view sees the point [K] (1 or 0).
    """
    images = [_blurred_image(view) for view in views]
    rows = max(1, _BLOCK_VALUES // len(views))
    blocks = [_compare_block(points[k : k + rows], views, images) for k in range(0, max(1, len(points)), rows)]
    return np.concatenate([better for better, _ in blocks]), np.concatenate([known for _, known in blocks])


def _compare_block(points: Float32, views: Sequence[View], images: Sequence[Float32]) -> tuple[Float64, Float64]:
    colors = np.zeros((len(views), len(points), 3), np.float32)
    coarse = np.full((len(views), len(points)), np.inf, np.float32)  # depth per focal length: metres a pixel
    for k, (view, image) in enumerate(zip(views, images, strict=True)):
        index, sampled, depth = _sample_image(points, view, image)
        colors[k, index] = sampled
        coarse[k, index] = depth / np.float32(view.lens.fx_px / view.lens.width_px)
    # The view that resolves a point best gives the colour that the others are compared with.
    best = coarse.argmin(0)
    total = np.zeros(len(points))
    count = np.zeros(len(points))
    for b, best_view in enumerate(views):
        judged = np.flatnonzero((best == b) & np.isfinite(coarse[b]))
        # Columns are in order of their places, so most views see nothing of a block.
        if not len(judged):
            continue
        camera_centre = best_view.chunk_SE3_camera[:3, 3].astype(np.float32)
        ray = points[judged] - camera_centre
        ray *= np.float32(_FAR_M) / np.linalg.norm(ray, axis=1, keepdims=True)
        best_color = colors[b, judged]
        for k, (view, image) in enumerate(zip(views, images, strict=True)):
            sees = coarse[k, judged] < _COARSER * coarse[b, judged]
            if k == b or not sees.any():
                continue
            far_point = view.chunk_SE3_camera[:3, 3].astype(np.float32) + ray
            index, far_color, _ = _sample_image(far_point, view, image)
            # A view counts only where it has both the point and its far twin in the image.
            both = index[sees[index]]
            here = _color_difference(colors[k, judged[both]], best_color[both])
            total[judged[both]] += _color_difference(far_color[sees[index]], best_color[both]) - here
            count[judged[both]] += 1
    return total / np.maximum(count, 1), (count > 0).astype(np.float64)


def _blurred_image(view: View) -> Float32:
    # Colours [H, W, 3] in [0, 1] at the width for comparisons.
    from scipy.ndimage import gaussian_filter

    lens = view.lens.resized_to_width(_WIDTH_PX)
    pixels = decode_pixels(view.image, lens.width_px, lens.height_px).astype(np.float32) / np.float32(255)
    return gaussian_filter(pixels, (_BLUR_PX, _BLUR_PX, 0))


def _sample_image(points: Float32, view: View, image: Float32) -> tuple[NDArray[np.int64], Float32, Float32]:
    # Which points [M] are in the image, their colours [M, 3] and depths [M].
    inside = project(points, view.chunk_SE3_camera, view.lens.resized_to_width(_WIDTH_PX))
    column = inside.uv[:, 0].astype(np.int64)
    row = inside.uv[:, 1].astype(np.int64)
    return inside.index, image[row, column], inside.depth


def _color_difference(a: Float32, b: Float32) -> Float32:
    return np.minimum(np.abs(a - b).mean(1), _MOST_DIFFERENCE)


def _choose_extents(columns: Columns, evidence: Float64, known: Float64) -> Float64:
    """Chooses how far each column grows: to where the sum of its evidence from the top on is largest.

    Evidence of the columns around counts at the same height above the road.

    Args:
        columns: C of them.
        evidence: [C, N] of each step, 0 where it is not known.
        known: [C, N] 1 or 0.

    Returns:
        Metres [C].
    """
    from scipy.sparse import csr_array
    from scipy.spatial import cKDTree

    count, steps = evidence.shape
    start = np.round(columns.top / STEP_M).astype(np.int64)
    row = np.arange(count)[:, None]
    # Columns have tops of their own, so steps are counted from the road.
    level = start[:, None] + np.arange(steps)
    by_height = np.zeros((2, count, int(start.max()) + steps))
    by_height[0][row, level] = evidence
    by_height[1][row, level] = known
    pairs = cKDTree(columns.xy).query_pairs(_NEIGHBOURHOOD_M, output_type="ndarray")
    itself = np.arange(count)[:, None].repeat(2, 1)
    a, b = np.concatenate([pairs, pairs[:, ::-1], itself]).T
    around = csr_array((np.ones(len(a)), (a, b)), shape=(count, count))
    total = (around @ by_height[0])[row, level]
    weight = (around @ by_height[1])[row, level]
    # Steps that no view can judge count slightly against growing: what is not seen need not be there.
    gain = np.where(weight > 0, total / np.maximum(weight, 1) - _MARGIN, -_UNSEEN_MARGIN)
    sums = np.cumsum(gain, 1)
    extent = np.where(sums.max(1) > _ENOUGH, STEP_M * (sums.argmax(1) + 1), 0.0)
    return np.minimum(extent, HIGHEST_M - columns.top).clip(0)


def _fill_columns(points: Float64, height: Float64, columns: Columns, extent: Float64) -> Float32:
    # Stacks points over the upper LiDAR points of the columns that grow, from the columns' tops on.
    from scipy.spatial import cKDTree

    distance, column = cKDTree(columns.xy).query(points[:, :2], distance_upper_bound=CELL_M)
    column = np.where(np.isfinite(distance), column, 0)
    base = np.isfinite(distance) & (extent[column] > 0) & (height > columns.top[column] - _CROWN_M)
    points = points[base]
    column = column[base]
    # Which point stands for its cell must not depend on the order of the sweeps.
    order = np.lexsort(points.T)
    points = points[order]
    column = column[order]
    first = np.unique(_cell_keys(points, SPACING_M), return_index=True)[1]
    points = points[first]
    column = column[first]
    count = np.floor(extent[column] / SPACING_M).astype(np.int64)
    step = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + 0.5
    z = np.repeat((columns.road + columns.top)[column], count) + SPACING_M * step
    return np.column_stack([np.repeat(points[:, :2], count, 0), z]).astype(np.float32)
