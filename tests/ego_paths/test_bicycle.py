"""The kinematic bicycle drives as the equations say, and never beyond what a car can do."""

from __future__ import annotations

import math

import numpy as np
import pytest

from genre_tasks.config.simulation_sections import KinematicBounds
from genre_tasks.ego_paths.bicycle import MAX_STEER_RATE_RAD_S, BicycleModel, VehicleState

STEP_S = 0.01
TINY = 1e-6
BOUNDS = KinematicBounds()
MODEL = BicycleModel(BOUNDS)


def drive(state: VehicleState, actions: np.ndarray, seconds: float = 0.1) -> list[VehicleState]:
    states = [state]
    for acceleration, steer_rate in actions.tolist():
        states.append(MODEL.advance(states[-1], acceleration, steer_rate, seconds))
    return states


def test_a_held_steering_angle_is_a_circle() -> None:
    steer = MODEL.find_steer(0.05)
    states = drive(VehicleState(3.0, -20.0, 0.0, speed_m_s=5.0, steer_rad=steer), np.zeros((250, 2)))
    positions = np.array([[s.x_m, s.y_m] for s in states])
    # 20 m around a centre that lies to the left: (3, 0).
    assert np.allclose(np.linalg.norm(positions - (3.0, 0.0), axis=1), 20.0, atol=1e-3)
    assert states[-1].heading_rad == pytest.approx(25.0 * 5.0 * 0.05, abs=1e-9)


def test_braking_ends_at_a_standstill() -> None:
    state = VehicleState(0.0, 0.0, 1.0, speed_m_s=9.0)
    braking = drive(state, np.tile([-9.0, 0.0], (30, 1)))
    assert braking[-1].speed_m_s == 0 and braking[-1].acceleration_m_s2 == 0
    # v² / 2a, and what the jerk takes to build up the deceleration.
    assert 4.5 < math.hypot(braking[-1].x_m, braking[-1].y_m) < 4.5 + 9.0 * 0.3
    assert braking[-1].heading_rad == 1.0
    fast = drive(VehicleState(0.0, 0.0, 0.0, speed_m_s=39.9), np.tile([4.0, 0.0], (10, 1)))
    assert fast[-1].speed_m_s == BOUNDS.max_speed_m_s and fast[-1].acceleration_m_s2 == 0


@pytest.mark.parametrize("speed_m_s", [0.0, 4.0, 12.0, 30.0])
@pytest.mark.parametrize("factor", [1.0, 100.0])
def test_no_driver_leaves_the_bounds(speed_m_s: float, factor: float) -> None:
    random = np.random.default_rng(int(speed_m_s))
    # Each wish lasts for a second, as wishes of a hundredth would cancel each other.
    wishes = np.repeat(random.uniform((-9.0, -0.8), (4.0, 0.8), size=(12, 2)), 100, axis=0)
    states = drive(VehicleState(0.0, 0.0, 0.0, speed_m_s=speed_m_s), factor * wishes, seconds=STEP_S)
    speed = np.array([s.speed_m_s for s in states])
    acceleration = np.diff(speed) / STEP_S
    assert speed.min() >= 0 and speed.max() <= BOUNDS.max_speed_m_s
    assert -BOUNDS.max_deceleration_m_s2 <= acceleration.min() + TINY
    assert acceleration.max() <= BOUNDS.max_acceleration_m_s2 + TINY
    # Who stops, or reaches the largest speed, ends to accelerate there at once.
    free = (speed[1:-1] > 0) & (speed[2:] > 0) & (speed[2:] < BOUNDS.max_speed_m_s)
    assert np.abs(np.diff(acceleration)[free]).max() <= BOUNDS.max_jerk_m_s3 * STEP_S + TINY
    # From where the vehicle has been, and not from the steering angle.
    position = np.array([[s.x_m, s.y_m] for s in states])
    length = np.linalg.norm(np.diff(position, axis=0), axis=1)
    turned = np.diff([s.heading_rad for s in states])
    curvature = turned / np.maximum(length, 1e-9)
    assert np.abs(curvature).max() <= BOUNDS.max_curvature_1_m * 1.001
    lateral = curvature * (length / STEP_S) ** 2
    assert np.abs(lateral).max() <= BOUNDS.max_lateral_acceleration_m_s2 + TINY
    steer = np.diff([s.steer_rad for s in states])
    # A faster vehicle straightens up more quickly, where the lateral acceleration demands it.
    assert np.abs(steer[speed[1:] < 5]).max(initial=0.0) <= MAX_STEER_RATE_RAD_S * STEP_S + TINY
    # Of a vector in turning axes: the turn carries one component over to the other.
    lateral_jerk = np.diff(lateral) / STEP_S + (turned * acceleration)[1:] / STEP_S
    assert np.abs(lateral_jerk).max() <= BOUNDS.max_jerk_m_s3 * 1.02
