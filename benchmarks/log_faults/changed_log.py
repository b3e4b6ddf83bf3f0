"""A sound log with one thing changed, as a faulty converter or recorder would have changed it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from genre_tasks.logs.types import Camera, CuboidTrack, DrivingLog, Float64, Sweep


def _same_camera(camera: Camera) -> Camera:
    return camera


def _same_pose(frame: int, pose: Float64) -> Float64:
    return pose


def _same_camera_pose(camera: str, frame: int, pose: Float64) -> Float64:
    return pose


def _same_sweep(frame: int, sweep: Sweep) -> Sweep:
    return sweep


def _same_image(camera: str, frame: int, image: bytes) -> bytes:
    return image


def _same_source(camera: str, frame: int) -> tuple[str, int]:
    return camera, frame


def _same_frame(frame: int) -> int:
    return frame


def _same_time(frame: int, time_s: float) -> float:
    return time_s


def _same_tracks(tracks: tuple[CuboidTrack, ...]) -> tuple[CuboidTrack, ...]:
    return tracks


@dataclass(frozen=True)
class Changes:
    """What is changed; everything else stays.

    Attributes:
        camera: the lens, mostly.
        lidar_pose: by frame.
        camera_pose: by camera and frame.
        sweep: by frame.
        sweep_source: the frame whose sweep is given for a frame.
        image: the encoded image, by camera and frame.
        image_source: the camera and frame whose image is given for a camera and frame.
        frame_time: by frame.
        camera_time: by frame, the same for all cameras.
        tracks: the annotated objects.
    """

    camera: Callable[[Camera], Camera] = _same_camera
    lidar_pose: Callable[[int, Float64], Float64] = _same_pose
    camera_pose: Callable[[str, int, Float64], Float64] = _same_camera_pose
    sweep: Callable[[int, Sweep], Sweep] = _same_sweep
    sweep_source: Callable[[int], int] = _same_frame
    image: Callable[[str, int, bytes], bytes] = _same_image
    image_source: Callable[[str, int], tuple[str, int]] = _same_source
    frame_time: Callable[[int, float], float] = _same_time
    camera_time: Callable[[int, float], float] = _same_time
    tracks: Callable[[tuple[CuboidTrack, ...]], tuple[CuboidTrack, ...]] = _same_tracks


class ChangedLog:
    """A ``DrivingLog`` that gives another log's values changed.

    Args:
        log: the sound log.
        changes: what is changed.
    """

    def __init__(self, log: DrivingLog, changes: Changes) -> None:
        self._log = log
        self._changes = changes

    # Name, number of frames and digest are the sound log's.
    def __getattr__(self, name: str) -> Any:
        return getattr(self._log, name)

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """See ``DrivingLog``."""
        return tuple(self._changes.camera(camera) for camera in self._log.cameras)

    def frame_timestamp_s(self, frame: int) -> float:
        """See ``DrivingLog``."""
        return self._changes.frame_time(frame, self._log.frame_timestamp_s(frame))

    def camera_timestamp_s(self, camera: str, frame: int) -> float:
        """See ``DrivingLog``."""
        return self._changes.camera_time(frame, self._log.camera_timestamp_s(camera, frame))

    def world_SE3_lidar(self, frame: int) -> Float64:
        """See ``DrivingLog``."""
        return self._changes.lidar_pose(frame, self._log.world_SE3_lidar(frame))

    def world_SE3_camera(self, camera: str, frame: int) -> Float64:
        """See ``DrivingLog``."""
        return self._changes.camera_pose(camera, frame, self._log.world_SE3_camera(camera, frame))

    def image_bytes(self, camera: str, frame: int) -> bytes | None:
        """See ``DrivingLog``."""
        image = self._log.image_bytes(*self._changes.image_source(camera, frame))
        return None if image is None else self._changes.image(camera, frame, image)

    def sweep(self, frame: int) -> Sweep | None:
        """See ``DrivingLog``."""
        sweep = self._log.sweep(self._changes.sweep_source(frame))
        return None if sweep is None else self._changes.sweep(frame, sweep)

    def tracks(self) -> tuple[CuboidTrack, ...]:
        """See ``DrivingLog``."""
        return self._changes.tracks(self._log.tracks())
