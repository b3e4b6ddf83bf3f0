"""Measured motion against analytic motion, and which violations are found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from genre_tasks.config.simulation_sections import KinematicBounds
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.kinematics import find_bound_violations, measure_kinematics
from tests.ego_paths.drives import drive, straight

BOUNDS = KinematicBounds()


@pytest.mark.parametrize("radius_m", [5.0, 10.0, 30.0])
@pytest.mark.parametrize("speed_m_s", [2.0, 5.0])
@pytest.mark.parametrize("frame_s", [0.05, 0.1, 0.2])
def test_a_circle_has_its_curvature_and_lateral_acceleration(radius_m: float, speed_m_s: float, frame_s: float) -> None:
    path = drive(40, lambda t: np.full_like(t, speed_m_s), lambda s: np.full_like(s, 1 / radius_m), frame_s=frame_s)
    motion = measure_kinematics(path)
    middle = slice(len(motion.times_s) // 4, -len(motion.times_s) // 4)
    assert np.allclose(motion.curvature_1_m[middle] * radius_m, 1.0, atol=0.03)
    assert np.allclose(motion.lateral_acceleration_m_s2[middle] * radius_m / speed_m_s**2, 1.0, atol=0.03)
    assert np.abs(motion.acceleration_m_s2[middle]).max() < 0.15
    assert np.abs(motion.curvature_1_m).max() * radius_m < 1.05


def test_the_sign_of_curvature_is_that_of_the_side() -> None:
    right = drive(40, lambda t: np.full_like(t, 5.0), lambda s: np.full_like(s, -0.1))
    motion = measure_kinematics(right)
    assert motion.curvature_1_m.max() < -0.08
    assert motion.lateral_acceleration_m_s2.max() < -2.0


def test_braking_has_its_deceleration_and_jerk() -> None:
    # 3 m/s² more deceleration in every second.
    path = drive(30, lambda t: 20.0 - 1.5 * t**2)
    motion = measure_kinematics(path)
    # At the ends the curve has no third derivative, by which it is smooth where samples are on one side alone.
    middle = slice(len(motion.times_s) // 4, -len(motion.times_s) // 4)
    assert np.allclose(motion.acceleration_m_s2[middle], -3 * motion.times_s[middle], atol=0.15)
    assert np.allclose(motion.jerk_m_s3[middle], -3.0, atol=0.3)


@pytest.mark.parametrize("jitter_m", [0.0, 0.003, 0.01])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "speed", [lambda t: np.full_like(t, 8.0), lambda t: np.clip(4 - 2 * t, 0, None), np.zeros_like, lambda t: 0.9 + t]
)
def test_jitter_of_centimetres_breaks_no_bound(jitter_m: float, seed: int, speed: object) -> None:
    path = drive(40, speed, lambda s: 0.03 * np.sin(s / 8), jitter_m=jitter_m, jitter_rad=0.002, seed=seed)  # type: ignore[arg-type]
    lateral = 3.0 * path.world_SE3_ego[:, :3, 1]
    moved = EgoPath(path.times_s, path.frames, path.world_SE3_ego.copy())
    moved.world_SE3_ego[:, :3, 3] += lateral
    assert find_bound_violations(path, BOUNDS) == ()
    assert find_bound_violations(moved, BOUNDS) == ()


def _quantities(path: EgoPath) -> set[str]:
    return {violation.quantity for violation in find_bound_violations(path, BOUNDS)}


def test_every_quantity_is_checked() -> None:
    assert _quantities(straight(40, 45.0)) == {"speed"}
    assert "acceleration" in _quantities(drive(40, lambda t: 6.0 * t))
    assert _quantities(drive(20, lambda t: 30 - 12.0 * t)) == {"deceleration"}
    assert "curvature" in _quantities(drive(60, lambda t: np.full_like(t, 2.0), lambda s: np.full_like(s, 0.4)))
    assert _quantities(drive(40, lambda t: np.full_like(t, 12.0), lambda s: np.full_like(s, 0.06))) == {
        "lateral acceleration"
    }
    assert "jerk" in _quantities(drive(60, lambda t: 10 + 2 * np.sin(6 * t)))
    assert "lateral jerk" in _quantities(drive(60, lambda t: np.full_like(t, 20.0), lambda s: 0.03 * np.sin(0.2 * s)))


def test_a_jump_of_a_metre_is_found_at_its_time() -> None:
    path = straight(40, 8.0)
    path.world_SE3_ego[25:, 1, 3] += 1.0
    violations = find_bound_violations(path, BOUNDS)
    assert {"lateral acceleration", "lateral jerk"} <= {violation.quantity for violation in violations}
    assert all(violation.time_s == pytest.approx(2.45, abs=0.5) for violation in violations)
    assert all(violation.value > violation.bound for violation in violations)


def test_turns_that_smoothing_would_hide_are_found() -> None:
    # Circles of half a metre: the smooth curve over arc length is a point.
    path = drive(60, lambda t: np.full_like(t, 1.0), lambda s: np.full_like(s, 2.0))
    assert "curvature" in _quantities(path)


@pytest.mark.parametrize("frames", [1, 2, 3, 4])
def test_short_paths_are_measured(frames: int) -> None:
    motion = measure_kinematics(straight(frames, 8.0))
    assert motion.speed_m_s.max() == pytest.approx(8.0 if frames > 1 else 0.0, abs=1e-6)
    assert np.abs(motion.jerk_m_s3).max() < 1e-4


def test_bounds_are_those_of_the_configuration() -> None:
    path = straight(20, 8.0)
    (violation,) = find_bound_violations(path, BOUNDS.model_copy(update={"max_speed_m_s": 5.0}))
    assert violation.value == pytest.approx(8.0, abs=1e-3)
    assert (
        str(violation) == str(replace(violation, value=8.0)) == f"speed of 8 m/s at {violation.time_s:.1f} s (bound 5)"
    )
