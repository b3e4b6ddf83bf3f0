"""What the plausibility checks read of a log: each pose, time, sweep and image once, with gaps where reading fails."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import GenreError
from genre_tasks.logs.types import Camera, CuboidTrack, DrivingLog, Float64, Sweep
from genre_tasks.scene.image_decoding import decode_pixels

Value = TypeVar("Value")


class LogSample:
    """Some frames of a log, read lazily and kept: the same thing is never read twice.

    Whatever cannot be read is a gap (NaN or ``None``) here, because other findings report it already.

    Args:
        log: the log.
        frames: frames of one chunk, increasing.
        cameras: the cameras that are used.

    Attributes:
        log: the log.
        frames: frames of one chunk.
        cameras: the cameras that are used.
    """

    def __init__(self, log: DrivingLog, frames: tuple[int, ...], cameras: tuple[Camera, ...]) -> None:
        self.log = log
        self.frames = frames
        self.cameras = cameras
        self._sweeps: dict[int, Sweep | None] = {}
        self._pixels: dict[tuple[str, int, int], NDArray[np.uint8] | None] = {}

    @cached_property
    def times_s(self) -> Float64:
        """[F] times of the frames' sweeps, seconds; NaN where there is none."""
        return np.array([_read_or(np.nan, self.log.frame_timestamp_s, frame) for frame in self.frames])

    @cached_property
    def world_SE3_lidar(self) -> Float64:
        """[F, 4, 4] poses of the LiDAR; NaN where one cannot be read."""
        return np.stack([_read_pose(self.log.world_SE3_lidar, frame) for frame in self.frames])

    @cached_property
    def tracks(self) -> tuple[CuboidTrack, ...]:
        """The annotated objects of the log; none where they cannot be read."""
        return _read_or((), self.log.tracks)

    def camera_times_s(self, camera: Camera) -> Float64:
        """Reads when a camera took its images.

        Args:
            camera: one of ``cameras``.

        Returns:
            [F] seconds; NaN where there is no time.
        """
        return np.array([_read_or(np.nan, self.log.camera_timestamp_s, camera.name, frame) for frame in self.frames])

    def world_SE3_camera(self, camera: Camera) -> Float64:
        """Reads the poses of a camera.

        Args:
            camera: one of ``cameras``.

        Returns:
            [F, 4, 4]; NaN where a pose cannot be read.
        """
        return np.stack([_read_pose(self.log.world_SE3_camera, camera.name, frame) for frame in self.frames])

    def sweep(self, frame: int) -> Sweep | None:
        """Reads a sweep.

        Args:
            frame: one of ``frames``.

        Returns:
            The sweep; ``None`` where it is missing or cannot be read.
        """
        if frame not in self._sweeps:
            self._sweeps[frame] = _read_or(None, self.log.sweep, frame)
        return self._sweeps[frame]

    def pixels(self, camera: Camera, frame: int, width_px: int) -> NDArray[np.uint8] | None:
        """Decodes an image.

        Args:
            camera: one of ``cameras``.
            frame: one of ``frames``.
            width_px: width of the result; its height is in proportion to the lens.

        Returns:
            [H, W, 3] sRGB; ``None`` where the image is missing or cannot be decoded.
        """
        key = (camera.name, frame, width_px)
        if key not in self._pixels:
            height_px = camera.lens.resized_to_width(width_px).height_px
            data = _read_or(None, self.log.image_bytes, camera.name, frame)
            self._pixels[key] = None if data is None else _read_or(None, decode_pixels, data, width_px, height_px)
        return self._pixels[key]


def _read_pose(read: Callable[..., Float64], *arguments: object) -> Float64:
    """A pose of the log; NaN in all places where it cannot be read, or is not finite in one."""
    gap = np.full((4, 4), np.nan)
    pose = _read_or(gap, read, *arguments)
    return pose if np.isfinite(pose).all() else gap


def _read_or(gap: Value, read: Callable[..., Value], *arguments: object) -> Value:
    """Calls a function of the log; ``gap`` stands for what cannot be read."""
    try:
        return read(*arguments)
    except GenreError:
        return gap
