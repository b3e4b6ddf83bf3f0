"""Columns that several tables share: a view's lens and its pose."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from genre_tasks.logs.types import Float64, Lens
from storage.codecs.tables import POSE, column, pose_rows, poses_of

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
    """The shared columns of V views."""
    stack = np.stack(poses) if len(poses) else np.zeros((0, 4, 4))
    return {
        "chunk_SE3_camera": pose_rows(stack, "chunk_SE3_camera"),
        "fx_px": [lens.fx_px for lens in lenses],
        "fy_px": [lens.fy_px for lens in lenses],
        "cx_px": [lens.cx_px for lens in lenses],
        "cy_px": [lens.cy_px for lens in lenses],
        "lens_width_px": [lens.width_px for lens in lenses],
        "lens_height_px": [lens.height_px for lens in lenses],
        "distortion": [list(lens.distortion) for lens in lenses],
    }


def pose_and_lens(row: dict[str, Any]) -> tuple[Float64, Lens]:
    """The inverse, for one row."""
    lens = Lens(
        row["fx_px"],
        row["fy_px"],
        row["cx_px"],
        row["cy_px"],
        row["lens_width_px"],
        row["lens_height_px"],
        tuple(row["distortion"]),
    )
    return poses_of(row["chunk_SE3_camera"])[0], lens
