"""The reference: its shape against the analytic one, standstill, ends, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest

from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.reference_path import fit_reference_path
from genre_tasks.errors import InputError
from tests.ego_paths.drives import drive, position_of, straight

RADIUS_M = 20.0


def circle(jitter_m: float = 0.0) -> EgoPath:
    return drive(
        40,
        lambda t: np.full_like(t, 8.0),
        lambda s: np.full_like(s, 1 / RADIUS_M),
        jitter_m=jitter_m,
        jitter_rad=0.3 * jitter_m,
        origin=(4e6, -5e6, 100.0),
    )


@pytest.mark.parametrize(("jitter_m", "tolerance"), [(0.0, 0.003), (0.01, 0.01)])
def test_a_circle_has_its_curvature_and_heading(jitter_m: float, tolerance: float) -> None:
    reference = fit_reference_path(circle(jitter_m))
    arc = np.linspace(0.0, reference.length_m, 200)
    points = reference.sample(arc)
    assert reference.length_m == pytest.approx(8.0 * 3.9, rel=0.002)
    assert np.abs(points.curvature_1_m - 1 / RADIUS_M).max() < tolerance
    assert np.abs(points.heading_rad - arc / RADIUS_M).max() < 2 * tolerance
    center = np.array([4e6, -5e6 + RADIUS_M])
    assert np.abs(np.linalg.norm(points.position_m[:, :2] - center, axis=1) - RADIUS_M).max() < 0.03


def test_the_curvature_fades_past_the_end() -> None:
    reference = fit_reference_path(circle())
    arc = reference.length_m + np.linspace(0.0, 40.0, 401)
    points = reference.sample(arc)
    assert points.curvature_1_m[-1] == pytest.approx(0.0, abs=1e-9)
    assert np.abs(np.diff(points.curvature_1_m)).max() < 0.001
    steps = np.linalg.norm(np.diff(points.position_m, axis=0), axis=1)
    assert np.allclose(steps, 0.1, atol=1e-3)
    heading = np.arctan2(*np.diff(points.position_m[:, :2], axis=0).T[::-1])
    assert np.abs(heading - 0.5 * (points.heading_rad[1:] + points.heading_rad[:-1])).max() < 0.002


def test_progress_is_that_of_the_recorded_vehicle_through_standstill() -> None:
    recorded = drive(80, lambda t: np.clip(np.abs(8 - 2 * t) - 4, 0, None), jitter_m=0.005, jitter_rad=0.002)
    reference = fit_reference_path(recorded)
    place = reference.sample(reference.locate(recorded.times_s))
    assert np.linalg.norm(place.position_m[:, :2] - position_of(recorded), axis=1).max() < 0.05
    # From 2 to 6 s it stands.
    still = reference.locate(np.linspace(2.3, 5.7, 30))
    assert still.max() - still.min() < 0.03
    assert np.abs(place.heading_rad).max() < 0.02


def test_a_standing_vehicle_has_a_reference_straight_ahead() -> None:
    recorded = drive(20, np.zeros_like, heading=0.7, jitter_m=0.01, jitter_rad=0.002)
    reference = fit_reference_path(recorded)
    points = reference.sample(np.array([0.0, 10.0]))
    assert reference.length_m == 0
    assert np.diff(points.position_m[:, :2], axis=0)[0] == pytest.approx([10 * np.cos(0.7), 10 * np.sin(0.7)], abs=0.05)


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_very_short_paths_have_a_reference(frames: int) -> None:
    recorded = straight(frames, 8.0)
    reference = fit_reference_path(recorded)
    assert reference.locate(recorded.times_s) == pytest.approx(0.8 * np.arange(frames), abs=0.01)
    assert reference.sample(np.array([0.0])).position_m == pytest.approx(np.zeros((1, 3)), abs=1e-6)


def test_rotations_are_the_recorded_ones_though_the_vehicle_points_askew() -> None:
    recorded = straight(30, 8.0)
    tilt = np.eye(4)
    # A LiDAR that is mounted 2° askew and pitches: neither is a lateral motion.
    tilt[:3, :3] = np.array([[1, -0.035, 0.02], [0.035, 1, 0], [-0.02, 0, 1]]) @ np.eye(3)
    tilt[:3, :3] = np.linalg.qr(tilt[:3, :3])[0] * np.sign(np.diag(np.linalg.qr(tilt[:3, :3])[1]))
    askew = EgoPath(recorded.times_s, recorded.frames, recorded.world_SE3_ego @ tilt)
    points = fit_reference_path(askew).sample(np.linspace(0, 20, 9))
    assert np.abs(points.heading_rad).max() < 1e-6
    assert np.allclose(points.attitude_rad[:, 2], 0.035, atol=0.001)
    assert np.allclose(points.attitude_rad[:, 1], 0.02, atol=0.001)


def test_projection_finds_the_offset_on_both_sides_and_past_the_ends() -> None:
    reference = fit_reference_path(circle())
    arc = np.linspace(0.5, reference.length_m - 0.5, 300)
    points = reference.sample(arc)
    left = np.stack([-np.sin(points.heading_rad), np.cos(points.heading_rad)], axis=1)
    for offset in (-5.0, 0.0, 5.0):
        found, lateral = reference.project(points.position_m[:, :2] + offset * left, arc)
        assert np.allclose(found, arc, atol=1e-3)
        assert np.allclose(lateral, offset, atol=1e-3)
    start = reference.sample(np.zeros(1))
    found, lateral = reference.project(start.position_m[:, :2] - [[3.0, -2.0]], np.zeros(1))
    assert found[0] == pytest.approx(-3.0, abs=0.02)
    assert lateral[0] == pytest.approx(2.0, abs=0.02)


def test_a_path_that_crosses_itself_is_projected_where_it_is_expected() -> None:
    # Once and a half around: the second lap lies on the first.
    recorded = drive(200, lambda t: np.full_like(t, 8.0), lambda s: np.full_like(s, 1 / 17.0))
    reference = fit_reference_path(recorded)
    arc = np.array([10.0, 10.0 + 2 * np.pi * 17.0])
    found, _ = reference.project(reference.sample(arc).position_m[:, :2], arc)
    assert np.allclose(found, arc, atol=0.05)


def test_what_has_no_reference_is_refused() -> None:
    with pytest.raises(InputError, match="without frames"):
        fit_reference_path(EgoPath(np.zeros(0), np.zeros(0), np.zeros((0, 4, 4))))
    backwards = straight(30, 8.0)
    backwards.world_SE3_ego[:, :2, :2] *= -1
    with pytest.raises(InputError, match="drives backwards, 23"):
        fit_reference_path(backwards)
