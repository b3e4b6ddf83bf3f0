"""Behaviours: where they lead, by how much, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from genre_tasks.config.simulation_sections import KinematicBounds, SimulateConfig
from genre_tasks.ego_paths.behaviours import BEHAVIOURS, plan_behaviour
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.kinematics import find_bound_violations, measure_kinematics
from genre_tasks.errors import ConfigError, InputError
from tests.ego_paths.drives import drive, position_of, straight, yaw_of

CONFIG = SimulateConfig()


def plan(name: str, recorded: EgoPath, offset_m: float = 0.0, **options: object) -> EgoPath:
    return plan_behaviour(name, recorded, CONFIG, start_offset_m=offset_m, **options)  # type: ignore[arg-type]


def raw_motion(path: EgoPath) -> dict[str, np.ndarray]:
    """By plain differences, which no smoothing touches: for paths without jitter at a hundred poses a second."""
    step = path.times_s[1] - path.times_s[0]
    velocity = np.gradient(position_of(path), step, axis=0)
    speed = np.linalg.norm(velocity, axis=1)
    yaw = yaw_of(path)
    lateral = speed * np.gradient(yaw, step)
    inner = slice(4, -4)
    return {
        "speed": speed[inner],
        "acceleration": np.gradient(speed, step)[inner],
        "lateral": lateral[inner],
        "lateral_jerk": np.gradient(lateral, step)[inner],
        "curvature": (np.gradient(yaw, step) / np.maximum(speed, 0.1))[inner],
        "slip": (yaw - np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0])))[inner],
    }


@pytest.mark.parametrize("name", ["brake", "accelerate", "lane-change", "swerve"])
def test_what_breaks_the_bounds_is_planned_where_that_is_allowed(name: str) -> None:
    # Three metres of radius are left on the inside, which breaks the bound of the curvature.
    recorded = drive(60, lambda t: np.full_like(t, 8.0), lambda s: np.full_like(s, 0.12))
    with pytest.raises(ConfigError, match="breaks the bounds"):
        plan(name, recorded, offset_m=5.0)
    path = plan(name, recorded, offset_m=5.0, allow_implausible=True)
    assert find_bound_violations(path, CONFIG.bounds) and len(path) == len(recorded)


def test_times_and_frames_are_the_recorded_ones() -> None:
    recorded = straight(40, 8.0)
    for name in BEHAVIOURS:
        path = plan(name, recorded, 3.0)
        assert np.array_equal(path.times_s, recorded.times_s)
        assert np.array_equal(path.frames, recorded.frames)
        assert position_of(path)[0] == pytest.approx([0.0, 3.0], abs=0.01)


@pytest.mark.parametrize("strength", [0.5, 1.0, 2.0])
def test_braking_takes_the_distance_of_its_deceleration(strength: float) -> None:
    speed = 10.0
    recorded = straight(80, speed)
    path = plan("brake", recorded, -3.0, strength=strength, delay_s=1.0)
    rate = strength * CONFIG.braking_m_s2
    distance = position_of(path)[-1, 0] - 1.0 * speed
    jerk = 0.5 * CONFIG.bounds.max_jerk_m_s3
    # Beginning and end of the braking are gentle, and take their time.
    assert distance == pytest.approx(speed**2 / (2 * rate) + speed * rate / (2 * jerk), abs=0.1)
    assert distance > speed**2 / (2 * rate)
    assert position_of(path)[:, 1] == pytest.approx(np.full(80, -3.0), abs=1e-6)
    # It stays where it stops.
    assert np.ptp(position_of(path)[-10:, 0]) < 1e-6


@pytest.mark.parametrize("strength", [0.4, 1.0])
def test_accelerating_gains_speed_past_the_end_of_the_recording(strength: float) -> None:
    recorded = straight(40, 10.0)
    path = plan("accelerate", recorded, strength=strength)
    rate = strength * CONFIG.accelerating_m_s2
    assert position_of(path)[-1, 0] == pytest.approx(39 + 0.5 * rate * 3.9**2, rel=0.02)
    assert measure_kinematics(path).speed_m_s.max() == pytest.approx(10 + rate * 3.9, rel=0.02)


def test_accelerating_ends_at_the_largest_speed() -> None:
    path = plan("accelerate", straight(80, 36.0))
    assert measure_kinematics(path).speed_m_s.max() == pytest.approx(CONFIG.bounds.max_speed_m_s, rel=0.002)


def test_accelerating_in_a_curve_is_limited_by_the_curve() -> None:
    recorded = drive(60, lambda t: np.full_like(t, 10.0), lambda s: np.full_like(s, 0.04))
    motion = measure_kinematics(plan("accelerate", recorded))
    assert 10.5 < motion.speed_m_s.max() < 13.0
    assert np.abs(motion.lateral_acceleration_m_s2).max() < 1.01 * CONFIG.bounds.max_lateral_acceleration_m_s2


def test_a_standing_vehicle_accelerates_where_it_points() -> None:
    recorded = drive(40, np.zeros_like, heading=-1.2, jitter_m=0.005)
    path = plan("accelerate", recorded)
    travel = position_of(path)[-1] - position_of(path)[0]
    assert np.linalg.norm(travel) == pytest.approx(0.5 * 2.5 * 3.9**2, rel=0.1)
    assert np.arctan2(travel[1], travel[0]) == pytest.approx(-1.2, abs=0.01)


@pytest.mark.parametrize(
    ("offset_m", "side", "end_m"),
    [(0.0, None, 3.5), (3.0, None, -0.5), (-3.0, None, 0.5), (3.0, "left", 6.5), (0.0, "right", -3.5)],
)
def test_a_lane_change_ends_a_lane_to_the_side(offset_m: float, side: str | None, end_m: float) -> None:
    path = plan("lane-change", straight(40, 8.0), offset_m, side=side)
    assert position_of(path)[0, 1] == pytest.approx(offset_m, abs=1e-6)
    assert position_of(path)[-1, 1] == pytest.approx(end_m, abs=1e-6)
    assert yaw_of(path)[[0, -1]] == pytest.approx([0.0, 0.0], abs=1e-6)
    assert np.all(np.diff(position_of(path)[:, 1]) * np.sign(end_m - offset_m) > -1e-9)


@pytest.mark.parametrize("speed_m_s", [5.0, 8.0, 14.0])
def test_a_swerve_goes_a_lane_aside_and_back(speed_m_s: float) -> None:
    lateral = position_of(plan("swerve", straight(45, speed_m_s), 1.0, side="right"))[:, 1]
    assert lateral.min() == pytest.approx(1.0 - CONFIG.lane_m, abs=0.05)
    assert lateral[[0, -1]] == pytest.approx([1.0, 1.0], abs=1e-6)
    assert lateral.max() < 1.0 + 1e-9


@pytest.mark.parametrize("name", ["lane-change", "swerve"])
@pytest.mark.parametrize("strength", [0.05, 0.3, 1.0])
@pytest.mark.parametrize("curvature", [0.0, 0.02, -0.02])
def test_lateral_behaviours_keep_within_the_bounds_without_any_smoothing(
    name: str, strength: float, curvature: float
) -> None:
    recorded = drive(501, lambda t: np.full_like(t, 8.0), lambda s: np.full_like(s, curvature), frame_s=0.01)
    motion = raw_motion(plan(name, recorded, 2.0, strength=strength))
    bounds = CONFIG.bounds
    assert np.abs(motion["curvature"]).max() < 1.02 * bounds.max_curvature_1_m
    assert np.abs(motion["lateral"]).max() < 1.02 * bounds.max_lateral_acceleration_m_s2
    assert np.abs(motion["lateral_jerk"]).max() < 1.1 * bounds.max_jerk_m_s3
    # A vehicle with wheels goes where it points.
    assert np.abs(motion["slip"]).max() < 0.005
    # It is a shortest manoeuvre: one of the bounds is almost used up.
    shares = [
        np.abs(motion["curvature"]).max() / bounds.max_curvature_1_m,
        np.abs(motion["lateral"]).max() / bounds.max_lateral_acceleration_m_s2,
        np.abs(motion["lateral_jerk"]).max() / bounds.max_jerk_m_s3,
    ]
    assert max(shares) > 0.55


def test_standstill_moves_nothing_sideways() -> None:
    recorded = drive(110, lambda t: np.clip(2 * np.abs(t - 4) - 4, 0, 4), jitter_m=0.003)
    path = plan("lane-change", recorded, delay_s=0.3)
    still = (recorded.times_s > 2.4) & (recorded.times_s < 5.6)
    assert np.ptp(position_of(path)[still, 1]) < 0.02
    assert 0.3 < position_of(path)[still, 1].mean() < 3.2
    assert np.ptp(yaw_of(path)[still]) < 0.01
    assert position_of(path)[-1, 1] == pytest.approx(3.5, abs=0.03)


def test_recorded_driving_is_the_recorded_path_at_the_offset() -> None:
    recorded = drive(40, lambda t: np.full_like(t, 8.0), lambda s: np.full_like(s, 0.02), jitter_m=0.005)
    assert np.array_equal(plan("recorded", recorded).world_SE3_ego, recorded.world_SE3_ego)
    moved = plan("recorded", recorded, -2.0)
    in_ego = np.linalg.inv(recorded.world_SE3_ego) @ moved.world_SE3_ego
    assert np.allclose(in_ego[:, :3, 3], [0.0, -2.0, 0.0], atol=1e-9)
    for name in BEHAVIOURS:
        assert np.array_equal(plan(name, recorded, -2.0, strength=0.0).world_SE3_ego, moved.world_SE3_ego)


def test_a_behaviour_without_strength_needs_is_near_the_recorded_path() -> None:
    recorded = drive(40, lambda t: 6 + np.sin(t), lambda s: 0.03 * np.sin(s / 10), jitter_m=0.003, jitter_rad=0.001)
    path = plan("lane-change", recorded, strength=0.001)
    assert np.linalg.norm(position_of(path) - position_of(recorded), axis=1).max() < 0.04
    assert np.abs(yaw_of(path) - yaw_of(recorded)).max() < 0.02


def test_height_roll_and_pitch_are_those_of_the_road_there() -> None:
    recorded = straight(40, 8.0)
    recorded.world_SE3_ego[:, 2, 3] = 0.05 * recorded.world_SE3_ego[:, 0, 3]
    pitch = np.arctan(0.05)
    turn = np.array([[np.cos(pitch), 0, -np.sin(pitch)], [0, 1, 0], [np.sin(pitch), 0, np.cos(pitch)]])
    recorded.world_SE3_ego[:, :3, :3] = turn
    path = plan("brake", recorded, 3.0)
    assert path.world_SE3_ego[:, 2, 3] == pytest.approx(0.05 * path.world_SE3_ego[:, 0, 3], abs=1e-3)
    assert np.allclose(path.world_SE3_ego[:, :3, :3], turn, atol=1e-3)


@pytest.mark.parametrize("frames", [1, 2, 3, 5])
def test_very_short_logs_allow_what_fits(frames: int) -> None:
    recorded = straight(frames, 8.0)
    for name in ("brake", "accelerate", "recorded"):
        assert len(plan(name, recorded, 3.0)) == frames
    with pytest.raises(ConfigError, match=r"lane-change of 3\.5 m takes about .* m of it"):
        plan("lane-change", recorded, 3.0)


def test_twenty_frames_allow_braking_and_accelerating() -> None:
    recorded = straight(20, 8.0)
    assert measure_kinematics(plan("brake", recorded, 3.0)).speed_m_s[-1] < 2.0
    assert measure_kinematics(plan("accelerate", recorded, 3.0)).speed_m_s[-1] > 12.0


def test_a_log_that_is_too_short_says_what_it_is_long_enough_for() -> None:
    recorded = straight(20, 7.0)
    with pytest.raises(ConfigError) as refused:
        plan("swerve", recorded, 3.0, delay_s=0.5)
    error = refused.value
    assert "swerve of 3.5 m takes about 2" in error.problem
    assert "the recorded path has 9.8 m of it after 0.5 s" in error.problem
    assert "more chunks" in error.remedy
    assert "--delay 0" in error.remedy
    possible = float(error.remedy.split("--strength ")[1].split("`")[0])
    assert 0.05 < possible < 0.5
    assert plan("swerve", recorded, 3.0, delay_s=0.5, strength=possible)
    with pytest.raises(ConfigError):
        plan("swerve", recorded, 3.0, delay_s=0.5, strength=possible + 0.02)


def test_a_recorded_path_that_breaks_a_bound_is_named() -> None:
    tight = drive(40, lambda t: np.full_like(t, 4.0), lambda s: np.full_like(s, 0.12))
    with pytest.raises(ConfigError, match=r"the recorded path itself, moved by 5 m, breaks the bounds: curvature") as e:
        plan("brake", tight, 5.0)
    assert "--start-offset 2.5" in e.value.remedy
    jump = straight(40, 8.0)
    jump.world_SE3_ego[20:, 0, 3] += 2.0
    with pytest.raises(ConfigError, match="the recorded path itself breaks the bounds") as e:
        plan("lane-change", jump)
    assert "--start-offset" not in e.value.remedy


@pytest.mark.parametrize(
    ("name", "options", "problem", "remedy"),
    [
        ("break", {}, "unknown behaviour 'break'", "Did you mean 'brake'"),
        ("brake", {"side": "left"}, "brake has no side", "lane-change, swerve"),
        ("brake", {"strength": -1.0}, "--strength is -1", "from 0 to 100"),
        ("brake", {"strength": float("nan")}, "--strength is nan", "from 0 to 100"),
        ("brake", {"strength": 3.0}, "has the deceleration 12 m/s², the bound is 9", "--strength 2.25"),
        ("accelerate", {"strength": 2.0}, "has the acceleration 5 m/s², the bound is 4", "--strength 1.6"),
        ("brake", {"delay_s": 4.0}, "--delay is 4", "from 0 to 3.9"),
        ("brake", {"offset_m": 500.0}, "--start-offset is 500", "from -100 to 100"),
    ],
)
def test_what_makes_no_sense_is_refused(name: str, options: dict[str, object], problem: str, remedy: str) -> None:
    with pytest.raises(ConfigError) as refused:
        plan(name, straight(40, 8.0), **options)  # type: ignore[arg-type]
    assert problem in refused.value.problem
    assert remedy in refused.value.remedy


def test_a_path_without_frames_is_refused() -> None:
    empty = EgoPath(np.zeros(0), np.zeros(0), np.zeros((0, 4, 4)))
    for name in BEHAVIOURS:
        with pytest.raises(InputError, match="a path without frames: the recorded path has 0 poses"):
            plan(name, empty)


def test_bounds_of_the_configuration_make_manoeuvres_longer() -> None:
    gentle = CONFIG.model_copy(update={"bounds": KinematicBounds(max_lateral_acceleration_m_s2=2.0, max_jerk_m_s3=4.0)})
    recorded = straight(60, 8.0)
    fast = position_of(plan("lane-change", recorded))[:, 1]
    slow_path = plan_behaviour("lane-change", recorded, gentle, start_offset_m=0.0)
    slow = position_of(slow_path)[:, 1]
    assert np.argmax(slow > 3.49) > 1.3 * np.argmax(fast > 3.49)
    assert not find_bound_violations(slow_path, gentle.bounds)
