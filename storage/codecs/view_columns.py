"""Columns that several tables share: which image a row is about, its lens and its pose."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from genre_tasks.logs.types import Float64, Lens
from storage.codecs.tables import POSE, column, poses_from_rows, poses_to_column

FRAME = column("frame", pa.int64(), "frame of the log")
CAMERA_AND_FRAME = (column("camera", pa.string(), "name"), FRAME)
SHIFT = column("shift_m", pa.float64(), "metres, left is positive")
LENS_AND_POSE = (
    column("chunk_SE3_camera", POSE, "camera coordinates to chunk coordinates, 4 x 4 row by row, metres"),
    column("fx_px", pa.float64(), "pixels"),
    column("fy_px", pa.float64(), "pixels"),
    column("cx_px", pa.float64(), "pixels; the first pixel's centre is 0.5"),
    column("cy_px", pa.float64(), "pixels; the first pixel's centre is 0.5"),
    column("lens_width_px", pa.int64(), "pixels"),
    column("lens_height_px", pa.int64(), "pixels"),
    column("distortion", pa.list_(pa.float64()), "k1 k2 p1 p2 k3, or empty"),
)


def lens_columns(poses: Sequence[Float64], lenses: Sequence[Lens]) -> dict[str, Any]:
    """Packs the lenses and poses of views into the columns :data:`LENS_AND_POSE`.

    Args:
        poses: ``chunk_SE3_camera`` [4, 4] of each of V views.
        lenses: the lens of each view.

    Returns:
        Column name → V values.

    Raises:
        ConfigError: a pose has another dtype or shape.
        NonFiniteError: a pose holds NaN or infinity.
    """
    # A table without rows is legal, but NumPy does not stack nothing.
    stack = np.stack(poses) if len(poses) else np.zeros((0, 4, 4))
    return {
        "chunk_SE3_camera": poses_to_column(stack, "chunk_SE3_camera"),
        "fx_px": [lens.fx_px for lens in lenses],
        "fy_px": [lens.fy_px for lens in lenses],
        "cx_px": [lens.cx_px for lens in lenses],
        "cy_px": [lens.cy_px for lens in lenses],
        "lens_width_px": [lens.width_px for lens in lenses],
        "lens_height_px": [lens.height_px for lens in lenses],
        # A list and not five columns: an empty one says that the lens does not distort.
        "distortion": [list(lens.distortion) for lens in lenses],
    }


def pose_and_lens(row: dict[str, Any]) -> tuple[Float64, Lens]:
    """Unpacks the pose and the lens of one row.

    Args:
        row: the columns :data:`LENS_AND_POSE` of one view, and any others.

    Returns:
        (``chunk_SE3_camera`` [4, 4], lens).
    """
    lens = Lens(
        row["fx_px"],
        row["fy_px"],
        row["cx_px"],
        row["cy_px"],
        row["lens_width_px"],
        row["lens_height_px"],
        tuple(row["distortion"]),
    )
    return poses_from_rows(row["chunk_SE3_camera"])[0], lens


def image_columns(images: Sequence[tuple[str, int]]) -> dict[str, Any]:
    """Packs the names of images into the columns :data:`CAMERA_AND_FRAME`.

    Args:
        images: (camera, frame of the log) of each image.

    Returns:
        Column name → a value for each image.

    >>> image_columns([("front_camera", 3), ("back_camera", 4)])
    {'camera': ['front_camera', 'back_camera'], 'frame': [3, 4]}
    """
    return {"camera": [camera for camera, _ in images], "frame": [frame for _, frame in images]}
