"""A chunk: up to 20 consecutive frames of a log, rebased to a local origin, as ``ingest`` leaves it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.types import Float32, Float64, Lens, MotionBlur, RollingShutter

# Words of the artifacts' tables: see storage/codecs/chunk.py.
Role = Literal["source", "heldout"]
Gain = tuple[float, float, float]
"""Logarithm of an image's gain in linear light: red, green, blue."""

NO_SWEEP = -1
"""The frame of points that are of no sweep: those of a file, of images, and of the road where LiDAR is blind."""

MOST_FRAMES = 1 << 15
"""A log may have so many frames: points have the numbers of theirs as int16."""


@dataclass(frozen=True)
class View:
    """One recorded image: a camera at a frame of a chunk.

    ``ingest`` leaves the last four attributes ``None``; the effects' plan fills in those whose effects are on.

    Attributes:
        camera: name of the camera in the rig.
        frame: counts in the log, not in the chunk.
        role: whether scenes are fitted to it or compared with it.
        timestamp_s: when the image was taken.
        chunk_SE3_camera: [4, 4] float64.
        lens: at the *working* resolution.
        image: the encoded bytes as they came, at the native resolution; a view without an image is not in the chunk.
        log_gain: of the image's exposure.
        ego_mask: [H, W], true where the recording vehicle itself is in the image.
        shutter: how the camera moves while the image is read out.
        blur: how the camera moves while the image is exposed.
    """

    camera: str
    frame: int
    role: Role
    timestamp_s: float
    chunk_SE3_camera: Float64
    lens: Lens
    image: bytes
    log_gain: Gain | None = None
    ego_mask: NDArray[np.bool_] | None = None
    shutter: RollingShutter | None = None
    blur: MotionBlur | None = None


@dataclass(frozen=True)
class Points:
    """Coloured LiDAR points of one node: the static background in chunk coordinates, or an actor in its box frame.

    Attributes:
        positions: [P, 3] float32 metres.
        colors: [P, 3] uint8 sRGB; grey 128 where no image saw the point.
        colored: [P] bool: some image saw the point unoccluded.
        frames: [P] int16, the log frame of the sweep each point is from; ``NO_SWEEP`` for points of none.
    """

    positions: Float32
    colors: NDArray[np.uint8]
    colored: NDArray[np.bool_]
    frames: NDArray[np.int16]

    def __len__(self) -> int:
        return len(self.positions)


@dataclass(frozen=True)
class Actor:
    """A moving object of the chunk.

    Attributes:
        track_id: the log's name for the object.
        label: its class, in the log's words.
        size_m: length, width, height of its box.
        frames: [F] int64 log frames at which it exists.
        chunk_SE3_box: [F, 4, 4] float64.
        points: in box coordinates: x forward, y left, z up, origin at the centre.
    """

    track_id: str
    label: str
    size_m: tuple[float, float, float]
    frames: NDArray[np.int64]
    chunk_SE3_box: Float64
    points: Points


@dataclass(frozen=True)
class LogIssue:
    """Something that the log lacks or that was set aside, for reports to name.

    Attributes:
        kind: what it is, one word: that of a finding of ``genre check`` where the same thing is found there.
        detail: one clause for a reader.
        frame: log frame, where it is about one.
        camera: where it is about one.
    """

    kind: str
    detail: str
    frame: int | None = None
    camera: str | None = None


@dataclass(frozen=True)
class Chunk:
    """All that later stages read of a log.

    Attributes:
        dataset: kind of log.
        log: its name.
        index: of the chunk in the log.
        frames: log frames of the chunk, in order.
        camera_names: in the order of the rig.
        width_px: working width of images.
        height_px: working height of images.
        world_SE3_chunk: [4, 4] float64, a translation to the chunk's middle ego position: local coordinates are small
            enough for float32.
        chunk_SE3_ego: [F, 4, 4] float64 LiDAR poses, x forward, y left, z up, one per frame.
        views: ordered by (frame, camera order of the rig).
        static: points of the background.
        actors: moving objects.
        log_issues: what was missing, unreadable or left out.
    """

    dataset: str
    log: str
    index: int
    frames: tuple[int, ...]
    camera_names: tuple[str, ...]
    width_px: int
    height_px: int
    world_SE3_chunk: Float64
    chunk_SE3_ego: Float64
    views: tuple[View, ...]
    static: Points
    actors: tuple[Actor, ...]
    log_issues: tuple[LogIssue, ...]

    def views_with_role(self, role: Role) -> tuple[View, ...]:
        """The views that scenes are fitted to, or those they are compared with, in order.

        Args:
            role: ``source`` or ``heldout``.
        """
        return tuple(v for v in self.views if v.role == role)
