"""What every log reader must keep: inherit ``ReaderSuite``, give it a log, and the reader is held to its word."""

from __future__ import annotations

import io
import re
from abc import ABC, abstractmethod
from collections.abc import Iterator

import numpy as np
import pytest
from PIL import Image

from genre_tasks.errors import InputError
from genre_tasks.logs.types import Camera, CuboidTrack, DrivingLog, Float64

CLOCK_TOLERANCE_S = 0.2  # a sensor of a 10 Hz rig fires within two periods of the frame's time


def assert_rigid(pose: Float64) -> None:
    """[4, 4] float64, a rotation of determinant +1 and a last row of 0, 0, 0, 1."""
    assert pose.shape == (4, 4)
    assert pose.dtype == np.float64
    np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-9)
    assert np.linalg.det(pose[:3, :3]) > 0
    np.testing.assert_array_equal(pose[3], [0, 0, 0, 1])


def inside(points_world: Float64, world_SE3_box: Float64, size_m: tuple[float, float, float]) -> int:
    """How many points [N, 3] lie in a box."""
    local = (points_world - world_SE3_box[:3, 3]) @ world_SE3_box[:3, :3]
    # Points lie on the faces, and files round them.
    return int((np.abs(local) <= np.asarray(size_m) / 2 + 1e-3).all(axis=1).sum())


class ReaderSuite(ABC):
    """Facts that any reader's log must show; a subclass names the log and what it is known to lack."""

    missing_images: frozenset[tuple[str, int]] = frozenset()
    missing_sweeps: frozenset[int] = frozenset()
    front_camera = "front"
    has_tracks = True
    has_sweeps = True

    @abstractmethod
    def open(self) -> DrivingLog:
        """A fresh object of the same log, each time."""

    @pytest.fixture
    def log(self) -> DrivingLog:
        cls = type(self)
        if "_log" not in cls.__dict__:
            cls._log = self.open()  # type: ignore[attr-defined]
        return cls._log  # type: ignore[attr-defined, no-any-return]

    # --- what it is

    def test_names(self, log: DrivingLog) -> None:
        assert log.uri.startswith(f"{log.dataset}:")
        assert re.fullmatch(r"[\w.=,+-]+", log.name), "the name becomes a folder of the store"
        assert log.frame_count >= 1
        names = [camera.name for camera in log.cameras]
        assert names and len(set(names)) == len(names)

    def test_lenses(self, log: DrivingLog) -> None:
        for camera in log.cameras:
            lens = camera.lens
            assert lens.fx_px > 0 and lens.fy_px > 0
            assert 0 < lens.cx_px < lens.width_px and 0 < lens.cy_px < lens.height_px
            assert isinstance(lens.width_px, int) and isinstance(lens.height_px, int)
            assert 0 <= camera.readout_s < 0.1
            assert len(lens.distortion) in (0, 5)

    # --- poses and frames

    def test_poses_are_rigid(self, log: DrivingLog) -> None:
        for frame in range(log.frame_count):
            assert_rigid(log.world_SE3_lidar(frame))
            for camera in log.cameras:
                assert_rigid(log.world_SE3_camera(camera.name, frame))

    def test_ego_axes(self, log: DrivingLog) -> None:
        """z is up, and x points where the vehicle goes."""
        poses = [log.world_SE3_lidar(frame) for frame in range(log.frame_count)]
        assert all(pose[2, 2] > 0.9 for pose in poses)
        way = poses[-1][:3, 3] - poses[0][:3, 3]
        if np.linalg.norm(way) > 1.0:
            assert np.mean([pose[:3, 0] @ way for pose in poses]) > 0.9 * np.linalg.norm(way)

    def test_camera_axes(self, log: DrivingLog) -> None:
        """Camera z is the viewing direction (x forward, y left in the ego frame), camera y points down."""
        looks = {"front": (1, 0), "left": (0, 1), "right": (0, -1), "back": (-1, 0)}
        looks |= {"front_left": (1, 1), "front_right": (1, -1)}
        for camera in log.cameras:
            lidar_SE3_camera = np.linalg.inv(log.world_SE3_lidar(0)) @ log.world_SE3_camera(camera.name, 0)
            assert lidar_SE3_camera[2, 1] < -0.8, f"{camera.name}: y is not down"
            assert np.linalg.norm(lidar_SE3_camera[:3, 3]) < 5.0, f"{camera.name} is not on the vehicle"
            look = looks.get(camera.name.removesuffix("_camera"))
            if look is not None:
                along = lidar_SE3_camera[:2, 2] @ np.asarray(look) / np.linalg.norm(look)
                assert along > 0.8, f"{camera.name} looks along {lidar_SE3_camera[:3, 2]}"

    # --- time

    def test_time_is_float64_seconds(self, log: DrivingLog) -> None:
        times = [log.frame_timestamp_s(frame) for frame in range(log.frame_count)]
        assert all(isinstance(time, float) for time in times)
        assert (np.diff(times) > 0).all() and (np.diff(times) < 2.0).all()
        for camera in log.cameras:
            for frame, time in enumerate(times):
                fired = log.camera_timestamp_s(camera.name, frame)
                assert isinstance(fired, float) and abs(fired - time) < CLOCK_TOLERANCE_S

    # --- images

    def test_images_are_encoded_bytes_of_the_lens_size(self, log: DrivingLog) -> None:
        for camera in log.cameras:
            for frame in (0, log.frame_count - 1):
                data = log.image_bytes(camera.name, frame)
                if (camera.name, frame) in self.missing_images:
                    continue
                assert isinstance(data, bytes)
                with Image.open(io.BytesIO(data)) as image:
                    assert image.format in ("JPEG", "PNG")
                    assert image.size == (camera.lens.width_px, camera.lens.height_px)
                assert log.image_bytes(camera.name, frame) == data

    def test_missing_images_are_none(self, log: DrivingLog) -> None:
        for name, frame in self.missing_images:
            assert log.image_bytes(name, frame) is None

    # --- sweeps

    def _sweeps(self, log: DrivingLog) -> Iterator[tuple[int, Float64]]:
        for frame in (0, log.frame_count - 1):
            sweep = log.sweep(frame)
            if sweep is not None:
                yield frame, sweep.points_world

    def test_sweeps(self, log: DrivingLog) -> None:
        read = 0
        for frame in (0, log.frame_count // 2, log.frame_count - 1):
            sweep = log.sweep(frame)
            if frame in self.missing_sweeps:
                assert sweep is None
                continue
            assert sweep is not None
            read += 1
            count = len(sweep.points_world)
            assert sweep.points_world.shape == (count, 3) and sweep.points_world.dtype == np.float64
            assert sweep.intensity.shape == (count,) and sweep.intensity.dtype == np.float32
            assert sweep.timestamps_s.shape == (count,) and sweep.timestamps_s.dtype == np.float64
            assert np.isfinite(sweep.points_world).all()
            assert sweep.intensity.min() >= 0 and sweep.intensity.max() <= 1
            assert np.abs(sweep.timestamps_s - log.frame_timestamp_s(frame)).max() < CLOCK_TOLERANCE_S
            if sweep.sensor_world is not None:
                assert sweep.sensor_world.shape == (3,) and sweep.sensor_world.dtype == np.float64
                # On the vehicle itself.
                assert np.linalg.norm(sweep.sensor_world - log.world_SE3_lidar(frame)[:3, 3]) < 5.0
        assert bool(read) == self.has_sweeps

    def test_missing_sweeps_are_none(self, log: DrivingLog) -> None:
        for frame in self.missing_sweeps:
            assert log.sweep(frame) is None

    def test_points_surround_the_vehicle(self, log: DrivingLog) -> None:
        """World coordinates that fit the pose: points on all sides, and the ground beneath the cameras.

        Where the ego frame's own origin lies is the log's business: at the sensor, or (PandaSet) near the ground.
        """
        front = self._front(log).name
        for frame, points in self._sweeps(log):
            local = (points - log.world_SE3_lidar(frame)[:3, 3]) @ log.world_SE3_lidar(frame)[:3, :3]
            for axis in (0, 1):
                assert 0.1 < (local[:, axis] > 0).mean() < 0.9
            near = np.linalg.norm(local[:, :2], axis=1) < 10
            camera = log.world_SE3_lidar(frame)[:3, :3].T @ (
                log.world_SE3_camera(front, frame)[:3, 3] - log.world_SE3_lidar(frame)[:3, 3]
            )
            assert 0.5 < camera[2] - np.percentile(local[near, 2], 5) < 4.0

    def test_points_ahead_are_seen_by_the_front_camera(self, log: DrivingLog) -> None:
        """What lies ahead falls into the front image, on the side on which it lies; what lies behind does not."""
        front = self._front(log)
        for frame, points in self._sweeps(log):
            local = (points - log.world_SE3_lidar(frame)[:3, 3]) @ log.world_SE3_lidar(frame)[:3, :3]
            seen = (points - log.world_SE3_camera(front.name, frame)[:3, 3]) @ log.world_SE3_camera(front.name, frame)[
                :3, :3
            ]
            ahead = (local[:, 0] > 6) & (np.abs(local[:, 1]) < 0.2 * local[:, 0])
            assert ahead.sum() > 20
            assert (seen[ahead, 2] > 0).all()
            assert (seen[local[:, 0] < -3, 2] < 0).all()
            u = front.lens.fx_px * seen[ahead, 0] / seen[ahead, 2] + front.lens.cx_px
            v = front.lens.fy_px * seen[ahead, 1] / seen[ahead, 2] + front.lens.cy_px
            in_image = (u > 0) & (u < front.lens.width_px) & (v > 0) & (v < front.lens.height_px)
            assert in_image.mean() > 0.5
            left = local[ahead, 1] > 0.05 * local[ahead, 0]
            assert left.sum() < 5 or (u[left] < front.lens.cx_px).mean() > 0.95

    def _front(self, log: DrivingLog) -> Camera:
        return next(c for c in log.cameras if c.name.removesuffix("_camera") == self.front_camera)

    # --- tracks

    def test_track_invariants(self, log: DrivingLog) -> None:
        tracks = log.tracks()
        assert bool(tracks) == self.has_tracks
        assert len({track.track_id for track in tracks}) == len(tracks)
        for track in tracks:
            frames = track.frames
            assert frames.dtype == np.int64 and frames.ndim == 1 and len(frames) >= 1
            assert (np.diff(frames) > 0).all() and frames[0] >= 0 and frames[-1] < log.frame_count
            assert track.world_SE3_box.shape == (len(frames), 4, 4)
            for pose in track.world_SE3_box:
                assert_rigid(pose)
            assert len(track.size_m) == 3 and all(np.isfinite(size) and size > 0 for size in track.size_m)
            assert isinstance(track.moving, bool) and isinstance(track.label, str) and track.label

    def test_no_object_is_doubled(self, log: DrivingLog) -> None:
        tracks = log.tracks()
        for frame in range(log.frame_count):
            centres = [t.world_SE3_box[t.frames == frame][0, :3, 3] for t in tracks if frame in t.frames]
            if len(centres) > 1:
                gaps = np.linalg.norm(
                    np.subtract.outer(np.array(centres), np.array(centres))[:, range(3), :, range(3)].T, axis=-1
                )
                assert np.sort(gaps, axis=1)[:, 1].min() > 0.3

    def test_boxes_lie_along_their_points(self, log: DrivingLog) -> None:
        """Length goes with box x: turned by 90° the boxes hold fewer points."""
        straight = turned = 0
        quarter = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        for frame, points in self._sweeps(log):
            for track in self._long(log.tracks(), frame):
                pose = track.world_SE3_box[track.frames == frame][0]
                straight += inside(points, pose, track.size_m)
                turned += inside(points, pose @ quarter, track.size_m)
        assert not self.has_tracks or (straight > 1.2 * turned and straight > 50)

    def _long(self, tracks: tuple[CuboidTrack, ...], frame: int) -> list[CuboidTrack]:
        return [t for t in tracks if frame in t.frames and t.size_m[0] > 1.5 * t.size_m[1]]

    def test_moving_boxes_go_forward(self, log: DrivingLog) -> None:
        cosines = []
        for track in log.tracks():
            way = track.world_SE3_box[-1, :3, 3] - track.world_SE3_box[0, :3, 3]
            if np.linalg.norm(way) > 2.0 and track.size_m[0] > 1.5 * track.size_m[1]:
                assert track.moving
                cosines.append(track.world_SE3_box[:, :3, 0].mean(axis=0) @ way / np.linalg.norm(way))
        assert not cosines or np.median(cosines) > 0.9

    # --- digests and faults

    def test_digest_is_stable(self, log: DrivingLog) -> None:
        assert re.fullmatch(r"[0-9a-f]{64}", log.digest())
        assert self.open().digest() == log.digest()

    @pytest.mark.parametrize("beyond", ["before", "after"])
    def test_frames_out_of_range(self, log: DrivingLog, beyond: str) -> None:
        frame = -1 if beyond == "before" else log.frame_count
        camera = log.cameras[0].name
        for ask in (
            lambda: log.frame_timestamp_s(frame),
            lambda: log.world_SE3_lidar(frame),
            lambda: log.world_SE3_camera(camera, frame),
            lambda: log.camera_timestamp_s(camera, frame),
            lambda: log.image_bytes(camera, frame),
            lambda: log.sweep(frame),
        ):
            with pytest.raises(InputError) as caught:
                ask()
            assert caught.value.frame == frame

    def test_unknown_camera(self, log: DrivingLog) -> None:
        with pytest.raises(InputError) as caught:
            log.image_bytes("rear_periscope", 0)
        assert caught.value.camera == "rear_periscope"
        assert log.cameras[0].name in caught.value.remedy
