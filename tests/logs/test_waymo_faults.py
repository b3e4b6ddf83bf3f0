"""Waymo: whatever is wrong with a component is one error that names its file and what to do, within bounded memory."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from genre_tasks.bounded_parquet import MemoryBound, RowReader, TableTooLargeError
from genre_tasks.errors import InputError
from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import DrivingLog
from tests.fakes import FakeLog
from tests.logs.waymo_folder import LISTS, SEGMENT, TRANSFORM, change_column, write_waymo

FAKE = FakeLog(frame_count=3, camera_names=("front",), lidar_azimuths=24, lidar_rings=4, width_px=16, height_px=12)
IMAGES = len(range(FAKE.frame_count))


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("waymo")
    write_waymo(FAKE, root)
    return root


@pytest.fixture
def root(written: Path, tmp_path: Path) -> Path:
    """A dataset for a test to break."""
    shutil.copytree(written, tmp_path / "waymo")
    return tmp_path / "waymo"


def _set(component: str, field: str, values: Any) -> Callable[[Path], None]:
    return lambda root: change_column(root, component, field, values)


def _remove(component: str) -> Callable[[Path], None]:
    return lambda root: (root / component / f"{SEGMENT}.parquet").unlink()


def _cut(component: str) -> Callable[[Path], None]:
    def cut(root: Path) -> None:
        path = root / component / f"{SEGMENT}.parquet"
        path.write_bytes(path.read_bytes()[:-30])

    return cut


def _name_cameras(name: str) -> Callable[[Path], None]:
    def change(root: Path) -> None:
        change_column(root, "camera_calibration", "key.camera_name", [name])
        change_column(root, "camera_image", "key.camera_name", [name] * IMAGES)

    return change


def _lists(values: list[float]) -> pa.Array:
    return pa.array([values] * IMAGES, LISTS)


MIRROR = pa.array([np.diag([1.0, 1, -1, 1]).ravel().tolist()], TRANSFORM)
NOT_SQUARE = pa.array([[1.0] * 9] * IMAGES, pa.list_(pa.float64()))
BROKEN: dict[str, tuple[Callable[[Path], None], str, str]] = {
    "no poses": (_remove("vehicle_pose"), "lacks vehicle_pose", "vehicle_pose"),
    "no calibration": (_remove("camera_calibration"), "lacks camera_calibration", "camera_calibration"),
    "no images": (_remove("camera_image"), "lacks camera_image", "camera_image"),
    "no lidar calibration": (_remove("lidar_calibration"), "without lidar_calibration", "lidar"),
    "no column": (_set("camera_image", "pose_timestamp", None), "lacks .*pose_timestamp", "camera_image"),
    "no key": (_set("lidar", "key.laser_name", None), "lacks key.laser_name", "lidar"),
    "no times": (_set("lidar_box", "key.frame_timestamp_micros", None), "lacks key.frame", "lidar_box"),
    "a frame twice": (
        _set("vehicle_pose", "key.frame_timestamp_micros", [5] * 3),
        "two of the same time",
        "vehicle_pose",
    ),
    "text for times": (
        _set("vehicle_pose", "key.frame_timestamp_micros", ["a", "b", "c"]),
        "holds string",
        "vehicle_pose",
    ),
    "poses of nine": (
        _set("vehicle_pose", "world_from_vehicle.transform", NOT_SQUARE),
        "no 16 numbers",
        "vehicle_pose",
    ),
    "a mirror": (_set("camera_calibration", "extrinsic.transform", MIRROR), "no rotation", "camera_calibration"),
    "an infinite pose": (
        _set("vehicle_pose", "world_from_vehicle.transform", pa.array([[np.inf] * 16] * 3, TRANSFORM)),
        "not finite",
        "vehicle_pose",
    ),
    "nulls": (_set("camera_image", "pose_timestamp", pa.array([None] * 3, pa.float64())), "nulls", "camera_image"),
    "no focus": (_set("camera_calibration", "intrinsic.f_u", [0.0]), "no positive focal length", "camera_calibration"),
    "a lens that folds": (_set("camera_calibration", "intrinsic.k1", [-3.0]), "folds back", "camera_calibration"),
    "a camera elsewhere": (_name_cameras("../x"), "cannot be a folder's name", "camera_calibration"),
    "another camera": (
        _set("camera_calibration", "key.camera_name", pa.array([3], pa.int8())),
        "no camera has both",
        "camera_calibration",
    ),
    "an image twice": (
        _set("camera_image", "key.frame_timestamp_micros", pa.array([7, 7, 8], pa.int64())),
        "two images of the frame",
        "camera_image",
    ),
    "another lidar": (
        _set("lidar_calibration", "key.laser_name", pa.array([4], pa.int8())),
        "no calibration of the",
        "lidar",
    ),
    "another shape": (
        _set("lidar", "range_image_return1.shape", pa.array([[2, 2, 4]] * IMAGES, pa.list_(pa.int32(), 3))),
        "has the shape",
        "lidar",
    ),
    "too many rows": (_set("lidar_calibration", "beam_inclination.values", pa.array([[0.1]])), "8 rows", "lidar"),
    "poses of other pixels": (
        _set("lidar_pose", "range_image_return1.values", _lists([0.0])),
        "has the shape",
        "lidar_pose",
    ),
    "a box of no frame": (
        _set("lidar_box", "key.frame_timestamp_micros", pa.array([7] * 6, pa.int64())),
        "there is no frame",
        "lidar_box",
    ),
    "no size": (_set("lidar_box", "box.size.z", [0.0] * 6), "boxes are bad: .* not positive", "lidar_box"),
    "images of text": (_set("camera_image", "image", ["x", "y", "z"]), "holds no bytes", "camera_image"),
    "a cut table": (_cut("camera_image"), "cannot be read", "camera_image"),
}


def read_all(log: DrivingLog) -> None:
    """Everything that a log has."""
    log.tracks()
    for frame in range(log.frame_count):
        log.sweep(frame)
        for camera in log.cameras:
            log.image_bytes(camera.name, frame)


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_component_is_an_error_that_names_it(root: Path, name: str) -> None:
    break_it, problem, component = BROKEN[name]
    break_it(root)
    with pytest.raises(InputError, match=problem) as caught:
        read_all(open_log(f"waymo:{root}/{SEGMENT}"))
    assert caught.value.file == str(root / component / f"{SEGMENT}.parquet")
    assert caught.value.remedy


def test_another_layout(root: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such segment") as caught:
        open_log(f"waymo:{root}/1002")
    assert SEGMENT in caught.value.remedy
    with pytest.raises(InputError, match="no such segment"):
        open_log(f"waymo:{root}")
    with pytest.raises(InputError, match="no segments of Waymo's version 2"):
        open_log(f"waymo:{tmp_path}/nowhere/1002")
    with pytest.raises(InputError, match="no segments of Waymo's version 2"):
        open_log("waymo:")
    (tmp_path / "old").mkdir()
    (tmp_path / "old/segment-1.tfrecord").touch()
    with pytest.raises(InputError, match="version 1 of the dataset"):
        open_log(f"waymo:{tmp_path}/old/segment-1.tfrecord")


def test_damage_within_a_page_is_found(root: Path) -> None:
    path = root / f"camera_image/{SEGMENT}.parquet"
    # Checksums cover neither statistics, which would repeat an image, nor pages of dictionaries.
    table = pq.read_table(path)
    pq.write_table(table, path, use_dictionary=False, write_statistics=False, write_page_checksum=True)
    data = path.read_bytes()
    image = FAKE.image_bytes("front", 1)
    assert image is not None
    # Compression leaves most bytes of an image as they are.
    at = next(at for at in (data.find(image[k : k + 40]) for k in range(len(image) - 40)) if at > 0)
    path.write_bytes(data[:at] + b"\0" * 40 + data[at + 40 :])
    with pytest.raises(InputError, match="cannot be read") as caught:
        read_all(open_log(f"waymo:{root}/{SEGMENT}"))
    assert caught.value.file == str(path)


def test_a_small_file_that_holds_a_billion_numbers(root: Path) -> None:
    """Repeated values take no room in a file: the reader asks what they would take in memory."""
    path = root / f"lidar/{SEGMENT}.parquet"
    table = pq.read_table(path)
    zeros = pa.array(np.zeros(40_000_000, np.float32))
    offsets = pa.array([0, 40_000_000, 40_000_000, 40_000_000], pa.int32())
    index = table.column_names.index("[LiDARComponent].range_image_return1.values")
    table = table.set_column(index, table.column_names[index], pa.ListArray.from_arrays(offsets, zeros))
    with pq.ParquetWriter(path, table.schema) as writer:
        for _ in range(2):
            writer.write_table(table, row_group_size=3)
    assert path.stat().st_size < 1 << 22
    with pytest.raises(InputError) as caught:
        open_log(f"waymo:{root}/{SEGMENT}").sweep(0)
    assert caught.value.file == str(path)


def test_rows_are_read_in_any_order_within_their_bound(tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"
    values = [bytes([k]) * 1000 for k in range(50)]
    pq.write_table(pa.table({"a.b": values, "other": list(range(50))}), path, row_group_size=8)
    bound = MemoryBound(1 << 20, file_ratio=1, value_bytes=1, row_bytes=0)
    reader = RowReader(path, bound, ["a.b"])
    for row in (0, 3, 9, 8, 49, 49, 0, 17):
        assert reader.read(row).column("a.b")[0].as_py() == values[row]
    with pytest.raises(ValueError, match="no row 50"):
        reader.read(50)
    with pytest.raises(TableTooLargeError):
        RowReader(path, MemoryBound(100, file_ratio=0, value_bytes=1, row_bytes=0), ["a.b"])
