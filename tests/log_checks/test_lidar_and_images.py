"""Whether LiDAR, poses and images belong together: faults that people's converters make are found and named."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.log_faults.changed_log import ChangedLog, Changes
from benchmarks.log_faults.faults import FAULTS
from genre_tasks.log_checks.calibration import find_miscalibration, measure_agreement
from genre_tasks.log_checks.edge_agreement import correlate_edges, score_turns
from genre_tasks.log_checks.lidar_frame import find_misplaced_lidar
from genre_tasks.log_checks.log_sample import LogSample
from genre_tasks.log_checks.pose_axes import find_misread_poses
from genre_tasks.log_checks.sweep_overlap import find_inconsistent_sweeps
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import DrivingLog, Float64, Sweep
from tests.fakes import FakeLog

FAULT = {fault.name: fault for fault in FAULTS}
Check = Callable[[LogSample], object]


@pytest.fixture(scope="module")
def street() -> DrivingLog:
    """Eight frames of two small cameras; images are drawn once."""
    small = "width=224&height=126&samples=1&cameras=2&moving=2&pedestrians=0"
    return open_log(f"synthetic:street?seed=905&frames=8&{small}")


def sample_of(log: DrivingLog) -> LogSample:
    return LogSample(log, tuple(range(log.frame_count)), log.cameras)


def broken(log: DrivingLog, fault: str, strength: float = 1.0) -> LogSample:
    return sample_of(ChangedLog(log, FAULT[fault].change(log, strength)))


def words(findings: object) -> list[str]:
    return [finding.word for finding in findings]  # type: ignore[attr-defined]


def only(findings: object) -> Finding:
    (finding,) = findings  # type: ignore[misc]
    assert isinstance(finding, Finding)
    return finding


@pytest.mark.parametrize(
    "check", [find_misread_poses, find_misplaced_lidar, find_inconsistent_sweeps, find_miscalibration]
)
def test_a_sound_street_gives_no_finding(street: DrivingLog, check: Check) -> None:
    assert words(check(sample_of(street))) == []


def test_points_in_the_frame_of_the_lidar_are_named_so(street: DrivingLog) -> None:
    """Report: DerrickXuNu/OpenCOOD#170."""
    finding = only(find_inconsistent_sweeps(broken(street, "points in LiDAR coordinates")))
    assert finding.word == "lidar_not_in_world"
    assert "points taken as LiDAR coordinates (x forward, y left, z up)" in finding.message
    assert finding.numbers["best_misfit_m"] < 0.12 < finding.numbers["misfit_m"]


def test_poses_that_were_applied_twice_are_named_so(street: DrivingLog) -> None:
    """Report: DerrickXuNu/OpenCOOD#170."""
    finding = only(find_inconsistent_sweeps(broken(street, "LiDAR pose applied twice")))
    assert finding.word == "lidar_not_in_world" and "applied twice" in finding.message


def test_sweeps_that_move_with_the_vehicle_are_found(street: DrivingLog) -> None:
    """Report: none found; points in the axes of the first pose, as after a registration that was not applied."""
    finding = only(find_inconsistent_sweeps(broken(street, "all sweeps placed by the first pose")))
    assert finding.word == "lidar_not_in_world" and "placed by the first pose" in finding.message


def test_points_placed_by_quaternions_in_the_wrong_order_are_found(street: DrivingLog) -> None:
    """Report: once-for-auto-driving/once_devkit#22."""
    finding = only(find_inconsistent_sweeps(broken(street, "points placed by quaternions out of order")))
    assert finding.word == "lidar_not_in_world" and "points that were placed by quaternions" in finding.message


@pytest.mark.parametrize(
    ("fault", "cause"),
    [
        ("LiDAR poses: quaternions out of order", "x, y, z, w"),
        ("LiDAR poses: quaternions conjugate", "conjugate"),
    ],
)
def test_misread_quaternions_are_named(street: DrivingLog, fault: str, cause: str) -> None:
    """Report: once-for-auto-driving/once_devkit#22."""
    finding = only(find_misread_poses(broken(_turned(street, 60.0), fault)))
    assert finding.word == "misread_poses"
    assert cause in finding.message
    assert max(finding.numbers["heading_deg"], finding.numbers["tilt_deg"]) > finding.numbers["limit_deg"]


def _turned(log: DrivingLog, yaw_deg: float) -> DrivingLog:
    """The log in a world turned about its z axis: a conjugate changes little where the vehicle drives along x."""
    c, s = np.cos(np.deg2rad(yaw_deg)), np.sin(np.deg2rad(yaw_deg))
    turn = np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])

    def turn_sweep(frame: int, sweep: Sweep) -> Sweep:
        return replace(sweep, points_world=sweep.points_world @ turn[:3, :3].T)

    turned: DrivingLog = ChangedLog(
        log,
        Changes(
            lidar_pose=lambda frame, pose: turn @ pose,
            camera_pose=lambda camera, frame, pose: turn @ pose,
            sweep=turn_sweep,
        ),
    )
    return turned


def test_a_vehicle_that_reverses_or_stands_is_not_misread(street: DrivingLog) -> None:
    backwards = Changes(lidar_pose=lambda frame, pose: street.world_SE3_lidar(street.frame_count - 1 - frame))
    assert words(find_misread_poses(sample_of(ChangedLog(street, backwards)))) == []
    standing = Changes(lidar_pose=lambda frame, pose: street.world_SE3_lidar(0))
    sample = sample_of(ChangedLog(street, standing))
    assert words(find_misread_poses(sample)) == []
    assert words(find_inconsistent_sweeps(sample)) == []


@pytest.mark.parametrize(
    ("fault", "strength", "word"),
    [
        ("points scaled", 1000.0, "odd_lidar_scale"),
        ("points scaled", 0.001, "odd_lidar_scale"),
        ("points as float32", 4e6, "coarse_lidar_points"),
        ("points upside down", 1.0, "odd_ground_height"),
        ("sweeps of later frames", 2.0, "sweep_of_another_time"),
    ],
)
def test_points_that_no_lidar_measures_are_found(street: DrivingLog, fault: str, strength: float, word: str) -> None:
    """Reports: autowarefoundation/autoware_universe#3090 (float32), tier4/nebula#445 (upside down)."""
    kitti_like = Changes(lidar_pose=lambda frame, pose: _raised(pose, 1.7))
    log: DrivingLog = ChangedLog(street, kitti_like) if word == "odd_ground_height" else street
    assert word in words(find_misplaced_lidar(broken(log, fault, strength)))


def _raised(pose: Float64, height_m: float) -> Float64:
    raised = pose.copy()
    raised[2, 3] += height_m
    return raised


def test_points_far_from_the_path_are_found(street: DrivingLog) -> None:
    """Report: DerrickXuNu/OpenCOOD#170."""
    far = Changes(lidar_pose=lambda frame, pose: pose + 1e5 * np.eye(4)[3] * np.array([[1], [1], [0], [0]]))
    finding = only(find_misplaced_lidar(sample_of(ChangedLog(street, far))))
    assert finding.word == "lidar_far_from_path" and finding.numbers["distance_m"] > 1e5


@pytest.mark.parametrize("yaw_deg", [-2.0, 2.0, 10.0])
def test_a_turned_camera_is_found_with_its_angle(street: DrivingLog, yaw_deg: float) -> None:
    """Report: dhchung/pohang_canal_dataset#3."""
    for finding in find_miscalibration(broken(street, "camera turned sideways", yaw_deg)):
        assert finding.word == "turned_camera"
        assert abs(finding.numbers["yaw_deg"]) == pytest.approx(abs(yaw_deg), abs=0.7)
        # The camera was turned to the right by a positive angle about its downward axis, and belongs further left.
        assert (f"to the {'left' if yaw_deg > 0 else 'right'}") in finding.message
        return
    pytest.fail("not found")


@pytest.mark.parametrize(
    ("fault", "strength", "expected"),
    [
        ("focal length scaled", 1.3, "odd_field_of_view"),
        ("focal length scaled", 0.9, "odd_field_of_view"),
        ("images swapped between cameras", 1.0, "images_of_another_camera"),
        ("images mirrored", 1.0, "flipped_images"),
        ("images turned by 180°", 1.0, "flipped_images"),
    ],
)
def test_images_that_do_not_fit_are_named(street: DrivingLog, fault: str, strength: float, expected: str) -> None:
    """Reports: VSLAM-LAB/VSLAM-LAB#99 (focal length), unmannedlab/RELLIS-3D#27 (images of something else)."""
    found = list(find_miscalibration(broken(street, fault, strength)))
    assert expected in words(found)
    assert all(finding.camera and finding.numbers["score"] < finding.numbers["best_score"] for finding in found)


@pytest.mark.parametrize("edit", [lambda p: p * 0, lambda p: p // 64 * 0 + 9, lambda p: (p * 0.02).astype(np.uint8)])
def test_black_and_dark_images_give_no_verdict(street: DrivingLog, edit: Callable[[np.ndarray], np.ndarray]) -> None:
    """Report: none found; a night without lights must not be taken for a wrong calibration."""
    from benchmarks.log_faults.faults import _edit_pixels

    sample = sample_of(ChangedLog(street, Changes(image=_edit_pixels(edit))))
    assert words(find_miscalibration(sample)) == []


def test_small_images_and_few_points_give_no_verdict(street: DrivingLog) -> None:
    fake = FakeLog(frame_count=4, width_px=48, height_px=32)
    assert measure_agreement(sample_of(fake), fake.cameras[0]) is None
    thin = Changes(sweep=lambda frame, sweep: replace(sweep, points_world=sweep.points_world[::400]))
    sample = sample_of(ChangedLog(street, thin))
    assert words(find_miscalibration(sample)) == [] and words(find_inconsistent_sweeps(sample)) == []


def test_gaps_give_no_verdict(street: DrivingLog) -> None:
    """Poses, sweeps and images that cannot be read are others' findings."""
    fake = FakeLog(frame_count=4, no_lidar=True)
    for check in (find_misread_poses, find_misplaced_lidar, find_inconsistent_sweeps, find_miscalibration):
        assert words(check(sample_of(fake))) == []
    unposed = sample_of(ChangedLog(street, Changes(lidar_pose=lambda frame, pose: pose * np.nan)))
    assert words(find_inconsistent_sweeps(unposed)) == [] and words(find_misread_poses(unposed)) == []


def test_few_edges_give_no_score() -> None:
    """Report: none found; case 2 of the list of odd logs: images of 160 × 90 agreed by 134438.9 deviations."""
    edges = np.zeros((40, 100), np.float32)
    edges[10, 50] = 1.0
    edges[30, 20] = 2.0
    surface = correlate_edges(edges, edges)
    assert score_turns(surface) is None
    noise = np.random.default_rng(0).normal(size=edges.shape).astype(np.float32)
    scores = score_turns(correlate_edges(noise, noise))
    assert scores is not None and 10 < scores.near.score < 200
