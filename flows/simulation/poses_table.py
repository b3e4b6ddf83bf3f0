"""The poses of a rollout as a table, ``poses.parquet``: where the vehicle is, and what counts against each pose."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
from scipy.spatial.transform import Rotation

from genre_tasks.ego_paths.ego_path import EgoPath
from storage.codecs.tables import column, schema, write_records

POSES_FILE = "poses.parquet"
POSES_SCHEMA = schema(
    "rollout_poses/1",
    [
        column("index", pa.int64(), "of the pose, and of its image files"),
        column("time_s", pa.float64(), "seconds since the first pose"),
        column("frame", pa.float64(), "of the log, or a moment between two: where the traffic is"),
        column("x", pa.float64(), "of the ego vehicle in the log's world, metres"),
        column("y", pa.float64(), "metres"),
        column("z", pa.float64(), "metres"),
        column("qw", pa.float64(), "unit quaternion of world_SE3_ego; x forward, y left, z up"),
        column("qx", pa.float64(), "unit quaternion"),
        column("qy", pa.float64(), "unit quaternion"),
        column("qz", pa.float64(), "unit quaternion"),
        column("lateral_m", pa.float64(), "to the left of the recorded path, metres"),
        column("ahead_m", pa.float64(), "of the recorded vehicle at that moment, along its path, metres"),
        column("reliable", pa.bool_(), "within the reliable range of the chunk's scene", nullable=True),
        column("outside_recording", pa.bool_(), "before the start or behind the end of the recorded path"),
        column("chunk", pa.int64(), "whose scene is shown"),
        column("blended_chunk", pa.int64(), "whose scene is mixed in by a hand-over", nullable=True),
        column("blend_weight", pa.float64(), "how much that scene counts, 0 to 0.5"),
        column("collision", pa.string(), "actors whose boxes overlap the vehicle's", nullable=True),
    ],
)


@dataclass(frozen=True)
class PoseRow:
    """A row of the table; its attributes are the columns of ``POSES_SCHEMA``."""

    index: int
    time_s: float
    frame: float
    x: float
    y: float
    z: float
    qw: float
    qx: float
    qy: float
    qz: float
    lateral_m: float
    ahead_m: float
    reliable: bool | None
    outside_recording: bool
    chunk: int
    blended_chunk: int | None
    blend_weight: float
    collision: str | None


def pose_values(path: EgoPath, index: int) -> dict[str, float]:
    """Gives time, frame, position and rotation of a pose.

    Args:
        path: P poses.
        index: of the pose.

    Returns:
        Values by column.

    >>> import numpy as np
    >>> path = EgoPath(np.zeros(1), np.full(1, 4.0), np.eye(4)[None])
    >>> pose_values(path, 0)["qw"], pose_values(path, 0)["frame"]
    (1.0, 4.0)
    """
    pose = path.world_SE3_ego[index]
    # Canonical: a quaternion and its negative are the same rotation.
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True)
    quaternion = {"qw": float(w), "qx": float(x), "qy": float(y), "qz": float(z)}
    position = {name: float(value) for name, value in zip("xyz", pose[:3, 3], strict=True)}
    return {"time_s": float(path.times_s[index]), "frame": float(path.frames[index])} | position | quaternion


def write_poses(folder: Path, rows: list[PoseRow]) -> None:
    """Writes the table.

    Args:
        folder: of the rollout.
        rows: one for each pose.
    """
    write_records(folder / POSES_FILE, POSES_SCHEMA, rows)
