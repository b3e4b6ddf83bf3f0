"""Finds where a LiDAR sits on the vehicle: a spinning one by what its returns have in common, others as the log says.

Logs state the pose of the vehicle, and not all say where on it the LiDAR is. Where it spins, a beam's azimuth about
the sensor's axis rises evenly with time, and its elevation stays the same: seen from anywhere else, neither does. So
the position is the one from which azimuths and elevations are sharpest, measured by the entropy of their histograms.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from genre_tasks.lidar_simulation.ego_motion import interpolate_poses
from genre_tasks.logs.types import Float64, Sweep

SAMPLE_RANGE_M = (2.0, 40.0)
"""Nearer returns are of the vehicle itself; farther ones say little about where the sensor is."""

MIN_SHARPNESS = 0.7
"""Nats by which the entropy of azimuths has to fall short of an even spread, for the sensor to count as spinning."""

_SAMPLES = 8000
_FORWARD_M = np.arange(-2.0, 3.05, 0.1)
_LEFT_M = np.arange(-1.0, 1.05, 0.1)
_HEIGHT_M = np.arange(0.0, 3.05, 0.1)
_TILT_RAD = np.radians(np.arange(-2.0, 2.1, 0.5))
_AZIMUTH_BIN_RAD = np.radians(0.25)
_FINE_BIN_RAD = np.radians(0.05)
_REFINING_BINS_DEG = (0.1, 0.05, 0.03)
_REFINED_HEIGHTS = 6


@dataclass(frozen=True)
class LidarSensor:
    """A LiDAR on the vehicle.

    Attributes:
        position_m: [3] in ego axes.
        axes: [3, 3] takes the sensor's axes to the ego vehicle's; the last column is the axis that it turns about.
        turn_rad_s: how fast azimuths rise; negative for a sensor that turns clockwise; 0: it does not spin, or its
            sweeps do not say so.
        is_assumed: nothing says where the sensor is, and ``position_m`` is the ego vehicle's origin.
    """

    position_m: Float64
    axes: Float64
    turn_rad_s: float
    is_assumed: bool = False


def to_ego_axes(sweep: Sweep, frame_times_s: Float64, world_SE3_ego: Float64) -> Float64:
    """Takes a sweep's points to the ego vehicle's axes, where it is at the moment of each.

    Args:
        sweep: in world coordinates.
        frame_times_s: [F] of the log.
        world_SE3_ego: [F, 4, 4] at these times.

    Returns:
        [N, 3] metres.
    """
    pose = interpolate_poses(world_SE3_ego, frame_times_s, sweep.timestamps_s)
    return np.asarray(np.einsum("nij,ni->nj", pose[:, :3, :3], sweep.points_world - pose[:, :3, 3]))


def estimate_sensor(points: Float64, times_s: Float64, frame_s: float, stated_m: Float64 | None = None) -> LidarSensor:
    """Estimates where a LiDAR is.

    Args:
        points: [N, 3] metres in ego axes, as of :func:`to_ego_axes`.
        times_s: [N] when each was measured.
        frame_s: seconds of a log frame, in which a spinning LiDAR turns once.
        stated_m: [3] where the log says that it is, in ego axes, for sweeps that do not show a spin; ``None``: nowhere.

    Returns:
        The sensor.
    """
    # Many datasets state one time for all points of a sweep, which hides the spin.
    position_m = np.zeros(3) if stated_m is None else stated_m
    still = LidarSensor(position_m, np.eye(3), 0.0, is_assumed=stated_m is None)
    distance = np.linalg.norm(points, axis=1)
    rows = np.flatnonzero((distance > SAMPLE_RANGE_M[0]) & (distance < SAMPLE_RANGE_M[1]))
    if len(rows) < 100 or np.ptp(times_s) <= 0:
        return still
    rows = rows[:: max(len(rows) // _SAMPLES, 1)]
    points = points[rows]
    times_s = times_s[rows] - times_s[rows].mean()
    turns = [sign * 2 * np.pi / frame_s for sign in (-1, 1)]
    found = [(*_find_axis(points, turn * times_s, _FORWARD_M, _LEFT_M, _AZIMUTH_BIN_RAD), turn) for turn in turns]
    entropy, x, y, turn = min(found)
    if np.log(2 * np.pi / _AZIMUTH_BIN_RAD) - entropy < MIN_SHARPNESS:
        return still
    around = np.arange(-0.1, 0.105, 0.01)
    _, x, y = _find_axis(points, turn * times_s, x + around, y + around, _FINE_BIN_RAD)
    z, roll, pitch = _find_height(points - np.array([x, y, 0.0]))
    return LidarSensor(np.array([x, y, z]), _tilt(roll, pitch), turn)


def _find_axis(
    points: Float64, turned: Float64, forward_m: Float64, left_m: Float64, bin_rad: float
) -> tuple[float, float, float]:
    """Entropy and position at which azimuths follow the turn most evenly."""
    best = (np.inf, 0.0, 0.0)
    for x, y in itertools.product(forward_m, left_m):
        residual = np.arctan2(points[:, 1] - y, points[:, 0] - x) - turned
        best = min(best, (_measure_entropy(residual % (2 * np.pi), bin_rad), float(x), float(y)))
    return best


def _find_height(points: Float64) -> tuple[float, float, float]:
    """Height, roll and pitch at which elevations are sharpest."""
    from scipy.optimize import minimize

    def measure(values: Float64, bin_rad: float) -> float:
        seen = (points - np.array([0.0, 0.0, values[0]])) @ _tilt(values[1], values[2])
        elevation = np.arctan2(seen[:, 2], np.hypot(seen[:, 0], seen[:, 1]))
        return _measure_entropy(elevation + np.pi, bin_rad)

    def refine(best: Float64) -> tuple[float, tuple[float, ...]]:
        # Finer and finer: a fine histogram alone is flat away from the solution.
        for bin_deg in _REFINING_BINS_DEG:
            simplex = best + np.vstack([np.zeros(3), steps * bin_deg / _REFINING_BINS_DEG[0]])
            options = {"maxiter": 200, "initial_simplex": simplex}
            best = minimize(measure, best, (np.radians(bin_deg),), method="Nelder-Mead", options=options).x
        return measure(best, np.radians(_REFINING_BINS_DEG[-1])), tuple(best.tolist())

    steps = np.diag([0.1, 0.005, 0.005])
    coarse_bin = np.radians(_REFINING_BINS_DEG[0])
    tilts = list(itertools.product(_TILT_RAD, _TILT_RAD))
    by_height = [min((measure(np.array([z, *tilt]), coarse_bin), z, *tilt) for tilt in tilts) for z in _HEIGHT_M]
    entropies = np.pad([entry[0] for entry in by_height], 1, constant_values=np.inf)
    is_low = (entropies[1:-1] <= entropies[:-2]) & (entropies[1:-1] <= entropies[2:])
    # From a place on a flat road all its returns are at one elevation, which is a minimum too. It is as low as the
    # right one while heights are coarse, and only fine histograms tell the two apart.
    lowest = sorted(itertools.compress(by_height, is_low))[:_REFINED_HEIGHTS]
    _, (z, roll, pitch) = min(refine(np.array(entry[1:])) for entry in lowest)
    return z, roll, pitch


def _tilt(roll: float, pitch: float) -> Float64:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_euler("xy", [roll, pitch]).as_matrix())


def _measure_entropy(values: Float64, width: float) -> float:
    counts = np.bincount((values / width).astype(np.int64))
    fraction = counts[counts > 0] / len(values)
    return float(-(fraction * np.log(fraction)).sum())
