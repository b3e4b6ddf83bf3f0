"""Where an edited actor is: its recorded path moved, turned, delayed or driven at another speed, on the ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from genre_tasks.logs.types import Float64
from genre_tasks.scene.transforms import interpolate_pose
from genre_tasks.scene_edits.edits import ActorChange
from genre_tasks.scene_edits.ground import Ground

STANDING_M_S = 0.3
"""A box that seems to be slower than this stands: annotations jitter by a few centimetres."""

_END_FRAMES = 5
"""The speed at an end of a path is the mean over so many frames."""

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


def change_trajectory(
    recorded: Trajectory, change: ActorChange, run_frames: NDArray[np.int64], frame_s: float, ground: Ground
) -> Trajectory:
    """Changes the path of an actor.

    With a delay an actor exists at its recorded frames and at the delayed ones. Before its path begins and after it
    ends the actor drives straight on; one that stands there stands.

    Args:
        recorded: at least one pose.
        change: what all edits of the actor come to.
        run_frames: log frames of the run, rising.
        frame_s: seconds of a log frame.
        ground: of the run.

    Returns:
        The new path; its frames are some of ``run_frames``.
    """
    delay = float(change.delay_s) / frame_s
    # Rounded, since the length of a frame is measured: four frames are not to be 4.000001.
    first = min(recorded.frames[0], np.floor(recorded.frames[0] + delay + 1e-3))
    last = max(recorded.frames[-1], np.ceil(recorded.frames[-1] + delay - 1e-3))
    frames = recorded.frames
    if change.delay_s:
        frames = run_frames[(run_frames >= first) & (run_frames <= last)]
    if change.keeps_motion:
        poses = recorded.world_SE3_box
        reference = poses
        moments = recorded.shape_frames
    else:
        moments = np.asarray(frames - delay, np.float64)
        if change.speed_factor != 1:
            moments = _scale_progress(recorded, moments, float(change.speed_factor), frame_s)
        reference = np.stack(
            [_pose_at(recorded, min(max(m, recorded.frames[0]), recorded.frames[-1])) for m in moments]
        )
        poses = np.stack([_extrapolate(recorded, m, pose, frame_s) for m, pose in zip(moments, reference, strict=True)])
    shift = np.array([float(change.forward_m), float(change.left_m), 0.0])
    moved = _shift_level(poses, shift)
    moved[:, :3, :3] = moved[:, :3, :3] @ Rotation.from_euler("z", float(change.turn_deg), degrees=True).as_matrix()
    moved = rest_on_ground(moved, reference, ground)
    moved[:, 2, 3] += float(change.up_m)
    return Trajectory(frames, moved, np.clip(moments, recorded.frames[0], recorded.frames[-1]))


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


def measure_speed(trajectory: Trajectory, frame_s: float) -> float:
    """Measures the mean speed along a path.

    Args:
        trajectory: of a box.
        frame_s: seconds of a log frame.

    Returns:
        m/s; 0 for a box that stands or has one pose.
    """
    span_s = float(trajectory.frames[-1] - trajectory.frames[0]) * frame_s
    return float(_arc_length(trajectory, frame_s)[-1]) / span_s if span_s else 0.0


def _shift_level(poses: Float64, shift: Float64) -> Float64:
    # Along the horizontal heading, so that a pitching box does not climb.
    out = poses.copy()
    if not shift.any():
        return out
    forward = poses[:, :2, 0] / np.linalg.norm(poses[:, :2, 0], axis=1, keepdims=True)
    left = np.stack([-forward[:, 1], forward[:, 0]], 1)
    out[:, :2, 3] += shift[0] * forward + shift[1] * left
    return out


def _pose_at(recorded: Trajectory, moment: float) -> Float64:
    after = int(np.searchsorted(recorded.frames, moment))
    if recorded.frames[after] == moment:
        return recorded.world_SE3_box[after]
    low = float(recorded.frames[after - 1])
    fraction = (moment - low) / (float(recorded.frames[after]) - low)
    return interpolate_pose(recorded.world_SE3_box[after - 1], recorded.world_SE3_box[after], fraction)


def _extrapolate(recorded: Trajectory, moment: float, pose: Float64, frame_s: float) -> Float64:
    excess = moment - min(max(moment, recorded.frames[0]), recorded.frames[-1])
    if not excess:
        return pose
    out = pose.copy()
    out[:2, 3] += excess * frame_s * _end_speed(recorded, frame_s, at_start=excess < 0) * _heading(pose)
    return out


def _heading(pose: Float64) -> Float64:
    forward = pose[:2, 0]
    return np.asarray(forward / np.linalg.norm(forward), np.float64)


def _end_speed(recorded: Trajectory, frame_s: float, at_start: bool) -> float:
    # Speed in the direction that the box faces, m/s; negative for one that drives back.
    count = min(_END_FRAMES, len(recorded) - 1)
    if not count:
        return 0.0
    a, b = (0, count) if at_start else (len(recorded) - 1 - count, len(recorded) - 1)
    span_s = float(recorded.frames[b] - recorded.frames[a]) * frame_s
    step = recorded.world_SE3_box[b, :2, 3] - recorded.world_SE3_box[a, :2, 3]
    speed = float(step @ _heading(recorded.world_SE3_box[a if at_start else b])) / span_s
    return speed if abs(speed) > STANDING_M_S else 0.0


def _arc_length(recorded: Trajectory, frame_s: float) -> Float64:
    # Metres along the path at each pose; frames in which the box stands add nothing.
    steps = np.linalg.norm(np.diff(recorded.world_SE3_box[:, :2, 3], axis=0), axis=1)
    steps[steps < STANDING_M_S * frame_s * np.diff(recorded.frames)] = 0.0
    return np.concatenate([[0.0], np.cumsum(steps)])


def _scale_progress(recorded: Trajectory, moments: Float64, factor: float, frame_s: float) -> Float64:
    # The moments of the recording at which the actor was as far along its path as it is now.
    frames = recorded.frames.astype(np.float64)
    length = _arc_length(recorded, frame_s)
    speeds = [_end_speed(recorded, frame_s, at_start=start) for start in (True, False)]
    before = np.minimum(moments - frames[0], 0) * frame_s * abs(speeds[0])
    after = np.maximum(moments - frames[-1], 0) * frame_s * abs(speeds[1])
    progress = factor * (np.interp(moments, frames, length) + before + after)
    # Lengths must rise for the inverse: where the box stands, the last moment there is taken.
    rising = np.concatenate([np.diff(length) > 0, [True]])
    out = np.interp(progress, length[rising], frames[rising])
    out += np.where(progress > length[-1], (progress - length[-1]) / max(abs(speeds[1]), 1e-9) / frame_s, 0.0)
    out = np.where((progress > length[-1]) & (speeds[1] == 0), frames[-1], out)
    return np.where(progress < 0, frames[0] + progress / max(abs(speeds[0]), 1e-9) / frame_s, out)


def _smooth(values: Float64) -> Float64:
    # A moving average [F, C]. Its window shrinks at both ends and stays symmetric, as it would bend a ramp otherwise.
    halves = [min(_SMOOTH_FRAMES // 2, k, len(values) - 1 - k) for k in range(len(values))]
    return np.stack([values[k - half : k + half + 1].mean(0) for k, half in enumerate(halves)])
