"""Where a LiDAR sits, from its returns alone; and the rays that had none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from genre_tasks.lidar_simulation.rollout_lidar import LidarSimulator
from genre_tasks.lidar_simulation.sensor import LidarSensor, estimate_sensor, to_ego_axes
from genre_tasks.lidar_simulation.sweep_pattern import NO_RING, SweepPattern, build_pattern, find_rings
from genre_tasks.logs.registry import open_log
from genre_tasks.logs.synthetic.ego_vehicle import LIDAR_HEIGHT_M
from tests.lidar_simulation.spinning_lidar import AZIMUTHS, FRAME_S, POSITION_M, RINGS, FlashLog, beams, ego_path, scan


def pattern_of(frame: int, sensor: LidarSensor) -> SweepPattern:
    times, poses = ego_path()
    sweep = scan(frame)
    points = to_ego_axes(sweep, times, poses)
    return build_pattern(points, sweep.timestamps_s - times[frame], sweep.intensity, sensor)


def true_sensor() -> LidarSensor:
    return LidarSensor(POSITION_M, np.eye(3), -2 * np.pi / FRAME_S)


def test_the_sensor_is_found_on_a_driving_vehicle():
    times, poses = ego_path()
    sweep = scan(2)
    sensor = estimate_sensor(to_ego_axes(sweep, times, poses), sweep.timestamps_s, FRAME_S)
    assert np.abs(sensor.position_m - POSITION_M).max() < 0.03
    assert np.isclose(sensor.turn_rad_s, -2 * np.pi / FRAME_S)
    assert np.abs(sensor.axes - np.eye(3)).max() < 0.01


def test_a_flat_road_does_not_draw_the_sensor_down():
    """Seen from the road itself, all its returns have one elevation, which looks sharp."""
    log = open_log("synthetic:street?seed=950&frames=4&cameras=1&lidar_azimuths=450")
    position_m = LidarSimulator(log).sensor.position_m
    assert np.abs(position_m - [0.0, 0.0, LIDAR_HEIGHT_M]).max() < 0.05


def test_a_sensor_that_does_not_spin_stays_at_the_origin():
    times, poses = ego_path()
    sweep = scan(2)
    shuffled = np.random.default_rng(0).uniform(times[1], times[2], len(sweep.timestamps_s))
    sensor = estimate_sensor(to_ego_axes(sweep, times, poses), shuffled, FRAME_S)
    assert sensor.turn_rad_s == 0
    assert not sensor.position_m.any()
    flash = replace(sweep, timestamps_s=np.full_like(shuffled, times[2]))
    assert estimate_sensor(to_ego_axes(flash, times, poses), flash.timestamps_s, FRAME_S).turn_rad_s == 0


def test_a_log_says_where_a_sensor_is_that_no_spin_shows():
    """At the origin, which is at the road's height in many logs, rays would skim along the road."""
    simulator = LidarSimulator(FlashLog(states_sensor=True))
    assert np.abs(simulator.sensor.position_m - POSITION_M).max() < 1e-9
    assert not simulator.sensor.is_assumed
    pattern = simulator.pattern_at(2.0)
    below = pattern.directions[:, 2] < 0
    heights = pattern.range_m[below] * pattern.directions[below, 2] + POSITION_M[2]
    # A tenth of a metre is the drive within a turn, which one time for all points hides.
    assert heights.min() > -0.1
    assert np.degrees(np.arcsin(pattern.directions[:, 2].min())) < -15


def test_a_spin_tells_more_than_the_log():
    times, poses = ego_path()
    sweep = scan(2)
    points = to_ego_axes(sweep, times, poses)
    stated = estimate_sensor(points, sweep.timestamps_s, FRAME_S, np.array([0.0, 0.0, 1.0]))
    np.testing.assert_array_equal(stated.position_m, estimate_sensor(points, sweep.timestamps_s, FRAME_S).position_m)
    assert not stated.is_assumed


def test_a_place_that_nothing_says_is_known_to_be_assumed():
    sensor = LidarSimulator(FlashLog(states_sensor=False)).sensor
    assert sensor.is_assumed
    assert not sensor.position_m.any()


def test_the_pattern_has_the_rays_that_came_back_and_those_that_did_not():
    pattern = pattern_of(2, true_sensor())
    assert abs(len(pattern) - len(RINGS) * AZIMUTHS) <= len(RINGS)
    assert pattern.ring.max() == len(RINGS) - 1
    missing = np.isnan(pattern.range_m)
    assert 0.05 < missing.mean() < 0.5
    # Into the sky, at a true beam's direction and moment.
    assert (pattern.directions[missing, 2] > 0).all()
    directions, times, rings = beams()
    for row in np.flatnonzero(missing)[::97]:
        same = np.flatnonzero(rings == pattern.ring[row])
        nearest = same[np.abs(times[same] - pattern.times_s[row]).argmin()]
        assert np.abs(directions[nearest] - pattern.directions[row]).max() < 0.01


def test_a_pattern_without_a_spin_has_returns_alone():
    still = LidarSensor(POSITION_M, np.eye(3), 0.0)
    pattern = pattern_of(2, still)
    assert np.isfinite(pattern.range_m).all()
    assert (pattern.ring == NO_RING).all()


def test_rings_are_numbered_from_below():
    noise = np.random.default_rng(1).normal(0, np.radians(0.02), 3000)
    levels = np.radians([5.0, -10.0, 0.0])
    truth = np.arange(3000) % 3
    ring, found = find_rings(levels[truth] + noise, np.full(3000, 10.0))
    assert np.abs(found - np.sort(levels)).max() < np.radians(0.02)
    assert (ring == np.array([2, 0, 1])[truth]).all()
