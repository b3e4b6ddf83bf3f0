"""Paths that no vehicle drives, in growing strength, and those that one does."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import Float64
from tests.fakes import yaw_pose
from tests.log_checks.edited_log import EditedLog, assess, is_complete, street, with_ego


def shifted(pose: Float64, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Float64:
    out = pose.copy()
    out[:3, 3] += (x, y, z)
    return out


def moved_at(frame: int, **shift: float) -> Callable[[int, Float64], Float64]:
    """A change of one pose."""
    return lambda k, pose: shifted(pose, **shift) if k == frame else pose


def turned_by(rotation: Float64) -> Callable[[int, Float64], Float64]:
    """A change of axes: every pose is turned in its own frame."""
    turn = np.eye(4)
    turn[:3, :3] = rotation
    return lambda k, pose: pose @ turn


def words(change: Callable[[int, Float64], Float64], **street_changes: object) -> set[str]:
    """What is found in a street with other poses; boxes and LiDAR, which no longer fit them, are left out."""
    log = street(cars=(), without_tracks=True, no_lidar=True, **street_changes)
    found = assess(with_ego(log, change))
    assert all(is_complete(finding) for finding in found.values())
    return set(found)


@pytest.mark.parametrize("speed", [0.0, 0.3, 3.0, 33.0, 60.0])
def test_vehicles_at_any_speed_are_plausible(speed: float) -> None:
    assert words(lambda k, pose: pose, speed_mps=speed) == set()


@pytest.mark.parametrize("speed", [75.0, 600.0])
def test_sixty_metres_a_frame(speed: float) -> None:
    """Report: none found; case 6 of the list of odd logs."""
    assert words(lambda k, pose: pose, speed_mps=speed) == {"implausible_speed"}


def test_vehicles_brake_turn_and_climb() -> None:
    """Full braking, a hairpin bend at walking pace, a kerb, a road of 20 %, and noise of 3 cm."""
    noise = np.random.default_rng(0).normal(0, 0.03, (8, 3))
    assert words(lambda k, pose: shifted(pose, x=-0.5 * 10 * (0.1 * k) ** 2)) == set()
    assert words(lambda k, pose: yaw_pose(0.1 * k, (3 * np.sin(0.1 * k), 3 - 3 * np.cos(0.1 * k), 1.8))) == set()
    assert words(lambda k, pose: shifted(pose, z=0.12 if k > 3 else 0.0)) == set()
    assert words(lambda k, pose: shifted(pose, z=0.2 * k)) == set()
    assert words(lambda k, pose: shifted(pose, *noise[k])) == set()


@pytest.mark.parametrize(("jump", "fires"), [(0.1, False), (0.2, False), (0.5, True), (5.0, True)])
@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_a_frame_that_jumps(axis: str, jump: float, fires: bool) -> None:
    """Report: tudelft-iv/view-of-delft-dataset#7 (the localisation failed for single frames)."""
    assert ("position_jump" in words(moved_at(4, **{axis: jump}))) == fires


def test_a_jump_is_located() -> None:
    """Report: aevainc/aevascenes#9 (the height of the poses drifts)."""
    found = assess(with_ego(street(without_tracks=True, no_lidar=True), moved_at(5, z=2.0)))
    assert "frame 5 is 2.00 m off its neighbours" in found["position_jump"].message
    assert 5 in found["position_jump"].frames and found["position_jump"].numbers["jump_m"] == pytest.approx(2.0)


def test_a_path_that_is_another_from_some_frame_on() -> None:
    assert "position_jump" in words(lambda k, pose: shifted(pose, y=3.0 if k >= 4 else 0.0))


@pytest.mark.parametrize(("degrees", "fires"), [(1.0, False), (2.0, False), (20.0, True), (90.0, True), (180.0, True)])
def test_a_heading_that_jumps(degrees: float, fires: bool) -> None:
    """Report: tudelft-iv/view-of-delft-dataset#7 (a large change of yaw while the images go straight on)."""
    turn = yaw_pose(np.deg2rad(degrees), (0.0, 0.0, 0.0))
    found = words(lambda k, pose: pose @ turn if k == 3 else pose)
    assert ("rotation_jump" in found) == fires


@pytest.mark.parametrize(
    ("yaw", "axis"), [(90.0, "minus left"), (-90.0, "left"), (180.0, "minus forward"), (60.0, "minus left")]
)
def test_vehicles_that_drive_sideways(yaw: float, axis: str) -> None:
    """Report: scaleapi/pandaset-devkit#121, once-for-auto-driving/once_devkit#20 (which axis is ahead)."""
    change = turned_by(yaw_pose(np.deg2rad(yaw), (0.0, 0.0, 0.0))[:3, :3])
    found = assess(with_ego(street(without_tracks=True, no_lidar=True), change))
    assert set(found) == {"odd_travel_direction"} and f"along its axis {axis}" in found["odd_travel_direction"].message


def test_vehicles_may_slip_and_reverse() -> None:
    assert words(turned_by(yaw_pose(np.deg2rad(30.0), (0.0, 0.0, 0.0))[:3, :3])) == set()
    assert words(lambda k, pose: pose, speed_mps=-2.0) == set()
    assert words(lambda k, pose: pose, speed_mps=-10.0) == {"odd_travel_direction"}


def test_poses_with_the_axes_of_a_camera() -> None:
    """Report: facebookresearch/projectaria_tools#7 (quaternions in another order)."""
    camera_axes = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    assert {"tilted_pose", "odd_travel_direction"} <= words(turned_by(camera_axes))


@pytest.mark.parametrize("rotation", [np.diag([1.0, -1.0, 1.0]), 0.01 * np.eye(3), np.ones((3, 3))])
def test_axes_that_are_no_rotation(rotation: Float64) -> None:
    """Report: none found; case 6 of the list of odd logs."""
    found = assess(with_ego(street(without_tracks=True, no_lidar=True), turned_by(rotation), rig=False))
    assert found["improper_rotation"].severity == "fatal" and found["improper_rotation"].remedy


@pytest.mark.parametrize("count", [1, 3])
def test_poses_that_freeze_while_the_vehicle_moves(count: int) -> None:
    """Report: none found; case 6 of the list of odd logs."""
    log = street()
    frozen = range(3, 3 + count)
    found = assess(with_ego(log, lambda k, pose: log.world_SE3_lidar(2) if k in frozen else pose))
    assert found["frozen_pose"].frames == tuple(frozen) and is_complete(found["frozen_pose"])


def test_poses_that_are_all_the_same_while_images_change() -> None:
    """Report: none found; case 6 of the list of odd logs."""
    log = open_log("synthetic:street?seed=3&frames=8&cameras=2&width=64&height=36&samples=1&lidar=0&cuboids=0")
    frozen = EditedLog(
        log,
        world_SE3_lidar=lambda frame: np.eye(4),
        world_SE3_camera=lambda camera, frame: np.linalg.inv(log.world_SE3_lidar(0)) @ log.world_SE3_camera(camera, 0),
    )
    found = assess(frozen)
    assert set(found) == {"frozen_pose"} and "pixels change" in found["frozen_pose"].message
    assert is_complete(found["frozen_pose"])


def test_a_vehicle_that_stands_in_traffic() -> None:
    uri = "synthetic:street?seed=5&frames=8&cameras=2&width=64&height=36&samples=1&lidar=0&cuboids=0"
    assert assess(open_log(f"{uri}&standstill=1&moving=12&pedestrians=20")) == {}


def test_poses_and_times_that_cannot_be_read_are_gaps() -> None:
    nowhere = np.full((4, 4), np.nan)
    assert words(lambda k, pose: nowhere if k in (0, 3) else pose) == set()
    assert words(lambda k, pose: nowhere) == set()
    log = street(timestamps_s=(0.0, 0.1, 0.1, float("nan"), 0.4, 0.5, 0.45, 0.7), without_tracks=True, no_lidar=True)
    assert {word for word in assess(log) if "jump" in word or "speed" in word} == set()


@pytest.mark.parametrize("count", [1, 2])
def test_chunks_of_few_frames(count: int) -> None:
    assert words(lambda k, pose: pose, frame_count=count) == set()
