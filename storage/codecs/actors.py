"""The table of actors, which the codecs of chunks and of reconstructions share."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from genre_tasks.errors import ArtifactCorruptError
from storage.codecs.tables import POSE, REMEDY, check_array, column, poses_from_rows, read_rows, schema, write_table

if TYPE_CHECKING:
    from genre_tasks.scene.actor_node import ActorNode
    from genre_tasks.scene.chunk import Actor

# Lists inside rows, because few actors have many frames: a second table would need a join to read.
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


def write_actors(path: Path, actors: Sequence[Actor | ActorNode]) -> None:
    """Writes the actors of a chunk or of a reconstruction, without their points.

    Args:
        path: the new file.
        actors: the actors, one row each.

    Raises:
        ConfigError: frames or poses have another dtype or shape.
        NonFiniteError: a pose holds NaN or infinity.
    """
    # Checked before anything is written, so that a wrong actor leaves no half-written table.
    for actor in actors:
        name = f"of actor {actor.track_id}"
        check_array(actor.frames, f"frames {name}", np.int64, (None,))
        check_array(actor.chunk_SE3_box, f"chunk_SE3_box {name}", np.float64, (len(actor.frames), 4, 4))
    columns = {
        "track_id": [a.track_id for a in actors],
        "label": [a.label for a in actors],
        "length_m": [float(a.size_m[0]) for a in actors],
        "width_m": [float(a.size_m[1]) for a in actors],
        "height_m": [float(a.size_m[2]) for a in actors],
        "frames": [a.frames.tolist() for a in actors],
        "chunk_SE3_box": [a.chunk_SE3_box.reshape(-1, 16).tolist() for a in actors],
    }
    write_table(path, ACTORS, columns)


def read_actors(path: Path) -> list[dict[str, Any]]:
    """Reads the fields that ``Actor`` and ``ActorNode`` share.

    Args:
        path: the file.

    Returns:
        A dictionary for each actor: ``track_id``, ``label``, ``size_m``, ``frames`` [F] and ``chunk_SE3_box``
        [F, 4, 4].

    Raises:
        ArtifactCorruptError: the table is damaged, or an actor has another number of frames than of poses.
    """
    return [_actor_fields(path, row) for row in read_rows(path, ACTORS)]


def _actor_fields(path: Path, row: dict[str, Any]) -> dict[str, Any]:
    frames = np.array(row["frames"], np.int64)
    poses = poses_from_rows(row["chunk_SE3_box"])
    # Two lists in a row may differ in length, which no schema can forbid.
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
