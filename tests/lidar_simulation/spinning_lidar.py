"""A LiDAR that turns on a driving vehicle, in a street of ground and walls whose ranges are known exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from genre_tasks.lidar_simulation.ego_motion import interpolate_poses
from genre_tasks.logs.types import Float64, Sweep
from genre_tasks.scene.chunk import Chunk, Points

POSITION_M = np.array([0.7, 0.1, 1.8])
FRAME_S = 0.1
SPEED_M_S = 10.0
WALL_Y_M = 8.0
WALL_X_M = 35.0
WALL_HEIGHT_M = 5.0
RINGS = np.radians(np.linspace(-20, 12, 24))
AZIMUTHS = 300


def ego_path(frames: int = 5) -> tuple[Float64, Float64]:
    """Times [F] and poses [F, 4, 4] of a vehicle that drives along x."""
    times = FRAME_S * np.arange(frames)
    poses = np.repeat(np.eye(4)[None], frames, axis=0)
    poses[:, 0, 3] = SPEED_M_S * (times - times.mean())
    return times, poses


def beams() -> tuple[Float64, Float64, Float64]:
    """Directions [N, 3] in ego axes, times since the frame [N] and rings [N]; the sensor turns clockwise."""
    turn = np.arange(AZIMUTHS) / AZIMUTHS
    azimuth = np.repeat(np.pi - 2 * np.pi * turn, len(RINGS))
    times = np.repeat(FRAME_S * (turn - 1), len(RINGS))
    level = np.tile(RINGS, AZIMUTHS)
    directions = np.stack([np.cos(level) * np.cos(azimuth), np.cos(level) * np.sin(azimuth), np.sin(level)], 1)
    return directions, times, np.tile(np.arange(len(RINGS)), AZIMUTHS)


def cast_street(origins: Float64, directions: Float64) -> Float64:
    """True ranges [N]; NaN into the sky."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = -origins[:, 2] / directions[:, 2]
        sides = (np.sign(directions[:, 1]) * WALL_Y_M - origins[:, 1]) / directions[:, 1]
        ends = (np.sign(directions[:, 0]) * WALL_X_M - origins[:, 0]) / directions[:, 0]
    walls = np.fmin(sides, ends)
    walls[origins[:, 2] + walls * directions[:, 2] > WALL_HEIGHT_M] = np.inf
    found = np.fmin(np.where(ground > 0, ground, np.inf), walls)
    return np.where(np.isfinite(found), found, np.nan)


def scan(frame: int, frames: int = 5) -> Sweep:
    """One sweep in world coordinates, returns alone."""
    times, poses = ego_path(frames)
    directions, offsets, _ = beams()
    pose = interpolate_poses(poses, times, times[frame] + offsets)
    origins = pose[:, :3, 3] + pose[:, :3, :3] @ POSITION_M
    range_m = cast_street(origins, directions)
    hit = np.isfinite(range_m)
    points = origins + directions * range_m[:, None]
    return Sweep(points[hit], np.full(hit.sum(), 0.5, np.float32), (times[frame] + offsets)[hit])


@dataclass(frozen=True)
class FlashLog:
    """A log that gives all points of a sweep the time of its frame."""

    states_sensor: bool
    uri: str = "test:flash"
    frame_count: int = 5

    def sweep(self, frame: int) -> Sweep:
        """The sweep of a frame."""
        found = scan(frame)
        place = ego_path()[1][frame, :3, 3] + POSITION_M
        return Sweep(
            points_world=found.points_world,
            intensity=found.intensity,
            timestamps_s=np.full(len(found.points_world), self.frame_timestamp_s(frame)),
            sensor_world=place if self.states_sensor else None,
        )

    def frame_timestamp_s(self, frame: int) -> float:
        """Seconds of a frame."""
        return float(ego_path()[0][frame])

    def world_SE3_lidar(self, frame: int) -> Float64:
        """Pose of a frame."""
        return ego_path()[1][frame]


def build_chunk(frames: tuple[int, ...]) -> Chunk:
    """A chunk without images, of the sweeps of some frames."""
    sweeps = [(frame, scan(frame).points_world.astype(np.float32)) for frame in frames]
    positions = np.concatenate([points for _, points in sweeps])
    count = len(positions)
    numbers = np.concatenate([np.full(len(points), frame, np.int16) for frame, points in sweeps])
    points = Points(positions, np.full((count, 3), 128, np.uint8), np.ones(count, bool), numbers)
    return Chunk(
        dataset="test",
        log="street",
        index=0,
        frames=tuple(range(5)),
        camera_names=(),
        width_px=64,
        height_px=36,
        world_SE3_chunk=np.eye(4),
        chunk_SE3_ego=ego_path()[1],
        views=(),
        static=points,
        actors=(),
        log_issues=(),
    )
