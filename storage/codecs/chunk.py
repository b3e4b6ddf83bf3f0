"""Chunk ↔ ``chunk.parquet``, ``views.parquet`` (images as they came), ``points``, ``actors`` and ``marks``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from genre_tasks.errors import ArtifactCorruptError
from genre_tasks.scene.chunk import Actor, Chunk, LogIssue, Points, View
from storage.codecs.actors import read_actors, write_actors
from storage.codecs.point_table import read_points, write_points
from storage.codecs.tables import (
    POSE,
    REMEDY,
    check_array,
    column,
    poses_from_rows,
    poses_to_column,
    read_records,
    read_rows,
    read_table,
    schema,
    write_records,
    write_table,
)
from storage.codecs.view_columns import CAMERA_AND_FRAME, FRAME, LENS_AND_POSE, lens_columns, pose_and_lens

STATIC = 0
"""Value of the column ``node`` for the static background, as in the scene graph."""

# Node 1 is the distant shell, to which no LiDAR point belongs.
FIRST_ACTOR = 2
"""Value of the column ``node`` for the first actor; the next one has 3."""

# A table of one row instead of JSON: one format, with types and checksums, for everything that is stored.
CHUNK = schema(
    "chunk/1",
    [
        column("dataset", pa.string(), "first folder of the store's layout"),
        column("log", pa.string(), "name of the log"),
        column("index", pa.int64(), "chunk of the log, from 0"),
        column("width_px", pa.int64(), "working width"),
        column("height_px", pa.int64(), "working height"),
        column("camera_names", pa.list_(pa.string()), "cameras of the rig, in order"),
        column("world_SE3_chunk", POSE, "chunk coordinates to world coordinates, metres"),
    ],
)
FRAMES = schema(
    "frames/1",
    [
        FRAME,
        column("chunk_SE3_ego", POSE, "LiDAR pose: ego coordinates (x forward, y left, z up) to chunk, metres"),
    ],
)
VIEWS = schema(
    "chunk_views/1",
    [
        *CAMERA_AND_FRAME,
        column("role", pa.string(), "source or heldout"),
        column("timestamp_s", pa.float64(), "seconds"),
        *LENS_AND_POSE,
        column("image", pa.large_binary(), "encoded image, the bytes of the log"),
    ],
)
LOG_ISSUES = schema(
    "marks/1",
    [
        column("kind", pa.string(), "what is lacking or set aside"),
        column("detail", pa.string(), "one sentence"),
        column("frame", pa.int64(), "frame of the log", nullable=True),
        column("camera", pa.string(), "name", nullable=True),
    ],
)


def write(folder: Path, value: Chunk) -> None:
    """Writes all tables of a chunk.

    Args:
        folder: an empty folder.
        value: the chunk.

    Raises:
        ConfigError: an array has another dtype or shape.
        NonFiniteError: a pose or a position is NaN or infinite.
    """
    pose = check_array(value.world_SE3_chunk, "world_SE3_chunk", np.float64, (4, 4))
    chunk = {
        "dataset": [value.dataset],
        "log": [value.log],
        "index": [value.index],
        "width_px": [value.width_px],
        "height_px": [value.height_px],
        "camera_names": [list(value.camera_names)],
        "world_SE3_chunk": poses_to_column(pose[None], "world_SE3_chunk"),
    }
    write_table(folder / "chunk.parquet", CHUNK, chunk)
    ego = check_array(value.chunk_SE3_ego, "chunk_SE3_ego", np.float64, (len(value.frames), 4, 4))
    frames = {"frame": list(value.frames), "chunk_SE3_ego": poses_to_column(ego, "chunk_SE3_ego")}
    write_table(folder / "frames.parquet", FRAMES, frames)
    _write_views(folder, value.views)
    nodes = [(STATIC, value.static)] + [(FIRST_ACTOR + k, a.points) for k, a in enumerate(value.actors)]
    write_points(folder / "points.parquet", nodes)
    write_actors(folder / "actors.parquet", value.actors)
    write_records(folder / "marks.parquet", LOG_ISSUES, value.log_issues)


def read(folder: Path, measurements: Mapping[str, Any] | None = None) -> Chunk:
    """Reads a chunk.

    Args:
        folder: the folder that :func:`write` filled.
        measurements: not used: a chunk is all payload.

    Returns:
        The chunk; its NumPy arrays are writable copies.

    Raises:
        ArtifactCorruptError: a table is damaged, or points belong to no actor.
    """
    rows = read_rows(folder / "chunk.parquet", CHUNK)
    # A valid table may still hold no row or several, which the schema cannot forbid.
    if len(rows) != 1:
        raise ArtifactCorruptError(
            f"There are {len(rows)} rows, expected 1", remedy=REMEDY, file=folder / "chunk.parquet"
        )
    (head,) = rows
    frames = read_table(folder / "frames.parquet", FRAMES)[0]
    points = read_points(folder / "points.parquet")
    actors = read_actors(folder / "actors.parquet")
    stray = set(points) - {STATIC, *(FIRST_ACTOR + k for k in range(len(actors)))}
    # Points of an unknown node would be dropped silently, and the scene would lack them without any sign.
    if stray:
        raise ArtifactCorruptError(
            f"Column 'node' names unknown nodes {sorted(stray)}", remedy=REMEDY, file=folder / "points.parquet"
        )
    return Chunk(
        dataset=head["dataset"],
        log=head["log"],
        index=head["index"],
        frames=tuple(frames.column("frame").to_pylist()),
        camera_names=tuple(head["camera_names"]),
        width_px=head["width_px"],
        height_px=head["height_px"],
        world_SE3_chunk=poses_from_rows(head["world_SE3_chunk"])[0],
        chunk_SE3_ego=poses_from_rows(frames.column("chunk_SE3_ego").to_pylist()),
        views=_read_views(folder),
        static=points.get(STATIC, _no_points()),
        actors=tuple(
            Actor(**actor, points=points.get(FIRST_ACTOR + k, _no_points())) for k, actor in enumerate(actors)
        ),
        log_issues=read_records(folder / "marks.parquet", LOG_ISSUES, LogIssue),
    )


def measurements(value: Chunk) -> dict[str, Any]:
    """Selects no measurements: a chunk is all payload.

    Returns:
        An empty dictionary.
    """
    return {}


def _write_views(folder: Path, views: tuple[View, ...]) -> None:
    columns = {
        "camera": [v.camera for v in views],
        "frame": [v.frame for v in views],
        "role": [v.role for v in views],
        "timestamp_s": [v.timestamp_s for v in views],
        **lens_columns([v.chunk_SE3_camera for v in views], [v.lens for v in views]),
        "image": [v.image for v in views],
    }
    # The log's own bytes are kept: encoding an image again would cost quality, and compressing it saves nothing.
    write_table(folder / "views.parquet", VIEWS, columns, raw=("image",))


def _read_views(folder: Path) -> tuple[View, ...]:
    path = folder / "views.parquet"
    views = []
    for row in read_rows(path, VIEWS):
        # An unknown role would be neither trained nor evaluated, and nobody would notice.
        if row["role"] not in ("source", "heldout"):
            raise ArtifactCorruptError(f"Column 'role' holds {row['role']!r}", remedy=REMEDY, file=path)
        pose, lens = pose_and_lens(row)
        views.append(View(row["camera"], row["frame"], row["role"], row["timestamp_s"], pose, lens, row["image"]))
    return tuple(views)


def _no_points() -> Points:
    return Points(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, bool), np.zeros(0, np.int16))
