"""Whether the ego vehicle moves as vehicles do: speed, jumps, heading, and poses that stand still while it drives."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from genre_tasks.log_checks.camera_poses import find_improper
from genre_tasks.log_checks.log_sample import LogSample
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.types import Camera, Float64

# 250 km/h: no recording vehicle is faster on a public road.
_MAX_SPEED_M_S = 70.0
# Full braking is 10 m/s², a kerb 15 m/s². At 10 Hz, the noise of positions to 5 cm looks like 12 m/s².
_MAX_ACCELERATION_M_S2 = 25.0
# Below that, an acceleration is noise of the positions at a high frame rate.
_MIN_JUMP_M = 0.25
# A swerve turns by 3 rad/s², a speed bump pitches by 8 rad/s².
_MAX_ANGULAR_ACCELERATION_RAD_S2 = 20.0
_MIN_JUMP_RAD = np.deg2rad(3.0)
# Slower than that, a direction of travel is noise.
_MIN_MOVING_M_S = 1.0
# From that speed no vehicle stops, and none reaches it, between two frames.
_MIN_FROZEN_M_S = 2.0
# A sensor over the front axle of a vehicle in a hairpin bend moves 30° off its heading.
_MAX_SLIP_DEG = 45.0
# Parking is slower: nobody reverses a chunk through at such a speed.
_MAX_REVERSE_M_S = 4.0
# No road banks or climbs so far; a pose beyond is of other axes.
_MAX_TILT_DEG = 45.0
# Poses of a standing vehicle differ by less: by nothing, or by the noise of its positioning.
_STANDING_M = 0.05
# Fraction of an image's pixels that change: traffic that passes a standing vehicle gives 0.2, 3 m of travel 0.4.
_MAX_STANDING_CHANGE = 0.35
# Grey levels: less is noise, or how an image was compressed.
_MIN_CHANGE = 8.0
_IMAGE_WIDTH_PX = 64
_FROZEN_REMEDY = "Export the pose of every frame at its own time."
_AXES = ("forward (x)", "left (y)", "up (z)")
_UNIT_REMEDY = "Check the unit of poses and times: write metres and seconds, or what the format of the log prescribes."
_AXES_REMEDY = "Poses must take x forward, y left, z up to a world whose z is up: check axes and quaternion order."


def find_implausible_motion(sample: LogSample) -> Iterator[Finding]:
    """Finds steps between frames that no vehicle drives, and poses that cannot be a vehicle's.

    Args:
        sample: the frames of a chunk.

    Yields:
        ``improper_rotation``, ``tilted_pose``, ``implausible_speed``, ``position_jump``, ``rotation_jump``,
        ``odd_travel_direction`` or ``frozen_pose``.
    """
    improper = find_improper(sample.world_SE3_lidar)
    if improper.size:
        message = "the axes of the LiDAR's pose are mirrored, scaled or not at right angles"
        frames = _frames(sample, improper)
        # Everything else takes poses for rigid.
        yield Finding("improper_rotation", "fatal", message, _AXES_REMEDY, frames=frames)
        return
    yield from _judge_tilt(sample)
    yield from _judge_speed(sample)
    yield from _judge_jumps(sample)
    yield from _judge_direction(sample)
    yield from _judge_repetitions(sample)
    yield from _judge_standstill(sample)


def _speeds(sample: LogSample) -> Float64:
    """[F - 1] speeds of the steps between frames in m/s, NaN where time does not advance."""
    lengths = np.linalg.norm(np.diff(sample.world_SE3_lidar[:, :3, 3], axis=0), axis=1)
    periods = np.diff(sample.times_s)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(periods > 0, lengths / periods, np.nan)


def _judge_tilt(sample: LogSample) -> Iterator[Finding]:
    upward = sample.world_SE3_lidar[:, 2, 2]
    # All comparisons are false for poses that cannot be read.
    tilted = np.flatnonzero(upward < np.cos(np.deg2rad(_MAX_TILT_DEG)))
    if tilted.size:
        largest = float(np.degrees(np.arccos(np.clip(np.nanmin(upward), -1, 1))))
        message = f"the ego vehicle is tilted by {largest:.0f}° at {tilted.size} of {upward.size} frames"
        numbers = {"tilt_deg": largest, "limit_deg": _MAX_TILT_DEG}
        yield Finding("tilted_pose", "warning", message, _AXES_REMEDY, numbers, frames=_frames(sample, tilted))


def _judge_speed(sample: LogSample) -> Iterator[Finding]:
    speeds = _speeds(sample)
    fast = np.flatnonzero(speeds > _MAX_SPEED_M_S)
    if fast.size:
        fastest = float(np.nanmax(speeds))
        message = (
            f"the ego vehicle moves at {fastest:.0f} m/s in {fast.size} of {speeds.size} steps; "
            f"{_MAX_SPEED_M_S:.0f} m/s is plausible at most"
        )
        numbers = {"speed_m_s": fastest, "limit_m_s": _MAX_SPEED_M_S}
        yield Finding("implausible_speed", "warning", message, _UNIT_REMEDY, numbers, frames=_frames(sample, fast + 1))


def _judge_jumps(sample: LogSample) -> Iterator[Finding]:
    """Findings where one frame lies off the straight and even motion from the one before to the one after."""
    if len(sample.frames) < 3:
        return
    before_s = np.diff(sample.times_s)[:-1]
    after_s = np.diff(sample.times_s)[1:]
    # Jumps across a fault of the clock are not the path's.
    valid = (before_s > 0) & (after_s > 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        weight = np.where(valid, before_s / (before_s + after_s), np.nan)
        # x_k - lerp(x_(k-1), x_(k+1)) of a constant acceleration a is a * before * after / 2.
        to_acceleration = np.where(valid, 2 / (before_s * after_s), np.nan)
    yield from _judge_position_jumps(sample, weight, to_acceleration)
    yield from _judge_rotation_jumps(sample, weight, to_acceleration)


def _judge_position_jumps(sample: LogSample, weight: Float64, to_acceleration: Float64) -> Iterator[Finding]:
    positions = sample.world_SE3_lidar[:, :3, 3]
    expected = positions[:-2] + weight[:, None] * (positions[2:] - positions[:-2])
    offsets_m = np.linalg.norm(positions[1:-1] - expected, axis=1)
    accelerations = offsets_m * to_acceleration
    jumps = np.flatnonzero((offsets_m > _MIN_JUMP_M) & (accelerations > _MAX_ACCELERATION_M_S2))
    if jumps.size:
        largest = int(jumps[offsets_m[jumps].argmax()])
        message = (
            f"the path jumps at {jumps.size} frames: frame {sample.frames[largest + 1]} is {offsets_m[largest]:.2f} m "
            f"off its neighbours ({accelerations[largest]:.0f} m/s², {_MAX_ACCELERATION_M_S2:.0f} m/s² is plausible)"
        )
        remedy = "Smooth the poses, check them against the times of the frames, or leave the chunk out with --chunks."
        numbers = {
            "jump_m": float(offsets_m[largest]),
            "acceleration_m_s2": float(accelerations[largest]),
            "limit_m_s2": _MAX_ACCELERATION_M_S2,
        }
        yield Finding("position_jump", "warning", message, remedy, numbers, frames=_frames(sample, jumps + 1))


def _judge_rotation_jumps(sample: LogSample, weight: Float64, to_acceleration: Float64) -> Iterator[Finding]:
    poses = sample.world_SE3_lidar
    turns = np.stack([_rotation_vector(a[:3, :3], b[:3, :3]) for a, b in pairwise(poses)])
    # Turns of one step are small, and small turns add up like vectors.
    offsets_rad = np.linalg.norm((1 - weight)[:, None] * turns[:-1] - weight[:, None] * turns[1:], axis=1)
    accelerations = offsets_rad * to_acceleration
    jumps = np.flatnonzero((offsets_rad > _MIN_JUMP_RAD) & (accelerations > _MAX_ANGULAR_ACCELERATION_RAD_S2))
    if jumps.size:
        largest = int(jumps[offsets_rad[jumps].argmax()])
        degrees = float(np.degrees(offsets_rad[largest]))
        message = (
            f"the heading jumps at {jumps.size} frames: frame {sample.frames[largest + 1]} is {degrees:.1f}° off "
            f"its neighbours ({accelerations[largest]:.0f} rad/s², {_MAX_ANGULAR_ACCELERATION_RAD_S2:.0f} is plausible)"
        )
        remedy = "Check the quaternions (order w, x, y, z), smooth the poses, or leave the chunk out with --chunks."
        numbers = {
            "turn_deg": degrees,
            "acceleration_rad_s2": float(accelerations[largest]),
            "limit_rad_s2": _MAX_ANGULAR_ACCELERATION_RAD_S2,
        }
        yield Finding("rotation_jump", "warning", message, remedy, numbers, frames=_frames(sample, jumps + 1))


def _rotation_vector(from_rotation: Float64, to_rotation: Float64) -> Float64:
    """[3] axis times angle of the turn from one orientation to another, in the axes of the first."""
    from scipy.spatial.transform import Rotation

    turn = from_rotation.T @ to_rotation
    vector: Float64 = Rotation.from_matrix(turn).as_rotvec() if np.isfinite(turn).all() else np.full(3, np.nan)
    return vector


def _judge_direction(sample: LogSample) -> Iterator[Finding]:
    """A finding where the vehicle does not travel along its x axis."""
    poses = sample.world_SE3_lidar
    speeds = _speeds(sample)
    moving = np.flatnonzero(speeds > _MIN_MOVING_M_S)
    if moving.size == 0:
        return
    steps = np.diff(poses[:, :3, 3], axis=0)[moving]
    # From the heading half-way: in a bend, that is the direction of the chord.
    headings = poses[moving, :3, :3] + poses[moving + 1, :3, :3]
    along = np.einsum("sij,si->sj", headings, steps)
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    # The middle one of many steps: single jumps are another finding.
    direction = np.median(along, axis=0)
    angle_deg = float(np.degrees(np.arctan2(np.linalg.norm(direction[1:]), direction[0])))
    speed = float(np.median(speeds[moving]))
    is_reversing = angle_deg > 180 - _MAX_SLIP_DEG and speed < _MAX_REVERSE_M_S
    if angle_deg <= _MAX_SLIP_DEG or is_reversing:
        return
    axis = int(np.abs(direction).argmax())
    name = _AXES[axis] if direction[axis] > 0 else f"minus {_AXES[axis]}"
    message = (
        f"the ego vehicle drives along its axis {name}, {angle_deg:.0f}° off its heading, at {speed:.1f} m/s; "
        f"{_MAX_SLIP_DEG:.0f}° are plausible at most"
    )
    numbers = {"angle_deg": angle_deg, "limit_deg": _MAX_SLIP_DEG, "speed_m_s": speed}
    yield Finding("odd_travel_direction", "warning", message, _AXES_REMEDY, numbers)


def _judge_repetitions(sample: LogSample) -> Iterator[Finding]:
    """A finding where a pose is repeated exactly while the vehicle moves right before and after."""
    poses = sample.world_SE3_lidar
    speeds = _speeds(sample)
    repeated = (poses[1:] == poses[:-1]).all(axis=(1, 2))
    # Of every step, the speed of the last step with another pose before it, and of the next one after it.
    changing = np.flatnonzero(~repeated)
    if changing.size < 2 or not repeated.any():
        return
    after = np.searchsorted(changing, np.flatnonzero(repeated))
    inside = (after > 0) & (after < changing.size)
    steps = np.flatnonzero(repeated)[inside]
    after = after[inside]
    moving = (speeds[changing[after - 1]] > _MIN_FROZEN_M_S) & (speeds[changing[after]] > _MIN_FROZEN_M_S)
    frozen = steps[moving]
    if frozen.size:
        message = f"the pose is that of the frame before at {frozen.size} frames, while the vehicle moves around them"
        numbers = {"frames": float(frozen.size), "limit_m_s": _MIN_FROZEN_M_S}
        yield Finding("frozen_pose", "warning", message, _FROZEN_REMEDY, numbers, frames=_frames(sample, frozen + 1))


def _judge_standstill(sample: LogSample) -> Iterator[Finding]:
    """A finding where poses stay while images show that the vehicle moves."""
    positions = sample.world_SE3_lidar[:, :3, 3]
    finite = np.isfinite(positions).all(axis=1)
    if finite.sum() < 2 or np.ptp(positions[finite], axis=0).max() > _STANDING_M:
        return
    changes = [change for camera in sample.cameras for change in _image_change(sample, camera)]
    # In most cameras of a standing vehicle nothing moves; one may be filled by a passing bus.
    change = float(np.median(changes)) if changes else 0.0
    if change > _MAX_STANDING_CHANGE:
        message = (
            f"all poses are the same, but {100 * change:.0f} % of the pixels change from the first to the last frame; "
            f"{100 * _MAX_STANDING_CHANGE:.0f} % are plausible for a standing vehicle"
        )
        numbers = {"changed_percent": 100 * change, "limit_percent": 100 * _MAX_STANDING_CHANGE}
        yield Finding("frozen_pose", "warning", message, _FROZEN_REMEDY, numbers)


def _image_change(sample: LogSample, camera: Camera) -> Iterator[float]:
    """The fraction of pixels that change from the first to the last frame; nothing where an image cannot be read."""
    first = _grey(sample, camera, sample.frames[0])
    last = _grey(sample, camera, sample.frames[-1])
    if first is not None and last is not None:
        # What becomes brighter everywhere by one factor is the exposure, not the place.
        gain = float(np.median((last + 1) / (first + 1)))
        yield float((np.abs(last - gain * first) > _MIN_CHANGE).mean())


def _grey(sample: LogSample, camera: Camera, frame: int) -> Float64 | None:
    pixels = sample.pixels(camera, frame, min(_IMAGE_WIDTH_PX, camera.lens.width_px))
    return None if pixels is None else pixels.mean(axis=2)


def _frames(sample: LogSample, indices: NDArray[np.int64]) -> tuple[int, ...]:
    return tuple(sample.frames[int(index)] for index in indices)
