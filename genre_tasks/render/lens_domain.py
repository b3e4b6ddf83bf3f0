"""Which rays of a distorted lens are valid, and where its projection is linearised."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from genre_tasks.render.constants import JACOBIAN_MARGIN
from genre_tasks.render.types import Cameras
from genre_tasks.scene.lens_distortion import fold_radius, undistort

# A side of the image: its undistorted extremes are at corners or, where a side bulges, near its middle.
_BORDER_POINTS = 33


@dataclass(frozen=True)
class ValidDomain:
    """Limits of a lens in undistorted image coordinates x/z and y/z.

    The projection is linearised no farther out than −``left`` … ``right`` and −``top`` … ``bottom``: the whole image,
    and ``JACOBIAN_MARGIN`` on each side.

    Attributes:
        fold_radius: rays beyond it would come back into the image.
        left: limit towards −x, counted positive.
        right: limit towards x.
        top: limit towards −y, counted positive.
        bottom: limit towards y.
    """

    fold_radius: float
    left: float
    right: float
    top: float
    bottom: float


def find_valid_domain(cameras: Cameras, v: int) -> ValidDomain | None:
    """Finds the limits of a view's lens.

    Args:
        cameras: V of them.
        v: which view.

    Returns:
        ``None`` for a lens that does not distort.
    """
    if cameras.distortion is None:
        return None
    # Python floats are hashable, so that the result can be cached.
    coefficients = tuple(cameras.distortion[v].tolist())
    if not any(coefficients):
        return None
    intrinsics = (*cameras.focal_px[v].tolist(), *cameras.center_px[v].tolist())
    return _compute_domain(coefficients, intrinsics, cameras.width_px, cameras.height_px)


# A rig has a few lenses and is rendered a thousand times; undistorting the border takes longer than a small render.
@lru_cache(maxsize=4096)
def _compute_domain(
    coefficients: tuple[float, ...], intrinsics: tuple[float, ...], width: int, height: int
) -> ValidDomain:
    fx, fy, cx, cy = intrinsics
    # The border decides: inside of the fold radius a lens maps the image's inside into that of its border.
    along = np.linspace(0.0, 1.0, _BORDER_POINTS)
    zero = np.zeros_like(along)
    one = np.ones_like(along)
    px = width * np.concatenate([along, along, zero, one])
    py = height * np.concatenate([zero, one, along, along])
    x, y = undistort((px - cx) / fx, (py - cy) / fy, coefficients)
    margin_x = JACOBIAN_MARGIN * width / (2 * fx)
    margin_y = JACOBIAN_MARGIN * height / (2 * fy)
    return ValidDomain(
        fold_radius=fold_radius(coefficients),
        left=float(margin_x - x.min()),
        right=float(margin_x + x.max()),
        top=float(margin_y - y.min()),
        bottom=float(margin_y + y.max()),
    )
