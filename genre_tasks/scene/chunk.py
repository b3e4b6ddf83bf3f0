"""A chunk: up to 20 consecutive frames of a log, rebased to a local origin, as `ingest` leaves it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.types import Float32, Float64, Lens, MotionBlur, RollingShutter

Role = Literal["source", "heldout"]
Gain = tuple[float, float, float]
"""Logarithm of an image's gain in linear light: red, green, blue."""
MarkKind = Literal[
    "missing_image",
    "unreadable_image",
    "missing_sweep",
    "unreadable_sweep",
    "cuboid_outside",
    "cuboid_invalid",
    "actor_few_points",
    "timestamps",
    "standstill",
]


@dataclass(frozen=True)
class View:
    """One camera at one frame of a chunk.

    ``frame`` counts in the log; ``chunk_SE3_camera`` [4, 4] float64; ``lens`` at the *working* resolution; ``image``
    the encoded bytes as they came (native resolution), never ``None``: a view without an image is not in the chunk.

    What effects say of the image, ``None`` where they are off (``ingest`` knows nothing of it): ``log_gain`` of its
    exposure, ``own`` [H, W] where the vehicle itself is in it, ``shutter`` how the camera moves while it is read out,
    ``blur`` how it moves while it is exposed.
    """

    camera: str
    frame: int
    role: Role
    timestamp_s: float
    chunk_SE3_camera: Float64
    lens: Lens
    image: bytes
    log_gain: Gain | None = None
    own: NDArray[np.bool_] | None = None
    shutter: RollingShutter | None = None
    blur: MotionBlur | None = None


@dataclass(frozen=True)
class Points:
    """Coloured LiDAR points of one node (the static background in chunk coordinates, or an actor in its box frame).

    ``positions`` [P, 3] float32 metres; ``colors`` [P, 3] uint8 sRGB; ``colored`` [P] bool: some image saw the point
    unoccluded (elsewhere the colour is grey 128); ``frames`` [P] int16, the log frame of the sweep each point is
    from, −1 of none (a point file, or road filled in where LiDAR is blind).
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

    ``frames`` [F] int64 log frames in which it exists; ``chunk_SE3_box`` [F, 4, 4] float64; ``size_m`` length, width,
    height; ``points`` in box coordinates (x forward, y left, z up, origin at the centre).
    """

    track_id: str
    label: str
    size_m: tuple[float, float, float]
    frames: NDArray[np.int64]
    chunk_SE3_box: Float64
    points: Points


@dataclass(frozen=True)
class Mark:
    """Something the log lacks or that was set aside, kept so that a report can say it."""

    kind: MarkKind
    detail: str
    frame: int | None = None
    camera: str | None = None


@dataclass(frozen=True)
class Chunk:
    """What every later stage reads of the log.

    ``frames`` are the log frames of the chunk in order; ``world_SE3_chunk`` [4, 4] float64 (a pure translation to the
    chunk's middle ego position, so that local coordinates are small); ``chunk_SE3_ego`` [F, 4, 4] float64 LiDAR poses,
    x forward, y left, z up, one per frame; ``views`` ordered by (frame, camera order of the rig).
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
    marks: tuple[Mark, ...]

    def of_role(self, role: Role) -> tuple[View, ...]:
        """The views of one role, in order."""
        return tuple(v for v in self.views if v.role == role)
