"""nuScenes: the scene that was written comes back, rates and gaps are as stated, real files are read."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flows.pipeline.log_cache import expand_logs
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import Camera, Lens, Sweep
from tests.fakes import FakeCar, FakeLog
from tests.logs.nuscenes_folder import LIDAR_MOUNT, START_US, VERSION, change_table, token, write_nuscenes
from tests.logs.stated_sensor import check_stated_sensor

FAKE = FakeLog(frame_count=6, camera_names=("front", "left"), lidar_azimuths=60, lidar_rings=8, ego_yaw_rad=0.4)
REAL = Path(__file__).resolve().parents[3] / "shared/data/nuscenes_frame"


def test_a_written_scene_comes_back(tmp_path: Path) -> None:
    log = open_log(f"nuscenes:{write_nuscenes(FAKE, tmp_path)}")
    assert log.name == "scene-0061"
    assert [camera.name for camera in log.cameras] == ["CAM_FRONT", "CAM_LEFT"]
    assert log.cameras[0].lens == FAKE.lens
    for frame in range(FAKE.frame_count):
        assert log.frame_timestamp_s(frame) == (START_US + 100_000 * frame) * 1e-6
        np.testing.assert_allclose(log.world_SE3_lidar(frame), FAKE.world_SE3_lidar(frame), atol=1e-9)
        for camera in FAKE.camera_names:
            name = f"CAM_{camera.upper()}"
            np.testing.assert_allclose(
                log.world_SE3_camera(name, frame), FAKE.world_SE3_camera(camera, frame), atol=1e-9
            )
            assert log.image_bytes(name, frame) == FAKE.image_bytes(camera, frame)
        np.testing.assert_allclose(log.sweep(frame).points_world, FAKE.sweep(frame).points_world, atol=1e-4)
        np.testing.assert_allclose(log.sweep(frame).intensity, 0.5, atol=1e-6)
    for track in FAKE.tracks():
        (found,) = [found for found in log.tracks() if found.track_id == token(track.track_id)]
        assert (found.label, found.moving) == (track.label, track.moving)
        assert found.size_m == track.size_m
        np.testing.assert_allclose(found.world_SE3_box, track.world_SE3_box, atol=1e-9)
    assert "interpolated_boxes" not in {finding.word for finding in log.findings()}


def test_a_sweep_says_where_its_lidar_is(tmp_path: Path) -> None:
    check_stated_sensor(open_log(f"nuscenes:{write_nuscenes(FAKE, tmp_path)}"), FAKE, LIDAR_MOUNT)


def test_rates(tmp_path: Path) -> None:
    """Twenty sweeps a second, of which every fifth is a key frame."""
    fake = FAKE.with_(frame_count=21, timestamps_s=tuple(0.05 * frame for frame in range(21)))
    address = write_nuscenes(fake, tmp_path, key_every=5)
    for rate, step, count in (("", 2, 11), ("?rate=10", 2, 11), ("?rate=20", 1, 21), ("?rate=2", 5, 5)):
        log = open_log(f"nuscenes:{address}{rate}")
        assert log.frame_count == count
        for frame in range(count):
            assert log.image_bytes("CAM_FRONT", frame) == fake.image_bytes("front", frame * step)
            np.testing.assert_allclose(log.world_SE3_lidar(frame), fake.world_SE3_lidar(frame * step), atol=1e-9)
    with pytest.raises(ConfigError, match="'12'"):
        open_log(f"nuscenes:{address}?rate=12")


def test_boxes_between_key_frames_are_interpolated_and_said_to_be(tmp_path: Path) -> None:
    turning = FakeCar("turning", 5.0, 3.0, speed_mps=5.0, yaw_rad=0.2)
    fake = FAKE.with_(frame_count=11, cars=(turning,))
    log = open_log(f"nuscenes:{write_nuscenes(fake, tmp_path, key_every=5)}")
    (track,) = log.tracks()
    np.testing.assert_array_equal(track.frames, range(11))
    np.testing.assert_allclose(track.world_SE3_box, fake.tracks()[0].world_SE3_box, atol=1e-6)
    (finding,) = [finding for finding in log.findings() if finding.word == "interpolated_boxes"]
    assert finding.numbers == {"interpolated": 8, "boxes": 11}


def test_of_two_boxes_of_one_id_the_first_counts(tmp_path: Path) -> None:
    address = write_nuscenes(FAKE, tmp_path)
    expected = open_log(f"nuscenes:{address}").tracks()

    def repeat(rows: list[dict[str, Any]]) -> None:
        rows.append({**rows[0], "token": token("another"), "translation": [99.0, 0.0, 0.0]})

    change_table(tmp_path, "sample_annotation", repeat)
    log = open_log(f"nuscenes:{address}")
    for track, known in zip(log.tracks(), expected, strict=True):
        np.testing.assert_array_equal(track.world_SE3_box, known.world_SE3_box)
    (found,) = [finding for finding in log.findings() if finding.word == "repeated_box_id"]
    assert found.frames == (0,)


def test_a_long_gap_between_boxes_stays(tmp_path: Path) -> None:
    fake = FAKE.with_(frame_count=16)
    address = write_nuscenes(fake, tmp_path, key_every=3)
    gone = {token("box", "mover", frame) for frame in (3, 6, 9)}
    change_table(tmp_path, "sample_annotation", lambda rows: [row for row in rows if row["token"] not in gone])
    tracks = {track.track_id: track for track in open_log(f"nuscenes:{address}").tracks()}
    np.testing.assert_array_equal(tracks[token("mover")].frames, [0, 12, 13, 14, 15])
    np.testing.assert_array_equal(tracks[token("parked")].frames, range(16))


def test_cameras_that_are_not_in_step(tmp_path: Path) -> None:
    """Twelve images a second beside ten sweeps: each frame has its nearest, and no image is used twice."""
    fake = FAKE.with_(frame_count=12)
    address = write_nuscenes(fake, tmp_path)
    for table, by in (("sample_data", "token"), ("ego_pose", "token")):

        def move(rows: list[dict[str, Any]], by: str = by) -> None:
            times = {token("scene-0061", "CAM_FRONT", frame): START_US + frame * 83_333 for frame in range(12)}
            for row in rows:
                row["timestamp"] = times.get(row[by], row["timestamp"])

        change_table(tmp_path, table, move)
    log = open_log(f"nuscenes:{address}")
    images = [log.image_bytes("CAM_FRONT", frame) for frame in range(12)]
    used = [image for image in images if image is not None]
    assert len(set(used)) == len(used) == 10
    for frame in range(12):
        distance_s = log.camera_timestamp_s("CAM_FRONT", frame) - log.frame_timestamp_s(frame)
        assert abs(distance_s) <= 0.0501
        if images[frame] is not None:
            source = next(k for k in range(12) if fake.image_bytes("front", k) == images[frame])
            pose = fake.world_SE3_camera("front", source)
            np.testing.assert_allclose(log.world_SE3_camera("CAM_FRONT", frame), pose, atol=1e-9)


class TwoMegapointSweeps(FakeLog):
    """A dense LiDAR: a sweep of two million points."""

    def sweep(self, frame: int) -> Sweep | None:
        points = np.random.default_rng(frame).normal(0, 30, (2_000_000, 3))
        points[:, 0] += np.sign(points[:, 0]) * 2.0
        pose = self.world_SE3_lidar(frame)
        return Sweep(points @ pose[:3, :3].T + pose[:3, 3], np.full(2_000_000, 0.5, np.float32), np.zeros(2_000_000))


def test_two_million_points(tmp_path: Path) -> None:
    fake = TwoMegapointSweeps(frame_count=1, camera_names=("front",))
    log = open_log(f"nuscenes:{write_nuscenes(fake, tmp_path)}")
    points = log.sweep(0).points_world
    assert len(points) > 1_990_000
    path = next((tmp_path / "samples/LIDAR_TOP").iterdir())
    path.write_bytes(path.read_bytes() + bytes(20))
    with pytest.raises(InputError, match="not up to 2000000 points") as caught:
        log.sweep(0)
    assert (caught.value.frame, caught.value.file) == (0, str(path))


def test_ten_thousand_boxes(tmp_path: Path) -> None:
    cars = tuple(FakeCar(f"car-{k}", 5.0 + k, 3.0, speed_mps=2.0) for k in range(500))
    fake = FAKE.with_(frame_count=20, camera_names=("front",), width_px=16, height_px=12, no_lidar=True, cars=cars)
    log = open_log(f"nuscenes:{write_nuscenes(fake, tmp_path)}")
    assert sum(len(track.frames) for track in log.tracks()) == 10_000
    assert log.sweep(3) is None


@pytest.mark.parametrize(("width_px", "height_px"), [(4096, 300), (30, 60)])
def test_wide_and_portrait_cameras(tmp_path: Path, width_px: int, height_px: int) -> None:
    fake = FAKE.with_(frame_count=1, camera_names=("front",), width_px=width_px, height_px=height_px, cars=())
    log = open_log(f"nuscenes:{write_nuscenes(fake, tmp_path)}")
    assert log.cameras == (Camera("CAM_FRONT", fake.lens),)
    assert log.image_bytes("CAM_FRONT", 0) == fake.image_bytes("front", 0)
    assert [finding.word for finding in log.findings()] == ["no_labels"]


def test_several_lidars(tmp_path: Path) -> None:
    address = write_nuscenes(FAKE, tmp_path)
    sensor = {"token": "s", "channel": "LIDAR_REAR", "modality": "lidar"}
    mount = {"token": "c", "sensor_token": "s", "camera_intrinsic": [], "translation": [-1, 0, 1]}
    change_table(tmp_path, "sensor", lambda rows: rows.append(sensor))
    change_table(tmp_path, "calibrated_sensor", lambda rows: rows.append({**mount, "rotation": [1, 0, 0, 0]}))
    (tmp_path / "rear.bin").write_bytes(np.array([[5, 0, 0, 255, 0]], "<f4").tobytes())

    def add(rows: list[dict[str, Any]]) -> None:
        top = next(row for row in rows if row["token"] == token("scene-0061", "LIDAR_TOP", 2))
        links = {"calibrated_sensor_token": "c", "filename": "rear.bin", "timestamp": top["timestamp"] + 9}
        rows.append({**top, **links, "token": "rear"})

    change_table(tmp_path, "sample_data", add)
    log = open_log(f"nuscenes:{address}")
    assert len(log.sweep(1).points_world) == len(FAKE.sweep(1).points_world)
    points = log.sweep(2).points_world
    assert len(points) == len(FAKE.sweep(2).points_world) + 1
    pose = FAKE.world_SE3_lidar(2)
    rear = pose @ [4.0, 0.0, 1.0, 1.0]
    assert np.abs(points - rear[:3]).max(axis=1).min() < 1e-6


def test_without_a_lidar_a_camera_is_the_clock(tmp_path: Path) -> None:
    address = write_nuscenes(FAKE, tmp_path)
    change_table(tmp_path, "sensor", lambda rows: rows[0].update(modality="radar"))
    log = open_log(f"nuscenes:{address}")
    assert log.frame_count == FAKE.frame_count
    assert log.sweep(0) is None
    assert log.image_bytes("CAM_LEFT", 3) == FAKE.image_bytes("left", 3)


def test_patterns_and_versions(tmp_path: Path) -> None:
    (tmp_path / "a b").mkdir()
    root = tmp_path / "a b"
    write_nuscenes(FAKE, root, "scene-0061")
    assert expand_logs([f"nuscenes:{root}/*"]) == [f"nuscenes:{root}/scene-0061"]
    write_nuscenes(FAKE, root, "scene-0103", version="v1.0-test")
    with pytest.raises(InputError, match="several versions") as caught:
        open_log(f"nuscenes:{root}/scene-0103")
    assert "v1.0-mini, v1.0-test" in caught.value.remedy
    (found,) = expand_logs([f"nuscenes:{root}/scene-01*?version=v1.0-test&rate=2"])
    assert found == f"nuscenes:{root}/scene-0103?version=v1.0-test&rate=2"
    assert open_log(found).frame_count == FAKE.frame_count
    assert open_log(f"nuscenes:{root}/{VERSION}/scene-0061").frame_count == FAKE.frame_count
    with pytest.raises(InputError, match="no log matches"):
        expand_logs([f"nuscenes:{root}/*-9?version=v1.0-test"])


def test_the_index_is_made_once_for_all_scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GENRE_CACHE_DIR", str(tmp_path / "cache"))
    address = write_nuscenes(FAKE, tmp_path / "data")
    digest = open_log(f"nuscenes:{address}").digest()
    (index,) = (tmp_path / "cache/nuscenes").iterdir()
    made = index.stat().st_mtime_ns
    assert open_log(f"nuscenes:{address}").digest() == digest
    assert index.stat().st_mtime_ns == made
    change_table(tmp_path / "data", "ego_pose", lambda rows: rows[0]["translation"].__setitem__(2, 7.0))
    assert open_log(f"nuscenes:{address}").digest() != digest
    assert len(list((tmp_path / "cache/nuscenes").iterdir())) == 2


def test_a_scene_whose_boxes_are_all_bad_has_a_digest(tmp_path: Path) -> None:
    def flatten(rows: list[dict[str, Any]]) -> None:
        for row in rows:
            row["size"] = [0.0, 0.0, 0.0]

    address = write_nuscenes(FAKE, tmp_path)
    change_table(tmp_path, "sample_annotation", flatten)
    log = open_log(f"nuscenes:{address}")
    assert len(log.digest()) == 64
    with pytest.raises(InputError, match="boxes are bad"):
        log.tracks()


def test_files_count_in_the_digest(tmp_path: Path) -> None:
    address = write_nuscenes(FAKE, tmp_path)
    digests = {open_log(f"nuscenes:{address}").digest()}
    image = next((tmp_path / "samples/CAM_LEFT").iterdir())
    image.write_bytes(image.read_bytes() + b"\0")
    digests.add(open_log(f"nuscenes:{address}").digest())
    image.unlink()
    digests.add(open_log(f"nuscenes:{address}").digest())
    assert len(digests) == 3


@pytest.mark.real
@pytest.mark.skipif(not REAL.is_dir(), reason=f"no frame of nuScenes beside the checkout ({REAL})")
def test_a_real_frame_in_written_tables(tmp_path: Path) -> None:
    """Six real images and a real sweep, with the places that the rig has by eye."""
    yaws = {"FRONT": 0, "FRONT_LEFT": 55, "FRONT_RIGHT": -55, "BACK": 180, "BACK_LEFT": 110, "BACK_RIGHT": -110}
    lens = Lens(1266.4, 1266.4, 816.8, 492.0, 1600, 900)
    fake = FAKE.with_(frame_count=1, camera_names=("front",), cars=())
    address = write_nuscenes(fake, tmp_path)
    sensors = [{"token": f"s{name}", "channel": f"CAM_{name}", "modality": "camera"} for name in yaws]
    matrix = [[lens.fx_px, 0, lens.cx_px - 0.5], [0, lens.fy_px, lens.cy_px - 0.5], [0, 0, 1]]
    mount = {"translation": [1.0, 0, 1.6], "rotation": [0.5, -0.5, 0.5, -0.5], "camera_intrinsic": matrix}
    mounts = [{"token": f"c{name}", "sensor_token": f"s{name}", **mount} for name in yaws]
    change_table(tmp_path, "sensor", lambda rows: rows.extend(sensors))
    change_table(tmp_path, "calibrated_sensor", lambda rows: rows.extend(mounts))

    def put(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
        (top,) = [row for row in rows if row["token"] == token("scene-0061", "LIDAR_TOP", 0)]
        found = []
        for path in REAL.iterdir():
            channel, time_us = path.name.split(".")[0].split("__")[1:]
            shutil.copy(path, tmp_path / path.name)
            values = {"token": channel, "filename": path.name, "timestamp": int(time_us)}
            sensor = top["calibrated_sensor_token"] if channel == "LIDAR_TOP" else channel.replace("CAM_", "c")
            found.append({**top, **values, "calibrated_sensor_token": sensor})
        return found

    change_table(tmp_path, "sample_data", put)
    log = open_log(f"nuscenes:{address}")
    assert {camera.name: camera.lens for camera in log.cameras} == {f"CAM_{name}": lens for name in yaws}
    assert log.frame_timestamp_s(0) == pytest.approx(1532402927.647951, abs=1e-6)
    assert all(log.image_bytes(camera.name, 0).startswith(b"\xff\xd8") for camera in log.cameras)
    assert all(0 <= log.frame_timestamp_s(0) - log.camera_timestamp_s(camera.name, 0) < 0.05 for camera in log.cameras)
    sweep = log.sweep(0)
    # A quarter of the points is the car's roof and bonnet, or did not return.
    assert len(sweep.points_world) == 34_688 - 8_526
    local = (sweep.points_world - FAKE.world_SE3_lidar(0)[:3, 3]) @ FAKE.world_SE3_lidar(0)[:3, :3]
    near = np.hypot(local[:, 0], local[:, 1]) < 10
    assert abs(np.percentile(local[near, 2], 20)) < 0.4
