"""What of a distorted lens is valid, and where its projection is linearised."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from genre_tasks.render.constants import JACOBIAN_MARGIN
from genre_tasks.render.types import Cameras
from genre_tasks.scene.lens_distortion import fold_radius, undistort

_BORDER_POINTS = 33
"""A side of the image: its undistorted extremes are at corners or, where a side bulges, near its middle."""


@dataclass(frozen=True)
class Domain:
    """Undistorted image coordinates x/z and y/z of a lens.

    Rays beyond ``fold_radius`` would come back into the image. The projection is linearised no farther out than
    −``left`` … ``right`` and −``top`` … ``bottom``: the whole image, and ``JACOBIAN_MARGIN`` on each side.
    """

    fold_radius: float
    left: float
    right: float
    top: float
    bottom: float


def domain_of(cameras: Cameras, v: int) -> Domain | None:
    """Of view v; ``None`` for a lens that does not distort."""
    if cameras.distortion is None:
        return None
    coefficients = tuple(cameras.distortion[v].tolist())
    if not any(coefficients):
        return None
    lens = (*cameras.focal_px[v].tolist(), *cameras.center_px[v].tolist())
    return _domain(coefficients, lens, cameras.width_px, cameras.height_px)


@lru_cache(maxsize=4096)
def _domain(coefficients: tuple[float, ...], lens: tuple[float, ...], width: int, height: int) -> Domain:
    fx, fy, cx, cy = lens
    along = np.linspace(0.0, 1.0, _BORDER_POINTS)
    zero, one = np.zeros_like(along), np.ones_like(along)
    px = width * np.concatenate([along, along, zero, one])
    py = height * np.concatenate([zero, one, along, along])
    x, y = undistort((px - cx) / fx, (py - cy) / fy, coefficients)
    mx, my = JACOBIAN_MARGIN * width / (2 * fx), JACOBIAN_MARGIN * height / (2 * fy)
    limits = mx - x.min(), mx + x.max(), my - y.min(), my + y.max()
    return Domain(fold_radius(coefficients), *(float(limit) for limit in limits))
