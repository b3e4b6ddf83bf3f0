"""Which way is up in the axes of a file of poses, and where the vehicle goes: what novel views are placed by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.logs.types import Float64

STANDING_M = 0.1
"""A path that stays within this distance has no direction of its own."""

_HEADING_M = 0.5
# Files are mostly written with an axis up; what is so near to one is it, but for noise.
_SNAP_DEG = 3.0
_MIN_AGREEMENT = 0.5
_MAX_TILT_DEG = 25.0
# A path is a plane where it is broad enough to have one and flat against its breadth.
_MIN_BREADTH = 0.1
_MAX_HEIGHT = 0.1
_MIN_LENGTH = 1e-9


@dataclass(frozen=True)
class UpDirection:
    """Which way is up.

    Attributes:
        vector: [3] unit, in the axes of the file of poses.
        reason: how it was found, for the user.
    """

    vector: Float64
    reason: str


def find_up(source_SE3_cameras: Float64, centers: Float64, file: Path) -> UpDirection:
    """Finds the direction that is up, from how cameras are turned and where they go.

    The mean of the cameras' own upward axes is tilted where all cameras look down a little. The plane of a path with
    turns is not, nor is what stands at right angles to a straight one.

    Args:
        source_SE3_cameras: [N, 4, 4] poses of all images.
        centers: [F, 3] the path, in the same axes.
        file: that they are from, for errors.

    Returns:
        The direction.

    Raises:
        InputError: the cameras do not agree.

    >>> poses = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (2, 1, 1))
    >>> find_up(poses, np.zeros((2, 3)), Path("transforms.json")).vector.tolist()
    [0.0, 1.0, 0.0]
    """
    upward = -source_SE3_cameras[:, :3, 1].mean(0)
    length = float(np.linalg.norm(upward))
    if length < _MIN_AGREEMENT:
        raise InputError(
            "the cameras do not agree which way is up", remedy="Say it with --up, such as --up 0,0,1.", file=file
        )
    upward /= length
    up, reason = _refine_by_path(upward, centers)
    axis = int(np.abs(up).argmax())
    if np.degrees(np.arccos(min(1.0, abs(up[axis])))) < _SNAP_DEG:
        snapped = np.zeros(3)
        snapped[axis] = np.sign(up[axis])
        return UpDirection(snapped, f"{reason}, rounded to an axis")
    return UpDirection(up, reason)


def _refine_by_path(upward: Float64, centers: Float64) -> tuple[Float64, str]:
    """The cameras' upward axis [3], corrected by the path [F, 3] as far as that says something."""
    _, spread, axes = np.linalg.svd(centers - centers.mean(0), full_matrices=False)
    spread = np.pad(spread, (0, max(0, 3 - len(spread))))
    if len(centers) >= 3 and spread[1] > _MIN_BREADTH * spread[0] and spread[2] < _MAX_HEIGHT * spread[1]:
        normal = axes[2] * np.sign(axes[2] @ upward)
        if normal @ upward > np.cos(np.deg2rad(_MAX_TILT_DEG)):
            return normal / np.linalg.norm(normal), "the plane of the path"
    if spread[0] > _MIN_LENGTH and spread[1] <= _MIN_BREADTH * spread[0]:
        across = upward - (upward @ axes[0]) * axes[0]
        if across @ upward > np.cos(np.deg2rad(_MAX_TILT_DEG)):
            return across / np.linalg.norm(across), "the cameras' mean upward axis, at right angles to the path"
    return upward, "the cameras' mean upward axis"


def turn_up_to_z(up: Float64) -> Float64:
    """Makes the smallest rotation that takes a direction to z.

    Args:
        up: [3], not zero.

    Returns:
        [3, 3]; exact where ``up`` is an axis.

    >>> (turn_up_to_z(np.array([0.0, -1.0, 0.0])) @ [0.0, -1.0, 0.0]).tolist()
    [0.0, 0.0, 1.0]
    """
    x, y, z = up / np.linalg.norm(up)
    # Half a turn has no smallest axis: about x.
    if z < -1 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    cross = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    rotation: Float64 = np.eye(3) + cross + cross @ cross / (1 + z)
    return rotation


def place_vehicle(centers: Float64, viewing: Float64) -> Float64:
    """Places a vehicle on the path of its cameras: x along the motion, z up.

    Args:
        centers: [F, 3] metres, z up.
        viewing: [3] where the cameras look on average, which is forward where the path stands still.

    Returns:
        world_SE3_ego [F, 4, 4] float64.
    """
    flat = centers[:, :2]
    out = np.tile(np.eye(4), (len(centers), 1, 1))
    out[:, :3, 3] = centers
    extent = float(np.linalg.norm(flat - flat[0], axis=1).max())
    for index in range(len(centers)):
        forward = _find_heading(flat, index) if extent >= STANDING_M else viewing[:2]
        length = float(np.linalg.norm(forward))
        # Cameras that look straight down leave no heading; any is as good.
        x, y = forward / length if length > _MIN_LENGTH else (1.0, 0.0)
        out[index, :3, :3] = [[x, -y, 0.0], [y, x, 0.0], [0.0, 0.0, 1.0]]
    return out


def _find_heading(flat: Float64, index: int) -> Float64:
    """The motion [2] around a frame, over enough frames that noise of poses does not turn it."""
    last = len(flat) - 1
    motion = np.zeros(2)
    for reach in range(1, len(flat)):
        motion = flat[min(index + reach, last)] - flat[max(index - reach, 0)]
        if np.linalg.norm(motion) >= _HEADING_M:
            break
    return motion


def choose_reference(world_SE3_cameras: Sequence[Float64], motion: Float64) -> int:
    """Chooses the camera that looks along the motion most, which stands for the vehicle.

    Args:
        world_SE3_cameras: for each camera its poses [F, 4, 4].
        motion: [3] from the first frame to the last.

    Returns:
        Its index; the first one where nothing moves.
    """
    # Noise of poses must not choose.
    if np.linalg.norm(motion) < STANDING_M:
        return 0
    along = [float((poses[:, :3, 2] @ motion).mean()) for poses in world_SE3_cameras]
    return int(np.argmax(along))
