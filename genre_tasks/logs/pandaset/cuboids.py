"""PandaSet's cuboids, frame by frame, as tracks.

Where both LiDARs saw an object it is annotated twice, once for each sensor's time, under two ids that point at each
other (``cuboids.sibling_id``: at times only one does, or with a truncated id). Such a pair is one object here: the
64-beam sensor's box counts, the other one fills the frames in which that is missing.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.logs.pandaset.layout import BOX_HEADING, PANDA_R_OURS, SPINNING_SENSOR, rotations
from genre_tasks.logs.pandaset.pickle_reader import Frame
from genre_tasks.logs.types import CuboidTrack, Float64, LogProblem

_BOX = ("position.x", "position.y", "position.z", "dimensions.x", "dimensions.y", "dimensions.z", "yaw")
_MIN_ID_PREFIX = 24  # a sibling id cut off by a few characters still names one uuid


@dataclass
class _Annotated:
    """What the files say under one uuid: frame → the seven numbers of ``_BOX``, and a quaternion."""

    uuid: str
    label: str
    sensor: int
    sibling: str
    boxes: dict[int, Float64] = field(default_factory=dict)
    moving: bool = False


def tracks_of_cuboids(frames: Iterable[tuple[int, Frame]]) -> tuple[tuple[CuboidTrack, ...], tuple[LogProblem, ...]]:
    """The tracks of a sequence, in the order in which they are first seen, and the boxes that were left out.

    Args:
        frames: (frame, its cuboids) in increasing order; columns uuid, label, yaw, position.*, dimensions.* are needed.

    A box with a non-finite number or without volume is left out (``LogProblem`` of kind ``invalid_box``). *Moving* is
    what ``attributes.object_motion`` says in any frame; pedestrians have none: they move where they walk.

    Raises:
        InputError: a needed column is missing (names the frame).
    """
    objects: dict[str, _Annotated] = {}
    problems: list[LogProblem] = []
    for frame, table in frames:
        problems += _collect(objects, frame, table)
    tracks = []
    for group in _groups(objects):
        track = _track(group)
        if track is not None:
            tracks.append(track)
    return tuple(tracks), tuple(problems)


def _collect(objects: dict[str, _Annotated], frame: int, table: Frame) -> list[LogProblem]:
    missing = [name for name in ("uuid", "label", *_BOX) if name not in table.columns]
    if missing:
        remedy = "Copy the cuboids of the sequence again, or remove them: a log without tracks is survived."
        raise InputError(f"the cuboids lack the columns {', '.join(missing)}", remedy=remedy, frame=frame)
    boxes = _boxes(table)
    column = {name: values.tolist() for name, values in table.columns.items() if name not in _BOX}
    problems = []
    for row, uuid in enumerate(map(str, column["uuid"])):
        sensor = int(column["cuboids.sensor_id"][row]) if "cuboids.sensor_id" in column else -1
        sibling = str(column["cuboids.sibling_id"][row]) if "cuboids.sibling_id" in column else "-"
        seen = objects.setdefault(uuid, _Annotated(uuid, str(column["label"][row]), sensor, sibling))
        box = boxes[row]
        if not np.isfinite(box).all() or (box[3:6] <= 0).any() or not box[7:].any():
            problems.append(LogProblem("invalid_box", f"the box of {seen.label} {uuid} in frame {frame} is not finite"))
            continue
        seen.boxes.setdefault(frame, box)
        seen.moving |= _moves({name: values[row] for name, values in column.items()})
    return problems


def _boxes(table: Frame) -> Float64:
    """[N, 11]: ``_BOX`` and the orientation as a quaternion, which is about z by the yaw unless the file says more."""
    box = [np.asarray(table.columns[name], dtype=np.float64) for name in _BOX]
    if all(name in table.columns for name in BOX_HEADING):
        heading = [np.asarray(table.columns[name], dtype=np.float64) for name in BOX_HEADING]
    else:
        half = np.where(np.isfinite(box[-1]), box[-1], 0.0) / 2  # such a box is left out for its yaw
        heading = [np.cos(half), np.zeros_like(half), np.zeros_like(half), np.sin(half)]
    return np.stack([*box, *heading], axis=1)


def _moves(row: dict[str, object]) -> bool:
    motion, behaviour = row.get("attributes.object_motion"), row.get("attributes.pedestrian_behavior")
    if isinstance(motion, str):
        return motion == "Moving"
    if isinstance(behaviour, str):
        return behaviour == "Walking"
    return row.get("stationary") is False


def _groups(objects: dict[str, _Annotated]) -> list[list[_Annotated]]:
    """The objects, each with its siblings of the other sensor; the 64-beam sensor's first."""
    leader = {uuid: uuid for uuid in objects}

    def find(uuid: str) -> str:
        while leader[uuid] != uuid:
            uuid = leader[uuid]
        return uuid

    for uuid, seen in objects.items():
        other = _named(seen.sibling, objects)
        if other is not None and objects[other].sensor != seen.sensor:
            leader[find(other)] = find(uuid)
    groups: dict[str, list[_Annotated]] = {}
    for uuid, seen in objects.items():
        groups.setdefault(find(uuid), []).append(seen)
    return [sorted(group, key=lambda seen: seen.sensor != SPINNING_SENSOR) for group in groups.values()]


def _named(sibling: str, objects: dict[str, _Annotated]) -> str | None:
    if sibling in objects:
        return sibling
    if len(sibling) < _MIN_ID_PREFIX:
        return None
    matches = [uuid for uuid in objects if uuid.startswith(sibling)]
    return matches[0] if len(matches) == 1 else None


def _track(group: list[_Annotated]) -> CuboidTrack | None:
    boxes: dict[int, Float64] = {}
    for seen in group:
        for frame, box in seen.boxes.items():
            boxes.setdefault(frame, box)
    if not boxes:
        return None
    frames = np.array(sorted(boxes), dtype=np.int64)
    rows = np.stack([boxes[int(frame)] for frame in frames])
    width, length, height = (float(v) for v in np.median(rows[:, 3:6], axis=0))
    main = group[0]
    return CuboidTrack(
        main.uuid, main.label, frames, _box_poses(rows), (length, width, height), any(seen.moving for seen in group)
    )


def _box_poses(rows: Float64) -> Float64:
    """[F, 4, 4] from rows [F, 11] of ``_boxes``."""
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = rotations(rows[:, 7:]) @ PANDA_R_OURS
    poses[:, :3, 3] = rows[:, :3]
    return poses
