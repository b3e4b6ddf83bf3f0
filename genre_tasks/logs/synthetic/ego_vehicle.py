"""How the ego vehicle moves, and its rig: the places and lenses of PandaSet's cameras.

The ego frame (``world_SE3_lidar`` of the log) has its origin on the ground below the roof, as PandaSet's poses do: x
forward, y left, z up. The LiDAR itself sits ``LIDAR_HEIGHT_M`` above it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from genre_tasks.logs.synthetic.parameters import CAMERA_NAMES, StreetParameters
from genre_tasks.logs.synthetic.road import Road, generator
from genre_tasks.logs.types import Camera, Float64, Lens

FRAME_S = 0.1
LIDAR_HEIGHT_M = 1.95

# Position in the ego frame (x forward, y left, z up) and viewing azimuth (degrees, left is positive), from the poses of
# PandaSet's sequence 002; focal length and principal point in pixels of 1920 × 1080.
_MOUNTS: dict[str, tuple[tuple[float, float, float], float, tuple[float, float, float]]] = {
    "front_camera": ((0.82, 0.00, 1.81), 0.0, (1970.0, 970.0, 532.0)),
    "front_left_camera": ((1.47, 0.65, 1.53), 57.8, (930.0, 972.2, 538.0)),
    "front_right_camera": ((1.46, -0.60, 1.60), -57.8, (930.0, 965.1, 533.4)),
    "left_camera": ((0.50, 0.54, 1.58), 91.5, (930.0, 961.7, 541.6)),
    "right_camera": ((0.58, -0.70, 1.55), -88.6, (922.5, 945.1, 537.6)),
    "back_camera": ((-0.32, -0.03, 1.66), 178.2, (933.5, 946.5, 537.4)),
}


def rig(parameters: StreetParameters) -> tuple[Camera, ...]:
    """The first N cameras, at the size asked for, with the shutter and the lens of the parameters."""
    cameras = []
    for name in CAMERA_NAMES[: parameters.cameras]:
        focal, cx, cy = _MOUNTS[name][2]
        bent = (parameters.distortion, 0.0, 0.0, 0.0, 0.0) if parameters.distortion else ()
        lens = Lens(focal, focal, cx, cy, 1920, 1080, bent).resized(parameters.width, parameters.height)
        cameras.append(Camera(name, lens, parameters.rolling_shutter_s, parameters.exposure_s))
    return tuple(cameras)


def ego_SE3_camera(name: str) -> Float64:
    """[4, 4]; camera axes x right, y down, z forward."""
    position, azimuth, _ = _MOUNTS[name]
    a = np.deg2rad(azimuth)
    out = np.eye(4)
    out[:3, 0] = (np.sin(a), -np.cos(a), 0.0)
    out[:3, 1] = (0.0, 0.0, -1.0)
    out[:3, 2] = (np.cos(a), np.sin(a), 0.0)
    out[:3, 3] = position
    return out


@dataclass(frozen=True)
class Ego:
    """The drive: mean ``speed`` (m/s; 0 stands), a gentle change of speed and of place in the lane."""

    road: Road
    speed: float
    phases: tuple[float, float]

    def travel(self, times: ArrayLike) -> Float64:
        """s in metres, 0 at time 0; grows as long as the speed is positive."""
        t = np.asarray(times, float)
        return self.speed * (t + 0.3 * (np.sin(0.4 * t + self.phases[0]) - np.sin(self.phases[0])))

    def pose(self, times: ArrayLike) -> Float64:
        """[n, 4, 4] in the street's coordinates."""
        t = np.asarray(times, float)
        s = self.travel(t)
        wave = s / 14 + self.phases[1]
        return self.road.pose(s, 0.22 * np.sin(wave), 0.0, np.arctan(0.22 / 14 * np.cos(wave)))


def draw_ego(parameters: StreetParameters, road: Road) -> Ego:
    """Speed from the seed, 4–10 m/s."""
    rng = generator(parameters.seed, "ego")
    speed, a, b = rng.uniform(4.0, 10.0), rng.uniform(0, 6.28), rng.uniform(0, 6.28)
    return Ego(road, 0.0 if parameters.standstill else float(speed), (float(a), float(b)))
