"""Chunk ↔ ``chunk.parquet``, ``views.parquet`` (images as they came), ``points``, ``actors`` and ``marks``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from genre_tasks.errors import ArtifactCorruptError
from genre_tasks.scene.chunk import Actor, Chunk, Mark, Points, View
from storage.codecs.lenses import LENS_AND_POSE, lens_columns, pose_and_lens
from storage.codecs.tables import (
    POSE,
    REMEDY,
    array_of,
    checked,
    column,
    pose_rows,
    poses_of,
    read_table,
    schema,
    write_table,
)

STATIC, FIRST_ACTOR = 0, 2
"""Values of the column ``node``, as in the scene graph: the static background, and 2 + k for actor k."""

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
        column("frame", pa.int64(), "frame of the log"),
        column("chunk_SE3_ego", POSE, "LiDAR pose: ego coordinates (x forward, y left, z up) to chunk, metres"),
    ],
)
VIEWS = schema(
    "chunk_views/1",
    [
        column("camera", pa.string(), "name"),
        column("frame", pa.int64(), "frame of the log"),
        column("role", pa.string(), "source or heldout"),
        column("timestamp_s", pa.float64(), "seconds"),
        *LENS_AND_POSE,
        column("image", pa.large_binary(), "encoded image, the bytes of the log"),
    ],
)
POINTS = schema(
    "points/1",
    [
        column("node", pa.int64(), "0 static (chunk coordinates), 2 + k actor k (box coordinates)"),
        column("x", pa.float32(), "metres"),
        column("y", pa.float32(), "metres"),
        column("z", pa.float32(), "metres"),
        column("red", pa.uint8(), "sRGB"),
        column("green", pa.uint8(), "sRGB"),
        column("blue", pa.uint8(), "sRGB"),
        column("colored", pa.bool_(), "an image saw it unoccluded"),
        column("frame", pa.int16(), "frame of the log of its sweep"),
    ],
)
ACTORS = schema(
    "actors/1",
    [
        column("track_id", pa.string(), "name of the track"),
        column("label", pa.string(), "class in the log's own words"),
        column("length_m", pa.float64(), "metres"),
        column("width_m", pa.float64(), "metres"),
        column("height_m", pa.float64(), "metres"),
        column("frames", pa.list_(pa.int64()), "frames of the log in which it exists"),
        column("chunk_SE3_box", pa.list_(POSE), "box coordinates to chunk coordinates at those frames, metres"),
    ],
)
MARKS = schema(
    "marks/1",
    [
        column("kind", pa.string(), "what is lacking or set aside"),
        column("detail", pa.string(), "one sentence"),
        column("frame", pa.int64(), "frame of the log", nullable=True),
        column("camera", pa.string(), "name", nullable=True),
    ],
)


def actor_columns(actors: Any) -> dict[str, Any]:
    """Columns of :data:`ACTORS` for ``Actor`` or ``ActorNode`` values (they share these fields)."""
    for a in actors:
        checked(a.frames, f"frames of actor {a.track_id}", np.int64, (None,))
        checked(a.chunk_SE3_box, f"chunk_SE3_box of actor {a.track_id}", np.float64, (len(a.frames), 4, 4))
    return {
        "track_id": [a.track_id for a in actors],
        "label": [a.label for a in actors],
        "length_m": [float(a.size_m[0]) for a in actors],
        "width_m": [float(a.size_m[1]) for a in actors],
        "height_m": [float(a.size_m[2]) for a in actors],
        "frames": [a.frames.tolist() for a in actors],
        "chunk_SE3_box": [a.chunk_SE3_box.reshape(-1, 16).tolist() for a in actors],
    }


def actor_fields(path: Path, row: dict[str, Any]) -> dict[str, Any]:
    """The fields that ``Actor`` and ``ActorNode`` share, of one row."""
    frames, poses = np.array(row["frames"], np.int64), poses_of(row["chunk_SE3_box"])
    if len(frames) != len(poses):
        raise ArtifactCorruptError(
            f"Actor {row['track_id']!r} has {len(frames)} frames and {len(poses)} poses", remedy=REMEDY, file=path
        )
    return {
        "track_id": row["track_id"],
        "label": row["label"],
        "size_m": (row["length_m"], row["width_m"], row["height_m"]),
        "frames": frames,
        "chunk_SE3_box": poses,
    }


def write(folder: Path, value: Chunk) -> None:
    """Write all tables of a chunk."""
    pose = checked(value.world_SE3_chunk, "world_SE3_chunk", np.float64, (4, 4))
    write_table(
        folder / "chunk.parquet",
        CHUNK,
        {
            "dataset": [value.dataset],
            "log": [value.log],
            "index": [value.index],
            "width_px": [value.width_px],
            "height_px": [value.height_px],
            "camera_names": [list(value.camera_names)],
            "world_SE3_chunk": pose_rows(pose[None], "world_SE3_chunk"),
        },
    )
    ego = checked(value.chunk_SE3_ego, "chunk_SE3_ego", np.float64, (len(value.frames), 4, 4))
    frames = {"frame": list(value.frames), "chunk_SE3_ego": pose_rows(ego, "chunk_SE3_ego")}
    write_table(folder / "frames.parquet", FRAMES, frames)
    _write_views(folder, value.views)
    _write_points(folder, [(STATIC, value.static)] + [(FIRST_ACTOR + k, a.points) for k, a in enumerate(value.actors)])
    write_table(folder / "actors.parquet", ACTORS, actor_columns(value.actors))
    write_table(
        folder / "marks.parquet",
        MARKS,
        {
            "kind": [m.kind for m in value.marks],
            "detail": [m.detail for m in value.marks],
            "frame": [m.frame for m in value.marks],
            "camera": [m.camera for m in value.marks],
        },
    )


def read(folder: Path, measurements: Mapping[str, Any] | None = None) -> Chunk:
    """The chunk; NumPy arrays are writable copies."""
    rows = read_table(folder / "chunk.parquet", CHUNK)[0].to_pylist()
    if len(rows) != 1:
        raise ArtifactCorruptError(
            f"There are {len(rows)} rows, expected 1", remedy=REMEDY, file=folder / "chunk.parquet"
        )
    (head,) = rows
    frames = read_table(folder / "frames.parquet", FRAMES)[0]
    points = _read_points(folder)
    actors = read_table(folder / "actors.parquet", ACTORS)[0].to_pylist()
    stray = set(points) - {STATIC, *(FIRST_ACTOR + k for k in range(len(actors)))}
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
        world_SE3_chunk=poses_of(head["world_SE3_chunk"])[0],
        chunk_SE3_ego=poses_of(frames.column("chunk_SE3_ego").to_pylist()),
        views=_read_views(folder),
        static=points.get(STATIC, _no_points()),
        actors=tuple(
            Actor(**actor_fields(folder / "actors.parquet", row), points=points.get(FIRST_ACTOR + k, _no_points()))
            for k, row in enumerate(actors)
        ),
        marks=tuple(Mark(**row) for row in read_table(folder / "marks.parquet", MARKS)[0].to_pylist()),
    )


def measurements(value: Chunk) -> dict[str, Any]:
    """None: a chunk is all payload."""
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
    write_table(folder / "views.parquet", VIEWS, columns, raw=("image",))


def _read_views(folder: Path) -> tuple[View, ...]:
    path = folder / "views.parquet"
    views = []
    for row in read_table(path, VIEWS)[0].to_pylist():
        if row["role"] not in ("source", "heldout"):
            raise ArtifactCorruptError(f"Column 'role' holds {row['role']!r}", remedy=REMEDY, file=path)
        pose, lens = pose_and_lens(row)
        views.append(View(row["camera"], row["frame"], row["role"], row["timestamp_s"], pose, lens, row["image"]))
    return tuple(views)


def _write_points(folder: Path, nodes: list[tuple[int, Points]]) -> None:
    for node, p in nodes:
        checked(p.positions, f"positions of node {node}", np.float32, (None, 3))
        checked(p.colors, f"colors of node {node}", np.uint8, (len(p), 3))
        checked(p.colored, f"colored of node {node}", np.bool_, (len(p),))
        checked(p.frames, f"frames of node {node}", np.int16, (len(p),))
    positions = np.concatenate([p.positions for _, p in nodes])
    colors = np.concatenate([p.colors for _, p in nodes])
    columns = {
        "node": np.concatenate([np.full(len(p), node, np.int64) for node, p in nodes]),
        **{axis: positions[:, i] for i, axis in enumerate("xyz")},
        **{name: colors[:, i] for i, name in enumerate(("red", "green", "blue"))},
        "colored": np.concatenate([p.colored for _, p in nodes]),
        "frame": np.concatenate([p.frames for _, p in nodes]),
    }
    write_table(folder / "points.parquet", POINTS, columns)


def _read_points(folder: Path) -> dict[int, Points]:
    table = read_table(folder / "points.parquet", POINTS)[0]
    node = array_of(table, "node")
    if np.any(np.diff(node) < 0):
        raise ArtifactCorruptError("Column 'node' is not sorted", remedy=REMEDY, file=folder / "points.parquet")
    positions = np.stack([array_of(table, c) for c in ("x", "y", "z")], 1)
    colors = np.stack([array_of(table, c) for c in ("red", "green", "blue")], 1)
    colored, frame = array_of(table, "colored"), array_of(table, "frame")
    out = {}
    for n in np.unique(node).tolist():
        at = slice(*np.searchsorted(node, [n, n + 1]).tolist())
        out[n] = Points(positions[at].copy(), colors[at].copy(), colored[at].copy(), frame[at].copy())
    return out


def _no_points() -> Points:
    return Points(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, bool), np.zeros(0, np.int16))
