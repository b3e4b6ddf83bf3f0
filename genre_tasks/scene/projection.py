"""Points into images: pinhole projection with lens distortion and rolling shutter, and depth maps from points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from genre_tasks.logs.brown_conrady import distort, distortion_jacobian
from genre_tasks.logs.types import Float32, Float64, Lens, RollingShutter
from genre_tasks.scene.lens_distortion import Reals, fold_radius

NEAR_M = 0.1
"""Points nearer to the camera plane than this are behind it."""

SHUTTER_MIN_RATE = 0.1
"""As in ``genre_tasks/render/constants.py``, which says why."""


@dataclass(frozen=True)
class Projected:
    """Points inside an image.

    Attributes:
        index: [M] into the points that were projected, rising.
        uv: [M, 2] float32 pixels, column and row.
        depth: [M] float32 metres along the camera's axis.
    """

    index: NDArray[np.int64]
    uv: Float32
    depth: Float32


def project(points: Float32, chunk_SE3_camera: Float64, lens: Lens, shutter: RollingShutter | None = None) -> Projected:
    """Finds which points fall into an image, and where; occlusion is not considered.

    Args:
        points: [P, 3] metres, chunk coordinates; they rest.
        chunk_SE3_camera: [4, 4] at the time of the image.
        lens: of the camera.
        shutter: if any, points are seen from where the camera is when their row is exposed.

    Returns:
        The points ahead of the camera and within the lens's fold radius, both then and at the pose's time, that lie
        inside the image.

    >>> lens = Lens(fx_px=100.0, fy_px=100.0, cx_px=50.0, cy_px=50.0, width_px=100, height_px=100)
    >>> seen = project(np.array([[0, 0, 2], [0, 0, -2]], np.float32), np.eye(4), lens)
    >>> seen.index.tolist(), seen.uv.tolist(), seen.depth.tolist()
    ([0], [[50.0, 50.0]], [2.0])
    """
    camera_SE3_chunk = np.linalg.inv(chunk_SE3_camera).astype(np.float32)
    # Depth first: half of all points are behind a camera and need no more arithmetic.
    depth = points @ camera_SE3_chunk[2, :3] + camera_SE3_chunk[2, 3]
    index = np.flatnonzero(depth > NEAR_M)
    depth = depth.take(index)
    # Here and below ``take``: brackets give the same in several times the time, with an index or a mask.
    ahead = points.take(index, axis=0)
    x = (ahead @ camera_SE3_chunk[0, :3] + camera_SE3_chunk[0, 3]) / depth
    y = (ahead @ camera_SE3_chunk[1, :3] + camera_SE3_chunk[1, 3]) / depth
    inside = np.ones(len(index), dtype=bool)
    if any(lens.distortion):
        inside &= x * x + y * y < fold_radius(lens.coefficients) ** 2
    # After the first check: a point that is outside of the fold at the pose's time has no row.
    if shutter is not None and shutter.readout_s:
        x, y, depth = _move_to_exposure(x, y, depth, lens, shutter)
        inside &= depth > NEAR_M
    if any(lens.distortion):
        inside &= x * x + y * y < fold_radius(lens.coefficients) ** 2
        x, y = distort(x, y, lens.coefficients)
    u = x * np.float32(lens.fx_px) + np.float32(lens.cx_px)
    v = y * np.float32(lens.fy_px) + np.float32(lens.cy_px)
    inside &= (u >= 0) & (u < lens.width_px) & (v >= 0) & (v < lens.height_px)
    seen = np.flatnonzero(inside)
    return Projected(index.take(seen), np.stack([u.take(seen), v.take(seen)], 1), depth.take(seen))


def _move_to_exposure(x: Reals, y: Reals, z: Reals, lens: Lens, shutter: RollingShutter) -> tuple[Reals, Reals, Reals]:
    # x/z, y/z and z when the points' rows are exposed: the formula of the renderer's Shutter.
    velocity = np.array(shutter.velocity_m_s, np.float32)
    turn = np.array(shutter.turn_rad_s, np.float32)
    posed = np.stack([x * z, y * z, z], 1)
    motion = -velocity - np.cross(turn, posed)
    x_rate = (motion[:, 0] - x * motion[:, 2]) / z
    y_rate = (motion[:, 1] - y * motion[:, 2]) / z
    row = distort(x, y, lens.coefficients)[1] * lens.fy_px + lens.cy_px
    row_rate = lens.fy_px * y_rate
    if any(lens.distortion):
        _, xy, yy = distortion_jacobian(x, y, lens.coefficients)
        row_rate = lens.fy_px * (xy * x_rate + yy * y_rate)
    rate = np.maximum(1 - shutter.readout_s * row_rate / lens.height_px, SHUTTER_MIN_RATE)
    half = shutter.readout_s / 2
    time = np.clip(shutter.readout_s * (row / lens.height_px - 0.5) / rate, -half, half)
    exposed = posed + time[:, None] * motion
    depth = exposed[:, 2]
    # What is beside the camera by then is left out by its depth; its quotient does not matter.
    with np.errstate(divide="ignore", invalid="ignore"):
        return exposed[:, 0] / depth, exposed[:, 1] / depth, depth


def splat_depth(projected: Projected, lens: Lens, footprint_m: float, max_radius_px: int = 10) -> Float32:
    """Draws points as squares into a depth map, which tells what they hide.

    Args:
        projected: points in the image of ``lens``.
        lens: of the depth map. Where its pixels are no squares, those of the points are as wide as high in the world.
        footprint_m: half the side of a point's square; at least one pixel.
        max_radius_px: half the width of the largest square.

    Returns:
        Nearest depth of each pixel [H, W] float32 metres, ∞ where there is no point.
    """
    height = lens.height_px
    width = lens.width_px
    out = np.full((height, width), np.inf, np.float32)
    # In pixels: near points hide more of the image.
    radius = np.rint(lens.fx_px * footprint_m / projected.depth).astype(np.int64).clip(1, max_radius_px)
    pixel = projected.uv[:, 1].astype(np.int64) * width + projected.uv[:, 0].astype(np.int64)
    # All squares grow together, by one pixel at a time; the largest start first. A square each would cost far more.
    for size in range(int(radius.max(initial=0)), 0, -1):
        chosen = radius == size
        # By torch: NumPy's ``minimum.at`` gives the same in thirty times the time.
        depth = torch.from_numpy(projected.depth[chosen])
        torch.from_numpy(out).view(-1).scatter_reduce_(0, torch.from_numpy(pixel[chosen]), depth, "amin")
        for _ in range(_count_rows(size, lens) - _count_rows(size - 1, lens)):
            out = _spread_minimum(out)
        out = _spread_minimum(out.T).T
    return out


def _count_rows(columns: int, lens: Lens) -> int:
    """How many rows a square reaches above and below its centre that reaches so many columns to the sides."""
    return max(1, round(columns * lens.fy_px / lens.fx_px)) if columns else 0


def _spread_minimum(depth: Float32) -> Float32:
    """Gives each pixel the least of itself and of its neighbours above and below."""
    spread = depth.copy(order="K")
    np.minimum(spread[1:], depth[:-1], out=spread[1:])
    np.minimum(spread[:-1], depth[1:], out=spread[:-1])
    return spread
