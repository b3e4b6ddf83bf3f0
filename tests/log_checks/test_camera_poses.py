"""Cameras that are not fixed to the vehicle, and those that are."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from genre_tasks.logs.types import Float64
from tests.fakes import FakeLog, yaw_pose
from tests.log_checks.edited_log import EditedLog, assess, is_complete, street

NO_BOXES = {"without_tracks": True, "no_lidar": True}
# A vehicle that brakes: the same delay of a camera is not the same distance in all frames.
DISTANCES_M = np.array([0.0, 1.5, 2.9, 4.2, 5.4, 6.5, 7.5, 8.4])


def with_camera(log: FakeLog, change: Callable[[int, Float64], Float64]) -> EditedLog:
    return EditedLog(log, world_SE3_camera=lambda camera, frame: change(frame, log.world_SE3_camera(camera, frame)))


def own_axes(rotation: Float64) -> Callable[[int, Float64], Float64]:
    turn = np.eye(4)
    turn[:3, :3] = rotation
    return lambda k, pose: pose @ turn


def tilt(degrees: float) -> Float64:
    """[3, 3] about the camera's x axis."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


@pytest.mark.parametrize("degrees", [-60.0, -20.0, 0.0, 20.0, 60.0])
def test_cameras_may_be_pitched(degrees: float) -> None:
    assert assess(with_camera(street(**NO_BOXES), own_axes(tilt(degrees)))) == {}


@pytest.mark.parametrize(
    ("rotation", "reason"),
    [
        (np.diag([1.0, -1.0, -1.0]), "OpenGL"),
        (np.diag([-1.0, -1.0, 1.0]), "upside down"),
        (tilt(90.0), "looks at the sky"),
        (tilt(-90.0), "looks at the ground"),
        (np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), "lies on its side"),
        (np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), "looks at the sky"),
    ],
)
def test_cameras_with_other_axes(rotation: Float64, reason: str) -> None:
    """Report: krrish94/nerf-pytorch#24, LightwheelAI/street-gaussians-ns#46 (OpenGL's axes or OpenCV's)."""
    found = assess(with_camera(street(**NO_BOXES), own_axes(rotation)))
    assert set(found) == {"odd_camera_orientation"} and reason in found["odd_camera_orientation"].message
    assert is_complete(found["odd_camera_orientation"])


def test_a_mirrored_camera_is_fatal() -> None:
    """Report: autonomousvision/transfuser#112 (left and right are swapped)."""
    found = assess(with_camera(street(**NO_BOXES), own_axes(np.diag([-1.0, 1.0, 1.0]))))
    assert found["improper_rotation"].severity == "fatal"


@pytest.mark.parametrize(("shift_m", "fires"), [(1.0, False), (8.0, False), (15.0, True), (5000.0, True)])
def test_cameras_far_from_the_lidar(shift_m: float, fires: bool) -> None:
    """Report: lyft/nuscenes-devkit#73 (LiDAR and cameras refer to different poses of the vehicle)."""

    def change(frame: int, pose: Float64) -> Float64:
        out = pose.copy()
        out[1, 3] += shift_m
        return out

    found = assess(with_camera(street(**NO_BOXES), change))
    assert set(found) == ({"far_camera"} if fires else set()) and all(is_complete(f) for f in found.values())


def test_cameras_whose_poses_are_those_of_the_rig() -> None:
    """Camera to vehicle where camera to world was expected. Report: krrish94/nerf-pytorch#24 asks which it is."""
    log = street(**NO_BOXES)
    found = assess(with_camera(log, lambda frame, pose: log.world_SE3_camera("front", 0)))
    assert set(found) == {"loose_camera"} and is_complete(found["loose_camera"])


@pytest.mark.parametrize(("shift_m", "fires"), [(0.1, False), (0.2, False), (0.5, True), (3.0, True)])
def test_one_pose_of_a_camera_that_jumps(shift_m: float, fires: bool) -> None:
    """Report: tudelft-iv/view-of-delft-dataset#7."""

    def change(frame: int, pose: Float64) -> Float64:
        out = pose.copy()
        out[2, 3] += shift_m * (frame == 4)
        return out

    found = assess(with_camera(street(**NO_BOXES), change))
    assert set(found) == ({"loose_camera"} if fires else set())
    assert all(finding.frames == (4,) for finding in found.values())


@pytest.mark.parametrize(("degrees", "fires"), [(1.0, False), (10.0, True)])
def test_one_pose_of_a_camera_that_turns(degrees: float, fires: bool) -> None:
    """Report: tudelft-iv/view-of-delft-dataset#7."""
    turn = yaw_pose(np.deg2rad(degrees), (0.0, 0.0, 0.0))
    found = assess(with_camera(street(**NO_BOXES), lambda k, pose: pose @ turn if k == 4 else pose))
    assert set(found) == ({"loose_camera"} if fires else set())


def braking(delay_s: float, *, poses_at_sweeps: bool) -> EditedLog:
    """A braking vehicle whose cameras fire ``delay_s`` after the sweep."""
    log = street(**NO_BOXES)
    times = 0.1 * np.arange(8)

    def lidar(distance: float) -> Float64:
        return yaw_pose(0.0, (float(distance), 0.0, 1.8))

    def world_SE3_camera(camera: str, frame: int) -> Float64:
        mount = np.linalg.inv(log.world_SE3_lidar(frame)) @ log.world_SE3_camera(camera, frame)
        when = times[frame] + (0.0 if poses_at_sweeps else delay_s)
        # On the line between frames, and beyond the last one.
        k = min(int(when / 0.1 + 1e-9), 6)
        part = (when - times[k]) / 0.1
        return lidar(DISTANCES_M[k] + part * (DISTANCES_M[k + 1] - DISTANCES_M[k])) @ mount

    return EditedLog(
        log,
        world_SE3_lidar=lambda frame: lidar(DISTANCES_M[frame]),
        world_SE3_camera=world_SE3_camera,
        camera_timestamp_s=lambda camera, frame: times[frame] + delay_s,
    )


@pytest.mark.parametrize("delay_s", [0.0, 0.02, 0.09])
def test_cameras_that_fire_later_and_say_where_they_were(delay_s: float) -> None:
    assert assess(braking(delay_s, poses_at_sweeps=False)) == {}


@pytest.mark.parametrize(("delay_s", "fires"), [(0.0, False), (0.02, False), (0.149, True)])
def test_cameras_with_the_pose_of_another_time(delay_s: float, fires: bool) -> None:
    """Report: utiasASRL/pyboreas#92 (poses and images 30 ms apart); lyft/nuscenes-devkit#73."""
    found = assess(braking(delay_s, poses_at_sweeps=True))
    assert set(found) <= {"camera_pose_time"} and (set(found) != set()) == fires
    assert all(is_complete(finding) for finding in found.values())


def test_images_without_pose_or_time_are_passed_over() -> None:
    nowhere = np.full((4, 4), np.nan)
    assert assess(with_camera(street(**NO_BOXES), lambda k, pose: nowhere if k < 3 else pose)) == {}
    assert assess(with_camera(street(**NO_BOXES), lambda k, pose: nowhere)) == {}
