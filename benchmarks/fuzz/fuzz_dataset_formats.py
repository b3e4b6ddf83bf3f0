"""The readers of other datasets' layouts: KITTI, Argoverse 2, nuScenes, Waymo, and the layout for people's own logs."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from benchmarks.fuzz import fuzz_log_folders, fuzz_table_attacks
from benchmarks.fuzz.fuzz_mutations import BYTES, JSON, TEXT, Mutation
from benchmarks.fuzz.fuzz_target import LARGE_TABLE_MEMORY_MIB, FuzzTarget, require_sound


def dataset_targets() -> Iterator[FuzzTarget]:
    """Lists the files of all layouts, each damaged within a log that is valid else."""
    for layout, write, read in _LAYOUTS:
        for file, damages, share in _FILES[layout]:
            prepare = partial(_prepare, write, file)
            above = len(Path(file).parts) - 1
            yield FuzzTarget(layout, f"{layout} {file}", file, prepare, partial(read, above), damages, share)
    # The files are small, and what they would become is not.
    waymo, argoverse2 = _LAYOUTS[4], _LAYOUTS[2]
    segment = f"{fuzz_log_folders.SEGMENT}.parquet"
    for (layout, write, read), file, above, bomb in (
        (waymo, f"lidar_box/{segment}", 1, _make_large_parquet),
        (waymo, f"lidar/{segment}", 1, _make_long_lists),
        (argoverse2, "annotations.feather", 0, _make_large_feather),
    ):
        prepare = partial(_prepare, write, file)
        reader = f"{layout}, large {file}"
        yield FuzzTarget(layout, reader, file, prepare, partial(read, above), (bomb,), 1, LARGE_TABLE_MEMORY_MIB)


def _prepare(write: Callable[[Path], None], file: str, folder: Path) -> list[bytes]:
    write(folder)
    return [(folder / file).read_bytes()]


def _change_feather(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Changes a Feather table as a Parquet table is changed."""
    import pyarrow.parquet as pq
    from pyarrow import feather

    sink = io.BytesIO()
    try:
        pq.write_table(feather.read_table(io.BytesIO(data)), sink)
    except Exception:
        # Another damage came first.
        return data
    table = pq.read_table(io.BytesIO(fuzz_table_attacks.change_table(rng, sink.getvalue(), others)))
    sink = io.BytesIO()
    feather.write_feather(table, sink)
    return sink.getvalue()


def _make_large_feather(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Repeats the rows of a Feather table; compressed, they take next to nothing."""
    from pyarrow import feather

    sink = io.BytesIO()
    feather.write_feather(_repeat_rows(rng, feather.read_table(io.BytesIO(data))), sink, compression="zstd")
    return sink.getvalue()


def _make_large_parquet(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Repeats the rows of a Parquet table."""
    import pyarrow.parquet as pq

    sink = io.BytesIO()
    pq.write_table(_repeat_rows(rng, pq.read_table(io.BytesIO(data))), sink, compression="zstd")
    return sink.getvalue()


def _repeat_rows(rng: Random, table: Any) -> Any:
    return table.take(np.zeros(rng.choice((20_000, 200_000, 2_000_000)), np.int64))


def _make_long_lists(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Makes range images of millions of equal numbers, which take no room in a file."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.read_table(io.BytesIO(data))
    count = rng.choice((1_000_000, 10_000_000, 100_000_000))
    zeros = pa.array(np.zeros(count, np.float32))
    name = "[LiDARComponent].range_image_return1.values"
    values = pa.ListArray.from_arrays(pa.array([0, *[count] * table.num_rows], pa.int32()), zeros)
    sink = io.BytesIO()
    pq.write_table(table.set_column(table.column_names.index(name), name, values), sink)
    return sink.getvalue()


def _read_log(log: Any) -> None:
    """Reads everything that a log has, and checks what no file may change."""
    log.findings()
    for frame in range(min(log.frame_count, 4)):
        poses = [log.world_SE3_lidar(frame), *(log.world_SE3_camera(c.name, frame) for c in log.cameras)]
        require_sound(all(np.isfinite(pose).all() for pose in poses), "finite poses")
        sweep = log.sweep(frame)
        if sweep is not None:
            require_sound(np.isfinite(sweep.points_world).all(), "finite points")
        for camera in log.cameras:
            log.image_bytes(camera.name, frame)
    for track in log.tracks():
        require_sound(np.isfinite(track.world_SE3_box).all() and min(track.size_m) > 0, "finite boxes of some size")
    log.digest()


def _find_root(above: int, path: Path) -> Path:
    return path.parents[above]


def _read_kitti(above: int, path: Path) -> None:
    from genre_tasks.logs.kitti.reader import KittiLog

    drive = _find_root(above, path) / fuzz_log_folders.DRIVE
    labels = path if path.name == "labels.txt" else None
    _read_log(KittiLog("kitti:drive", drive, labels))


def _read_argoverse2(above: int, path: Path) -> None:
    from genre_tasks.logs.argoverse2.reader import Argoverse2Log

    _read_log(Argoverse2Log("argoverse2:log", _find_root(above, path)))


def _read_nuscenes(above: int, path: Path) -> None:
    from genre_tasks.logs.nuscenes.reader import NuScenesLog
    from genre_tasks.logs.nuscenes.scene_address import SceneAddress
    from genre_tasks.logs.nuscenes.scene_index import open_scene_index
    from genre_tasks.logs.nuscenes.scene_rows import read_scene

    root = _find_root(above, path)
    address = SceneAddress(root, root / "v1.0-mini", "scene-0061", 10, "")
    # The index lies with the input, whose folder alone may be written.
    with closing(open_scene_index(address.tables, "nuscenes:scene", root / "cache")) as index:
        rows = read_scene(index, address.scene, address.tables, "nuscenes:scene")
    _read_log(NuScenesLog("nuscenes:scene", address, rows))


def _read_waymo(above: int, path: Path) -> None:
    from genre_tasks.logs.waymo.reader import open_waymo

    _read_log(open_waymo(f"{_find_root(above, path)}/{fuzz_log_folders.SEGMENT}"))


def _read_genre_layout(above: int, path: Path) -> None:
    from genre_tasks.logs.genre_layout.reader import GenreLayoutLog

    _read_log(GenreLayoutLog("genre:log", _find_root(above, path) / "log"))


def _write_genre_folder(root: Path) -> None:
    from genre_tasks.logs.genre_layout.writer import write_genre_layout
    from genre_tasks.logs.kitti.reader import KittiLog

    fuzz_log_folders.write_kitti_folder(root / "kitti")
    log = KittiLog("kitti:drive", root / "kitti" / fuzz_log_folders.DRIVE, None)
    write_genre_layout(log, root / "log")


_LAYOUTS: tuple[tuple[str, Callable[[Path], None], Callable[[int, Path], None]], ...] = (
    ("genre layout", _write_genre_folder, _read_genre_layout),
    ("KITTI", fuzz_log_folders.write_kitti_folder, _read_kitti),
    ("Argoverse 2", fuzz_log_folders.write_argoverse2_folder, _read_argoverse2),
    ("nuScenes", fuzz_log_folders.write_nuscenes_folder, _read_nuscenes),
    ("Waymo", fuzz_log_folders.write_waymo_folder, _read_waymo),
)
_TABLE: tuple[Mutation, ...] = (*BYTES, *(fuzz_table_attacks.change_table,) * 8)
_FEATHER: tuple[Mutation, ...] = (*BYTES, *(_change_feather,) * 8)
_TIME = fuzz_log_folders.START_S * 10**9
_DRIVE = fuzz_log_folders.DRIVE
_FILES: dict[str, list[tuple[str, Sequence[Mutation], int]]] = {
    "genre layout": [
        ("log/log.json", JSON, 20),
        ("log/lidar/000000.npz", BYTES, 10),
        ("log/boxes.parquet", _TABLE, 10),
    ],
    "KITTI": [
        (f"{_DRIVE.partition('/')[0]}/calib_cam_to_cam.txt", TEXT, 5),
        (f"{_DRIVE.partition('/')[0]}/calib_velo_to_cam.txt", TEXT, 5),
        (f"{_DRIVE}/oxts/data/0000000001.txt", TEXT, 5),
        (f"{_DRIVE}/velodyne_points/timestamps.txt", TEXT, 5),
        (f"{_DRIVE}/velodyne_points/data/0000000000.bin", BYTES, 5),
        (f"{_DRIVE}/tracklet_labels.xml", TEXT, 10),
        ("labels.txt", TEXT, 10),
    ],
    "Argoverse 2": [
        ("annotations.feather", _FEATHER, 10),
        ("city_SE3_egovehicle.feather", _FEATHER, 5),
        ("calibration/intrinsics.feather", _FEATHER, 5),
        (f"sensors/lidar/{_TIME}.feather", _FEATHER, 10),
    ],
    "nuScenes": [
        *((f"v1.0-mini/{name}.json", JSON, 4) for name in ("scene", "sample", "sensor", "category", "instance")),
        *((f"v1.0-mini/{name}.json", JSON, 8) for name in ("calibrated_sensor", "ego_pose", "sample_annotation")),
        ("v1.0-mini/sample_data.json", JSON, 10),
        ("samples/0.pcd.bin", BYTES, 4),
    ],
    "Waymo": [
        (f"{name}/{fuzz_log_folders.SEGMENT}.parquet", _TABLE, 7)
        for name in (
            *("vehicle_pose", "camera_calibration", "camera_image", "lidar"),
            *("lidar_calibration", "lidar_pose", "lidar_box"),
        )
    ],
}
