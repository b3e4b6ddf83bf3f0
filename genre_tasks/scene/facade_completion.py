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
from genre_tasks.scene.road_completion import height_over_road
from genre_tasks.scene.transforms import path_distance

REACH_M = 45.0
"""Only this near to the path: farther away the LiDAR itself looks twelve metres up."""

CELL_M, STEP_M = 0.4, 0.4
"""Columns stand on cells of this width; their height is judged in such steps."""

LOWEST_TOP_M, HIGHEST_M = 2.2, 16.0
"""Above the road: what ends below the first is a car or a fence and whole, and no column goes above the second."""

SPACING_M = 0.15
"""Between the points that are added."""

_CROWN_M = 1.5
"""A column's points lie above its LiDAR points within this of its top."""
_NEIGHBOURHOOD_M = 1.2
"""Evidence is averaged over the columns around: a single column's is noise."""
_WIDTH_PX, _BLUR_PX = 320, 1.5
"""Images are compared at this width and blurred: a cell is several pixels wide, and a pose is never exact."""
_MOST_DIFFERENCE = 0.2
"""Of two colours in [0, 1]; more says nothing more."""
_COARSER = 3.0
"""A view that sees a point with so many more metres a pixel than the best one does not judge it."""
_MARGIN, _ENOUGH = 0.035, 0.105
"""Subtracted from each step's evidence, and what a column's sum has to reach: plain sky is evidence of nothing."""
_UNSEEN_MARGIN = 0.3 * _MARGIN
_FAR_M = 5000.0


@dataclass(frozen=True)
class Columns:
    """C columns over cells: where they stand, and above the road the height at which LiDAR left them."""

    xy: Float64  # [C, 2]
    road: Float64  # [C] height of the road there
    top: Float64  # [C] metres above it

    def candidates(self) -> tuple[Float32, NDArray[np.bool_]]:
        """Points [C, N, 3] going up from the tops in steps, and which of them are not too high."""
        above = self.top[:, None] + STEP_M * (np.arange(round(HIGHEST_M / STEP_M)) + 0.5)
        z = self.road[:, None] + above
        xy = np.broadcast_to(self.xy[:, None], (*z.shape, 2))
        return np.concatenate([xy, z[..., None]], -1).astype(np.float32), above < HIGHEST_M


def wall_fill(positions: Float32, chunk_SE3_ego: Float64, views: Sequence[View]) -> Float32:
    """Points [M, 3] above structures in the LiDAR points [P, 3], as high as the views' images bear out.

    ``views`` are source views. Deterministic; empty without structures, or without views whose images overlap.
    """
    near = positions[path_distance(positions, chunk_SE3_ego) < REACH_M].astype(np.float64)
    height = height_over_road(near, chunk_SE3_ego)
    columns = _columns(near, height)
    if not len(columns.xy) or len(views) < 2:
        return np.empty((0, 3), np.float32)
    points, allowed = columns.candidates()
    evidence = np.zeros((2, *allowed.shape))
    evidence[:, allowed] = _evidence(points[allowed], views)
    return _filled(near, height, columns, _extents(columns, *evidence))


def _columns(points: Float64, height: Float64) -> Columns:
    """Cells whose points reach high enough, each at the mean place of its upper points."""
    cells, which = np.unique(_cell_keys(points, CELL_M), return_inverse=True)
    count = len(cells)
    top = np.full(count, -np.inf)
    np.maximum.at(top, which, height)
    upper = (height > top[which] - 1.0).astype(np.float64)
    place = np.column_stack([points[:, :2], points[:, 2] - height])
    sums = np.column_stack([np.bincount(which, upper * place[:, k], count) for k in range(3)])
    mean = sums / np.maximum(np.bincount(which, upper, count), 1)[:, None]
    tall = top > LOWEST_TOP_M
    return Columns(mean[tall, :2], mean[tall, 2], top[tall])


def _cell_keys(points: Float64, size_m: float) -> NDArray[np.int64]:
    """One number for each cell seen from above: those of rows sort ten times slower."""
    cell = np.floor(points[:, :2] / size_m).astype(np.int64)
    return cell[:, 0] * 2**32 + cell[:, 1]


def _evidence(points: Float32, views: Sequence[View]) -> tuple[Float64, Float64]:
    """How much more the colours of each point [K, 3] agree over the views than those of its ray far away.

    Colours are compared with those in the view that resolves the point best. Also whether any other view sees it.
    """
    images = [_blurred(view) for view in views]
    colors = np.zeros((len(views), len(points), 3), np.float32)
    coarse = np.full((len(views), len(points)), np.inf, np.float32)
    for k, (view, image) in enumerate(zip(views, images, strict=True)):
        index, colors_at, depth = _sampled(points, view, image)
        colors[k, index], coarse[k, index] = colors_at, depth / np.float32(view.lens.fx_px / view.lens.width_px)
    best = coarse.argmin(0)
    total, count = np.zeros(len(points)), np.zeros(len(points))
    for b, first in enumerate(views):
        mine = np.flatnonzero((best == b) & np.isfinite(coarse[b]))
        eye = first.chunk_SE3_camera[:3, 3].astype(np.float32)
        ray = points[mine] - eye
        ray *= np.float32(_FAR_M) / np.linalg.norm(ray, axis=1, keepdims=True)
        own = colors[b, mine]
        for k, (view, image) in enumerate(zip(views, images, strict=True)):
            sees = coarse[k, mine] < _COARSER * coarse[b, mine]
            if k == b or not sees.any():
                continue
            shift = view.chunk_SE3_camera[:3, 3].astype(np.float32)
            index, far, _ = _sampled(shift + ray, view, image)
            both = index[sees[index]]
            here = _difference(colors[k, mine[both]], own[both])
            total[mine[both]] += _difference(far[sees[index]], own[both]) - here
            count[mine[both]] += 1
    return total / np.maximum(count, 1), (count > 0).astype(np.float64)


def _blurred(view: View) -> Float32:
    """Colours [H, W, 3] in [0, 1] at the width for comparisons."""
    from scipy.ndimage import gaussian_filter

    lens = view.lens.of_width(_WIDTH_PX)
    pixels = decode_pixels(view.image, lens.width_px, lens.height_px).astype(np.float32) / np.float32(255)
    return gaussian_filter(pixels, (_BLUR_PX, _BLUR_PX, 0))


def _sampled(points: Float32, view: View, image: Float32) -> tuple[NDArray[np.int64], Float32, Float32]:
    """Which points [M] are in the image, their colours [M, 3] and depths [M]."""
    seen = project(points, view.chunk_SE3_camera, view.lens.of_width(_WIDTH_PX))
    return seen.index, image[seen.uv[:, 1].astype(np.int64), seen.uv[:, 0].astype(np.int64)], seen.depth


def _difference(a: Float32, b: Float32) -> Float32:
    return np.minimum(np.abs(a - b).mean(1), _MOST_DIFFERENCE)


def _extents(columns: Columns, evidence: Float64, known: Float64) -> Float64:
    """Metres [C] by which each column grows: where the sum of its evidence from the top on is largest.

    Evidence of the columns around counts at the same height above the road; it is 0 where it is not known.
    """
    from scipy.sparse import csr_array
    from scipy.spatial import cKDTree

    count, steps = evidence.shape
    start = np.round(columns.top / STEP_M).astype(np.int64)
    row, level = np.arange(count)[:, None], start[:, None] + np.arange(steps)
    by_height = np.zeros((2, count, int(start.max()) + steps))
    by_height[0][row, level], by_height[1][row, level] = evidence, known
    pairs = cKDTree(columns.xy).query_pairs(_NEIGHBOURHOOD_M, output_type="ndarray")
    a, b = np.concatenate([pairs, pairs[:, ::-1], np.arange(count)[:, None].repeat(2, 1)]).T
    around = csr_array((np.ones(len(a)), (a, b)), shape=(count, count))
    total, weight = ((around @ part)[row, level] for part in by_height)
    gain = np.where(weight > 0, total / np.maximum(weight, 1) - _MARGIN, -_UNSEEN_MARGIN)
    sums = np.cumsum(gain, 1)
    extent = np.where(sums.max(1) > _ENOUGH, STEP_M * (sums.argmax(1) + 1), 0.0)
    return np.minimum(extent, HIGHEST_M - columns.top).clip(0)


def _filled(points: Float64, height: Float64, columns: Columns, extent: Float64) -> Float32:
    """Points over the upper LiDAR points of columns that grow, from their tops on."""
    from scipy.spatial import cKDTree

    distance, column = cKDTree(columns.xy).query(points[:, :2], distance_upper_bound=CELL_M)
    column = np.where(np.isfinite(distance), column, 0)
    base = np.isfinite(distance) & (extent[column] > 0) & (height > columns.top[column] - _CROWN_M)
    points, column = points[base], column[base]
    order = np.lexsort(points.T)  # which point stands for its cell must not depend on the order of the sweeps
    points, column = points[order], column[order]
    first = np.unique(_cell_keys(points, SPACING_M), return_index=True)[1]
    points, column = points[first], column[first]
    count = np.floor(extent[column] / SPACING_M).astype(np.int64)
    step = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + 0.5
    z = np.repeat((columns.road + columns.top)[column], count) + SPACING_M * step
    return np.column_stack([np.repeat(points[:, :2], count, 0), z]).astype(np.float32)
