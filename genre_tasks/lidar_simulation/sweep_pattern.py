"""The rays of a recorded sweep, as the sensor sent them: also those from which nothing came back."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from genre_tasks.lidar_simulation.sensor import LidarSensor
from genre_tasks.logs.types import Float64
from genre_tasks.stages.ingest_points import EGO_BOX_M

NO_RING = -1

_RING_BIN_RAD = np.radians(0.02)
_RING_DISTANCE_RAD = np.radians(0.14)
_RING_FRACTION = 0.0005
_RING_RANGE_M = 3.0

STEEP_RAD = np.radians(12.0)
"""A ray so far below the horizon meets the road within ten metres, and a road so near always answers: where nothing
came back the vehicle itself is in the way."""


@dataclass(frozen=True)
class SweepPattern:
    """N rays of a sweep.

    Attributes:
        sensor: that sent them.
        directions: [N, 3] float64 unit vectors in ego axes, at the moment of each ray.
        times_s: [N] float64 since the frame's time.
        ring: [N] int64 beam from the lowest up; ``NO_RING`` where the sensor does not spin.
        range_m: [N] float64 as recorded; NaN where nothing came back.
        intensity: [N] float64 in [0, 1] as recorded; NaN where nothing came back.
    """

    sensor: LidarSensor
    directions: Float64
    times_s: Float64
    ring: NDArray[np.int64]
    range_m: Float64
    intensity: Float64

    def __len__(self) -> int:
        return len(self.directions)


def build_pattern(points: Float64, times_s: Float64, intensity: Float64, sensor: LidarSensor) -> SweepPattern:
    """Builds the pattern of a recorded sweep.

    A spinning sensor's beams fire at even steps of time. Where a beam's returns are farther apart than a step, rays
    are added that had no return, as those into the sky.

    Args:
        points: [N, 3] metres in ego axes, as of ``to_ego_axes``.
        times_s: [N] since the frame's time.
        intensity: [N] in [0, 1].
        sensor: where the sensor is, and how it turns.

    Returns:
        Rays of the returns, and behind them the ones without.
    """
    offset = points - sensor.position_m
    range_m = np.linalg.norm(offset, axis=1)
    # Rays that meet the vehicle itself say nothing about the scene, which has no such vehicle.
    usable = (range_m > 0) & ~(np.abs(points) < np.array(EGO_BOX_M)).all(1)
    directions = offset[usable] / range_m[usable, None]
    returned = SweepPattern(
        sensor=sensor,
        directions=directions,
        times_s=times_s[usable],
        ring=np.full(int(usable.sum()), NO_RING, np.int64),
        range_m=range_m[usable],
        intensity=intensity[usable],
    )
    if not sensor.turn_rad_s or not len(directions):
        return returned
    return _add_missing_rays(returned)


def _add_missing_rays(returned: SweepPattern) -> SweepPattern:
    sensor = returned.sensor
    seen = returned.directions @ sensor.axes
    elevation = np.arcsin(seen[:, 2].clip(-1, 1))
    phase = np.arctan2(seen[:, 1], seen[:, 0]) - sensor.turn_rad_s * returned.times_s
    ring, levels = find_rings(elevation, returned.range_m)
    times = []
    azimuths = []
    rings = []
    bounds = (returned.times_s.min(), returned.times_s.max())
    for k, level in enumerate(levels):
        if level < -STEEP_RAD:
            continue
        of_ring = ring == k
        missing = _find_missing_times(np.sort(returned.times_s[of_ring]), bounds, sensor.turn_rad_s)
        # The mean as a vector, since phases wrap around.
        mean_phase = np.angle(np.exp(1j * phase[of_ring]).mean())
        times.append(missing)
        azimuths.append(mean_phase + sensor.turn_rad_s * missing)
        rings.append(np.full(len(missing), k, np.int64))
    if not times:
        return replace(returned, ring=ring)
    azimuth = np.concatenate(azimuths)
    added_ring = np.concatenate(rings)
    upward = levels[added_ring]
    flat = np.cos(upward)
    in_sensor = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(upward)], 1)
    nothing = np.full(len(azimuth), np.nan)
    return SweepPattern(
        sensor=sensor,
        directions=np.concatenate([returned.directions, in_sensor @ sensor.axes.T]),
        times_s=np.concatenate([returned.times_s, *times]),
        ring=np.concatenate([ring, added_ring]),
        range_m=np.concatenate([returned.range_m, nothing]),
        intensity=np.concatenate([returned.intensity, nothing]),
    )


def find_rings(elevation: Float64, range_m: Float64) -> tuple[NDArray[np.int64], Float64]:
    """Finds the beams of a sensor by the peaks of its returns' elevations.

    Args:
        elevation: [N] radians about the sensor's axis.
        range_m: [N] metres; near returns, whose elevations errors of the sensor's height blur, do not count.

    Returns:
        The beam of each return [N], and the beams' elevations [R] in radians, lowest first.
    """
    sharp = elevation[range_m > _RING_RANGE_M]
    if not len(sharp):
        sharp = elevation
    lowest = sharp.min() - 2 * _RING_BIN_RAD
    counts = np.bincount(((sharp - lowest) / _RING_BIN_RAD).astype(np.int64), minlength=5).astype(np.float64)
    smooth = np.convolve(counts, [0.25, 0.5, 0.25], mode="same")
    reach = round(_RING_DISTANCE_RAD / _RING_BIN_RAD)
    padded = np.pad(smooth, reach)
    highest = np.stack([padded[k : k + len(smooth)] for k in range(2 * reach + 1)]).max(0)
    peaks = np.flatnonzero((smooth == highest) & (smooth > _RING_FRACTION * len(sharp)))
    levels = lowest + (peaks + 0.5) * _RING_BIN_RAD
    # By the middle between two beams.
    ring = np.searchsorted((levels[1:] + levels[:-1]) / 2, elevation)
    known = [k for k in range(len(levels)) if (ring == k).any()]
    renumbered = np.searchsorted(known, ring)
    return renumbered, np.array([np.median(elevation[ring == k]) for k in known])


def _find_missing_times(times_s: Float64, bounds: tuple[float, float], turn_rad_s: float) -> Float64:
    """Moments within the bounds at which a beam fired and nothing came back."""
    if len(times_s) < 3:
        return np.zeros(0)
    gaps = np.diff(times_s)
    step = float(np.median(gaps))
    # Returns at one moment have no step between them; a turn has at least some rays.
    if step <= 0 or step * abs(turn_rad_s) > np.radians(5):
        return np.zeros(0)
    # The ends of the sweep, too: a beam whose first or last returns are missing.
    first = np.arange(times_s[0] - step, bounds[0], -step)
    last = np.arange(times_s[-1] + step, bounds[1], step)
    parts = [first, last]
    for k in np.flatnonzero(gaps > 1.5 * step):
        count = round(gaps[k] / step)
        parts.append(times_s[k] + gaps[k] * np.arange(1, count) / count)
    return np.concatenate(parts)
