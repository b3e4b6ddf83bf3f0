"""The PandaSet layout on disk: names, axes and numbers, as the reader and the writer share them.

Checked by overlay on a real sequence: images are undistorted; ``poses.json`` is sensor → world; LiDAR and box axes are
x right, y forward, z up (ours: x forward, y left, z up); principal points count from the centre of the first pixel
(ours: from its corner). The LiDAR pose's origin lies near the ground, about 1.8 m below the front camera.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.logs.types import Float64

RIG_ORDER = ("front_camera", "front_left_camera", "front_right_camera", "left_camera", "right_camera", "back_camera")
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
SPINNING_SENSOR = 0  # column d, and cuboids.sensor_id: the 64-beam Pandar64; 1 is the forward PandarGT
READOUT_S = 0.03  # rolling shutter of PandaSet's cameras, top to bottom row
PIXEL_CENTRE = 0.5
INTENSITY_SCALE = 255.0
BOX_HEADING = ("heading.w", "heading.x", "heading.y", "heading.z")
"""Extra cuboid columns of this project's writer, for boxes on a slope; PandaSet's own files have the yaw alone."""

# Takes coordinates in our axes (x forward, y left, z up) to PandaSet's (x right, y forward, z up).
PANDA_R_OURS = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def frame_stem(frame: int) -> str:
    """``00``, ``01``, … ``99``, ``100``."""
    return f"{frame:02d}"


def seconds(timestamps: Float64) -> Float64:
    """Unix times given in s, ms, µs or ns, as seconds in float64; the unit is told by the magnitude.

    1e11 s would be the year 5138, and 1e11 ms is 1973: no log's clock is in doubt. Relative times (small) are seconds.
    """
    times = np.asarray(timestamps, dtype=np.float64)
    finite = np.abs(times[np.isfinite(times)])
    largest = float(finite.max()) if finite.size else 0.0
    for limit, per_second in ((1e17, 1e9), (1e14, 1e6), (1e11, 1e3)):
        if largest > limit:
            return times / per_second
    return times


def read_json(path: Path, log: str) -> Any:
    """The JSON value of a file. Raises ``InputError`` naming it if it is missing or malformed."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InputError(
            "the sequence lacks a file", remedy="Copy the whole sequence folder again.", file=path, log=log
        ) from error
    except (OSError, ValueError) as error:
        raise InputError(
            f"the file is no readable JSON ({error})", remedy="Copy it again.", file=path, log=log
        ) from error


def pose_matrix(pose: Any, *, file: Path, log: str, frame: int, camera: str | None = None) -> Float64:
    """[4, 4] world_SE3_sensor of one entry of a ``poses.json``; the quaternion (w, x, y, z) is normalised.

    Raises:
        InputError: keys are missing, a value is not finite, or the quaternion is zero.
    """
    try:
        position = np.array([float(pose["position"][k]) for k in "xyz"])
        quaternion = np.array([float(pose["heading"][k]) for k in "wxyz"])
    except (KeyError, TypeError, ValueError) as error:
        problem = f"the pose lacks position x, y, z or heading w, x, y, z ({error!r})"
        raise InputError(problem, remedy=_POSE_REMEDY, file=file, log=log, frame=frame, camera=camera) from error
    norm = float(np.linalg.norm(quaternion))
    if not (np.isfinite(position).all() and np.isfinite(norm)) or norm < 1e-6:
        problem = "the pose is not finite, or its quaternion is zero"
        raise InputError(problem, remedy=_POSE_REMEDY, file=file, log=log, frame=frame, camera=camera)
    matrix = np.eye(4)
    matrix[:3, :3] = rotations(quaternion[None])[0]
    matrix[:3, 3] = position
    return matrix


def rotations(quaternions: Float64) -> Float64:
    """[N, 3, 3] from quaternions [N, 4] (w, x, y, z) of any non-zero length."""
    w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrices: Float64 = np.moveaxis(np.array(rows), 2, 0)
    return matrices


_POSE_REMEDY = "Correct the pose in that file, or leave its chunk out with --chunks."


def pose_entry(world_SE3_sensor: Float64) -> dict[str, dict[str, float]]:
    """The entry of a ``poses.json`` for a [4, 4] pose."""
    heading = quaternions(world_SE3_sensor[None, :3, :3])[0]
    position = world_SE3_sensor[:3, 3]
    return {
        "position": {axis: float(value) for axis, value in zip("xyz", position, strict=True)},
        "heading": {axis: float(value) for axis, value in zip("wxyz", heading, strict=True)},
    }


def quaternions(rotation: Float64) -> Float64:
    """[N, 4] unit quaternions (w, x, y, z) of rotations [N, 3, 3]."""
    from scipy.spatial.transform import Rotation

    turned: Float64 = Rotation.from_matrix(rotation).as_quat()[:, [3, 0, 1, 2]]
    return turned


def to_our_axes(world_SE3_panda: Float64) -> Float64:
    """The same pose, its own axes turned from PandaSet's to x forward, y left, z up."""
    turned = world_SE3_panda.copy()
    turned[:3, :3] = world_SE3_panda[:3, :3] @ PANDA_R_OURS
    return turned


def to_panda_axes(world_SE3_ours: Float64) -> Float64:
    """The inverse of ``to_our_axes``."""
    turned = world_SE3_ours.copy()
    turned[:3, :3] = world_SE3_ours[:3, :3] @ PANDA_R_OURS.T
    return turned
