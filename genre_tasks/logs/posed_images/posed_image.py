"""An image with its pose and lens, as a file of poses states them, and the checks that all such files share."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.logs.types import Float64, Lens

MAX_IMAGES = 200_000
"""A file with more images is taken for damaged."""

_MAX_SIDE_PX = 65_535
_ROTATION_TOLERANCE = 1e-3


@dataclass(frozen=True)
class PosedImage:
    """One image of a file of poses.

    Attributes:
        name: path of the image as the file writes it, with ``/``.
        source_SE3_camera: [4, 4] float64; camera x right, y down, z forward; in the file's own axes and unit of length.
        lens: of the image at the size that the file states.
        camera: label of the camera; ``None`` where the file has none.
        time_s: when it was taken, in seconds; ``None`` where the file does not say.
    """

    name: str
    source_SE3_camera: Float64
    lens: Lens
    camera: str | None = None
    time_s: float | None = None


def make_pose(matrix: Float64, name: str, file: Path) -> Float64:
    """Checks a pose, and makes its rotation exactly orthonormal.

    Args:
        matrix: [4, 4]; the last row does not count.
        name: of the image.
        file: that the pose is from.

    Returns:
        [4, 4] float64 rigid.

    Raises:
        InputError: it is not finite, mirrored, sheared or scaled.

    >>> make_pose(np.eye(4), "0001.png", Path("transforms.json")).tolist() == np.eye(4).tolist()
    True
    """
    remedy = "Export the poses again: rotations must be orthonormal."
    if not np.isfinite(matrix[:3]).all():
        raise InputError(f"the pose of {name} is not finite", remedy=remedy, file=file)
    rotation = matrix[:3, :3]
    is_rotation = np.allclose(rotation.T @ rotation, np.eye(3), atol=_ROTATION_TOLERANCE)
    if not is_rotation or np.linalg.det(rotation) < 0:
        raise InputError(f"the pose of {name} is mirrored, sheared or scaled", remedy=remedy, file=file)
    # Files round to a few digits; later products of poses rely on exact rotations.
    left, _, right = np.linalg.svd(rotation)
    pose = np.eye(4)
    pose[:3, :3] = left @ right
    pose[:3, 3] = matrix[:3, 3]
    return pose


def make_lens(
    focal_px: tuple[float, float],
    center_px: tuple[float, float],
    size_px: tuple[int, int],
    distortion: tuple[float, ...],
    file: Path,
) -> Lens:
    """Makes a lens of what a file states.

    Args:
        focal_px: horizontal and vertical.
        center_px: the principal point.
        size_px: width and height.
        distortion: k1, k2, p1, p2, k3, or fewer.
        file: that it is from.

    Returns:
        The lens, with five coefficients or none.

    Raises:
        InputError: a number is not finite or cannot be that of a lens.
    """
    numbers = (*focal_px, *center_px, *distortion)
    width, height = size_px
    is_sound = all(math.isfinite(number) for number in numbers) and min(focal_px) > 0
    is_sound = is_sound and 0 < width <= _MAX_SIDE_PX and 0 < height <= _MAX_SIDE_PX
    if not is_sound or not (0 < center_px[0] < width and 0 < center_px[1] < height):
        raise InputError(
            f"intrinsics {[round(number, 3) for number in numbers]} of {width}×{height} pixels are no lens's",
            remedy="Correct the intrinsics.",
            file=file,
        )
    coefficients = (*distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5] if any(distortion) else ()
    return Lens(*focal_px, *center_px, width_px=width, height_px=height, distortion=coefficients)
