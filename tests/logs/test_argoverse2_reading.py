"""Argoverse 2: the log that was written comes back, real tables are read, and what is broken names its file."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from PIL import Image
from pyarrow import feather

from genre_tasks.errors import InputError
from genre_tasks.logs.registry import open_log
from tests.fakes import FakeLog
from tests.logs.argoverse2_folder import START_NS, write_argoverse2

FAKE = FakeLog(frame_count=5, camera_names=("front", "left"), lidar_azimuths=60, lidar_rings=8, ego_yaw_rad=0.4)
REAL = Path(__file__).resolve().parents[3] / "shared/data/argoverse2/7fab2350-7eaf-3b7e-a39d-6937a4c1bede"


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_argoverse2(FAKE, tmp_path_factory.mktemp("argoverse2") / "log-1")


@pytest.fixture
def folder(written: Path, tmp_path: Path) -> Path:
    """A log for a test to break."""
    shutil.copytree(written, tmp_path / "log-1")
    return tmp_path / "log-1"


def test_a_written_log_comes_back(written: Path) -> None:
    log = open_log(f"argoverse2:{written}")
    shift = np.eye(4)
    shift[:3, 3] = -FAKE.world_SE3_lidar(0)[:3, 3]
    assert [camera.name for camera in log.cameras] == ["ring_front", "ring_left"]
    assert log.cameras[0].lens == FAKE.lens
    for frame in range(FAKE.frame_count):
        assert log.frame_timestamp_s(frame) - START_NS * 1e-9 == pytest.approx(FAKE.frame_timestamp_s(frame), abs=1e-6)
        np.testing.assert_allclose(log.world_SE3_lidar(frame), shift @ FAKE.world_SE3_lidar(frame), atol=1e-7)
        for camera in FAKE.camera_names:
            expected = shift @ FAKE.world_SE3_camera(camera, frame)
            np.testing.assert_allclose(log.world_SE3_camera(f"ring_{camera}", frame), expected, atol=1e-7)
            assert log.image_bytes(f"ring_{camera}", frame) == FAKE.image_bytes(camera, frame)
        points = FAKE.sweep(frame).points_world + shift[:3, 3]
        np.testing.assert_allclose(log.sweep(frame).points_world, points, atol=1e-5)
    for track in FAKE.tracks():
        (found,) = [found for found in log.tracks() if found.track_id == track.track_id]
        assert (found.label, found.moving) == (track.label, track.moving)
        np.testing.assert_allclose(found.size_m, track.size_m)
        np.testing.assert_allclose(found.world_SE3_box, shift @ track.world_SE3_box, atol=1e-7)


def test_a_sweep_says_where_its_upper_lidar_is_where_the_calibration_does(folder: Path) -> None:
    _set("calibration/egovehicle_SE3_sensor.feather", "tz_m", 1.64)(folder)
    log = open_log(f"argoverse2:{folder}")
    expected = log.world_SE3_lidar(2) @ [0.0, 0.0, 1.64, 1.0]
    np.testing.assert_allclose(log.sweep(2).sensor_world, expected[:3], atol=1e-9)
    mounts = folder / "calibration/egovehicle_SE3_sensor.feather"
    table = feather.read_table(mounts)
    feather.write_feather(table.filter(pa.compute.not_equal(table["sensor_name"], "up_lidar")), mounts)
    assert open_log(f"argoverse2:{folder}").sweep(2).sensor_world is None


def test_points_of_half_precision(tmp_path: Path) -> None:
    log = open_log(f"argoverse2:{write_argoverse2(FAKE, tmp_path / 'half', np.float16)}")
    points = FAKE.sweep(1).points_world - FAKE.world_SE3_lidar(0)[:3, 3]
    # A number of half precision below 64 m is right to 1.6 cm.
    np.testing.assert_allclose(log.sweep(1).points_world, points, atol=0.05)


def test_of_two_boxes_of_one_id_the_first_counts(folder: Path) -> None:
    expected = open_log(f"argoverse2:{folder}").tracks()
    table = feather.read_table(folder / "annotations.feather")
    moved = table.slice(0, 1).to_pydict()
    moved["tx_m"] = [moved["tx_m"][0] + 50.0]
    table = pa.concat_tables([table, pa.table(moved, schema=table.schema)])
    feather.write_feather(table, folder / "annotations.feather")
    log = open_log(f"argoverse2:{folder}")
    for track, known in zip(log.tracks(), expected, strict=True):
        np.testing.assert_array_equal(track.world_SE3_box, known.world_SE3_box)
    assert [finding.word for finding in log.findings()] == ["repeated_box_id"]


def test_each_frame_has_the_nearest_image_and_its_pose(folder: Path) -> None:
    images = sorted((folder / "sensors/cameras/ring_front").iterdir())
    # Two images a sweep, as the cameras are twice as fast; the second ones are nobody's.
    for path in images:
        path.with_name(f"{int(path.stem) + 60_000_000}.png").write_bytes(b"")
        path.rename(path.with_name(f"{int(path.stem) + 20_000_000}.png"))
    log = open_log(f"argoverse2:{folder}")
    for frame in range(FAKE.frame_count):
        assert log.image_bytes("ring_front", frame) == FAKE.image_bytes("front", frame)
        assert log.camera_timestamp_s("ring_front", frame) - log.frame_timestamp_s(frame) == pytest.approx(
            0.02, abs=1e-6
        )
    moved = log.world_SE3_camera("ring_front", 2)[:3, 3] - FAKE.world_SE3_camera("front", 2)[:3, 3]
    expected = 0.02 / 0.1 * 0.3 - FAKE.world_SE3_lidar(0)[0, 3]
    assert moved[0] == pytest.approx(expected, abs=1e-6)
    # What is wrong with images of nobody is of no account.
    assert log.findings() == ()


def test_findings_on_images_name_frames(folder: Path) -> None:
    images = sorted((folder / "sensors/cameras/ring_front").iterdir())
    # As the image of frame 0 is missing, that of frame 3 is the third one of its folder.
    images[0].unlink()
    Image.open(images[3]).resize((12, 8)).save(images[3])
    images[4].write_bytes(b"")
    # Thumbnails between the sweeps outnumber the images of frames.
    for index in range(10):
        Image.new("RGB", (12, 8)).save(images[1].with_name(f"{int(images[1].stem) + 40_000_000 + index}.png"))
    log = open_log(f"argoverse2:{folder}")
    assert log.cameras[0].lens == FAKE.lens
    found = {(finding.word, finding.frames) for finding in log.findings()}
    assert found == {("odd_image_size", (3,)), ("unreadable_image", (4,))}


@pytest.mark.real
@pytest.mark.skipif(not REAL.is_dir(), reason=f"no Argoverse 2 log beside the checkout ({REAL})")
def test_a_real_log_without_images() -> None:
    log = open_log(f"argoverse2:{REAL}")
    assert log.frame_count == 2
    assert log.cameras == ()
    boxes = [track for track in log.tracks() if len(track.frames) == 2]
    assert len(boxes) > 20
    sweep = log.sweep(0)
    assert len(sweep.points_world) == 99_229
    # Points lie in the boxes of their own sweep: cars have hundreds.
    (largest,) = sorted(boxes, key=lambda track: -_count_inside(sweep.points_world, track))[:1]
    assert _count_inside(sweep.points_world, largest) > 200
    pose = log.world_SE3_lidar(0)
    assert pose[2, 2] > 0.99
    # The upper LiDAR of the calibration.
    np.testing.assert_allclose((sweep.sensor_world - pose[:3, 3]) @ pose[:3, :3], [1.35018, 0, 1.64042], atol=1e-5)


def _count_inside(points: Any, track: Any) -> int:
    local = (points - track.world_SE3_box[0, :3, 3]) @ track.world_SE3_box[0, :3, :3]
    return int((np.abs(local) <= np.asarray(track.size_m) / 2).all(axis=1).sum())


def _drop(name: str, column: str) -> Any:
    return lambda folder: feather.write_feather(feather.read_table(folder / name).drop_columns(column), folder / name)


def _set(name: str, column: str, values: Any) -> Any:
    def change(folder: Path) -> None:
        table = feather.read_table(folder / name)
        index = table.column_names.index(column)
        table = table.set_column(index, column, pa.array([values] * table.num_rows))
        feather.write_feather(table, folder / name)

    return change


BROKEN = {
    "no poses": (lambda folder: (folder / "city_SE3_egovehicle.feather").unlink(), "there is no city_SE3"),
    "no lens": (lambda folder: (folder / "calibration/intrinsics.feather").unlink(), "lacks a table"),
    "no column": (_drop("calibration/intrinsics.feather", "fy_px"), "lacks fy_px"),
    "no mount": (_set("calibration/egovehicle_SE3_sensor.feather", "sensor_name", "x"), "no place on the vehicle"),
    "a camera elsewhere": (_set("calibration/intrinsics.feather", "sensor_name", "ring_/../x"), "a folder's name"),
    "no focus": (_set("calibration/intrinsics.feather", "fx_px", 0.0), "no positive focal length"),
    "an infinite pose": (_set("city_SE3_egovehicle.feather", "tx_m", float("inf")), "not finite"),
    "one time": (_set("city_SE3_egovehicle.feather", "timestamp_ns", 5), "1 poses"),
    "poses of text": (_set("city_SE3_egovehicle.feather", "tx_m", "here"), "holds string"),
    "no size": (_set("annotations.feather", "width_m", 0.0), "boxes are bad: .* not positive"),
    "no sweeps": (lambda folder: shutil.rmtree(folder / "sensors/lidar"), "no sweeps"),
    "cut": (
        lambda folder: (folder / "annotations.feather").write_bytes(
            (folder / "annotations.feather").read_bytes()[:-40]
        ),
        "cannot be read",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_log_is_an_error_that_names_the_file(folder: Path, name: str) -> None:
    break_it, problem = BROKEN[name]
    break_it(folder)
    with pytest.raises(InputError, match=problem) as caught:
        open_log(f"argoverse2:{folder}").tracks()
    assert caught.value.file is not None
    assert caught.value.remedy


def test_a_folder_above_names_its_logs(folder: Path) -> None:
    with pytest.raises(InputError) as caught:
        open_log(f"argoverse2:{folder.parent}")
    assert "log-1" in caught.value.remedy


@pytest.mark.parametrize(
    ("name", "column", "value"),
    [
        ("city_SE3_egovehicle.feather", "tz_m", 1.0),
        ("calibration/egovehicle_SE3_sensor.feather", "tz_m", 1.0),
        ("calibration/intrinsics.feather", "fx_px", 50.0),
        ("annotations.feather", "width_m", 1.0),
        (f"sensors/lidar/{START_NS}.feather", "intensity", 7),
    ],
)
def test_every_table_counts(folder: Path, name: str, column: str, value: float) -> None:
    digest = open_log(f"argoverse2:{folder}").digest()
    _set(name, column, value)(folder)
    assert open_log(f"argoverse2:{folder}").digest() != digest
