"""PandaSet's cuboids, frame by frame, as tracks.

Where both LiDARs saw an object it is annotated twice, once for each sensor's time, under two ids that point at each
other (``cuboids.sibling_id``: at times only one does, or with a truncated id). Such a pair is one object here: the
64-beam sensor's box counts, the other one fills the frames in which that is missing.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.pandaset.layout import BOX_HEADING, PANDA_R_FLU, SPINNING_SENSOR, quats_to_matrices
from genre_tasks.logs.pandaset.pickle_reader import Table
from genre_tasks.logs.types import CuboidTrack, Float64

_BOX_COLUMNS = ("position.x", "position.y", "position.z", "dimensions.x", "dimensions.y", "dimensions.z", "yaw")
# Of a box row: PandaSet's dimensions x (width), y (length), z (height).
_SIZE = slice(3, 6)
# Of a box row.
_YAW = 6
# Two full turns: a tracker may add up a few turns, and degrees are soon beyond.
_MAX_YAW_RAD = 4 * math.pi
# Of a box row, behind the columns above.
_QUATERNION = slice(7, 11)
# A sibling id cut off by a few characters still names one uuid.
_MIN_ID_PREFIX = 24
_NO_SENSOR = -1
_NO_SIBLING = "-"


@dataclass
class _AnnotatedObject:
    """What the files say under one uuid.

    Attributes:
        uuid: the object, as one sensor saw it.
        label: its class.
        sensor: ``SPINNING_SENSOR``, 1 for the forward LiDAR, or ``_NO_SENSOR``.
        sibling: uuid of the same object as the other sensor saw it.
        boxes: frame → [11] as ``_read_boxes`` gives them.
        moving: whether any frame says that it moves.
    """

    uuid: str
    label: str
    sensor: int
    sibling: str
    boxes: dict[int, Float64] = field(default_factory=dict)
    moving: bool = False


def build_tracks(frames: Iterable[tuple[int, Table]]) -> tuple[tuple[CuboidTrack, ...], tuple[Finding, ...]]:
    """Builds the tracks of a sequence from the cuboids of its frames.

    A box with a non-finite number or without volume is left out (``Finding`` with the word ``invalid_box``). An object
    moves if ``attributes.object_motion`` says so in any frame; pedestrians have none: they move where they walk.

    Args:
        frames: (frame, its cuboids) in increasing order; columns uuid, label, yaw, position.*, dimensions.* are needed.

    Returns:
        The tracks, in the order in which they first appear, and the boxes that were left out.

    Raises:
        InputError: a needed column is missing (names the frame).
    """
    objects: dict[str, _AnnotatedObject] = {}
    findings: list[Finding] = []
    for frame, table in frames:
        findings += _add_frame(objects, frame, table)
    findings += _judge_yaw(objects)
    tracks = (_build_track(group) for group in _group_siblings(objects))
    return tuple(track for track in tracks if track is not None), tuple(findings)


def _judge_yaw(objects: Mapping[str, _AnnotatedObject]) -> list[Finding]:
    """A finding where angles are too large for radians: turned into rotations, they would look like any others."""
    yaws = [abs(float(box[_YAW])) for annotated in objects.values() for box in annotated.boxes.values()]
    largest = max(yaws, default=0.0)
    if largest <= _MAX_YAW_RAD:
        return []
    message = f"the yaw of a box is {largest:.4g}, radians within ±{_MAX_YAW_RAD:.3g} were expected"
    numbers = {"yaw": largest, "limit": _MAX_YAW_RAD}
    return [Finding("odd_box_yaw", "warning", message, "Convert yaw from degrees to radians.", numbers)]


def _add_frame(objects: dict[str, _AnnotatedObject], frame: int, table: Table) -> list[Finding]:
    """Adds the boxes of one frame to their objects; returns those that were left out."""
    missing = [name for name in ("uuid", "label", *_BOX_COLUMNS) if name not in table.columns]
    if missing:
        remedy = "Copy the cuboids of the sequence again, or remove them: a log without tracks is survived."
        raise InputError(f"the cuboids lack the columns {', '.join(missing)}", remedy=remedy, frame=frame)
    boxes = _read_boxes(table)
    attributes = {name: values.tolist() for name, values in table.columns.items() if name not in _BOX_COLUMNS}
    findings = []
    for index, box in enumerate(boxes):
        row = {name: values[index] for name, values in attributes.items()}
        new_object = _AnnotatedObject(
            uuid=str(row["uuid"]),
            label=str(row["label"]),
            sensor=int(row.get("cuboids.sensor_id", _NO_SENSOR)),
            sibling=str(row.get("cuboids.sibling_id", _NO_SIBLING)),
        )
        annotated = objects.setdefault(new_object.uuid, new_object)
        if not np.isfinite(box).all() or (box[_SIZE] <= 0).any() or not box[_QUATERNION].any():
            message = f"the box of {annotated.label} {annotated.uuid} in frame {frame} is not finite"
            remedy = "Correct the box; it is left out."
            findings.append(Finding("invalid_box", "warning", message, remedy, frames=(frame,)))
            continue
        # A uuid that stands twice in a frame keeps its first box.
        annotated.boxes.setdefault(frame, box)
        annotated.moving |= _is_moving(row)
    return findings


def _read_boxes(table: Table) -> Float64:
    """[N, 11] position, size and yaw as in the file, and the orientation as a quaternion (w, x, y, z).

    The orientation is a turn about z by the yaw, unless the file says more.
    """
    box = [np.asarray(table.columns[name], dtype=np.float64) for name in _BOX_COLUMNS]
    if all(name in table.columns for name in BOX_HEADING):
        quat = [np.asarray(table.columns[name], dtype=np.float64) for name in BOX_HEADING]
    else:
        yaw = box[-1]
        # A box whose yaw is not finite is left out later, by its yaw; the quaternion only must not warn.
        half = np.where(np.isfinite(yaw), yaw, 0.0) / 2
        quat = [np.cos(half), np.zeros_like(half), np.zeros_like(half), np.sin(half)]
    return np.stack([*box, *quat], axis=1)


def _is_moving(row: Mapping[str, object]) -> bool:
    motion = row.get("attributes.object_motion")
    behaviour = row.get("attributes.pedestrian_behavior")
    if isinstance(motion, str):
        return motion == "Moving"
    if isinstance(behaviour, str):
        return behaviour == "Walking"
    # Compared by identity: a missing or NaN attribute says nothing.
    return row.get("stationary") is False


def _group_siblings(objects: dict[str, _AnnotatedObject]) -> list[list[_AnnotatedObject]]:
    """The objects, each with its siblings of the other sensor; the 64-beam sensor's first."""
    # Union-find: links may be one-sided, or join more than two uuids.
    parent = {uuid: uuid for uuid in objects}

    def find_root(uuid: str) -> str:
        while parent[uuid] != uuid:
            uuid = parent[uuid]
        return uuid

    for uuid, annotated in objects.items():
        sibling = _find_sibling(annotated.sibling, objects)
        # Ids that point at an object of the same sensor are errors of annotation.
        if sibling is not None and objects[sibling].sensor != annotated.sensor:
            parent[find_root(sibling)] = find_root(uuid)
    groups: dict[str, list[_AnnotatedObject]] = {}
    for uuid, annotated in objects.items():
        groups.setdefault(find_root(uuid), []).append(annotated)
    # The sort is stable: among equals, the order of the files stays.
    return [sorted(group, key=lambda member: member.sensor != SPINNING_SENSOR) for group in groups.values()]


def _find_sibling(sibling: str, objects: dict[str, _AnnotatedObject]) -> str | None:
    """The uuid that a possibly truncated sibling id names, if it names exactly one."""
    if sibling in objects:
        return sibling
    if len(sibling) < _MIN_ID_PREFIX:
        return None
    matches = [uuid for uuid in objects if uuid.startswith(sibling)]
    return matches[0] if len(matches) == 1 else None


def _build_track(group: list[_AnnotatedObject]) -> CuboidTrack | None:
    """The track of one object; ``None`` where all its boxes were left out."""
    boxes: dict[int, Float64] = {}
    # The 64-beam sensor comes first, so the other one only fills its gaps.
    for annotated in group:
        for frame, box in annotated.boxes.items():
            boxes.setdefault(frame, box)
    if not boxes:
        return None
    frames = np.array(sorted(boxes), dtype=np.int64)
    rows = np.stack([boxes[int(frame)] for frame in frames])
    # Annotators adjust a box from frame to frame; the object itself keeps its size.
    width, length, height = (float(size) for size in np.median(rows[:, _SIZE], axis=0))
    return CuboidTrack(
        track_id=group[0].uuid,
        label=group[0].label,
        frames=frames,
        world_SE3_box=_box_poses(rows),
        size_m=(length, width, height),
        moving=any(annotated.moving for annotated in group),
    )


def _box_poses(rows: Float64) -> Float64:
    """[F, 4, 4] world_SE3_box, axes x forward, y left, z up, from rows [F, 11] of ``_read_boxes``."""
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = quats_to_matrices(rows[:, _QUATERNION]) @ PANDA_R_FLU
    poses[:, :3, 3] = rows[:, :3]
    return poses
