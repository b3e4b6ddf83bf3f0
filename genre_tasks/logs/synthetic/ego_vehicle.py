"""How the ego vehicle moves, and its rig: the positions and lenses of PandaSet's cameras.

The ego frame (``world_SE3_lidar`` of the log) has its origin on the ground below the roof, as PandaSet's poses do: x
forward, y left, z up. The LiDAR itself sits ``LIDAR_HEIGHT_M`` above it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from genre_tasks.logs.synthetic.parameters import CAMERA_NAMES, StreetParameters
from genre_tasks.logs.synthetic.road import Road, make_generator
from genre_tasks.logs.types import Camera, Float64, Lens

FRAME_S = 0.1
# On the roof, as PandaSet's; the pose in the log is on the ground, as PandaSet's too.
LIDAR_HEIGHT_M = 1.95
_NATIVE_SIZE_PX = (1920, 1080)
# How far the vehicle strays from its lane's centre.
_WEAVE_M = 0.22
# Metres of road to a radian of that.
_WEAVE_LENGTH_M = 14


@dataclass(frozen=True)
class _Mount:
    """Where a camera sits and what lens it has.

    Attributes:
        position_m: in the ego frame.
        azimuth_deg: viewing direction, left is positive.
        focal_px: focal length in pixels of a native image.
        centre_px: principal point in pixels of a native image.
    """

    position_m: tuple[float, float, float]
    azimuth_deg: float
    focal_px: float
    centre_px: tuple[float, float]


# Real mounts, so that a method that works on the street meets the overlaps and blind angles of a real rig.
# From the poses and intrinsics of PandaSet's sequence 002.
_MOUNTS = {
    "front_camera": _Mount((0.82, 0.00, 1.81), 0.0, 1970.0, (970.0, 532.0)),
    "front_left_camera": _Mount((1.47, 0.65, 1.53), 57.8, 930.0, (972.2, 538.0)),
    "front_right_camera": _Mount((1.46, -0.60, 1.60), -57.8, 930.0, (965.1, 533.4)),
    "left_camera": _Mount((0.50, 0.54, 1.58), 91.5, 930.0, (961.7, 541.6)),
    "right_camera": _Mount((0.58, -0.70, 1.55), -88.6, 922.5, (945.1, 537.6)),
    "back_camera": _Mount((-0.32, -0.03, 1.66), 178.2, 933.5, (946.5, 537.4)),
}


def build_rig(parameters: StreetParameters) -> tuple[Camera, ...]:
    """Builds the cameras of the rig, in the order of ``CAMERA_NAMES``.

    Args:
        parameters: number and size of the images, shutter and lens distortion.

    Returns:
        The cameras.

    >>> [camera.name for camera in build_rig(StreetParameters(cameras=2))]
    ['front_camera', 'front_left_camera']
    """
    cameras = []
    for name in CAMERA_NAMES[: parameters.cameras]:
        mount = _MOUNTS[name]
        # Built at the native size and scaled, so that every image size has the same field of view.
        native = Lens(
            fx_px=mount.focal_px,
            fy_px=mount.focal_px,
            cx_px=mount.centre_px[0],
            cy_px=mount.centre_px[1],
            width_px=_NATIVE_SIZE_PX[0],
            height_px=_NATIVE_SIZE_PX[1],
            distortion=(parameters.distortion, 0.0, 0.0, 0.0, 0.0) if parameters.distortion else (),
        )
        lens = native.resized(parameters.width, parameters.height)
        cameras.append(Camera(name, lens, parameters.rolling_shutter_s, parameters.exposure_s))
    return tuple(cameras)


def ego_SE3_camera(name: str) -> Float64:
    """Poses a camera on the vehicle.

    Args:
        name: one of ``CAMERA_NAMES``.

    Returns:
        [4, 4]; camera axes x right, y down, z forward.

    >>> ego_SE3_camera("front_camera")[:3, 3]
    array([0.82, 0.  , 1.81])
    """
    mount = _MOUNTS[name]
    azimuth = np.deg2rad(mount.azimuth_deg)
    out = np.eye(4)
    out[:3, 0] = (np.sin(azimuth), -np.cos(azimuth), 0.0)
    out[:3, 1] = (0.0, 0.0, -1.0)
    out[:3, 2] = (np.cos(azimuth), np.sin(azimuth), 0.0)
    out[:3, 3] = mount.position_m
    return out


@dataclass(frozen=True)
class EgoDrive:
    """How the ego vehicle drives: its speed changes gently, and it weaves a little in its lane.

    Attributes:
        road: the street that it follows.
        speed: mean speed, m/s; 0 stands.
        phases: of the changes of speed and of the weaving, radians.
    """

    road: Road
    speed: float
    phases: tuple[float, float]

    def distance(self, times: ArrayLike) -> Float64:
        """Finds how far the vehicle has come.

        Args:
            times: [...] seconds since the first frame.

        Returns:
            [...] s in metres, 0 at time 0; it grows as long as the speed is positive.
        """
        t = np.asarray(times, float)
        # The amplitude keeps the speed within 12 % of its mean, so that it stays positive.
        return self.speed * (t + 0.3 * (np.sin(0.4 * t + self.phases[0]) - np.sin(self.phases[0])))

    def pose(self, times: ArrayLike) -> Float64:
        """Poses the vehicle.

        Args:
            times: [n] seconds since the first frame.

        Returns:
            [n, 4, 4] street_SE3_ego.
        """
        s = self.distance(np.asarray(times, float))
        weave = s / _WEAVE_LENGTH_M + self.phases[1]
        # The vehicle points where it drives: along the street, turned by the slope of its weaving.
        yaw = np.arctan(_WEAVE_M / _WEAVE_LENGTH_M * np.cos(weave))
        return self.road.pose(s, _WEAVE_M * np.sin(weave), 0.0, yaw)


def draw_drive(parameters: StreetParameters, road: Road) -> EgoDrive:
    """Draws how the ego vehicle drives.

    Args:
        parameters: seed, and whether the vehicle stands.
        road: the street.

    Returns:
        A drive of 4 to 10 m/s on average.
    """
    rng = make_generator(parameters.seed, "ego")
    # Drawn also for a vehicle that stands: standstill=1 must change nothing else of the street.
    speed = float(rng.uniform(4.0, 10.0))
    phases = (float(rng.uniform(0, 6.28)), float(rng.uniform(0, 6.28)))
    return EgoDrive(road, 0.0 if parameters.standstill else speed, phases)
