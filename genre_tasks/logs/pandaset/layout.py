"""The PandaSet layout on disk: names, axes, units and numbers, as the reader and the writer share them.

Where PandaSet differs from this project (see ``genre_tasks.logs.types``), checked by overlay on a real sequence:

* ``poses.json`` holds world_SE3_sensor; quaternions are w, x, y, z in both.
* LiDAR and box axes are x right, y forward, z up; here they are x forward, y left, z up ("FLU").
* Principal points count from the centre of the first pixel; here from its corner, half a pixel further up and left.
* Images are undistorted.
* The origin of the LiDAR pose lies near the ground, about 1.8 m below the front camera.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.logs.file_reading import describe_value, read_number
from genre_tasks.logs.types import Float64

RIG_ORDER = ("front_camera", "front_left_camera", "front_right_camera", "left_camera", "right_camera", "back_camera")
# Of two images of a frame, the one whose suffix comes first is read. Capitals count as small letters.
IMAGE_SUFFIXES = (
    *(".jpg", ".jpeg", ".png", ".jpe", ".jfif", ".webp", ".tif", ".tiff", ".bmp", ".dib"),
    *(".ppm", ".pgm", ".pnm", ".jp2", ".j2k", ".avif", ".gif"),
)
# What pandas writes, in the same order; gzip is PandaSet's.
TABLE_SUFFIXES = tuple(
    f".{name}{packed}" for packed in (".gz", "", ".bz2", ".xz", ".zip", ".gzip") for name in ("pkl", "pickle")
)
# Column d, and cuboids.sensor_id: the 64-beam Pandar64; 1 is the forward PandarGT.
SPINNING_SENSOR = 0
# Rolling shutter of PandaSet's cameras, top to bottom row, which its files do not state.
_READOUT_S = 0.03
_NATIVE_SIZE_PX = (1920, 1080)
# PandaSet's principal points count from the centre of the first pixel, which lies here.
PIXEL_CENTRE = 0.5
# Intensities are 0 to 255 in the files.
INTENSITY_SCALE = 255.0
# Extra cuboid columns of this project's writer, for boxes on a slope; PandaSet's own files have the yaw alone.
BOX_HEADING = ("heading.w", "heading.x", "heading.y", "heading.z")

# [3, 3] takes coordinates in x forward, y left, z up to PandaSet's x right, y forward, z up.
PANDA_R_FLU = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])

_POSE_FORM = "position x, y, z or heading w, x, y, z"
_POSE_REMEDY = "Correct the pose in that file, or leave its chunk out with --chunks."
# The Earth is 4e7 m around, and 4e10 mm; what overflows later on is no position.
_MAX_POSITION_M = 1e12
# Below that, rounding alone would decide where the sensor points.
_MIN_QUATERNION_NORM = 1e-6


def assume_readout(name: str, width_px: int, height_px: int) -> float:
    """Assumes the rolling shutter of a camera whose file states none.

    Args:
        name: of the camera.
        width_px: of its images.
        height_px: of its images.

    Returns:
        Seconds from the first row to the last: those of PandaSet's cameras, at their names and image size. Others
        that are written in this layout have 0, a global shutter.

    >>> assume_readout("front_camera", 1920, 1080), assume_readout("front_camera", 1280, 720)
    (0.03, 0.0)
    """
    return _READOUT_S if name in RIG_ORDER and (width_px, height_px) == _NATIVE_SIZE_PX else 0.0


def frame_stem(frame: int) -> str:
    """Names the files of a frame.

    Args:
        frame: log frame.

    Returns:
        The file name without its suffix.

    >>> frame_stem(3), frame_stem(100)
    ('03', '100')
    """
    # PandaSet has 80 frames; a longer log of this writer goes on with three digits.
    return f"{frame:02d}"


def parse_pose(pose: Any, *, file: Path, log: str, frame: int, camera: str | None = None) -> Float64:
    """Converts one entry of a ``poses.json`` to a matrix.

    Args:
        pose: the entry: position x, y, z in metres and heading w, x, y, z, a quaternion of any non-zero length.
        file: the file, for the error.
        log: URI of the log, for the error.
        frame: log frame, for the error.
        camera: name of the camera, for the error; ``None`` for the LiDAR.

    Returns:
        [4, 4] world_SE3_sensor.

    Raises:
        InputError: keys are missing, a value is not finite or beyond the Earth, or the quaternion is zero.
    """
    where: dict[str, Any] = {"file": file, "log": log, "frame": frame, "camera": camera}
    try:
        position = np.array([read_number(pose["position"][axis]) for axis in "xyz"])
        quat = np.array([read_number(pose["heading"][axis]) for axis in "wxyz"])
    except (KeyError, TypeError, ValueError) as error:
        problem = f"the pose lacks {_POSE_FORM}; found {_describe_pose(pose)}"
        raise InputError(problem, remedy=_POSE_REMEDY, **where) from error
    # Normalised later on: files round to a few digits.
    norm = float(np.linalg.norm(quat))
    if not (np.abs(position).max() < _MAX_POSITION_M and np.isfinite(norm)) or norm < _MIN_QUATERNION_NORM:
        problem = "the pose is not finite, or its quaternion is zero"
        raise InputError(problem, remedy=_POSE_REMEDY, **where)
    matrix = np.eye(4)
    matrix[:3, :3] = quats_to_matrices(quat[None])[0]
    matrix[:3, 3] = position
    return matrix


def _describe_pose(pose: object) -> str:
    """What is there in place of a pose: its keys, or the part of it that is none."""
    if not isinstance(pose, dict):
        return describe_value(pose)
    parts = {name: pose.get(name) for name in ("position", "heading")}
    if any(name not in pose for name in parts):
        return f"the keys {', '.join(map(str, pose)) or 'none'}"
    return ", ".join(f"{name} {_describe_part(part)}" for name, part in parts.items())


def _describe_part(part: object) -> str:
    if not isinstance(part, dict):
        return describe_value(part)
    return "with " + ", ".join(f"{key} = {describe_value(value)}" for key, value in part.items())


def format_pose(world_SE3_sensor: Float64) -> dict[str, dict[str, float]]:
    """Converts a pose to an entry of a ``poses.json``; the inverse of ``parse_pose``.

    Args:
        world_SE3_sensor: [4, 4].

    Returns:
        Position x, y, z in metres and heading w, x, y, z.

    >>> format_pose(np.eye(4))["heading"]
    {'w': 1.0, 'x': 0.0, 'y': 0.0, 'z': 0.0}
    """
    quat = matrices_to_quats(world_SE3_sensor[None, :3, :3])[0]
    position = world_SE3_sensor[:3, 3]
    return {
        "position": {axis: float(value) for axis, value in zip("xyz", position, strict=True)},
        "heading": {axis: float(value) for axis, value in zip("wxyz", quat, strict=True)},
    }


def quats_to_matrices(quats: Float64) -> Float64:
    """Converts quaternions to rotation matrices.

    Args:
        quats: [N, 4] w, x, y, z of any non-zero length.

    Returns:
        [N, 3, 3] float64.

    >>> quats_to_matrices(np.array([[2.0, 0.0, 0.0, 2.0]])).round(9)[0, :, 0]
    array([0., 1., 0.])
    """
    # Written out: SciPy rounds differently, and the poses of a log are part of every result.
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrices: Float64 = np.moveaxis(np.array(rows), 2, 0)
    return matrices


def matrices_to_quats(rotations: Float64) -> Float64:
    """Converts rotation matrices to unit quaternions.

    Args:
        rotations: [N, 3, 3].

    Returns:
        [N, 4] w, x, y, z.
    """
    # Imported late: only the writer needs SciPy.
    from scipy.spatial.transform import Rotation

    # SciPy puts the scalar part last.
    quats: Float64 = Rotation.from_matrix(rotations).as_quat()[:, [3, 0, 1, 2]]
    return quats


def to_flu_axes(world_SE3_panda: Float64) -> Float64:
    """Turns the axes of a LiDAR or box pose from PandaSet's to x forward, y left, z up; its position stays.

    Args:
        world_SE3_panda: [4, 4] pose whose axes are x right, y forward, z up.

    Returns:
        [4, 4] world_SE3_flu.

    >>> to_flu_axes(np.eye(4))[:3, 0]
    array([0., 1., 0.])
    """
    return _turn_axes(world_SE3_panda, PANDA_R_FLU)


def to_panda_axes(world_SE3_flu: Float64) -> Float64:
    """Turns the axes of a pose from x forward, y left, z up to PandaSet's; the inverse of ``to_flu_axes``.

    Args:
        world_SE3_flu: [4, 4] pose whose axes are x forward, y left, z up.

    Returns:
        [4, 4] world_SE3_panda.
    """
    return _turn_axes(world_SE3_flu, PANDA_R_FLU.T)


def _turn_axes(world_SE3_a: Float64, a_R_b: Float64) -> Float64:
    world_SE3_b = world_SE3_a.copy()
    world_SE3_b[:3, :3] = world_SE3_a[:3, :3] @ a_R_b
    return world_SE3_b
