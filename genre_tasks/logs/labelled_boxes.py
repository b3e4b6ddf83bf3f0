"""Boxes that labels state frame by frame in the axes of a sensor, joined to tracks in the world."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.types import CuboidTrack, Float64

MAX_BOXES = 300_000
"""What a log may have: twenty times the boxes of the busiest segment. A row of a table takes a kilobyte here."""

# The boxes of a standing car wander by less over twenty frames.
_MOVES_M = 1.0


@dataclass(frozen=True)
class LabelledBox:
    """A box in one frame.

    Attributes:
        frame: log frame.
        track_id: of its object.
        label: class, in the file's words.
        sensor_SE3_box: [4, 4] centre and axes (x forward, y left, z up) in the axes of the labels' sensor.
        size_m: length, width, height.
    """

    frame: int
    track_id: str
    label: str
    sensor_SE3_box: Float64
    size_m: tuple[float, float, float]


def build_tracks(
    boxes: list[LabelledBox], world_SE3_sensor: Callable[[int], Float64], frame_count: int
) -> tuple[tuple[CuboidTrack, ...], tuple[Finding, ...]]:
    """Joins the boxes of each object.

    Args:
        boxes: of all frames.
        world_SE3_sensor: frame → [4, 4] pose of the labels' sensor.
        frame_count: boxes of later frames are left out.

    Returns:
        Tracks by their ids, and findings: ``repeated_box_id`` where an id stands twice in a frame, of which the first
        box counts, and ``unreadable_cuboids`` where the sensor has no pose in a frame, whose boxes are left out.
        Where labels do not say what moves, an object whose boxes are a metre apart does.

    Raises:
        InputError: no frame with boxes has a pose.
    """
    poses, unposed = _find_poses({box.frame for box in boxes if 0 <= box.frame < frame_count}, world_SE3_sensor)
    by_track: dict[str, dict[int, LabelledBox]] = {}
    repeated = []
    for box in boxes:
        if box.frame in poses:
            box_at = by_track.setdefault(box.track_id, {})
            if box.frame in box_at:
                repeated.append(box.frame)
            else:
                box_at[box.frame] = box
    tracks = []
    # As numbers are sorted, though they are text.
    for track_id in sorted(by_track, key=lambda name: (len(name), name)):
        frames = sorted(by_track[track_id])
        rows = [by_track[track_id][frame] for frame in frames]
        world = np.stack([poses[frame] @ box.sensor_SE3_box for frame, box in zip(frames, rows, strict=True)])
        # The benchmark's sizes are one for all frames; tracklets of others may differ.
        sizes = np.median([box.size_m for box in rows], axis=0)
        distances = np.linalg.norm(world[:, :3, 3] - world[0, :3, 3], axis=1)
        tracks.append(
            CuboidTrack(
                track_id=track_id,
                label=rows[0].label,
                frames=np.array(frames, dtype=np.int64),
                world_SE3_box=world,
                size_m=(float(sizes[0]), float(sizes[1]), float(sizes[2])),
                moving=bool(distances.max() > _MOVES_M),
            )
        )
    return tuple(tracks), (*describe_repeated(repeated), *unposed)


def _find_poses(
    frames: Iterable[int], world_SE3_sensor: Callable[[int], Float64]
) -> tuple[dict[int, Float64], list[Finding]]:
    """Gives the sensor's pose in each frame that has one, and what is wrong with the others."""
    poses = {}
    findings = []
    error: InputError | None = None
    for frame in sorted(frames):
        try:
            poses[frame] = world_SE3_sensor(frame)
        except InputError as caught:
            error = error or caught
            message = f"the boxes of frame {frame} are left out: {caught.problem}"
            findings.append(Finding("unreadable_cuboids", "warning", message, caught.remedy, frames=(frame,)))
    # Without any pose, nothing would be left of the boxes but findings.
    if error is not None and not poses:
        raise error
    return poses, findings


def describe_repeated(frames: Iterable[int]) -> tuple[Finding, ...]:
    """Describes boxes that were left out because another box of their frame has their id.

    Args:
        frames: of these boxes, one entry a box.

    Returns:
        ``repeated_box_id`` for each frame.

    >>> describe_repeated([7, 7])[0].message
    '2 boxes of frame 7 left out, because another box of that frame has the same id'
    """
    findings = []
    for frame, count in sorted(Counter(frames).items()):
        some = "1 box" if count == 1 else f"{count} boxes"
        message = f"{some} of frame {frame} left out, because another box of that frame has the same id"
        remedy = "Give every object an id, the same one in all frames."
        findings.append(Finding("repeated_box_id", "warning", message, remedy, {"boxes": count}, frames=(frame,)))
    return tuple(findings)
