"""PandaSet's cuboids, frame by frame, as tracks.

Where both LiDARs saw an object it is annotated twice, once for each sensor's time, under two ids that point at each
other (``cuboids.sibling_id``: at times only one does, or with a truncated id). Such a pair is one object here: the
64-beam sensor's box counts, the other one fills the frames in which that is missing.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from genre_tasks.logs.box_validity import StatedBox, describe_bad_box, find_bad_boxes, report_bad_boxes
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.pandaset.layout import BOX_HEADING, PANDA_R_FLU, SPINNING_SENSOR, quats_to_matrices
from genre_tasks.logs.pandaset.pickle_reader import Table
from genre_tasks.logs.pandaset.sweeps import read_numbers, require_columns
from genre_tasks.logs.types import CuboidTrack, Float64

_BOX_COLUMNS = ("position.x", "position.y", "position.z", "dimensions.x", "dimensions.y", "dimensions.z", "yaw")
# Of a box row.
_POSITION = slice(0, 3)
# Of a box row: PandaSet's dimensions x (width), y (length), z (height).
_SIZE = slice(3, 6)
# Of a box row.
_YAW = 6
# Two full turns: a tracker may add up a few turns, and degrees are soon beyond.
_UUID_REMEDY = "Give every object a uuid, the same one in all frames."
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
        boxes: frame → [11] as ``read_boxes`` gives them.
        moving: whether any frame says that it moves.
    """

    uuid: str
    label: str
    sensor: int
    sibling: str
    boxes: dict[int, Float64] = field(default_factory=dict)
    moving: bool = False


@dataclass(frozen=True)
class FrameBoxes:
    """The boxes of one frame, checked: every needed column is there and of a usable type.

    Attributes:
        frame: log frame.
        boxes: [N, 11] position, size and yaw as in the file, and the orientation as a quaternion (w, x, y, z).
        attributes: for every box, the values of the other columns by name.
        file: that states them.
    """

    frame: int
    boxes: Float64
    attributes: tuple[Mapping[str, Any], ...]
    file: Path


def read_boxes(table: Table, frame: int, *, file: Path, log: str) -> FrameBoxes:
    """Reads the boxes of a frame from its table.

    Args:
        table: columns uuid, label, yaw, position.*, dimensions.* are needed.
        frame: log frame.
        file: of the table.
        log: URI of the log, for errors.

    Returns:
        The boxes, those with impossible numbers too.

    Raises:
        InputError: a needed column is missing, or not numeric.
    """
    where: dict[str, Any] = {"file": file, "log": log, "frame": frame}
    require_columns(table, ("uuid", "label", *_BOX_COLUMNS), "the table of cuboids", **where)
    box = [read_numbers(table, name, **where) for name in _BOX_COLUMNS]
    if all(name in table.columns for name in BOX_HEADING):
        quat = [read_numbers(table, name, **where) for name in BOX_HEADING]
    else:
        # A turn about z by the yaw. A yaw that is not finite is left out later; the quaternion only must not warn.
        yaw = box[-1]
        half = np.where(np.isfinite(yaw), yaw, 0.0) / 2
        quat = [np.cos(half), np.zeros_like(half), np.zeros_like(half), np.sin(half)]
    names = [name for name in table.columns if name not in _BOX_COLUMNS]
    columns = [table.columns[name].tolist() for name in names]
    rows = tuple(dict(zip(names, values, strict=True)) for values in zip(*columns, strict=True))
    return FrameBoxes(frame, np.stack([*box, *quat], axis=1), rows, file)


def build_tracks(frames: Sequence[FrameBoxes], log: str) -> tuple[tuple[CuboidTrack, ...], tuple[Finding, ...]]:
    """Builds the tracks of a sequence from the cuboids of its frames.

    A box with a non-finite number, without volume or without a uuid is left out (``Finding`` with the word
    ``invalid_box``). An object moves if ``attributes.object_motion`` says so in any frame; pedestrians have none: they
    move where they walk.

    Args:
        frames: the boxes of each frame, in increasing order of frames.
        log: URI of the log, for errors.

    Returns:
        The tracks, in the order in which they first appear, and the boxes that were left out.

    Raises:
        InputError: all boxes are bad.
    """
    objects: dict[str, _AnnotatedObject] = {}
    problems, invalid = _find_bad_boxes(frames, log)
    findings = list(invalid)
    for frame_boxes, bad_rows in zip(frames, problems, strict=True):
        findings += _add_frame(objects, frame_boxes, bad_rows)
    findings += _judge_yaw(objects)
    tracks = (_build_track(group) for group in _group_siblings(objects))
    return tuple(track for track in tracks if track is not None), tuple(findings)


def _find_bad_boxes(frames: Sequence[FrameBoxes], log: str) -> tuple[list[set[int]], tuple[Finding, ...]]:
    """For each frame the rows of boxes with impossible numbers, and their findings."""
    places = [(index, row) for index, frame_boxes in enumerate(frames) for row in range(len(frame_boxes.boxes))]
    bad_rows: list[set[int]] = [set() for _ in frames]
    if not places:
        return bad_rows, ()
    boxes = np.concatenate([frame_boxes.boxes for frame_boxes in frames])
    quats, yaws = boxes[:, _QUATERNION], boxes[:, _YAW, None]
    problems = find_bad_boxes(boxes[:, _POSITION], boxes[:, _SIZE], quats=quats, angles_rad=yaws)
    for number in problems:
        index, row = places[number]
        bad_rows[index].add(row)

    def locate(number: int) -> StatedBox:
        index, row = places[number]
        return _locate_box(frames[index], row)

    return bad_rows, report_bad_boxes(problems, len(boxes), locate, file=frames[0].file.parent, log=log)


def _locate_box(frame_boxes: FrameBoxes, row: int) -> StatedBox:
    attributes = frame_boxes.attributes[row]
    # Without the folder: where a log lies must not change what a run stores.
    source = f"cuboids/{frame_boxes.file.name}, row {row}"
    return StatedBox(frame_boxes.frame, str(attributes["uuid"]), str(attributes["label"]), source)


def _judge_yaw(objects: Mapping[str, _AnnotatedObject]) -> list[Finding]:
    """A finding where angles are too large for radians: turned into rotations, they would look like any others."""
    yaws = [abs(float(box[_YAW])) for annotated in objects.values() for box in annotated.boxes.values()]
    largest = max(yaws, default=0.0)
    if largest <= _MAX_YAW_RAD:
        return []
    message = f"the yaw of a box is {largest:.4g}, radians within ±{_MAX_YAW_RAD:.3g} were expected"
    numbers = {"yaw": largest, "limit": _MAX_YAW_RAD}
    return [Finding("odd_box_yaw", "warning", message, "Convert yaw from degrees to radians.", numbers)]


def _add_frame(
    objects: dict[str, _AnnotatedObject], frame_boxes: FrameBoxes, bad_rows: Collection[int]
) -> list[Finding]:
    """Adds the sound boxes of one frame to their objects; returns what else was left out."""
    frame = frame_boxes.frame
    findings = []
    repeated = 0
    for number, (box, row) in enumerate(zip(frame_boxes.boxes, frame_boxes.attributes, strict=True)):
        is_valid = number not in bad_rows
        # Boxes without a name would all become one object.
        if _is_missing(row["uuid"]):
            if is_valid:
                findings.append(describe_bad_box(_locate_box(frame_boxes, number), "has no uuid"))
            continue
        new_object = _AnnotatedObject(
            uuid=str(row["uuid"]),
            label=str(row["label"]),
            sensor=_parse_sensor(row.get("cuboids.sensor_id")),
            sibling=str(row.get("cuboids.sibling_id", _NO_SIBLING)),
        )
        annotated = objects.setdefault(new_object.uuid, new_object)
        if is_valid:
            repeated += frame in annotated.boxes
            # A uuid that stands twice in a frame keeps its first box.
            annotated.boxes.setdefault(frame, box)
            annotated.moving |= _is_moving(row)
    if repeated:
        some = "1 box" if repeated == 1 else f"{repeated} boxes"
        message = f"{some} of frame {frame} left out, because another box of that frame has the same uuid"
        numbers = {"boxes": repeated}
        findings.append(Finding("repeated_box_id", "warning", message, _UUID_REMEDY, numbers, frames=(frame,)))
    return findings


def _is_missing(value: object) -> bool:
    # NaN is the one value that differs from itself.
    return value is None or value != value or value == ""


def _parse_sensor(value: object) -> int:
    """The sensor that a box was annotated for; ``_NO_SENSOR`` where the file does not say."""
    try:
        return int(float(str(value)))
    except (ValueError, OverflowError):
        return _NO_SENSOR


def _is_false(value: object) -> bool:
    """Whether a column of booleans says no, however it is written; a missing value says nothing."""
    if isinstance(value, str):
        return value.strip().lower() in ("false", "0", "no")
    return not _is_missing(value) and not value


def _is_moving(row: Mapping[str, object]) -> bool:
    motion = row.get("attributes.object_motion")
    behaviour = row.get("attributes.pedestrian_behavior")
    if isinstance(motion, str):
        return motion.strip().lower() == "moving"
    if isinstance(behaviour, str):
        return behaviour.strip().lower() == "walking"
    return _is_false(row.get("stationary"))


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
    """[F, 4, 4] world_SE3_box, axes x forward, y left, z up, from rows [F, 11] of ``read_boxes``."""
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = quats_to_matrices(rows[:, _QUATERNION]) @ PANDA_R_FLU
    poses[:, :3, 3] = rows[:, :3]
    return poses
