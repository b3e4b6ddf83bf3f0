"""Values of a driving log: cameras, images, sweeps, cuboid tracks.

Conventions: ``world_SE3_camera`` takes camera coordinates to world coordinates; camera axes x right, y down,
z forward; metres, seconds, float64; quaternions w, x, y, z. Continuous image coordinates: the top-left corner of the
image is (0, 0) and the centre of the first pixel is (0.5, 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class Lens:
    """A pinhole lens with optional Brown–Conrady distortion.

    ``fx_px … cy_px`` are in pixels of an image of ``width_px × height_px``; ``distortion`` is (k1, k2, p1, p2, k3) or
    empty for an undistorted image.
    """

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    width_px: int
    height_px: int
    distortion: tuple[float, ...] = ()

    @property
    def coefficients(self) -> tuple[float, ...]:
        """``distortion`` as five numbers, 0 where none is stated."""
        return (*self.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]

    def resized(self, width_px: int, height_px: int) -> Lens:
        """The same lens for an image resampled to ``width_px × height_px`` (whole field of view kept)."""
        sx, sy = width_px / self.width_px, height_px / self.height_px
        return replace(
            self,
            fx_px=self.fx_px * sx,
            fy_px=self.fy_px * sy,
            cx_px=self.cx_px * sx,
            cy_px=self.cy_px * sy,
            width_px=width_px,
            height_px=height_px,
        )

    def of_width(self, width_px: int) -> Lens:
        """The same lens for an image resampled to ``width_px``, its sides in proportion."""
        return self.resized(width_px, max(1, round(width_px * self.height_px / self.width_px)))


@dataclass(frozen=True)
class RollingShutter:
    """How a camera moves while an image is read out, row after row from the top; the pose holds for the middle row.

    Row r (continuous, 0 to the height) is exposed (r / height − ½) · ``readout_s`` after the pose's time.
    ``velocity_m_s`` and ``turn_rad_s`` are the camera's own, in camera axes. ``frame_s`` is the time from one log frame
    to the next, which makes velocities of the poses of actors; 0: not stated, actors rest while an image is read out.
    """

    readout_s: float
    velocity_m_s: tuple[float, float, float]
    turn_rad_s: tuple[float, float, float]
    frame_s: float = 0.0


@dataclass(frozen=True)
class MotionBlur:
    """How a camera moves while its shutter is open; the pose holds for the middle of the exposure.

    ``velocity_m_s``, ``turn_rad_s`` and ``frame_s`` as of a ``RollingShutter``; with one, each row is exposed for so
    long. ``exposure_s`` 0 is no blur.
    """

    exposure_s: float
    velocity_m_s: tuple[float, float, float]
    turn_rad_s: tuple[float, float, float]
    frame_s: float = 0.0


@dataclass(frozen=True)
class Camera:
    """A camera of the rig: its name and its lens at native resolution.

    ``readout_s``: the rolling shutter's readout (0: global); ``exposure_s``: of an image (0: not stated).
    """

    name: str
    lens: Lens
    readout_s: float = 0.0
    exposure_s: float = 0.0


@dataclass(frozen=True)
class Sweep:
    """One LiDAR sweep in world coordinates.

    ``points_world`` [N, 3] float64 metres; ``intensity`` [N] float32 in [0, 1]; ``timestamps_s`` [N] float64 per point.
    """

    points_world: Float64
    intensity: Float32
    timestamps_s: Float64


@dataclass(frozen=True)
class CuboidTrack:
    """One annotated object through time.

    ``frames`` [F] int (increasing log frames in which it is annotated); ``world_SE3_box`` [F, 4, 4] float64, box axes
    x forward (length), y left (width), z up (height); ``size_m`` (length, width, height), the median over frames.
    ``moving``: the annotation says that it moves in at least one frame.
    """

    track_id: str
    label: str
    frames: NDArray[np.int64]
    world_SE3_box: Float64
    size_m: tuple[float, float, float]
    moving: bool


@runtime_checkable
class Truth(Protocol):
    """The true image at any viewpoint (only a ray-cast log has it)."""

    def image(
        self,
        frame: int,
        world_SE3_camera: Float64,  # [4, 4]
        lens: Lens,
    ) -> NDArray[np.uint8]:  # [H, W, 3] sRGB, H × W of the lens
        """What a camera at that pose would have seen at that frame's time."""
        ...


class DrivingLog(Protocol):
    """A driving log, read lazily: opening is cheap, images and sweeps are read when asked for.

    Frames count from 0 to ``frame_count - 1``. A *missing* image or sweep is ``None``; an *unreadable* sweep raises
    ``InputError`` naming file and frame (image bytes are not decoded here).
    """

    @property
    def uri(self) -> str:
        """What the user wrote: ``pandaset:PATH/002``, ``synthetic:street?seed=1000``."""
        ...

    @property
    def dataset(self) -> str:
        """``pandaset``, ``synthetic``: the first folder of the store's layout."""
        ...

    @property
    def name(self) -> str:
        """A name for the log that can be a folder: ``002``, ``street-seed=1000``."""
        ...

    @property
    def frame_count(self) -> int: ...

    @property
    def cameras(self) -> tuple[Camera, ...]: ...

    def frame_timestamp_s(self, frame: int) -> float:
        """The LiDAR sweep's time, seconds (float64)."""
        ...

    def world_SE3_lidar(self, frame: int) -> Float64:
        """[4, 4]; the LiDAR (ego) pose: x forward, y left, z up. Raises ``InputError`` if it is not finite."""
        ...

    def world_SE3_camera(self, camera: str, frame: int) -> Float64:
        """[4, 4]. Raises ``InputError`` if it is not finite."""
        ...

    def camera_timestamp_s(self, camera: str, frame: int) -> float: ...

    def image_bytes(self, camera: str, frame: int) -> bytes | None:
        """The encoded image (JPEG or PNG) as it came, or ``None`` where the log has none."""
        ...

    def sweep(self, frame: int) -> Sweep | None: ...

    def tracks(self) -> tuple[CuboidTrack, ...]: ...

    def digest(self) -> str:
        """sha256 (hex) over everything that a reconstruction may read from this log."""
        ...

    @property
    def truth(self) -> Truth | None: ...


@dataclass(frozen=True)
class LogProblem:
    """Something that a reader left out or repaired without failing: a word to count by, and one sentence."""

    kind: str
    message: str


@runtime_checkable
class ReportsProblems(Protocol):
    """A log whose reader leaves things out (a box without a position, a camera without images) says so here."""

    def problems(self) -> tuple[LogProblem, ...]: ...
