"""Waymo: the segment that was written comes back, and range images, shutters and lenses mean what Waymo says."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from flows.pipeline.log_cache import expand_logs
from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import Camera
from genre_tasks.logs.waymo.component_tables import ComponentTable
from genre_tasks.logs.waymo.range_images import LidarCalibration, compute_points
from tests.fakes import FakeCar, FakeLog
from tests.logs.stated_sensor import check_stated_sensor
from tests.logs.waymo_folder import (
    LIDAR_MOUNT,
    NAMES,
    SEGMENT,
    START_US,
    calibrate,
    change_column,
    make_range_image,
    tensors,
    write_waymo,
)

FAKE = FakeLog(frame_count=5, camera_names=("front", "left"), lidar_azimuths=60, lidar_rings=8, ego_yaw_rad=0.4)
REAL = Path(__file__).resolve().parents[3] / "shared/data/waymo_v2"


def test_a_written_segment_comes_back(tmp_path: Path) -> None:
    log = open_log(f"waymo:{write_waymo(FAKE, tmp_path)}")
    assert log.name == SEGMENT
    assert log.cameras == (Camera("FRONT", FAKE.lens), Camera("SIDE_LEFT", FAKE.lens))
    for frame in range(FAKE.frame_count):
        assert log.frame_timestamp_s(frame) == (START_US + 100_000 * frame) * 1e-6
        np.testing.assert_allclose(log.world_SE3_lidar(frame), FAKE.world_SE3_lidar(frame), atol=1e-9)
        for camera in FAKE.camera_names:
            pose = FAKE.world_SE3_camera(camera, frame)
            np.testing.assert_allclose(log.world_SE3_camera(NAMES[camera], frame), pose, atol=1e-9)
            assert log.image_bytes(NAMES[camera], frame) == FAKE.image_bytes(camera, frame)
        np.testing.assert_allclose(log.sweep(frame).points_world, FAKE.sweep(frame).points_world, atol=1e-4)
        np.testing.assert_allclose(log.sweep(frame).intensity, 0.5, atol=1e-6)
    # Going back reads a group of rows again.
    assert log.image_bytes("FRONT", 1) == FAKE.image_bytes("front", 1)
    for track in FAKE.tracks():
        (found,) = [found for found in log.tracks() if found.track_id == track.track_id]
        assert (found.label, found.moving, found.size_m) == ("vehicle", track.moving, track.size_m)
        np.testing.assert_allclose(found.world_SE3_box, track.world_SE3_box, atol=1e-9)
    assert log.findings() == ()


def test_a_sweep_says_where_its_lidar_is(tmp_path: Path) -> None:
    check_stated_sensor(open_log(f"waymo:{write_waymo(FAKE, tmp_path)}"), FAKE, LIDAR_MOUNT)


@pytest.mark.parametrize("uneven", [True, False])
def test_a_range_image_is_read_from_the_left_and_from_above(uneven: bool) -> None:
    """Columns count from behind over the left, rows from the highest beam; the vehicle's frame fixes the azimuth."""
    mount = np.eye(4)
    # Turned by a quarter on the vehicle: the middle column still looks ahead.
    mount[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    mount[:3, 3] = 1.0, 0.0, 2.0
    values = np.array([-0.3, 0.1]) if uneven else np.zeros(0)
    calibration = LidarCalibration(mount, values, -0.2, 0.2)
    image = np.zeros((2, 4, 4), np.float32)
    image[..., 0] = 10.0
    points, _ = compute_points(image, calibration, np.eye(4), None)
    upper, lower = (0.1, -0.3) if uneven else (0.1, -0.1)
    for row, inclination in enumerate((upper, lower)):
        for column, azimuth in enumerate(np.radians([135, 45, -45, -135])):
            level = 10 * np.cos(inclination)
            expected = [1 + level * np.cos(azimuth), level * np.sin(azimuth), 2 + 10 * np.sin(inclination)]
            np.testing.assert_allclose(points[4 * row + column], expected, atol=1e-6)


def test_pixels_have_poses_of_their_own() -> None:
    """Roll, pitch and yaw turn about x, then y, then z."""
    calibration = LidarCalibration(np.eye(4), np.array([0.0]), 0.0, 0.0)
    image = np.zeros((1, 3, 4), np.float32)
    image[0, 1] = 5.0, 0.25, 0.0, 0.0
    poses = np.zeros((1, 3, 6), np.float32)
    poses[0, 1] = 0.1, 0.2, 0.3, 100.0, 200.0, 300.0
    points, intensity = compute_points(image, calibration, np.eye(4), poses)
    expected = np.array([np.cos(0.3) * np.cos(0.2), np.sin(0.3) * np.cos(0.2), -np.sin(0.2)]) * 5 + [100, 200, 300]
    np.testing.assert_allclose(points, [expected], atol=1e-5)
    np.testing.assert_array_equal(intensity, [0.25])


def test_both_returns_and_all_lidars_are_read(tmp_path: Path) -> None:
    address = write_waymo(FAKE, tmp_path)
    image, _ = make_range_image(FAKE, 0)
    second = np.zeros((8, 3, 4), np.float32)
    second[0, 0, 0] = 3.0
    side = np.zeros((2, 4, 4), np.float32)
    side[..., 0] = 7.0
    columns = {"range_image_return1": [image, side], "range_image_return2": [np.resize(second, image.shape), None]}
    columns["range_image_return2"][0][:] = -1.0
    columns["range_image_return2"][0][2, 3, 0] = 4.0
    names = {f"[LiDARComponent].{name}": values for name, values in tensors(columns).items()}
    keys: dict[str, Any] = {"key.frame_timestamp_micros": [START_US] * 2, "key.laser_name": pa.array([1, 3], pa.int8())}
    pq.write_table(pa.table({**keys, **names}), tmp_path / f"lidar/{SEGMENT}.parquet")
    path = tmp_path / f"lidar_calibration/{SEGMENT}.parquet"
    even = calibrate(np.array([-0.5, 0.1]), np.eye(4)) | {
        "beam_inclination.values": pa.array([None], pa.list_(pa.float64()))
    }
    named = {f"[LiDARCalibrationComponent].{name}": values for name, values in even.items()}
    more = pa.table({"key.segment_context_name": [SEGMENT], "key.laser_name": pa.array([3], pa.int8()), **named})
    pq.write_table(pa.concat_tables([pq.read_table(path), more]), path)
    log = open_log(f"waymo:{address}")
    points = log.sweep(0).points_world
    count = len(FAKE.sweep(0).points_world)
    assert len(points) == count + 1 + 8
    # Sides come first by name; they have no poses of pixels.
    local = (points[:8] - FAKE.world_SE3_lidar(0)[:3, 3]) @ FAKE.world_SE3_lidar(0)[:3, :3]
    np.testing.assert_allclose(np.linalg.norm(local, axis=1), 7.0, atol=1e-5)
    np.testing.assert_allclose(local[0, 2], 7 * np.sin(-0.05), atol=1e-5)
    assert log.sweep(1) is None


def test_shutters(tmp_path: Path) -> None:
    """Readout by rows is modelled; that by columns is a note. Poses hold for the middle of the exposure."""
    address = write_waymo(FAKE, tmp_path)
    table = pq.read_table(tmp_path / f"camera_image/{SEGMENT}.parquet")
    stamps = table.column("[CameraImageComponent].pose_timestamp").to_numpy()
    change = {
        "rolling_shutter_params.shutter": np.full(len(stamps), 0.004),
        "rolling_shutter_params.camera_trigger_time": stamps - 0.010,
        "rolling_shutter_params.camera_readout_done_time": stamps + 0.034,
        "velocity.linear_velocity.x": pa.array([5.0] * len(stamps), pa.float32()),
        "velocity.angular_velocity.z": np.full(len(stamps), 0.5),
    }
    for field, values in change.items():
        change_column(tmp_path, "camera_image", field, values)
    change_column(tmp_path, "camera_calibration", "rolling_shutter_direction", pa.array([1, 4], pa.int8()))
    log = open_log(f"waymo:{address}")
    front, left = log.cameras
    assert (front.readout_s, left.readout_s) == (pytest.approx(0.04, abs=1e-6), 0.0)
    assert front.exposure_s == left.exposure_s == 0.004
    (finding,) = log.findings()
    assert (finding.word, finding.camera) == ("unmodelled_readout", "SIDE_LEFT")
    assert "from right to left in 40 ms" in finding.message
    later_s = 0.012
    assert log.camera_timestamp_s("FRONT", 2) == pytest.approx(START_US * 1e-6 + 0.2 + later_s, abs=1e-6)
    vehicle = FAKE.world_SE3_lidar(2).copy()
    mount = np.linalg.inv(vehicle) @ FAKE.world_SE3_camera("front", 2)
    angle = 0.5 * later_s
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    vehicle[:3, :3] = turn @ vehicle[:3, :3]
    vehicle[0, 3] += 5.0 * later_s
    # Seconds since 1970 in double precision are right to a quarter of a microsecond.
    np.testing.assert_allclose(log.world_SE3_camera("FRONT", 2), vehicle @ mount, atol=5e-6)


def test_distortion(tmp_path: Path) -> None:
    coefficients = (-0.3, 0.05, 0.001, -0.002, 0.0)
    address = write_waymo(FAKE, tmp_path)
    for value, name in zip(coefficients, ("k1", "k2", "p1", "p2", "k3"), strict=True):
        change_column(tmp_path, "camera_calibration", f"intrinsic.{name}", [0.0, value])
    front, left = open_log(f"waymo:{address}").cameras
    assert front.lens == FAKE.lens
    assert left.lens == replace(FAKE.lens, distortion=coefficients)


def test_parts_of_a_segment(tmp_path: Path) -> None:
    """Without boxes, without poses of pixels, without a LiDAR."""
    address = write_waymo(FAKE, tmp_path)
    shutil.rmtree(tmp_path / "lidar_box")
    log = open_log(f"waymo:{address}")
    assert log.tracks() == ()
    assert [finding.word for finding in log.findings()] == ["no_labels"]
    shutil.rmtree(tmp_path / "lidar_pose")
    log = open_log(f"waymo:{address}")
    assert len(log.sweep(0).points_world) == len(FAKE.sweep(0).points_world)
    assert [finding.word for finding in log.findings()] == ["no_pixel_poses", "no_labels"]
    for name in ("lidar", "lidar_calibration"):
        shutil.rmtree(tmp_path / name)
    log = open_log(f"waymo:{address}")
    assert log.sweep(0) is None
    assert log.image_bytes("FRONT", 0) == FAKE.image_bytes("front", 0)


def test_of_two_boxes_of_one_id_the_first_counts(tmp_path: Path) -> None:
    cars = (FakeCar("a", 5.0, 3.0), FakeCar("b", 9.0, 3.0))
    address = write_waymo(FAKE.with_(cars=cars), tmp_path)
    count = sum(len(track.frames) for track in open_log(f"waymo:{address}").tracks())
    change_column(tmp_path, "lidar_box", "key.laser_object_id", ["same"] * count)
    log = open_log(f"waymo:{address}")
    assert [finding.word for finding in log.findings()] == ["repeated_box_id"] * FAKE.frame_count
    assert len(log.tracks()) == 1 and len(log.tracks()[0].frames) == FAKE.frame_count < count


def test_ten_thousand_boxes(tmp_path: Path) -> None:
    cars = tuple(FakeCar(f"car-{k}", 5.0 + k, 3.0, speed_mps=2.0) for k in range(500))
    fake = FAKE.with_(frame_count=20, camera_names=("front",), width_px=16, height_px=12, no_lidar=True, cars=cars)
    log = open_log(f"waymo:{write_waymo(fake, tmp_path, rows_in_group=100_000)}")
    assert sum(len(track.frames) for track in log.tracks()) == 10_000


@pytest.mark.parametrize(("width_px", "height_px"), [(4096, 300), (30, 60)])
def test_wide_and_portrait_cameras(tmp_path: Path, width_px: int, height_px: int) -> None:
    fake = FAKE.with_(frame_count=1, camera_names=("front",), width_px=width_px, height_px=height_px, cars=())
    log = open_log(f"waymo:{write_waymo(fake, tmp_path)}")
    assert log.cameras == (Camera("FRONT", fake.lens),)
    assert log.image_bytes("FRONT", 0) == fake.image_bytes("front", 0)


def test_two_million_points(tmp_path: Path) -> None:
    address = write_waymo(FAKE.with_(frame_count=1), tmp_path)
    image = np.zeros((8, 250_000, 4), np.float32)
    image[..., 0] = 20.0
    lists = tensors({"range_image_return1": [image], "range_image_return2": [None]})
    columns: dict[str, Any] = {f"[LiDARComponent].{name}": values for name, values in lists.items()}
    keys = {"key.frame_timestamp_micros": [START_US], "key.laser_name": pa.array([1], pa.int8())}
    pq.write_table(pa.table({**keys, **columns}), tmp_path / f"lidar/{SEGMENT}.parquet")
    shutil.rmtree(tmp_path / "lidar_pose")
    assert len(open_log(f"waymo:{address}").sweep(0).points_world) == 2_000_000


def test_patterns(tmp_path: Path) -> None:
    write_waymo(FAKE.with_(frame_count=1), tmp_path, "1002_a")
    write_waymo(FAKE.with_(frame_count=1), tmp_path, "1003_b")
    assert expand_logs([f"waymo:{tmp_path}/*"]) == [f"waymo:{tmp_path}/1002_a", f"waymo:{tmp_path}/1003_b"]
    assert expand_logs([f"waymo:{tmp_path}/1003*"]) == [f"waymo:{tmp_path}/1003_b"]
    assert open_log(f"waymo:{tmp_path}/1003_b.parquet").frame_count == 1


@pytest.mark.real
@pytest.mark.skipif(not REAL.is_dir(), reason=f"no component of Waymo beside the checkout ({REAL})")
def test_a_real_component() -> None:
    table = ComponentTable(REAL / f"vehicle_pose/{SEGMENT}.parquet", "VehiclePoseComponent", "waymo:real")
    poses = table.read_poses("world_from_vehicle.transform")
    assert poses.shape == (199, 4, 4)
    assert set(np.diff(table.times_us) // 10_000) <= {9, 10}
    speeds = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / np.diff(table.times_us) * 1e6
    assert speeds.max() < 30
    # The vehicle drives along its x.
    ahead = np.einsum("fk,fk->f", poses[:-1, :3, 0], np.diff(poses[:, :3, 3], axis=0))
    assert ahead.sum() > 0.95 * speeds.sum() * 0.1
    keys = ComponentTable(REAL / f"camera_hkp/{SEGMENT}.parquet", "CameraHumanKeypointsComponent", "waymo:real")
    assert set(keys.read(["key.camera_name"], names=["key.camera_name"])["key.camera_name"]) <= {
        "FRONT",
        *NAMES.values(),
        "FRONT_LEFT",
        "FRONT_RIGHT",
    }
