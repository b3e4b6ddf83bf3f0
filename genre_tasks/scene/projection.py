"""Points into images: pinhole projection with lens distortion and rolling shutter, and depth maps from points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.types import Float32, Float64, Lens, RollingShutter
from genre_tasks.scene.lens_distortion import Reals, distort, fold_radius, slopes

NEAR_M = 0.1
"""Points nearer to the camera plane than this are behind it."""

SHUTTER_MIN_RATE = 0.1
"""As in ``genre_tasks/render/constants.py``, which says why."""


@dataclass(frozen=True)
class Projected:
    """Points inside an image: ``index`` [M] into the points, ``uv`` [M, 2] float32 pixels, ``depth`` [M] float32 m."""

    index: NDArray[np.int64]
    uv: Float32
    depth: Float32


def project(points: Float32, chunk_SE3_camera: Float64, lens: Lens, shutter: RollingShutter | None = None) -> Projected:
    """Which points [P, 3] (chunk coordinates) fall into an image, and where; occlusion is not considered.

    With a ``shutter``, from where the camera is when a point's row is exposed; the points themselves rest. A point is
    seen if it is ahead of the camera, and within the lens's fold radius, both then and at the pose's time.
    """
    inverse = np.linalg.inv(chunk_SE3_camera).astype(np.float32)
    depth = points @ inverse[2, :3] + inverse[2, 3]
    index = np.flatnonzero(depth > NEAR_M)
    depth = depth[index]
    near = points[index]
    x = (near @ inverse[0, :3] + inverse[0, 3]) / depth
    y = (near @ inverse[1, :3] + inverse[1, 3]) / depth
    inside = np.ones(len(index), dtype=bool)
    if any(lens.distortion):
        inside &= x * x + y * y < fold_radius(lens.coefficients) ** 2
    if shutter is not None and shutter.readout_s:
        x, y, depth = _exposed(x, y, depth, lens, shutter)
        inside &= depth > NEAR_M
    if any(lens.distortion):
        inside &= x * x + y * y < fold_radius(lens.coefficients) ** 2
        x, y = distort(x, y, lens.coefficients)
    u, v = x * np.float32(lens.fx_px) + np.float32(lens.cx_px), y * np.float32(lens.fy_px) + np.float32(lens.cy_px)
    inside &= (u >= 0) & (u < lens.width_px) & (v >= 0) & (v < lens.height_px)
    return Projected(index[inside], np.stack([u[inside], v[inside]], 1), depth[inside])


def _exposed(x: Reals, y: Reals, z: Reals, lens: Lens, shutter: RollingShutter) -> tuple[Reals, Reals, Reals]:
    """x/z, y/z and z when the points' rows are exposed: the formula of the renderer's ``Shutter``."""
    moving, turning = np.array(shutter.velocity_m_s, np.float32), np.array(shutter.turn_rad_s, np.float32)
    posed = np.stack([x * z, y * z, z], 1)
    motion = -moving - np.cross(turning, posed)
    x_rate, y_rate = (motion[:, 0] - x * motion[:, 2]) / z, (motion[:, 1] - y * motion[:, 2]) / z
    row, row_rate = distort(x, y, lens.coefficients)[1] * lens.fy_px + lens.cy_px, lens.fy_px * y_rate
    if any(lens.distortion):
        _, xy, yy = slopes(x, y, lens.coefficients)
        row_rate = lens.fy_px * (xy * x_rate + yy * y_rate)
    rate = np.maximum(1 - shutter.readout_s * row_rate / lens.height_px, SHUTTER_MIN_RATE)
    half = shutter.readout_s / 2
    time = np.clip(shutter.readout_s * (row / lens.height_px - 0.5) / rate, -half, half)
    at = posed + time[:, None] * motion
    depth = at[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return at[:, 0] / depth, at[:, 1] / depth, depth


def splat_depth(projected: Projected, lens: Lens, footprint_m: float, max_radius_px: int = 10) -> Float32:
    """Nearest depth per pixel [H, W] float32, ∞ where no point: points are squares of ± ``footprint_m`` metres.

    Squares are at least ± 1 pixel. Points of one pixel radius are splatted together and spread by a minimum filter.
    """
    from scipy.ndimage import minimum_filter

    height, width = lens.height_px, lens.width_px
    out = np.full((height, width), np.inf, np.float32)
    radius = np.rint(lens.fx_px * footprint_m / projected.depth).astype(np.int64).clip(1, max_radius_px)
    pixel = projected.uv[:, 1].astype(np.int64) * width + projected.uv[:, 0].astype(np.int64)
    for size in np.unique(radius):
        chosen = radius == size
        layer = np.full(height * width, np.inf, np.float32)
        np.minimum.at(layer, pixel[chosen], projected.depth[chosen])
        spread = minimum_filter(layer.reshape(height, width), 2 * int(size) + 1, mode="constant", cval=np.inf)
        np.minimum(out, spread, out=out)
    return out
