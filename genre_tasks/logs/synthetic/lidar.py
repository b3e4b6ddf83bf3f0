"""The spinning LiDAR on the roof: 64 beams from −25° to +5°, denser about the horizon, as a Pandar64's."""

from __future__ import annotations

import numpy as np

from genre_tasks.logs.synthetic.ego_vehicle import FRAME_S, LIDAR_HEIGHT_M, EgoDrive
from genre_tasks.logs.synthetic.materials import REFLECTIVITY
from genre_tasks.logs.synthetic.parameters import StreetParameters
from genre_tasks.logs.synthetic.raycast import RayCaster
from genre_tasks.logs.synthetic.road import make_generator
from genre_tasks.logs.types import Float64, Sweep

# Nearer returns would come from the vehicle itself.
_RANGE_M = (1.0, 100.0)
# More than any actor drives.
_MAX_ACTOR_SPEED_M_S = 16.0


def beam_elevations(beams: int) -> Float64:
    """Spreads the beams of the LiDAR; two thirds of them lie between −8° and +5°.

    Args:
        beams: how many.

    Returns:
        [beams] radians above the horizon, lowest first.

    >>> np.rad2deg(beam_elevations(4)).round(3)
    array([-25. ,  -8. ,  -1.5,   5. ])
    """
    return np.deg2rad(np.interp(np.linspace(0, 1, beams), [0, 1 / 3, 1], [-25.0, -8.0, 5.0]))


def scan_sweep(
    caster: RayCaster,
    ego: EgoDrive,
    parameters: StreetParameters,
    frame: int,
    *,
    offset_m: Float64,  # [3]
    start_s: float,
) -> Sweep:
    """Measures one turn from the moving roof; the forward direction is scanned at the frame's own time.

    Args:
        caster: the street.
        ego: how the vehicle drives.
        parameters: beams, directions, time of a turn, noise and seed.
        frame: log frame.
        offset_m: [3] added, in float64, to the street's coordinates to get the world's.
        start_s: time of frame 0.

    Returns:
        The points that come back from 1 to 100 m, each with the time at which its beam was sent.
    """
    count = parameters.lidar_azimuths
    # From behind through the left, the front and the right, as seen from above: clockwise turns have falling azimuth.
    azimuth = np.pi - 2 * np.pi * (np.arange(count) + 0.5) / count
    # 0 straight ahead, so that the forward points fit the cameras, which fire at the frame's time.
    delay = -azimuth / (2 * np.pi) * parameters.sweep_s
    times = frame * FRAME_S + delay
    elevation = beam_elevations(parameters.lidar_beams)
    beams = len(elevation)
    x = np.cos(azimuth)[:, None] * np.cos(elevation)
    y = np.sin(azimuth)[:, None] * np.cos(elevation)
    z = np.broadcast_to(np.sin(elevation), (count, beams))
    pose = ego.pose(times)
    direction = np.einsum("aij,abj->abi", pose[:, :3, :3], np.stack([x, y, z], -1)).reshape(-1, 3)
    origin = (pose[:, :3, 3] + pose[:, :3, 2] * LIDAR_HEIGHT_M).repeat(beams, 0)
    sent = times.repeat(beams)
    # Half a turn lies on either side of the frame's time.
    hits = caster.cast(origin, direction, sent, slack_m=_MAX_ACTOR_SPEED_M_S * parameters.sweep_s / 2)
    # A stream a frame: reading sweeps in another order gives the same sweeps.
    noise = make_generator(parameters.seed, f"range noise {frame}").normal(size=len(sent)) * parameters.noise_m
    nearest, farthest = _RANGE_M
    keep = (hits.face >= 0) & (hits.distance_m > nearest) & (hits.distance_m < farthest)
    measured_m = (hits.distance_m + noise)[keep]
    # The offset comes last and in float64: it may be millions of metres.
    points = origin[keep] + direction[keep] * measured_m[:, None] + offset_m
    slant = np.abs((hits.normal[keep] * direction[keep]).sum(1))
    # Rough surfaces throw back less at a slant, but never nothing.
    intensity = REFLECTIVITY[caster.faces.material[hits.face[keep]]] * (0.3 + 0.7 * slant)
    return Sweep(
        points_world=points,
        intensity=np.clip(intensity, 0, 1).astype(np.float32),
        timestamps_s=sent[keep] + start_s,
    )
