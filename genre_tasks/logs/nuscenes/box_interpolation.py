"""Boxes of key frames, at two a second, for the frames between them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from genre_tasks.logs.box_validity import StatedBox, find_bad_boxes, report_bad_boxes
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.labelled_boxes import LabelledBox
from genre_tasks.logs.nuscenes.scene_rows import SceneBoxes
from genre_tasks.logs.timed_poses import TimedPoses
from genre_tasks.logs.types import Float64

# Two key frames and some jitter: an object that is labelled again later was not seen in between.
_MAX_GAP_US = 1_100_000
_US = 1e-6


def leave_out_bad_boxes(
    boxes: SceneBoxes, frame_times_us: Sequence[int], *, file: Path, log: str
) -> tuple[SceneBoxes, tuple[Finding, ...]]:
    """Leaves out the boxes of key frames that cannot be used; between their neighbours, boxes are interpolated.

    Args:
        boxes: of key frames.
        frame_times_us: [F] increasing microseconds.
        file: that states the boxes.
        log: URI of the log, for errors.

    Returns:
        The others, and ``invalid_box`` for each that is left out and has an effect on frames.

    Raises:
        InputError: all boxes are bad.
    """
    problems = find_bad_boxes(boxes.positions, boxes.sizes_m, quats=boxes.quats)
    if not problems:
        return boxes, ()
    sound = [row for row in range(len(boxes.tokens)) if row not in problems]
    times_of: dict[str, list[int]] = {}
    for row in sound:
        times_of.setdefault(boxes.instances[row], []).append(boxes.times_us[row])
    frames_us = np.asarray(frame_times_us, dtype=np.int64)

    def locate(row: int) -> StatedBox | None:
        instance, time_us = boxes.instances[row], boxes.times_us[row]
        frames = _find_frames_around(time_us, times_of.get(instance, []), frames_us)
        if not frames:
            return None
        nearest = min(frames, key=lambda frame: abs(int(frames_us[frame]) - time_us))
        return StatedBox(nearest, instance, boxes.labels[row], f"{file.name}, token {boxes.tokens[row]}", frames)

    findings = report_bad_boxes(problems, len(boxes.tokens), locate, file=file, log=log)
    return boxes.select(sound), findings


def _find_frames_around(time_us: int, sound_us: Sequence[int], frames_us: NDArray[np.int64]) -> tuple[int, ...]:
    """Frames whose box of an object rests on the one at a time, of the object's sound boxes at other times."""
    before = max((time for time in sound_us if time < time_us), default=time_us)
    after = min((time for time in sound_us if time > time_us), default=time_us)
    is_between = (frames_us > max(before, time_us - _MAX_GAP_US)) & (frames_us < min(after, time_us + _MAX_GAP_US))
    return tuple(np.flatnonzero(is_between | (frames_us == time_us)).tolist())


def interpolate_boxes(boxes: SceneBoxes, frame_times_us: Sequence[int]) -> tuple[list[LabelledBox], int]:
    """Gives every frame the boxes of its time: centres on a line, turns at a constant rate.

    Nothing is extrapolated. Where an object lacks boxes for longer than a second, it lacks them between too. Of two
    boxes of an object at one time, the first counts.

    Args:
        boxes: of key frames, in the world.
        frame_times_us: [F] increasing microseconds.

    Returns:
        The boxes, and how many of them no key frame has.
    """
    frames_us = np.asarray(frame_times_us, dtype=np.int64)
    by_instance: dict[str, dict[int, int]] = {}
    for row, instance in enumerate(boxes.instances):
        by_instance.setdefault(instance, {}).setdefault(boxes.times_us[row], row)
    found: list[LabelledBox] = []
    interpolated = 0
    for instance, row_at in by_instance.items():
        # By their times and not by the tables' links, which may lead anywhere.
        times_us = np.array(sorted(row_at), dtype=np.int64)
        rows = np.array([row_at[time_us] for time_us in times_us.tolist()])
        after = np.searchsorted(times_us, frames_us)
        last = len(times_us) - 1
        is_stated = times_us[np.minimum(after, last)] == frames_us
        gaps_us = times_us[np.clip(after, 0, last)] - times_us[np.clip(after - 1, 0, last)]
        is_between = (after > 0) & (after <= last) & (gaps_us <= _MAX_GAP_US)
        chosen = np.flatnonzero(is_stated | is_between)
        interpolated += int((~is_stated[chosen]).sum())
        poses = _interpolate_poses(boxes, rows, times_us, frames_us[chosen])
        length, width, height = np.median(boxes.sizes_m[rows], axis=0).tolist()
        for frame, pose in zip(chosen.tolist(), poses, strict=True):
            found.append(LabelledBox(frame, instance, boxes.labels[rows[0]], pose, (length, width, height)))
    return found, interpolated


def find_repeated_boxes(boxes: SceneBoxes, frame_times_us: Sequence[int]) -> list[int]:
    """Finds boxes whose object has another box at the same time.

    Args:
        boxes: of key frames.
        frame_times_us: [F] increasing microseconds.

    Returns:
        The frame of each box but the object's first one; boxes before and after all frames are left out.
    """
    met: set[tuple[str, int]] = set()
    repeated = []
    for instance, time_us in zip(boxes.instances, boxes.times_us, strict=True):
        if (instance, time_us) in met and frame_times_us[0] <= time_us <= frame_times_us[-1]:
            repeated.append(int(np.searchsorted(np.asarray(frame_times_us), time_us)))
        met.add((instance, time_us))
    return repeated


def _interpolate_poses(
    boxes: SceneBoxes,
    rows: NDArray[np.int64],
    times_us: NDArray[np.int64],
    wanted_us: NDArray[np.int64],
) -> Float64:
    """[N, 4, 4] poses of one object."""
    # SciPy puts the scalar part last.
    rotations = Rotation.from_quat(boxes.quats[rows][:, [1, 2, 3, 0]])
    poses = np.tile(np.eye(4), (len(wanted_us), 1, 1))
    if len(rows) == 1:
        poses[:, :3, :3] = rotations.as_matrix()
        poses[:, :3, 3] = boxes.positions[rows]
    elif len(wanted_us):
        # Seconds since 1970 would round to a quarter of a microsecond.
        path = TimedPoses((times_us - times_us[0]) * _US, rotations, boxes.positions[rows])
        turns, positions = path.at((wanted_us - times_us[0]) * _US)
        poses[:, :3, :3] = turns.as_matrix()
        poses[:, :3, 3] = positions
    return poses
