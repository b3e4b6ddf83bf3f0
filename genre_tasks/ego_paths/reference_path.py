"""The reference of other behaviours: the recorded path as a smooth curve over arc length."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.smoothing import fit_smooth_curve
from genre_tasks.errors import InputError
from genre_tasks.logs.types import Float64

SMOOTHING_S = 0.15
"""Motion of a shorter period than 2π times this (0.9 s) counts as jitter of the recording. A car's lateral motion is
slower; centimetres of jitter at 10 Hz would otherwise be accelerations of several m/s²."""

_SMOOTHING_M = 1.5
# A fast vehicle leaves few samples in a metre, and turns gently.
_SMOOTHING_S_OF_SHAPE = 0.25
# Below this speed a vehicle stands, and jitter of centimetres is no driving.
_STANDING_M_S = 0.05
STRAIGHT_M = 1.0
"""A vehicle that drives less than this drives straight on: jitter of a centimetre alone would bend the path by more
than a car can steer."""

# Jitter alone comes to a good part of this.
_STANDING_M = 0.25

_DENSE_S = 0.02
_TABLE_STEP_M = 0.1
# Over so many seconds the curvature fades past the last recorded pose: at once would be an endless jerk.
_FADE_S = 1.5
_FADE_M = 5.0
# Metres over which the slope of the road at the end of the recording is measured.
_SLOPE_M = 5.0
# So much nearer, per metre along the path, another branch of a path that crosses itself has to be.
_EXPECTED_WEIGHT = 0.05
# Positions that are compared with the whole reference at a time.
_BLOCK = 256


@dataclass(frozen=True)
class ReferencePoints:
    """Places along the reference.

    Attributes:
        position_m: [N, 3] world.
        heading_rad: [N] direction of driving, counted from the world's x towards y.
        curvature_1_m: [N] change of heading over arc length; to the left is positive.
        curvature_change_1_m2: [N] change of the curvature over arc length.
        attitude_rad: [N, 3] rotation vectors of the vehicle against its direction of driving: roll, pitch, and how far
            its axes are turned away from it.
    """

    position_m: Float64
    heading_rad: Float64
    curvature_1_m: Float64
    curvature_change_1_m2: Float64
    attitude_rad: Float64


class ReferencePath:
    """The recorded path as a smooth curve, which goes on straight past the last recorded pose.

    Args:
        times_s: [T] seconds, dense.
        distances_m: [T] arc length that the recorded vehicle has driven by then.
        arc_m: [S] arc length of the table, from 0, rising.
        table: [S, 8]: position, heading, curvature, rotation vector.
    """

    def __init__(self, times_s: Float64, distances_m: Float64, arc_m: Float64, table: Float64) -> None:
        self.length_m = float(distances_m[-1])
        self.duration_s = float(times_s[-1])
        # A cubic keeps the third derivative of what is planned along it free of steps.
        self._table = CubicSpline(arc_m, table)
        self._arc_end_m = float(arc_m[-1])
        self._distance = CubicSpline(times_s, distances_m) if len(times_s) > 1 else None

    def sample(self, arc_m: Float64) -> ReferencePoints:
        """Finds places along the reference.

        Args:
            arc_m: [N] metres from the first recorded pose, not negative.

        Returns:
            The places; past the last recorded pose the curvature fades to 0.
        """
        inside = np.minimum(arc_m, self._arc_end_m)
        values = self._table(inside)
        heading = values[:, 3]
        ahead = (arc_m - inside)[:, None]
        straight = np.stack([np.cos(heading), np.sin(heading), np.zeros_like(heading)], axis=1)
        return ReferencePoints(
            position_m=values[:, :3] + ahead * straight,
            heading_rad=heading,
            curvature_1_m=values[:, 4],
            curvature_change_1_m2=self._table(inside, nu=1)[:, 4],
            attitude_rad=values[:, 5:],
        )

    def project(self, position_m: Float64, expected_m: Float64) -> tuple[Float64, Float64]:
        """Finds the nearest place of the reference, or of the straight lines that it goes on in at both ends.

        Args:
            position_m: [N, 2] world x and y.
            expected_m: [N] arc length where the place is expected: it decides where a path crosses itself.

        Returns:
            Arc length [N], negative before the first recorded pose, and distance to the left [N], metres.
        """
        arcs = self._table.x
        places = self._table(arcs)[:, :2]
        nearest = np.empty(len(position_m))
        for start in range(0, len(position_m), _BLOCK):
            block = slice(start, start + _BLOCK)
            squared = np.square(position_m[block, None] - places).sum(-1)
            detour = _EXPECTED_WEIGHT * (arcs - expected_m[block, None])
            nearest[block] = arcs[np.argmin(squared + np.square(detour), axis=1)]
        arc = nearest
        # The table's place is a few centimetres off: along the reference, two steps of Newton's method are exact.
        for _ in range(2):
            along, left, curvature = self._measure_offset(position_m, np.clip(arc, 0.0, self._arc_end_m))
            arc = np.clip(arc, 0.0, self._arc_end_m) + along / np.maximum(1 - curvature * left, _EXPECTED_WEIGHT)
        ended = np.clip(arc, 0.0, self._arc_end_m)
        along, left, _ = self._measure_offset(position_m, ended)
        return np.where(ended == arc, arc, ended + along), left

    def _measure_offset(self, position_m: Float64, arc_m: Float64) -> tuple[Float64, Float64, Float64]:
        """How far ahead and to the left of places of the reference positions are, and the curvature there."""
        values = self._table(arc_m)
        offset = position_m - values[:, :2]
        cosine = np.cos(values[:, 3])
        sine = np.sin(values[:, 3])
        return cosine * offset[:, 0] + sine * offset[:, 1], cosine * offset[:, 1] - sine * offset[:, 0], values[:, 4]

    def locate(self, times_s: Float64) -> Float64:
        """Finds how far the recorded vehicle has driven.

        Args:
            times_s: [N] seconds since the first pose.

        Returns:
            [N] arc length, metres.
        """
        if self._distance is None:
            return np.zeros(len(times_s))
        return np.asarray(self._distance(np.clip(times_s, 0.0, self.duration_s)), np.float64)

    def measure_speed(self, times_s: Float64) -> Float64:
        """Measures how fast the recorded vehicle drives.

        Args:
            times_s: [N] seconds since the first pose.

        Returns:
            [N] m/s.
        """
        if self._distance is None:
            return np.zeros(len(times_s))
        return np.maximum(self._distance(np.clip(times_s, 0.0, self.duration_s), nu=1), 0.0)


def fit_reference_path(recorded: EgoPath) -> ReferencePath:
    """Fits a smooth curve to the recorded path.

    Recorded poses jitter by centimetres, which differences at 10 Hz would turn into absurd accelerations. So speed
    comes from a smooth curve over time, and the shape from one over arc length, which standstill does not disturb.

    Args:
        recorded: one pose for each log frame.

    Returns:
        The reference. That of a vehicle that stands goes straight on where the vehicle points.

    Raises:
        InputError: a path without frames, or a vehicle that drives backwards.
    """
    if not len(recorded):
        raise InputError("a path without frames: the recorded path has 0 poses", remedy="Take at least one chunk.")
    times = recorded.times_s - recorded.times_s[0]
    poses = recorded.world_SE3_ego
    if len(recorded) == 1:
        return _place_straight_reference(np.zeros(1), np.zeros(1), poses)
    dense, distances = _measure_distances(times, poses)
    if distances[-1] < STRAIGHT_M:
        return _place_straight_reference(dense, distances * (distances[-1] > _STANDING_M), poses)
    driven = np.interp(times, dense, distances)
    scale = choose_smoothing_m(np.gradient(distances, dense))
    curve = fit_smooth_curve(driven, poses[:, :3, 3], scale)
    grid = np.linspace(0.0, distances[-1], max(8, round(distances[-1] / _TABLE_STEP_M)) + 1)
    velocity = curve.evaluate(grid, 1)
    change = curve.evaluate(grid, 2)
    norm = np.hypot(velocity[:, 0], velocity[:, 1])
    heading = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
    curvature = (velocity[:, 0] * change[:, 1] - velocity[:, 1] * change[:, 0]) / norm**3
    turned = _turn_back(poses[:, :3, :3], np.interp(driven, grid, heading))
    rotation = fit_smooth_curve(driven, turned, scale).evaluate(grid)
    # Arc length of the curve itself: smoothing has shortened what jitter had made longer.
    arc = np.concatenate([[0.0], np.cumsum(0.5 * (norm[1:] + norm[:-1]) * np.diff(grid))])
    table = np.column_stack([curve.evaluate(grid), heading, curvature, rotation])
    distances = np.interp(distances, grid, arc)
    speed = (distances[-1] - distances[-2]) / (dense[-1] - dense[-2])
    arc, table = _extend_straight(arc, table, max(_FADE_M, _FADE_S * speed))
    return ReferencePath(dense, distances, arc, table)


def drives_backwards(recorded: EgoPath) -> bool:
    """Tells whether a vehicle reverses further than it drives forwards.

    Args:
        recorded: one pose for each log frame.

    Returns:
        Whether ``fit_reference_path`` refuses it; false for fewer than two poses.
    """
    if len(recorded) < 2:
        return False
    dense, speed = _measure_forward_speed(recorded.times_s - recorded.times_s[0], recorded.world_SE3_ego)
    return _measure_backwards(dense, speed) > 0


def choose_smoothing_m(speed_m_s: Float64) -> float:
    """Chooses how smooth the shape of a path is.

    Args:
        speed_m_s: [T] along it.

    Returns:
        The scale of ``fit_smooth_curve`` over arc length, metres.
    """
    return max(_SMOOTHING_M, _SMOOTHING_S_OF_SHAPE * float(speed_m_s.max()))


def integrate_speed(times_s: Float64, speed_m_s: Float64) -> Float64:
    """Integrates a smooth speed; what is slower than jitter counts as standing.

    Args:
        times_s: [T] dense.
        speed_m_s: [T]; negative counts as 0.

    Returns:
        [T] metres driven by then.
    """
    # Fades out below the speed of standing, rather than ending there with a step.
    driving = np.maximum(speed_m_s, 0.0)
    driving = driving**3 / (driving**2 + _STANDING_M_S**2)
    steps = 0.5 * (driving[1:] + driving[:-1]) * np.diff(times_s)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _measure_distances(times: Float64, poses: Float64) -> tuple[Float64, Float64]:
    """Dense times and the metres driven by then."""
    dense, speed = _measure_forward_speed(times, poses)
    backwards_m = _measure_backwards(dense, speed)
    if backwards_m:
        problem = f"the recorded vehicle drives backwards, {backwards_m:.1f} m"
        raise InputError(problem, remedy="Behaviours are for vehicles that drive forwards: take other chunks.")
    return dense, integrate_speed(dense, speed)


def _measure_forward_speed(times: Float64, poses: Float64) -> tuple[Float64, Float64]:
    """Dense times and the speed in the direction that the vehicle faces, negative where it reverses."""
    curve = fit_smooth_curve(times, poses[:, :2, 3], SMOOTHING_S)
    dense = np.linspace(0.0, times[-1], max(2, round(times[-1] / _DENSE_S) + 1))
    velocity = curve.evaluate(dense, 1)
    forward = np.stack([np.interp(dense, times, poses[:, k, 0]) for k in (0, 1)], axis=1)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    return dense, np.einsum("tk,tk->t", velocity, forward)


def _measure_backwards(times: Float64, speed_m_s: Float64) -> float:
    """Metres in reverse where a vehicle reverses further than it drives forwards, else 0."""
    backwards_m = float(np.trapezoid(np.maximum(-speed_m_s, 0.0), times))
    if backwards_m > _STANDING_M and backwards_m > np.trapezoid(np.maximum(speed_m_s, 0.0), times):
        return backwards_m
    return 0.0


def _turn_back(rotations: Float64, heading: Float64) -> Float64:
    """Rotation vectors [N, 3] of recorded rotations against the direction of driving."""
    about_z = np.zeros((len(heading), 3))
    about_z[:, 2] = -heading
    return np.asarray((Rotation.from_rotvec(about_z) * Rotation.from_matrix(rotations)).as_rotvec(), np.float64)


def _place_straight_reference(times: Float64, distances: Float64, poses: Float64) -> ReferencePath:
    """A straight line from where the vehicle starts, to where it points."""
    position = poses[0, :3, 3]
    forward = poses[:, :2, 0].mean(0)
    heading = float(np.arctan2(forward[1], forward[0]))
    rotation = _turn_back(poses[:, :3, :3], np.full(len(poses), heading)).mean(0)
    arc = np.linspace(0.0, _FADE_M, 9)
    table = np.tile(np.concatenate([position, [heading, 0.0], rotation]), (len(arc), 1))
    table[:, 0] += arc * np.cos(heading)
    table[:, 1] += arc * np.sin(heading)
    return ReferencePath(times, distances, arc, table)


def _extend_straight(arc: Float64, table: Float64, fade_m: float) -> tuple[Float64, Float64]:
    """Adds a stretch whose curvature fades to 0."""
    ahead = np.linspace(0.0, fade_m, max(8, round(fade_m / _TABLE_STEP_M)) + 1)
    step = ahead[1] - ahead[0]
    u = ahead / fade_m
    curvature = table[-1, 4] * (1 - u**2 * (3 - 2 * u))
    heading = table[-1, 3] + np.concatenate([[0.0], np.cumsum(0.5 * (curvature[1:] + curvature[:-1]) * step)])
    first = int(np.searchsorted(arc, arc[-1] - _SLOPE_M))
    slope = (table[-1, 2] - table[first, 2]) / (arc[-1] - arc[first])
    added = np.repeat(table[-1:], len(ahead), axis=0)
    for column, rate in ((0, np.cos(heading)), (1, np.sin(heading))):
        added[1:, column] += np.cumsum(0.5 * (rate[1:] + rate[:-1]) * step)
    # The road goes on for a while as it was, and is level in the end: a slope over many metres would leave the ground.
    added[:, 2] += slope * (ahead - ahead**2 / (2 * fade_m))
    added[:, 3] = heading
    added[:, 4] = curvature
    return np.concatenate([arc, arc[-1] + ahead[1:]]), np.concatenate([table, added[1:]])
