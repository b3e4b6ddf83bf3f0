"""Marks: lateral distance, how far ahead, and what lies outside of the reliable range and the recording."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from genre_tasks.config.simulation_sections import SimulateConfig
from genre_tasks.ego_paths.behaviours import plan_behaviour
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.path_marks import mark_path
from genre_tasks.ego_paths.recorded_path import DEFAULT_FRAME_S, ImageTime, measure_frame_s, measure_frame_times
from genre_tasks.ego_paths.relative_path import place_relative_path
from genre_tasks.errors import InputError
from tests.ego_paths.drives import drive, straight, yaw_of

CONFIG = SimulateConfig()
CURVE = drive(40, lambda t: np.full_like(t, 8.0), lambda s: np.full_like(s, 0.04), jitter_m=0.003)


def test_the_recorded_path_is_on_itself() -> None:
    marks = mark_path(CURVE, CURVE, 0.5, 0.5)
    assert np.abs(marks.lateral_m).max() < 0.05
    assert np.abs(marks.ahead_m).max() < 0.05
    assert marks.reliable.all()
    assert not marks.outside_recording.any()


@pytest.mark.parametrize("times_s", [(0.0, 0.0, 0.0), (0.2, 0.1, 0.0), (5.0,)])
def test_a_clock_that_stands_or_runs_backwards_tells_no_frame_time(times_s: tuple[float, ...]) -> None:
    views = [SimpleNamespace(camera="front", frame=frame, timestamp_s=time_s) for frame, time_s in enumerate(times_s)]
    assert measure_frame_s([SimpleNamespace(views=views)]) == DEFAULT_FRAME_S  # type: ignore[list-item]


def test_a_pause_of_the_recording_is_in_the_times_of_its_frames() -> None:
    def measure(times_s: dict[int, float], frames: list[int]) -> list[float]:
        images = [ImageTime(camera, frame, time_s) for camera in ("front", "left") for frame, time_s in times_s.items()]
        return measure_frame_times(frames, images).round(6).tolist()

    jitter = {0: 5.0, 1: 5.09, 2: 5.21, 3: 5.3}
    assert measure(jitter, [0, 1, 2, 3]) == pytest.approx([0.0, 0.09, 0.18, 0.27])
    paused = {0: 5.0, 1: 5.1, 2: 8.1, 3: 8.2, 4: 8.3}
    assert measure(paused, [0, 1, 2, 3, 4]) == pytest.approx([0.0, 0.1, 3.1, 3.2, 3.3])
    # Chunk 0 and chunk 2 of a log: the frames between them took their time.
    assert measure({0: 0.0, 1: 0.1, 2: 0.2, 40: 4.0, 41: 4.1}, [0, 1, 2, 40, 41])[3] == pytest.approx(4.0)
    # A clock that jumps back tells nothing of that step.
    assert measure({0: 5.0, 1: 5.1, 2: 1.1, 3: 1.2, 4: 1.3}, [0, 1, 2, 3, 4]) == pytest.approx(
        [0.0, 0.1, 0.2, 0.3, 0.4]
    )


def test_a_lane_change_leaves_the_reliable_range_on_its_side() -> None:
    path = plan_behaviour("lane-change", CURVE, CONFIG, start_offset_m=0.0)
    marks = mark_path(path, CURVE, left_m=2.0, right_m=9.0)
    assert marks.lateral_m[[0, -1]] == pytest.approx([0.0, 3.5], abs=0.01)
    assert np.array_equal(marks.reliable, marks.lateral_m <= 2.0)
    assert 0 < marks.reliable.sum() < 40
    assert np.abs(marks.ahead_m).max() < 0.05
    assert mark_path(path, CURVE, left_m=4.0, right_m=0.0).reliable[1:].all()


def test_braking_falls_behind_and_accelerating_leaves_the_recording() -> None:
    recorded = straight(40, 8.0)
    behind = mark_path(plan_behaviour("brake", recorded, CONFIG, start_offset_m=-3.0), recorded, 2.0, 2.0)
    assert behind.ahead_m[-1] == pytest.approx(-(8.0 * 3.9 - 8.0 * 8.0 / 8.0), abs=1.5)
    assert not behind.outside_recording.any()
    assert not behind.reliable.any()
    ahead = mark_path(plan_behaviour("accelerate", recorded, CONFIG, start_offset_m=0.0), recorded, 2.0, 2.0)
    assert ahead.ahead_m[-1] == pytest.approx(0.5 * 2.5 * 3.9**2, rel=0.05)
    passed = ahead.ahead_m + 0.8 * np.arange(40) > 8.0 * 3.9 + 0.3
    assert np.array_equal(ahead.outside_recording, passed)
    assert ahead.outside_recording.sum() > 5


def test_before_the_first_pose_is_outside_of_the_recording() -> None:
    recorded = straight(20, 8.0)
    early = EgoPath(recorded.times_s, recorded.frames, recorded.world_SE3_ego.copy())
    early.world_SE3_ego[:, 0, 3] -= 2.0
    marks = mark_path(early, recorded, 1.0, 1.0)
    assert marks.ahead_m == pytest.approx(np.full(20, -2.0), abs=0.01)
    assert np.array_equal(marks.outside_recording, recorded.world_SE3_ego[:, 0, 3] < 1.7)


def test_a_vehicle_that_reverses_has_marks_of_its_sides() -> None:
    poses = CURVE.world_SE3_ego.copy()
    poses[:, :3, :2] *= -1
    recorded = replace(CURVE, world_SE3_ego=poses)
    marks = mark_path(recorded, recorded, 0.5, 0.5)
    assert np.abs(marks.lateral_m).max() < 0.05 and np.abs(marks.ahead_m).max() < 0.05
    assert marks.reliable.all() and not marks.outside_recording.any()
    moved = poses.copy()
    moved[:, :3, 3] += poses[:, :3, 1]
    marks = mark_path(replace(recorded, world_SE3_ego=moved), recorded, left_m=2.0, right_m=0.5)
    assert marks.lateral_m == pytest.approx(np.ones(40), abs=0.05) and marks.reliable.all()


def test_a_relative_path_has_the_marks_that_it_was_stated_with() -> None:
    frames = np.arange(5.0, 30.0, 0.5)
    lateral = 2.0 * np.sin(frames / 8)
    ahead = -0.1 * (frames - 5)
    path = place_relative_path(CURVE, frames * 0.1, frames, lateral, ahead)
    marks = mark_path(path, CURVE, 9.0, 9.0)
    assert path.times_s[0] == 0.0
    assert marks.lateral_m == pytest.approx(lateral, abs=0.01)
    assert marks.ahead_m == pytest.approx(ahead, abs=0.02)
    steps = np.diff(path.world_SE3_ego[:, :2, 3], axis=0)
    driven = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    yaw = yaw_of(path)
    assert np.abs(driven - 0.5 * (yaw[1:] + yaw[:-1])).max() < 0.03


def test_a_relative_path_steers_the_same_however_dense_its_poses_are() -> None:
    def place(rate_hz: float) -> EgoPath:
        times = np.arange(round(2.0 * rate_hz) + 1) / rate_hz
        # A lane change of 3 m within two seconds.
        return place_relative_path(CURVE, times, 10 * times, 1.5 * (1 - np.cos(np.pi * times / 2.0)), 0 * times)

    sparse = yaw_of(place(10.0))
    dense = yaw_of(place(1000.0))[::100]
    # Inside of both ends, where differences are one-sided.
    assert dense[1:-1] == pytest.approx(sparse[1:-1], abs=0.01)
    along = yaw_of(place_relative_path(CURVE, 0.1 * np.arange(21), np.arange(21.0), np.zeros(21), np.zeros(21)))
    assert np.abs(dense - along).max() > 0.2


def test_a_standing_vehicle_does_not_turn_for_going_sideways() -> None:
    times = 0.02 * np.arange(50)
    # It falls back as fast as the recorded vehicle drives, but for half of the speed that counts as driving.
    path = place_relative_path(CURVE, times, 10 * times + 10, 0.5 * times, -7.95 * times)
    assert np.ptp(yaw_of(path)) < 0.01


@pytest.mark.parametrize(
    ("lateral_m", "ahead_m", "problem"),
    [(0.0, -6.0, r"pose 0 of the path is 6\.0 m before the first"), (26.0, 0.0, "past the centre of the curve")],
)
def test_relative_paths_that_have_no_place_are_refused(lateral_m: float, ahead_m: float, problem: str) -> None:
    frames = np.arange(20.0)
    with pytest.raises(InputError, match=problem):
        place_relative_path(CURVE, 0.1 * frames, frames, np.full(20, lateral_m), np.full(20, ahead_m))
