"""What boxes in space cover of an image: their rectangle, how much of it is cut off, and how much nearer surfaces hide.

A box is cut at a plane just ahead of the camera, and at the radius where a distorting lens folds back; what is left is
projected with the lens's distortion.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.brown_conrady import distort
from genre_tasks.logs.types import Float32, Float64, Lens
from genre_tasks.scene.lens_distortion import fold_radius
from genre_tasks.scene.projection import NEAR_M

Polygon = list[tuple[float, float]]

# Corners in the order of bits: x, y, z; an edge joins two that differ in one bit.
_CORNERS = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_EDGES = np.array([(a, a | bit) for bit in (1, 2, 4) for a in range(8) if not a & bit])
# Between points of an edge, a distorting lens bends it by a fraction of a pixel.
_BENT_STEPS = 16
# Points along each side of a face where nearer surfaces are looked for; the finer ones where an image shows a strip.
_FACE_STEPS = (8, 64)
# A rendered surface is soft, and boxes are drawn to within a hand's breadth.
_DEPTH_MARGIN_M = 0.2
_DEPTH_MARGIN = 0.02


@dataclass(frozen=True)
class Outline:
    """Where a box is in an image.

    Attributes:
        box_px: x and y of the upper left, then of the lower right corner of the rectangle around what the image shows.
        truncated: share of the rectangle around all of the box that this one lacks, in [0, 1].
    """

    box_px: tuple[float, float, float, float]
    truncated: float


def box_corners(camera_SE3_box: Float64, size_m: Float64) -> Float64:
    """Places the corners of boxes.

    Args:
        camera_SE3_box: [..., 4, 4].
        size_m: [..., 3] length, width, height.

    Returns:
        [..., 8, 3] in camera axes.

    >>> box_corners(np.eye(4), np.array([2.0, 2.0, 2.0]))[7].tolist()
    [1.0, 1.0, 1.0]
    """
    corners = _CORNERS * size_m[..., None, :]
    # Sums and no matrix product: small ones wait long for busy cores.
    turned = (corners[..., :, None, :] * camera_SE3_box[..., None, :3, :3]).sum(-1)
    placed: Float64 = turned + camera_SE3_box[..., None, :3, 3]
    return placed


def find_boxes_in_view(corners: Float64, lens: Lens) -> NDArray[np.int64]:
    """Finds the boxes that may be in an image, fast: the others lie behind the camera or on one side of its view.

    Args:
        corners: [B, 8, 3] in camera axes.
        lens: of the image.

    Returns:
        Indices of the boxes, rising.
    """
    x, y, z = corners[..., 0], corners[..., 1], corners[..., 2]
    candidate = (z > NEAR_M).any(1)
    # The sides of a distorted image are no planes.
    if not any(lens.distortion):
        u = lens.fx_px * x + lens.cx_px * z
        v = lens.fy_px * y + lens.cy_px * z
        # Homogeneous coordinates: a test by planes holds for corners behind the camera, too.
        for outside in (u <= 0, u >= lens.width_px * z, v <= 0, v >= lens.height_px * z):
            candidate &= ~outside.all(1)
    return np.flatnonzero(candidate)


def outline_box(corners: Float64, lens: Lens) -> Outline | None:
    """Finds the rectangle that a box covers in an image.

    Args:
        corners: [8, 3] in camera axes, in the order of :func:`box_corners`.
        lens: of the image.

    Returns:
        The outline; ``None`` where the box is not in the image.

    >>> lens = Lens(fx_px=100.0, fy_px=100.0, cx_px=50.0, cy_px=50.0, width_px=100, height_px=100)
    >>> pose = np.eye(4)
    >>> pose[:3, 3] = 2.5, 0.0, 6.0
    >>> outline = outline_box(box_corners(pose, np.array([2.0, 2.0, 2.0])), lens)
    >>> [round(edge, 2) for edge in outline.box_px], round(outline.truncated, 4)
    ([71.43, 30.0, 100.0, 70.0], 0.4118)
    """
    pixels = _project_edges(corners, lens)
    if not len(pixels):
        return None
    low, high = pixels.min(0), pixels.max(0)
    full = float((high - low).prod())
    if low.min() >= 0 and high[0] <= lens.width_px and high[1] <= lens.height_px:
        return Outline((float(low[0]), float(low[1]), float(high[0]), float(high[1])), 0.0) if full > 0 else None
    # Of the polygon, not of its rectangle: that of a box next to the camera reaches far above and below the box.
    polygon = _cut_at_image(_convex_hull(pixels), lens)
    if not polygon:
        return None
    columns = [x for x, _ in polygon]
    rows = [y for _, y in polygon]
    area = (max(columns) - min(columns)) * (max(rows) - min(rows))
    if area <= 0:
        return None
    # Rounding may make the part larger than the whole.
    truncated = min(max(1 - area / full, 0.0), 1.0)
    return Outline((min(columns), min(rows), max(columns), max(rows)), truncated)


def _project_edges(corners: Float64, lens: Lens) -> Float64:
    """Pixels [N, 2] along what is left of the edges."""
    start, end = corners[_EDGES[:, 0]], corners[_EDGES[:, 1]]
    ahead = (start[:, 2] > NEAR_M) | (end[:, 2] > NEAR_M)
    start, end = start[ahead], end[ahead]
    rise = end[:, 2] - start[:, 2]
    # Parallel to the plane, an edge is not cut.
    cut = (NEAR_M - start[:, 2]) / np.where(rise == 0, np.inf, rise)
    first = np.where(start[:, 2] < NEAR_M, cut, 0.0)
    last = np.where(end[:, 2] < NEAR_M, cut, 1.0)
    steps = _BENT_STEPS if any(lens.distortion) else 1
    part = first[:, None] + (last - first)[:, None] * np.linspace(0, 1, steps + 1)
    points = (start[:, None] + part[..., None] * (end - start)[:, None]).reshape(-1, 3)
    return _to_pixels(points, lens)[0]


def _to_pixels(points: Float64, lens: Lens) -> tuple[Float64, NDArray[np.bool_]]:
    """Pixels [M, 2] of the points [N, 3] that the lens can show, and which those are."""
    # Points on the plane itself are where edges are cut, to within rounding.
    valid = points[:, 2] > NEAR_M * (1 - 1e-6)
    z = np.where(valid, points[:, 2], 1.0)
    x: NDArray[np.floating] = points[:, 0] / z
    y: NDArray[np.floating] = points[:, 1] / z
    if any(lens.distortion):
        valid &= x * x + y * y < fold_radius(lens.coefficients) ** 2
        # Others may overflow a polynomial.
        x, y = distort(np.where(valid, x, 0.0), np.where(valid, y, 0.0), lens.coefficients)
    pixels: Float64 = np.stack([x * lens.fx_px + lens.cx_px, y * lens.fy_px + lens.cy_px], 1)
    return pixels[valid], valid


def _convex_hull(pixels: Float64) -> Polygon:
    """The outermost points, in order: lower chain, then upper chain."""
    points = sorted({(float(x), float(y)) for x, y in pixels})
    if len(points) < 3:
        return points
    chains = []
    for ordered in (points, points[::-1]):
        chain: Polygon = []
        for point in ordered:
            while len(chain) > 1 and _turn(chain[-2], chain[-1], point) <= 0:
                chain.pop()
            chain.append(point)
        chains.append(chain[:-1])
    return chains[0] + chains[1]


def _turn(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _cut_at_image(polygon: Polygon, lens: Lens) -> Polygon:
    """Cuts a convex polygon at the four edges of the image."""
    for axis, sign, limit in ((0, 1, 0.0), (0, -1, lens.width_px), (1, 1, 0.0), (1, -1, lens.height_px)):
        kept: Polygon = []
        for a, b in pairwise([*polygon, *polygon[:1]]):
            inside_a = sign * (a[axis] - limit)
            inside_b = sign * (b[axis] - limit)
            if inside_a >= 0:
                kept.append(a)
            if inside_a * inside_b < 0:
                part = inside_a / (inside_a - inside_b)
                crossing = [a[0] + part * (b[0] - a[0]), a[1] + part * (b[1] - a[1])]
                # On the edge exactly, so that rectangles end where the image does.
                crossing[axis] = float(limit)
                kept.append((crossing[0], crossing[1]))
        polygon = kept
    return polygon


def measure_occlusion(camera_SE3_box: Float64, size_m: Float64, lens: Lens, depth: Float32) -> float:
    """Measures how much of a box nearer surfaces hide.

    Points are spread over the faces that look at the camera, which lie ahead of everything in the box. A point is
    hidden where the surface in its pixel is nearer by more than 0.2 m and 2 % of the point's depth: the object itself
    cannot be. Points outside of the image do not count.

    Args:
        camera_SE3_box: [4, 4].
        size_m: [3] length, width, height.
        lens: of the image.
        depth: [H, W] metres along the camera's axis; 0 where there is no surface.

    Returns:
        Share of the points that are hidden, in [0, 1]; NaN where the image has none of them.
    """
    for steps in _FACE_STEPS:
        points = _points_on_near_faces(camera_SE3_box, size_m, steps)
        pixels, valid = _to_pixels(points, lens)
        z = points[valid, 2]
        column = np.floor(pixels[:, 0]).astype(np.int64)
        row = np.floor(pixels[:, 1]).astype(np.int64)
        inside = (column >= 0) & (column < lens.width_px) & (row >= 0) & (row < lens.height_px)
        if inside.any():
            surface = depth[row[inside], column[inside]]
            limit = z[inside] * (1 - _DEPTH_MARGIN) - _DEPTH_MARGIN_M
            return float(((surface > 0) & (surface < limit)).mean())
    return float("nan")


def _points_on_near_faces(camera_SE3_box: Float64, size_m: Float64, steps: int) -> Float64:
    """Points [N, 3] in camera axes."""
    # Centres of cells: at a box's lower edge the road is as near as the box.
    ticks = (np.arange(steps) + 0.5) / steps - 0.5
    first, second = (grid.ravel() for grid in np.meshgrid(ticks, ticks, indexing="ij"))
    rotation = camera_SE3_box[:3, :3]
    eye = -(rotation * camera_SE3_box[:3, 3, None]).sum(0)
    faces = [np.zeros((0, 3))]
    for axis in range(3):
        # Only the face on the camera's side of the box, and none where the camera is between two.
        if abs(eye[axis]) > size_m[axis] / 2:
            face = np.empty((len(first), 3))
            face[:, axis] = 0.5 * np.sign(eye[axis])
            face[:, (axis + 1) % 3] = first
            face[:, (axis + 2) % 3] = second
            faces.append(face)
    points = np.concatenate(faces) * size_m
    placed: Float64 = (points[:, None, :] * rotation).sum(-1) + camera_SE3_box[:3, 3]
    return placed
