"""Boxes of the layout: a Parquet table with a row for every object and frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from genre_tasks.bounded_parquet import FOR_ROWS, read_bounded_table
from genre_tasks.errors import InputError
from genre_tasks.logs.box_validity import StatedBox, find_bad_boxes, report_bad_boxes
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.genre_layout.layout import BOX_COLUMNS
from genre_tasks.logs.labelled_boxes import describe_repeated
from genre_tasks.logs.types import CuboidTrack, Float64

_REMEDY = "Write the columns of the genre layout: " + ", ".join(BOX_COLUMNS) + "."


def write_boxes(path: Path, tracks: Sequence[CuboidTrack]) -> None:
    """Writes all boxes.

    Args:
        path: the file.
        tracks: of the log.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq
    from scipy.spatial.transform import Rotation

    columns: dict[str, list[Any]] = {name: [] for name in BOX_COLUMNS}
    for track in tracks:
        # SciPy puts the scalar part last.
        quats = Rotation.from_matrix(track.world_SE3_box[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
        for frame, pose, quat in zip(track.frames, track.world_SE3_box, quats, strict=True):
            row = [track.track_id, track.label, int(frame), track.moving, *pose[:3, 3], *quat, *track.size_m]
            for name, value in zip(BOX_COLUMNS, row, strict=True):
                columns[name].append(value)
    kinds = {"track_id": pa.string(), "label": pa.string(), "frame": pa.int64(), "moving": pa.bool_()}
    arrays = {name: pa.array(values, kinds.get(name, pa.float64())) for name, values in columns.items()}
    pq.write_table(pa.table(arrays), path)


def read_boxes(path: Path, frame_count: int, log: str) -> tuple[tuple[CuboidTrack, ...], tuple[Finding, ...]]:
    """Reads all boxes, but for those without a place, a size or a direction.

    Args:
        path: the file.
        frame_count: frames of the log.
        log: URI of the log, for errors.

    Returns:
        The tracks, in the order of their first rows. The size of a track is the median over its frames. Then
        ``invalid_box`` for every box that is left out, and ``repeated_box_id`` where an object has several boxes in a
        frame, of which the first sound one counts.

    Raises:
        InputError: the table is damaged, too large, or lacks a column; a row is of no frame or of no object;
            ``moving`` is neither true nor false; no box can be used.
    """
    import pyarrow as pa

    where: dict[str, Any] = {"file": path, "log": log, "remedy": _REMEDY}
    try:
        table = read_bounded_table(path, FOR_ROWS)
    except (OSError, ValueError, pa.ArrowException) as error:
        raise InputError(f"the boxes cannot be read ({error})", **where) from error
    missing = [name for name in BOX_COLUMNS if name not in table.column_names and name != "moving"]
    if missing:
        raise InputError(f"the boxes lack the columns {', '.join(missing)}", **where)
    columns = {name: table.column(name).to_pylist() for name in BOX_COLUMNS if name in table.column_names}
    _require_objects(columns, where)
    for row, frame in enumerate(columns["frame"]):
        if isinstance(frame, bool) or not isinstance(frame, int) or not 0 <= frame < frame_count:
            problem = f"row {row} is of frame {frame}, and the log has 0 to {frame_count - 1}"
            raise InputError(problem, **where)
    # Nulls of Parquet become NaN here.
    try:
        numbers = np.array([columns[name] for name in BOX_COLUMNS[4:]], dtype=np.float64).T.reshape(-1, 10)
    except (TypeError, ValueError) as error:
        raise InputError(f"the boxes hold something else than numbers ({error})", **where) from error
    problems = find_bad_boxes(numbers[:, :3], numbers[:, 7:], quats=numbers[:, 3:7])

    def locate(row: int) -> StatedBox:
        track_id, label = str(columns["track_id"][row]), str(columns["label"][row])
        return StatedBox(columns["frame"][row], track_id, label, f"{path.name}, row {row}")

    findings = report_bad_boxes(problems, len(numbers), locate, file=path, log=log)
    by_track: dict[str, dict[int, int]] = {}
    repeated = []
    for row, (track_id, frame) in enumerate(zip(columns["track_id"], columns["frame"], strict=True)):
        if row in problems:
            continue
        frames = by_track.setdefault(str(track_id), {})
        if frame in frames:
            repeated.append(frame)
        else:
            frames[frame] = row
    tracks = (_build_track(name, frames, columns, numbers) for name, frames in by_track.items())
    return tuple(tracks), (*findings, *describe_repeated(repeated))


def _require_objects(columns: dict[str, list[Any]], where: dict[str, Any]) -> None:
    """Raises where a row names no object, or does not say whether the object moves."""
    for row, track_id in enumerate(columns["track_id"]):
        # As text, nulls would join boxes of several objects. NaN is the one value that differs from itself.
        if track_id is None or track_id == "" or track_id != track_id:
            raise InputError(f"row {row} has no track_id ({track_id!r})", **where)
    for row, moving in enumerate(columns.get("moving", [])):
        # Python takes any text for true, "False" as well.
        if moving is not None and moving not in (0, 1):
            raise InputError(f"moving of row {row} is {moving!r}; write true or false, not as text", **where)


def _build_track(track_id: str, rows: dict[int, int], columns: dict[str, list[Any]], numbers: Float64) -> CuboidTrack:
    from scipy.spatial.transform import Rotation

    frames = sorted(rows)
    order = [rows[frame] for frame in frames]
    poses = np.tile(np.eye(4), (len(frames), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(numbers[order][:, [4, 5, 6, 3]]).as_matrix()
    poses[:, :3, 3] = numbers[order][:, :3]
    size = np.median(numbers[order][:, 7:], axis=0)
    moving = columns.get("moving")
    return CuboidTrack(
        track_id=track_id,
        label=str(columns["label"][order[0]]),
        frames=np.array(frames, dtype=np.int64),
        world_SE3_box=poses,
        size_m=(float(size[0]), float(size[1]), float(size[2])),
        moving=bool(moving is not None and any(moving[row] for row in order)),
    )
