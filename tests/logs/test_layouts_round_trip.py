"""Many different logs, written in every layout that can be written, read back as they were."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from genre_tasks.logs.genre_layout.writer import write_genre_layout
from genre_tasks.logs.nuscenes.reader import CAR_HIGH_M, CAR_LOW_M
from genre_tasks.logs.pandaset.writer import write_pandaset
from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import Sweep
from tests.fakes import FakeCar, FakeLog
from tests.logs.argoverse2_folder import START_NS, write_argoverse2
from tests.logs.kitti_folder import shifted_world, write_kitti
from tests.logs.nuscenes_folder import LIDAR_MOUNT, START_US, token, write_nuscenes
from tests.logs.waymo_folder import NAMES, write_waymo
from tests.logs.waymo_folder import START_US as WAYMO_START_US

# Two hundred logs in each layout. They are drawn by the tests' own fake, and are no streets.
SEEDS = range(200)
_RIGS = (("front",), ("front", "left"), ("left", "front", "right"), ("back", "front"))


def make_log(seed: int, cameras: tuple[str, ...] | None = None) -> FakeLog:
    """A log with a rig, a rate, a place, gaps and cars of its own."""
    chooser = np.random.default_rng(seed)
    frames = int(chooser.integers(2, 6))
    rig = cameras or _RIGS[chooser.integers(len(_RIGS))]
    steps = chooser.uniform(0.05, 0.5, frames)
    cars = [
        FakeCar(
            track_id=f"car-{number}",
            x_m=float(chooser.uniform(5, 30)),
            y_m=float(chooser.uniform(-6, 6)),
            speed_mps=float(chooser.choice([0.0, 8.0])),
            size_m=tuple(chooser.uniform([3, 1.5, 1.2], [6, 2.2, 2.5]).tolist()),
            yaw_rad=float(chooser.uniform(-3, 3)),
        )
        for number in range(chooser.integers(1, 4))
    ]
    images = [(name, frame) for name in rig for frame in range(1, frames) if chooser.random() < 0.1]
    return FakeLog(
        frame_count=frames,
        camera_names=rig,
        width_px=int(chooser.integers(16, 48)),
        height_px=int(chooser.integers(12, 40)),
        speed_mps=float(chooser.uniform(0, 12)),
        cars=tuple(cars),
        world_offset_m=tuple(chooser.uniform(-1e5, 1e5, 3).tolist()),
        lidar_rings=6,
        lidar_azimuths=24,
        missing_images=frozenset(images),
        missing_sweeps=frozenset(int(f) for f in range(frames) if chooser.random() < 0.1),
        timestamps_s=tuple(np.cumsum(steps).tolist()),
        ego_yaw_rad=float(chooser.uniform(-3, 3)),
    )


@pytest.mark.parametrize("layout", ["genre", "pandaset"])
def test_layouts_of_any_rig(layout: str, tmp_path: Path) -> None:
    write = {"genre": write_genre_layout, "pandaset": write_pandaset}[layout]
    for seed in SEEDS:
        log = make_log(seed)
        found = open_log(f"{layout}:{write(log, tmp_path / str(seed))}")
        # The PandaSet reader orders cameras as that rig has them.
        assert {camera.name: camera.lens for camera in found.cameras} == {c.name: c.lens for c in log.cameras}, seed
        for frame in range(log.frame_count):
            assert found.frame_timestamp_s(frame) == log.frame_timestamp_s(frame), seed
            np.testing.assert_allclose(found.world_SE3_lidar(frame), log.world_SE3_lidar(frame), atol=1e-12)
            for camera in log.camera_names:
                pose = found.world_SE3_camera(camera, frame)
                np.testing.assert_allclose(pose, log.world_SE3_camera(camera, frame), atol=1e-12)
                assert found.image_bytes(camera, frame) == log.image_bytes(camera, frame), seed
            _assert_same_sweep(found.sweep(frame), log.sweep(frame), atol=0.0)
        _assert_same_tracks(found.tracks(), log.tracks(), np.eye(4), atol=1e-9)


def test_kitti(tmp_path: Path) -> None:
    for seed in SEEDS:
        # Rectified cameras of KITTI look the same way.
        log = make_log(seed, cameras=("front",))
        log = log.with_(missing_images=frozenset(key for key in log.missing_images if key[1] > 0))
        found = open_log(f"kitti:{write_kitti(log, tmp_path / str(seed))}")
        shift = shifted_world(log)
        assert found.cameras[0].lens.width_px == log.width_px, seed
        for frame in range(log.frame_count):
            np.testing.assert_allclose(found.world_SE3_lidar(frame), shift @ log.world_SE3_lidar(frame), atol=1e-5)
            pose = found.world_SE3_camera("image_02", frame)
            np.testing.assert_allclose(pose, shift @ log.world_SE3_camera("front", frame), atol=1e-5)
            assert found.image_bytes("image_02", frame) == log.image_bytes("front", frame), seed
            expected = log.sweep(frame)
            if expected is not None:
                moved = type(expected)(expected.points_world + shift[:3, 3], expected.intensity, expected.timestamps_s)
                _assert_same_sweep(found.sweep(frame), moved, atol=1e-4, times=False)
            else:
                assert found.sweep(frame) is None
        _assert_same_tracks(found.tracks(), log.tracks(), shift, atol=1e-5, by_order=True)


def test_nuscenes(tmp_path: Path) -> None:
    """Times are whole microseconds, points single precision in the axes of the LiDAR."""
    for seed in SEEDS:
        log = make_log(seed)
        found = open_log(f"nuscenes:{write_nuscenes(log, tmp_path / str(seed))}?rate=20")
        names = {name: f"CAM_{name.upper()}" for name in log.camera_names}
        _assert_same_frames(found, log, names, np.eye(4), START_US * 1e-6, seed)
        for frame in range(log.frame_count):
            expected = log.sweep(frame)
            if expected is not None:
                pose = log.world_SE3_lidar(frame) @ LIDAR_MOUNT
                local = (expected.points_world - pose[:3, 3]) @ pose[:3, :3]
                # What is nearer counts as the vehicle's own roof or bonnet.
                far = np.hypot(local[:, 0], local[:, 1]) >= 1.0
                in_car = local @ LIDAR_MOUNT[:3, :3].T + LIDAR_MOUNT[:3, 3]
                far &= ~((in_car[:, :2] > CAR_LOW_M) & (in_car[:, :2] < CAR_HIGH_M)).all(1)
                expected = Sweep(expected.points_world[far], expected.intensity[far], expected.timestamps_s[far])
            _assert_same_sweep(found.sweep(frame), expected, atol=1e-4, times=False)
        tracks = {token(track.track_id): track for track in log.tracks()}
        assert {track.track_id for track in found.tracks()} == set(tracks)
        for track in found.tracks():
            np.testing.assert_array_equal(track.frames, tracks[track.track_id].frames)
            np.testing.assert_allclose(track.size_m, tracks[track.track_id].size_m, rtol=1e-12)
            np.testing.assert_allclose(track.world_SE3_box, tracks[track.track_id].world_SE3_box, atol=1e-8)


def test_waymo(tmp_path: Path) -> None:
    """Times are whole microseconds, poses of pixels single precision in the world."""
    for seed in SEEDS:
        log = make_log(seed)
        found = open_log(f"waymo:{write_waymo(log, tmp_path / str(seed))}")
        names = {name: NAMES[name] for name in log.camera_names}
        _assert_same_frames(found, log, names, np.eye(4), WAYMO_START_US * 1e-6, seed)
        # Half a step for the numbers, and what angles of single precision turn at 80 m.
        step = float(np.spacing(np.float32(np.abs(log.world_offset_m).max() + 100)))
        for frame in range(log.frame_count):
            _assert_same_sweep(found.sweep(frame), log.sweep(frame), atol=step / 2 + 1e-4, times=False)
        _assert_same_tracks(found.tracks(), log.tracks(), np.eye(4), atol=1e-8)


def test_argoverse2(tmp_path: Path) -> None:
    """Frames are sweeps; points are half precision in the axes of the vehicle, intensities bytes."""
    for seed in SEEDS:
        log = make_log(seed).with_(missing_sweeps=frozenset())
        found = open_log(f"argoverse2:{write_argoverse2(log, tmp_path / str(seed), np.float16)}")
        shift = np.eye(4)
        shift[:3, 3] = -log.world_SE3_lidar(0)[:3, 3]
        names = {name: f"ring_{name}" for name in log.camera_names}
        _assert_same_frames(found, log, names, shift, START_NS * 1e-9, seed)
        for frame in range(log.frame_count):
            expected, sweep = log.sweep(frame), found.sweep(frame)
            pose = log.world_SE3_lidar(frame)
            local = (expected.points_world - pose[:3, 3]) @ pose[:3, :3]
            error = (sweep.points_world - shift[:3, 3] - pose[:3, 3]) @ pose[:3, :3] - local
            # Half a step of eleven bits.
            assert (np.abs(error) <= np.abs(local) * 2.0**-11 + 1e-6).all(), seed
            np.testing.assert_allclose(sweep.intensity, expected.intensity, atol=0.5 / 255 + 1e-7)
        _assert_same_tracks(found.tracks(), log.tracks(), shift, atol=1e-8)


def _assert_same_frames(found, log, names: dict[str, str], shift, start_s: float, seed: int) -> None:
    """Cameras, times, poses and images; times since 1970 are right to a microsecond."""
    assert {camera.name: camera.lens for camera in found.cameras} == {names[c.name]: c.lens for c in log.cameras}, seed
    assert found.frame_count == log.frame_count
    for frame in range(log.frame_count):
        assert found.frame_timestamp_s(frame) - start_s == pytest.approx(log.frame_timestamp_s(frame), abs=1.5e-6)
        np.testing.assert_allclose(found.world_SE3_lidar(frame), shift @ log.world_SE3_lidar(frame), atol=1e-8)
        for camera, name in names.items():
            pose = found.world_SE3_camera(name, frame)
            np.testing.assert_allclose(pose, shift @ log.world_SE3_camera(camera, frame), atol=1e-8)
            assert found.image_bytes(name, frame) == log.image_bytes(camera, frame), (seed, camera, frame)


def _assert_same_sweep(found, expected, atol: float, times: bool = True) -> None:
    assert (found is None) == (expected is None)
    if found is None:
        return
    np.testing.assert_allclose(found.points_world, expected.points_world, rtol=0, atol=atol)
    np.testing.assert_allclose(found.intensity, expected.intensity, atol=1e-7)
    if times:
        np.testing.assert_array_equal(found.timestamps_s, expected.timestamps_s)


def _assert_same_tracks(found, expected, shift, atol: float, by_order: bool = False) -> None:
    assert len(found) == len(expected)
    names = {track.track_id: track for track in found}
    for number, track in enumerate(expected):
        same = found[number] if by_order else names[track.track_id]
        np.testing.assert_array_equal(same.frames, track.frames)
        np.testing.assert_allclose(same.size_m, track.size_m, rtol=1e-12)
        np.testing.assert_allclose(same.world_SE3_box, shift @ track.world_SE3_box, atol=atol)
