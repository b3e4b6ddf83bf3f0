"""The spinning LiDAR on the roof: 64 beams from −25° to +5°, denser about the horizon, as a Pandar64's."""

from __future__ import annotations

import numpy as np

from genre_tasks.logs.synthetic.ego_vehicle import FRAME_S, LIDAR_HEIGHT_M, Ego
from genre_tasks.logs.synthetic.materials import REFLECTIVITY
from genre_tasks.logs.synthetic.parameters import StreetParameters
from genre_tasks.logs.synthetic.raycast import Scene
from genre_tasks.logs.synthetic.road import generator
from genre_tasks.logs.types import Float64, Sweep

RANGE_M = 100.0
_NEAR_M = 1.0


def elevations(beams: int) -> Float64:
    """[beams] radians, lowest first; two thirds of them between −8° and +5°."""
    return np.deg2rad(np.interp(np.linspace(0, 1, beams), [0, 1 / 3, 1], [-25.0, -8.0, 5.0]))


def sweep(scene: Scene, ego: Ego, parameters: StreetParameters, frame: int, offset_m: Float64, start_s: float) -> Sweep:
    """One turn, seen from the moving roof; the forward direction is scanned at the frame's own time.

    Points that come back from 1 to 100 m, in world coordinates (``offset_m`` [3] added in float64); each with the time
    at which its beam was sent (``start_s`` is the time of frame 0).
    """
    count = parameters.lidar_azimuths
    # From behind through the right, the front and the left, as seen from above: clockwise turns have falling azimuth.
    azimuth = np.pi - 2 * np.pi * (np.arange(count) + 0.5) / count
    delay = -azimuth / (2 * np.pi) * parameters.sweep_s
    times = frame * FRAME_S + delay
    up = elevations(parameters.lidar_beams)
    local = np.stack(
        [
            np.cos(azimuth)[:, None] * np.cos(up),
            np.sin(azimuth)[:, None] * np.cos(up),
            np.broadcast_to(np.sin(up), (count, len(up))),
        ],
        -1,
    )
    pose = ego.pose(times)
    direction = np.einsum("aij,abj->abi", pose[:, :3, :3], local).reshape(-1, 3)
    origin = (pose[:, :3, 3] + pose[:, :3, 2] * LIDAR_HEIGHT_M).repeat(len(up), 0)
    sent = times.repeat(len(up))
    # 16 m/s is more than any actor drives; half a turn lies on either side of the frame's time.
    hits = scene.cast(origin, direction, sent, slack_m=16.0 * parameters.sweep_s / 2)
    noise = generator(parameters.seed, f"range noise {frame}").normal(size=len(sent)) * parameters.noise_m
    keep = (hits.face >= 0) & (hits.distance_m > _NEAR_M) & (hits.distance_m < RANGE_M)
    reach = (hits.distance_m + noise)[keep]
    points = origin[keep] + direction[keep] * reach[:, None] + offset_m
    slant = np.abs((hits.normal[keep] * direction[keep]).sum(1))
    intensity = REFLECTIVITY[scene.faces.material[hits.face[keep]]] * (0.3 + 0.7 * slant)
    return Sweep(points, np.clip(intensity, 0, 1).astype(np.float32), sent[keep] + start_s)
