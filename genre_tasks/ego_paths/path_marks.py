"""Where a path is relative to the recorded one, and whether the scene can be trusted there."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.reference_path import drives_backwards, fit_reference_path
from genre_tasks.logs.types import Float64

_TOLERANCE_M = 0.25
"""The smooth reference ends a few centimetres away from the recorded poses, which are not outside of themselves."""


@dataclass(frozen=True)
class PathMarks:
    """Marks of P poses.

    Attributes:
        lateral_m: [P] to the left of the recorded path, as the vehicle faces, even where it reverses.
        ahead_m: [P] along the recorded path, ahead of where the recorded vehicle is at that moment of the log.
        reliable: [P] the lateral distance is within the reliable range.
        outside_recording: [P] before the first or past the last recorded pose.
    """

    lateral_m: Float64
    ahead_m: Float64
    reliable: NDArray[np.bool_]
    outside_recording: NDArray[np.bool_]


def mark_path(path: EgoPath, recorded: EgoPath, left_m: float, right_m: float) -> PathMarks:
    """Marks where a path leaves the range in which the scene can be trusted.

    Args:
        path: any path.
        recorded: one pose for each log frame.
        left_m: reliable range to the left of the recorded path.
        right_m: to the right.

    Returns:
        A mark for each pose.

    Raises:
        InputError: a recorded path without frames.
    """
    reverses = drives_backwards(recorded)
    reference = fit_reference_path(_face_backwards(recorded) if reverses else recorded)
    times = np.interp(path.frames, recorded.frames, recorded.times_s - recorded.times_s[0])
    recorded_m = reference.locate(times)
    arc, left = reference.project(path.world_SE3_ego[:, :2, 3], recorded_m)
    # Left of the driven direction is right of a vehicle that reverses.
    lateral = -left if reverses else left
    return PathMarks(
        lateral_m=lateral,
        ahead_m=arc - recorded_m,
        reliable=(lateral <= left_m) & (lateral >= -right_m),
        outside_recording=(arc < -_TOLERANCE_M) | (arc > reference.length_m + _TOLERANCE_M),
    )


def _face_backwards(path: EgoPath) -> EgoPath:
    """The path of a vehicle that reverses, with poses that face where it drives."""
    poses = path.world_SE3_ego.copy()
    poses[:, :3, :2] *= -1
    return replace(path, world_SE3_ego=poses)
