"""Values of a driving log: cameras, images, LiDAR sweeps and cuboid tracks, and the protocol that every reader keeps.

Conventions of this project, from the log to the render:

* **Transforms.** ``a_SE3_b`` [4, 4] takes coordinates in frame b to coordinates in frame a. Names chain, so that a
  wrong product looks wrong: ``world_SE3_camera = world_SE3_lidar @ lidar_SE3_camera``.
* **Axes.** Cameras: x right, y down, z forward. Ego vehicle, LiDAR and cuboids: x forward, y left, z up. World: z up,
  with the origin that the log has, which may be millions of metres away.
* **Units.** Metres, seconds since 1970, radians and pixels. Poses, points and times are float64: a float32 would round
  a world coordinate of 4 000 km to 0.25 m and a time of today to two minutes.
* **Quaternions** are w, x, y, z.
* **Image coordinates** are continuous: (0, 0) is the top-left corner, (0.5, 0.5) the centre of the first pixel.
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

    A point (x, y, z) in camera axes appears at ``u = fx_px * x / z + cx_px`` and ``v = fy_px * y / z + cy_px`` where
    nothing is distorted.

    Attributes:
        fx_px: horizontal focal length, pixels.
        fy_px: vertical focal length, pixels.
        cx_px: horizontal principal point, pixels from the image's left edge.
        cy_px: vertical principal point, pixels from the image's upper edge.
        width_px: width of the image that the four numbers belong to.
        height_px: height of that image.
        distortion: k1, k2, p1, p2, k3; empty for an undistorted image.
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
        """``distortion`` as five numbers, 0 where none is stated.

        Returns:
            k1, k2, p1, p2, k3.
        """
        # Padded, so that formulas need no case of their own for a lens without distortion.
        return (*self.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]

    def resized(self, width_px: int, height_px: int) -> Lens:
        """Scales the lens to an image that was resampled, with the same field of view.

        Args:
            width_px: new width, at least 1.
            height_px: new height, at least 1.

        Returns:
            The lens of the resampled image. Distortion stays: its coefficients act on normalised coordinates.

        >>> Lens(100.0, 100.0, 32.0, 16.0, 64, 32).resized(32, 8)
        Lens(fx_px=50.0, fy_px=25.0, cx_px=16.0, cy_px=4.0, width_px=32, height_px=8, distortion=())
        """
        # Two factors, since a rounded height changes the proportions of the image.
        scale_x = width_px / self.width_px
        scale_y = height_px / self.height_px
        return replace(
            self,
            fx_px=self.fx_px * scale_x,
            fy_px=self.fy_px * scale_y,
            cx_px=self.cx_px * scale_x,
            cy_px=self.cy_px * scale_y,
            width_px=width_px,
            height_px=height_px,
        )

    def resized_to_width(self, width_px: int) -> Lens:
        """Scales the lens to an image of another width, its sides in proportion.

        Args:
            width_px: new width, at least 1.

        Returns:
            The lens of the resampled image; the height is rounded and at least 1.

        >>> Lens(1970.0, 1970.0, 970.0, 532.0, 1920, 1080).resized_to_width(320).height_px
        180
        """
        return self.resized(width_px, max(1, round(width_px * self.height_px / self.width_px)))


# Keyword-only, so that each kind of motion can begin with the duration that makes it one.
@dataclass(frozen=True, kw_only=True)
class CameraMotion:
    """How a camera moves around the time of its pose, and how long a log frame lasts.

    Attributes:
        velocity_m_s: velocity of the camera along its axes, m/s.
        turn_rad_s: angular velocity of the camera as a rotation vector in its axes, rad/s.
        frame_s: seconds from one log frame to the next, which turn the poses of actors into velocities; 0: not stated,
            and actors rest while an image is taken.
    """

    velocity_m_s: tuple[float, float, float]
    turn_rad_s: tuple[float, float, float]
    frame_s: float = 0.0


@dataclass(frozen=True)
class RollingShutter(CameraMotion):
    """How a camera moves while an image is read out, row after row from the top; the pose holds for the middle row.

    Row r (continuous, 0 to the height) is exposed (r / height − ½) · ``readout_s`` after the pose's time.

    Attributes:
        readout_s: seconds from the first row to the last; 0: all rows at once.
    """

    readout_s: float


@dataclass(frozen=True)
class MotionBlur(CameraMotion):
    """How a camera moves while its shutter is open; the pose holds for the middle of the exposure.

    With a rolling shutter, the exposure of every row is centred on the time of that row.

    Attributes:
        exposure_s: seconds for which the shutter is open; 0: no blur.
    """

    exposure_s: float


@dataclass(frozen=True)
class Camera:
    """A camera of the rig.

    Attributes:
        name: unique in the log, such as ``front_camera``.
        lens: at the resolution of the recorded images.
        readout_s: rolling shutter, seconds from the first row to the last; 0: a global shutter.
        exposure_s: seconds for which the shutter is open; 0: not stated.
    """

    name: str
    lens: Lens
    readout_s: float = 0.0
    exposure_s: float = 0.0


@dataclass(frozen=True)
class Sweep:
    """One LiDAR sweep in world coordinates.

    Attributes:
        points_world: [N, 3] float64, metres.
        intensity: [N] float32 in [0, 1].
        timestamps_s: [N] float64, seconds, when each point was measured.
        sensor_world: [3] float64, metres, where the main LiDAR is at the frame's time; ``None``: the log does not say.
    """

    points_world: Float64
    intensity: Float32
    timestamps_s: Float64
    sensor_world: Float64 | None = None


@dataclass(frozen=True)
class CuboidTrack:
    """One annotated object through time.

    Attributes:
        track_id: unique in the log.
        label: class of the object, in the log's words.
        frames: [F] log frames in which it is annotated, increasing.
        world_SE3_box: [F, 4, 4] float64; origin at the centre, x forward (length), y left (width), z up (height).
        size_m: length, width, height; the median over frames.
        moving: the annotation says that the object moves in at least one frame.
    """

    track_id: str
    label: str
    frames: NDArray[np.int64]
    world_SE3_box: Float64
    size_m: tuple[float, float, float]
    moving: bool


@runtime_checkable
class Truth(Protocol):
    """The true image at any viewpoint, which only a ray-cast log has."""

    def image(
        self,
        frame: int,
        world_SE3_camera: Float64,  # [4, 4]
        lens: Lens,
    ) -> NDArray[np.uint8]:  # [H, W, 3] sRGB, H × W of the lens
        """Renders what a camera at that pose would have seen at the time of a frame.

        Args:
            frame: log frame.
            world_SE3_camera: [4, 4] pose of the camera.
            lens: lens of the camera; its size is the image's.

        Returns:
            [H, W, 3] sRGB.

        Raises:
            InputError: no such frame, or a pose that is not finite.
        """
        ...


# A protocol rather than a base class: a reader in another package does not depend on this one.
class DrivingLog(Protocol):
    """A driving log, read lazily: opening is cheap, images and sweeps are read when they are asked for.

    Frames count from 0 to ``frame_count - 1``; any other frame, and an unknown camera, raises ``InputError``. A
    *missing* image or sweep is ``None``. An *unreadable* sweep raises ``InputError``, which names file and frame; image
    bytes are not decoded here.
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
    def frame_count(self) -> int:
        """How many frames the log has: one per LiDAR sweep, or the sweep's time where a sweep is missing."""
        ...

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras of the rig, in a fixed order."""
        ...

    def frame_timestamp_s(self, frame: int) -> float:
        """The time of a frame's LiDAR sweep.

        Returns:
            Seconds, float64.
        """
        ...

    def world_SE3_lidar(self, frame: int) -> Float64:
        """The pose of the LiDAR, which stands for the ego vehicle: x forward, y left, z up.

        Returns:
            [4, 4].

        Raises:
            InputError: the recorded pose is not finite.
        """
        ...

    def world_SE3_camera(self, camera: str, frame: int) -> Float64:
        """The pose of a camera at the time of its image: x right, y down, z forward.

        Returns:
            [4, 4].

        Raises:
            InputError: the recorded pose is not finite.
        """
        ...

    def camera_timestamp_s(self, camera: str, frame: int) -> float:
        """The time at which a camera took its image of a frame.

        Returns:
            Seconds, float64.
        """
        ...

    def image_bytes(self, camera: str, frame: int) -> bytes | None:
        """The encoded image as it was recorded: JPEG, PNG, or another format that Pillow reads.

        Returns:
            The file's bytes, or ``None`` where the log has no image.

        Raises:
            InputError: the file is there and cannot be read.
        """
        ...

    def sweep(self, frame: int) -> Sweep | None:
        """The LiDAR sweep of a frame.

        Returns:
            The sweep, or ``None`` where the log has none.

        Raises:
            InputError: the sweep is there and cannot be read.
        """
        ...

    def tracks(self) -> tuple[CuboidTrack, ...]:
        """The annotated objects; empty where the log has no annotations. Bad boxes are left out, and are findings.

        Raises:
            InputError: the annotations are there and cannot be read, or all boxes are bad.
        """
        ...

    def digest(self) -> str:
        """Identifies everything that a reconstruction may read from this log.

        Returns:
            sha256, hexadecimal.
        """
        ...

    @property
    def truth(self) -> Truth | None:
        """The true image at any viewpoint; ``None`` for recorded logs."""
        ...
