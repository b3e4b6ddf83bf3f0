"""Points into images: pinhole projection with optional lens distortion, and depth maps splatted from points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.types import Float32, Float64, Lens

NEAR_M = 0.1
"""Points nearer to the camera plane than this are behind it."""

_MAX_DISTORTED_TAN = 1.5
"""Brown–Conrady polynomials fold back outside their valid radius; rays beyond are taken as unseen."""


@dataclass(frozen=True)
class Projected:
    """Points inside an image: ``index`` [M] into the points, ``uv`` [M, 2] float32 pixels, ``depth`` [M] float32 m."""

    index: NDArray[np.int64]
    uv: Float32
    depth: Float32


def project(points: Float32, chunk_SE3_camera: Float64, lens: Lens) -> Projected:
    """Which points [P, 3] (chunk coordinates) fall into an image, and where; occlusion is not considered."""
    inverse = np.linalg.inv(chunk_SE3_camera).astype(np.float32)
    depth = points @ inverse[2, :3] + inverse[2, 3]
    index = np.flatnonzero(depth > NEAR_M)
    depth = depth[index]
    near = points[index]
    x = (near @ inverse[0, :3] + inverse[0, 3]) / depth
    y = (near @ inverse[1, :3] + inverse[1, 3]) / depth
    inside = np.ones(len(index), dtype=bool)
    if any(lens.distortion):
        inside = x * x + y * y < _MAX_DISTORTED_TAN**2
        x, y = distort(x, y, lens.distortion)
    u, v = x * np.float32(lens.fx_px) + np.float32(lens.cx_px), y * np.float32(lens.fy_px) + np.float32(lens.cy_px)
    inside &= (u >= 0) & (u < lens.width_px) & (v >= 0) & (v < lens.height_px)
    return Projected(index[inside], np.stack([u[inside], v[inside]], 1), depth[inside])


def distort(x: Float32, y: Float32, coefficients: tuple[float, ...]) -> tuple[Float32, Float32]:
    """Brown–Conrady (k1, k2, p1, p2, k3) on normalised image coordinates."""
    k1, k2, p1, p2, k3 = (np.float32(c) for c in (*coefficients, 0.0, 0.0, 0.0, 0.0, 0.0)[:5])
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


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
