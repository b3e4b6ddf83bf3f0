"""The rows of one scene, from the index of the tables."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from scipy.spatial.transform import Rotation

from genre_tasks.errors import InputError
from genre_tasks.logs.labelled_boxes import MAX_BOXES
from genre_tasks.logs.nuscenes.json_rows import REMEDY
from genre_tasks.logs.nuscenes.row_digests import check_rows, create_digest_table, write_row_digest
from genre_tasks.logs.types import Float64
from genre_tasks.suggestions import did_you_mean

_MAX_SCENES_LISTED = 10
# A scene of twenty seconds has a few thousand data and boxes.
_MAX_ROWS = MAX_BOXES
_MIN_QUATERNION_NORM = 1e-6

_SCENE_QUERY = "SELECT name, token FROM scene ORDER BY name, token"
# Outer joins, so that a token that points nowhere is seen and not left out.
_DATA_QUERY = """
    SELECT data.*, calibrated.token AS calibrated, sensor.token AS sensor, pose.token AS pose,
        channel, modality,
        calibrated.translation0 AS mount_x, calibrated.translation1 AS mount_y, calibrated.translation2 AS mount_z,
        calibrated.rotation0 AS mount_qw, calibrated.rotation1 AS mount_qx,
        calibrated.rotation2 AS mount_qy, calibrated.rotation3 AS mount_qz,
        pose.translation0 AS pose_x, pose.translation1 AS pose_y, pose.translation2 AS pose_z,
        pose.rotation0 AS pose_qw, pose.rotation1 AS pose_qx, pose.rotation2 AS pose_qy, pose.rotation3 AS pose_qz,
        camera_intrinsic0 AS fx, camera_intrinsic4 AS fy, camera_intrinsic2 AS cx, camera_intrinsic5 AS cy
    FROM sample JOIN sample_data AS data ON data.sample_token = sample.token
        LEFT JOIN calibrated_sensor AS calibrated ON calibrated.token = calibrated_sensor_token
        LEFT JOIN sensor ON sensor.token = sensor_token
        LEFT JOIN ego_pose AS pose ON pose.token = ego_pose_token
    WHERE scene_token = :scene ORDER BY data.timestamp, data.token LIMIT :limit
"""
_BOX_QUERY = """
    SELECT box.*, sample.timestamp AS timestamp, instance.token AS instance, category.name AS label
    FROM sample JOIN sample_annotation AS box ON box.sample_token = sample.token
        LEFT JOIN instance ON instance.token = instance_token
        LEFT JOIN category ON category.token = category_token
    WHERE scene_token = :scene ORDER BY sample.timestamp, box.token LIMIT :limit
"""
_QUERIES = {"scene": _SCENE_QUERY, "sample_data": _DATA_QUERY, "sample_annotation": _BOX_QUERY}
# Column that is null where a token points nowhere → the row's token, its table, the table it points to.
_DATA_LINKS = {
    "calibrated": ("calibrated_sensor_token", "sample_data", "calibrated_sensor"),
    "sensor": ("calibrated_sensor_token", "calibrated_sensor", "sensor"),
    "pose": ("ego_pose_token", "sample_data", "ego_pose"),
}
_BOX_LINKS = {
    "instance": ("instance_token", "sample_annotation", "instance"),
    "label": ("instance_token", "instance", "category"),
}


@dataclass(frozen=True)
class SensorData:
    """An image or a sweep.

    Attributes:
        time_us: microseconds since 1970.
        file: its path below the root.
        sample: token of the key frame that it belongs to.
        is_key_frame: its sensor's datum of that key frame.
        world_SE3_vehicle: [4, 4] at that time.
        vehicle_SE3_sensor: [4, 4].
        lens: fx, fy, cx, cy in pixels, as the file has them; ``None`` for other sensors than cameras.
        size_px: width and height; 0 where they are not stated.
    """

    time_us: int
    file: PurePosixPath
    sample: str
    is_key_frame: bool
    world_SE3_vehicle: Float64
    vehicle_SE3_sensor: Float64
    lens: tuple[float, float, float, float] | None
    size_px: tuple[int, int]


@dataclass(frozen=True)
class SceneBoxes:
    """The boxes of a scene, in the world. Their numbers are unchecked, and NaN where one is missing.

    Attributes:
        tokens: [B] of the boxes.
        samples: [B] tokens of key frames.
        times_us: [B] of key frames.
        instances: [B] tokens of objects.
        labels: [B] categories.
        positions: [B, 3] centres.
        quats: [B, 4] w, x, y, z.
        sizes_m: [B, 3] length, width, height.
    """

    tokens: tuple[str, ...]
    samples: tuple[str, ...]
    times_us: tuple[int, ...]
    instances: tuple[str, ...]
    labels: tuple[str, ...]
    positions: Float64
    quats: Float64
    sizes_m: Float64

    def select(self, rows: Sequence[int]) -> SceneBoxes:
        """Takes some of the boxes.

        Args:
            rows: of these boxes.
        """
        indices = list(rows)
        return SceneBoxes(
            tokens=tuple(self.tokens[row] for row in indices),
            samples=tuple(self.samples[row] for row in indices),
            times_us=tuple(self.times_us[row] for row in indices),
            instances=tuple(self.instances[row] for row in indices),
            labels=tuple(self.labels[row] for row in indices),
            positions=self.positions[indices],
            quats=self.quats[indices],
            sizes_m=self.sizes_m[indices],
        )


@dataclass(frozen=True)
class SceneRows:
    """A scene.

    Attributes:
        cameras: channel → data by time.
        lidars: channel → data by time.
        boxes: of key frames.
    """

    cameras: dict[str, tuple[SensorData, ...]]
    lidars: dict[str, tuple[SensorData, ...]]
    boxes: SceneBoxes


def write_row_digests(index: sqlite3.Connection) -> None:
    """Writes what :func:`read_scene` and :func:`list_scene_names` compare their rows with.

    Args:
        index: whose tables are complete.
    """
    create_digest_table(index)
    tokens = [token for _, token in _select(index, "scene")]
    parts = [("scene", ""), *((table, token) for token in tokens for table in ("sample_data", "sample_annotation"))]
    for table, scene in parts:
        write_row_digest(index, table, scene, _select(index, table, scene))


def list_scene_names(index: sqlite3.Connection) -> list[str]:
    """Lists the names of all scenes of a version, sorted.

    Args:
        index: of the version's tables.

    Raises:
        sqlite3.DatabaseError: the index is damaged.
    """
    return [row["name"] for row in _fetch(index, "scene")]


def read_scene(index: sqlite3.Connection, name: str, tables: Path, log: str) -> SceneRows:
    """Reads the rows of a scene.

    Args:
        index: of the version's tables.
        name: of the scene.
        tables: folder of the version, for errors.
        log: URI of the log, for errors.

    Returns:
        The rows, of cameras and LiDARs alone.

    Raises:
        InputError: there is no such scene, or a row points to one that is not there.
        sqlite3.DatabaseError: the index is damaged.
    """
    scenes = _fetch(index, "scene")
    # Names are what users know; nothing in the tables keeps two scenes from having the same one.
    tokens = [row["token"] for row in scenes if row["name"] == name]
    if len(tokens) != 1:
        raise _describe_no_scene([row["name"] for row in scenes], name, len(tokens), tables, log)
    data = _fetch_of_scene(index, "sample_data", tokens[0], tables, log)
    _check_links(data, _DATA_LINKS, tables, log)
    boxes = _fetch_of_scene(index, "sample_annotation", tokens[0], tables, log)
    _check_links(boxes, _BOX_LINKS, tables, log)
    file = tables / "sample_data.json"
    mounts = _compose(data, "mount", tables / "calibrated_sensor.json", log)
    poses = _compose(data, "pose", tables / "ego_pose.json", log)
    by_modality: dict[str, dict[str, list[SensorData]]] = {"camera": {}, "lidar": {}}
    for row, mount, pose in zip(data, mounts, poses, strict=True):
        if row["modality"] in by_modality:
            datum = _build_datum(row, mount, pose, file, log)
            by_modality[row["modality"]].setdefault(row["channel"], []).append(datum)
    cameras, lidars = (
        {channel: tuple(by_channel[channel]) for channel in sorted(by_channel)} for by_channel in by_modality.values()
    )
    return SceneRows(cameras, lidars, _build_boxes(boxes))


def _describe_no_scene(names: Sequence[str], name: str, count: int, tables: Path, log: str) -> InputError:
    known = ", ".join(names[:_MAX_SCENES_LISTED]) + (", …" if len(names) > _MAX_SCENES_LISTED else "")
    problem = f"{tables.name} has {count} scenes of the name {name!r}"
    remedy = f"{did_you_mean(name, names)}It has {known or 'none'}."
    return InputError(problem, remedy=remedy, file=tables / "scene.json", log=log)


def _fetch_of_scene(index: sqlite3.Connection, table: str, scene: str, tables: Path, log: str) -> list[sqlite3.Row]:
    rows = _fetch(index, table, scene)
    if len(rows) > _MAX_ROWS:
        problem = f"a scene has more than {_MAX_ROWS} rows"
        raise InputError(problem, remedy=REMEDY, file=tables / f"{table}.json", log=log)
    return rows


def _fetch(index: sqlite3.Connection, table: str, scene: str = "") -> list[sqlite3.Row]:
    rows = _select(index, table, scene).fetchall()
    check_rows(index, table, scene, rows)
    return rows


def _select(index: sqlite3.Connection, table: str, scene: str = "") -> sqlite3.Cursor:
    return index.execute(_QUERIES[table], {"scene": scene, "limit": _MAX_ROWS + 1})


def _check_links(rows: list[sqlite3.Row], links: dict[str, tuple[str, str, str]], tables: Path, log: str) -> None:
    for row in rows:
        for column, (token, table, target) in links.items():
            if row[column] is None:
                problem = f"{table} points to a row of {target} that is not there, from {token} {row[token]!r}"
                raise InputError(problem, remedy=REMEDY, file=tables / f"{target}.json", log=log)


def _compose(rows: list[sqlite3.Row], prefix: str, file: Path, log: str) -> Float64:
    """[N, 4, 4] poses of the columns that begin with a prefix."""
    numbers = np.array([[row[f"{prefix}_{name}"] for name in _POSE_COLUMNS] for row in rows]).reshape(-1, 7)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = _to_rotations(numbers[:, 3:], file, log).as_matrix()
    poses[:, :3, 3] = numbers[:, :3]
    return poses


_POSE_COLUMNS = ("x", "y", "z", "qw", "qx", "qy", "qz")


def _to_rotations(quats: Float64, file: Path, log: str) -> Rotation:
    if len(quats) and np.linalg.norm(quats, axis=1).min() < _MIN_QUATERNION_NORM:
        raise InputError("a quaternion is zero", remedy=REMEDY, file=file, log=log)
    # SciPy puts the scalar part last.
    return Rotation.from_quat(quats[:, [1, 2, 3, 0]].reshape(-1, 4))


def _build_datum(row: sqlite3.Row, mount: Float64, pose: Float64, file: Path, log: str) -> SensorData:
    name = PurePosixPath(row["filename"])
    # A table must not make the reader open files elsewhere.
    if name.is_absolute() or ".." in name.parts or not name.parts:
        raise InputError(f"a file lies outside of the root: {row['filename']!r}", remedy=REMEDY, file=file, log=log)
    lens = None if row["fx"] is None else (row["fx"], row["fy"], row["cx"], row["cy"])
    if row["modality"] == "camera" and (lens is None or not min(lens[:2]) > 0):
        problem = f"{row['channel']} has no positive focal lengths"
        where = file.with_name("calibrated_sensor.json")
        raise InputError(problem, remedy=REMEDY, file=where, log=log, camera=row["channel"])
    return SensorData(
        time_us=row["timestamp"],
        file=name,
        sample=row["sample_token"],
        is_key_frame=bool(row["is_key_frame"]),
        world_SE3_vehicle=pose,
        vehicle_SE3_sensor=mount,
        lens=lens,
        size_px=(row["width"], row["height"]),
    )


def _build_boxes(rows: list[sqlite3.Row]) -> SceneBoxes:
    def take(*names: str) -> Float64:
        # Nulls become NaN.
        return np.array([[row[name] for name in names] for row in rows], dtype=np.float64).reshape(-1, len(names))

    return SceneBoxes(
        tokens=tuple(row["token"] for row in rows),
        samples=tuple(row["sample_token"] for row in rows),
        times_us=tuple(row["timestamp"] for row in rows),
        instances=tuple(row["instance_token"] for row in rows),
        labels=tuple(row["label"] for row in rows),
        positions=take("translation0", "translation1", "translation2"),
        quats=take("rotation0", "rotation1", "rotation2", "rotation3"),
        # Sizes stand in the order width, length, height.
        sizes_m=take("size1", "size0", "size2"),
    )
