"""Where an edited actor is: its recorded path moved, turned, delayed or driven at another speed, on the ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from genre_tasks.ego_paths.frame_clock import FrameClock
from genre_tasks.logs.types import Float64
from genre_tasks.scene.actor_track import MOST_GAP_FRAMES
from genre_tasks.scene.transforms import interpolate_pose
from genre_tasks.scene_edits.edits import ActorChange
from genre_tasks.scene_edits.ground import Ground

STANDING_M_S = 0.3
"""A box that seems to be slower than this stands: annotations jitter by a few centimetres."""

_END_FRAMES = 5
"""The speed at an end of a path is the mean over so many frames."""

_FRAME_TOLERANCE = 1e-3
"""Fraction of a frame by which a delay may miss a frame's time and still meet it."""

_SMOOTH_FRAMES = 5
"""The correction by the ground is averaged over so many frames, so that the noise of its height moves nothing."""


@dataclass(frozen=True)
class Trajectory:
    """The path of a box in world coordinates.

    Attributes:
        frames: [F] log frames, rising.
        world_SE3_box: [F, 4, 4].
        shape_frames: [F] moments of the actor's recording whose shape it has then.
    """

    frames: NDArray[np.int64]
    world_SE3_box: Float64
    shape_frames: Float64

    def __len__(self) -> int:
        return len(self.frames)

    def select_frames(self, frames: tuple[int, ...]) -> Trajectory:
        """Cuts the path to some log frames.

        Args:
            frames: of a chunk.
        """
        inside = np.isin(self.frames, frames)
        return Trajectory(self.frames[inside], self.world_SE3_box[inside], self.shape_frames[inside])


@dataclass(frozen=True)
class _TimedPath:
    # Where a recorded box was by seconds [F], which rise, and not by frames: a frame after a pause lasts long.
    times_s: Float64
    world_SE3_box: Float64

    def pose_at(self, time_s: float) -> Float64:
        # Between the ends of the path.
        inside_s = min(max(time_s, self.times_s[0]), self.times_s[-1])
        after = int(np.searchsorted(self.times_s, inside_s))
        if self.times_s[after] == inside_s:
            return np.asarray(self.world_SE3_box[after], np.float64)
        before_s = float(self.times_s[after - 1])
        fraction = (inside_s - before_s) / (float(self.times_s[after]) - before_s)
        return interpolate_pose(self.world_SE3_box[after - 1], self.world_SE3_box[after], fraction)

    def extrapolate(self, time_s: float, pose: Float64) -> Float64:
        # Straight on from the pose at the end of the path that the time is past.
        excess_s = time_s - min(max(time_s, self.times_s[0]), self.times_s[-1])
        if not excess_s:
            return pose
        out = pose.copy()
        out[:2, 3] += excess_s * self.measure_end_speed(at_start=excess_s < 0) * _heading(pose)
        return out

    def measure_end_speed(self, at_start: bool) -> float:
        # Speed in the direction that the box faces, m/s; negative for one that drives back.
        count = min(_END_FRAMES, len(self.times_s) - 1)
        if not count:
            return 0.0
        a, b = (0, count) if at_start else (len(self.times_s) - 1 - count, len(self.times_s) - 1)
        step = self.world_SE3_box[b, :2, 3] - self.world_SE3_box[a, :2, 3]
        heading = _heading(self.world_SE3_box[a if at_start else b])
        speed = float(step @ heading) / float(self.times_s[b] - self.times_s[a])
        return speed if abs(speed) > STANDING_M_S else 0.0

    def measure_length(self) -> Float64:
        # Metres along the path at each pose; steps in which the box stands add nothing.
        steps = np.linalg.norm(np.diff(self.world_SE3_box[:, :2, 3], axis=0), axis=1)
        steps[steps < STANDING_M_S * np.diff(self.times_s)] = 0.0
        return np.concatenate([[0.0], np.cumsum(steps)])

    def scale_progress(self, times_s: Float64, factor: float) -> Float64:
        # The times of the recording at which the actor was as far along its path as it is now.
        length = self.measure_length()
        speeds = [self.measure_end_speed(at_start=start) for start in (True, False)]
        before = np.minimum(times_s - self.times_s[0], 0) * abs(speeds[0])
        after = np.maximum(times_s - self.times_s[-1], 0) * abs(speeds[1])
        progress = factor * (np.interp(times_s, self.times_s, length) + before + after)
        # Lengths must rise for the inverse: where the box stands, the last moment there is taken.
        rising = np.concatenate([np.diff(length) > 0, [True]])
        out = np.interp(progress, length[rising], self.times_s[rising])
        out += np.where(progress > length[-1], (progress - length[-1]) / max(abs(speeds[1]), 1e-9), 0.0)
        out = np.where((progress > length[-1]) & (speeds[1] == 0), self.times_s[-1], out)
        return np.where(progress < 0, self.times_s[0] + progress / max(abs(speeds[0]), 1e-9), out)


def change_trajectory(recorded: Trajectory, change: ActorChange, clock: FrameClock, ground: Ground) -> Trajectory:
    """Changes the path of an actor.

    With a delay an actor exists at its recorded frames and at the delayed ones. Before its path begins and after it
    ends the actor drives straight on; one that stands there stands. In long gaps of its recording it is absent. Delays
    and speeds count the seconds of pauses of the recording too.

    Args:
        recorded: at least one pose.
        change: what all edits of the actor come to.
        clock: of the run.
        ground: of the run.

    Returns:
        The new path; its frames are some of the run's.
    """
    timed = _TimedPath(clock.find_times(recorded.frames), recorded.world_SE3_box)
    frames = recorded.frames
    if change.delay_s:
        frames = _list_delayed_frames(recorded.frames, float(change.delay_s), clock)
    if change.keeps_motion:
        poses = recorded.world_SE3_box
        reference = poses
        moments = recorded.shape_frames
    else:
        times_s = clock.find_times(frames) - float(change.delay_s)
        if change.speed_factor != 1:
            times_s = timed.scale_progress(times_s, float(change.speed_factor))
        there = _find_recorded(clock.find_frames(times_s), recorded.frames)
        frames = frames[there]
        times_s = times_s[there]
        reference = np.stack([timed.pose_at(time_s) for time_s in times_s])
        poses = np.stack([timed.extrapolate(t, pose) for t, pose in zip(times_s, reference, strict=True)])
        # Frames are those of this run, and shapes those of the actor's recording: for an inserted actor they differ.
        moments = np.interp(clock.find_frames(times_s), recorded.frames, recorded.shape_frames)
    shift = np.array([float(change.forward_m), float(change.left_m), 0.0])
    moved = _shift_level(poses, shift)
    moved[:, :3, :3] = moved[:, :3, :3] @ Rotation.from_euler("z", float(change.turn_deg), degrees=True).as_matrix()
    moved = rest_on_ground(moved, reference, ground)
    moved[:, 2, 3] += float(change.up_m)
    return Trajectory(frames, moved, moments)


def rest_on_ground(poses: Float64, reference: Float64, ground: Ground) -> Float64:
    """Lifts and tilts boxes as the ground rises and tilts from where they were to where they are.

    What the box had under it in the recording stays: a correction by differences needs no exact height of the ground.

    Args:
        poses: [F, 4, 4] in world coordinates.
        reference: [F, 4, 4] where the boxes were in contact with the ground.
        ground: of the run.

    Returns:
        [F, 4, 4]; the very poses where a box has not moved.
    """
    moved = np.linalg.norm(poses[:, :2, 3] - reference[:, :2, 3], axis=1) > 1e-6
    out = poses.copy()
    if not moved.any():
        return out
    height, normal = ground.measure(poses[moved, :2, 3])
    height_before, normal_before = ground.measure(reference[moved, :2, 3])
    tilt = np.cross(normal_before, normal)
    lift = _smooth(np.concatenate([(height - height_before)[:, None], tilt], 1))
    for row, (rise, *turn) in zip(np.flatnonzero(moved), lift, strict=True):
        # The sine of the angle is the angle here: slopes of roads are small.
        out[row, :3, :3] = Rotation.from_rotvec(turn).as_matrix() @ poses[row, :3, :3]
        out[row, 2, 3] += rise
    return out


def measure_speed(trajectory: Trajectory, clock: FrameClock) -> float:
    """Measures the mean speed along a path.

    Args:
        trajectory: of a box.
        clock: of the run that the box was recorded in.

    Returns:
        m/s; 0 for a box that stands or has one pose.
    """
    timed = _TimedPath(clock.find_times(trajectory.frames), trajectory.world_SE3_box)
    span_s = float(timed.times_s[-1] - timed.times_s[0])
    return float(timed.measure_length()[-1]) / span_s if span_s else 0.0


def _list_delayed_frames(recorded: NDArray[np.int64], delay_s: float, clock: FrameClock) -> NDArray[np.int64]:
    """Frames of the run from the earlier one of the recorded and the delayed beginning to the later end."""
    begin_s, end_s = clock.find_times([recorded[0], recorded[-1]]) + delay_s
    # A delay that is no multiple of a frame begins and ends between two frames, and both are taken. Slightly less than
    # a frame, since its length is measured: four frames are not to be 4.000001.
    margin_s = (1 - _FRAME_TOLERANCE) * clock.frame_s
    is_after = (clock.frames >= recorded[0]) | (clock.times_s > begin_s - margin_s)
    is_before = (clock.frames <= recorded[-1]) | (clock.times_s < end_s + margin_s)
    return clock.frames[is_after & is_before].astype(np.int64)


def _find_recorded(moments: Float64, recorded: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which moments lie in no gap of the recorded frames that is too long to be bridged."""
    after = np.searchsorted(recorded, moments)
    low = recorded[(after - 1).clip(0)]
    high = recorded[after.clip(max=len(recorded) - 1)]
    # Beyond both ends the two are one frame, and at a recorded frame there is nothing to bridge.
    found: NDArray[np.bool_] = (high - low <= MOST_GAP_FRAMES + 1) | (high - moments < _FRAME_TOLERANCE)
    return found | (moments - low < _FRAME_TOLERANCE)


def _shift_level(poses: Float64, shift: Float64) -> Float64:
    # Along the horizontal heading, so that a pitching box does not climb.
    out = poses.copy()
    if not shift.any():
        return out
    forward = poses[:, :2, 0] / np.linalg.norm(poses[:, :2, 0], axis=1, keepdims=True)
    left = np.stack([-forward[:, 1], forward[:, 0]], 1)
    out[:, :2, 3] += shift[0] * forward + shift[1] * left
    return out


def _heading(pose: Float64) -> Float64:
    forward = pose[:2, 0]
    return np.asarray(forward / np.linalg.norm(forward), np.float64)


def _smooth(values: Float64) -> Float64:
    # A moving average [F, C]. Its window shrinks at both ends and stays symmetric, as it would bend a ramp otherwise.
    halves = [min(_SMOOTH_FRAMES // 2, k, len(values) - 1 - k) for k in range(len(values))]
    return np.stack([values[k - half : k + half + 1].mean(0) for k, half in enumerate(halves)])
