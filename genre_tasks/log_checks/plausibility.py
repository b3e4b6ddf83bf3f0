"""Whether what a log says can be true: measured from the log itself, chunk by chunk, before a scene is fitted to it."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from genre_tasks.log_checks.box_points import find_boxes_without_points
from genre_tasks.log_checks.box_times import find_boxes_of_another_frame
from genre_tasks.log_checks.boxes import find_implausible_boxes
from genre_tasks.log_checks.calibration import find_miscalibration
from genre_tasks.log_checks.camera_poses import find_implausible_camera_poses
from genre_tasks.log_checks.clocks import find_clock_faults
from genre_tasks.log_checks.lenses import find_implausible_lenses
from genre_tasks.log_checks.lidar_frame import find_misplaced_lidar
from genre_tasks.log_checks.log_sample import LogSample
from genre_tasks.log_checks.motion import find_implausible_motion
from genre_tasks.log_checks.pose_axes import find_misread_poses
from genre_tasks.log_checks.sweep_overlap import find_inconsistent_sweeps
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.types import Camera, DrivingLog

# In the order in which a person would look for the cause: a wrong unit explains most of what comes after it.
_CHECKS: tuple[Callable[[LogSample], Iterable[Finding]], ...] = (
    find_implausible_lenses,
    find_clock_faults,
    find_implausible_motion,
    find_misread_poses,
    find_implausible_camera_poses,
    find_misplaced_lidar,
    find_inconsistent_sweeps,
    find_implausible_boxes,
    find_boxes_without_points,
    find_boxes_of_another_frame,
    find_miscalibration,
)


def assess_plausibility(log: DrivingLog, frames: tuple[int, ...], cameras: tuple[Camera, ...]) -> tuple[Finding, ...]:
    """Measures whether poses, times, lenses, boxes, LiDAR and images of a chunk can belong together.

    ``genre check`` and the stage ``ingest`` both call this, so that they judge alike.

    Args:
        log: the log.
        frames: frames of one chunk, increasing.
        cameras: the cameras that are used.

    Returns:
        What is implausible; nothing for a sound log. What cannot be read is passed over: others report it.

    >>> from genre_tasks.logs.registry import open_log
    >>> log = open_log("synthetic:street?seed=7&frames=3")
    >>> assess_plausibility(log, (0, 1, 2), log.cameras)
    ()
    """
    sample = LogSample(log, frames, cameras)
    # What overflows becomes infinite or NaN, which the checks compare as they compare gaps.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        return tuple(finding for check in _CHECKS for finding in check(sample))
