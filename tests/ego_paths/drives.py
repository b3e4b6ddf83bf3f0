"""Recorded paths of known shape and speed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.logs.types import Float64

FRAME_S = 0.1
_STEP_S = 0.005

Profile = Callable[[Float64], Float64]


def drive(
    frames: int,
    speed: Profile,
    curvature: Profile = np.zeros_like,
    *,
    frame_s: float = FRAME_S,
    heading: float = 0.0,
    jitter_m: float = 0.0,
    jitter_rad: float = 0.0,
    seed: int = 0,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> EgoPath:
    """Drives at a speed over time along a curvature over arc length; the vehicle points where it drives."""
    times = np.arange(0.0, (frames - 1) * frame_s + 0.5 * _STEP_S, _STEP_S)
    middle = times[:-1] + 0.5 * _STEP_S
    steps = speed(middle) * _STEP_S
    arc = np.concatenate([[0.0], np.cumsum(steps)])
    turns = curvature(0.5 * (arc[1:] + arc[:-1])) * steps
    yaw = heading + np.concatenate([[0.0], np.cumsum(turns)])
    ahead = yaw[:-1] + 0.5 * turns
    x = np.concatenate([[0.0], np.cumsum(np.cos(ahead) * steps)])
    y = np.concatenate([[0.0], np.cumsum(np.sin(ahead) * steps)])
    at = np.arange(frames) * frame_s
    rng = np.random.default_rng(seed)
    jittered = np.interp(at, times, yaw) + jitter_rad * rng.standard_normal(frames)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(jittered)
    poses[:, 1, 0] = np.sin(jittered)
    poses[:, 0, 1] = -np.sin(jittered)
    poses[:, :3, 3] = origin
    poses[:, 0, 3] += np.interp(at, times, x)
    poses[:, 1, 3] += np.interp(at, times, y)
    poses[:, :2, 3] += jitter_m * rng.standard_normal((frames, 2))
    return EgoPath(at, np.arange(frames, dtype=np.float64), poses)


def straight(frames: int = 40, speed_m_s: float = 8.0, **options: float) -> EgoPath:
    return drive(frames, lambda t: np.full_like(t, speed_m_s), **options)  # type: ignore[arg-type]


def yaw_of(path: EgoPath) -> Float64:
    return np.unwrap(np.arctan2(path.world_SE3_ego[:, 1, 0], path.world_SE3_ego[:, 0, 0]))


def position_of(path: EgoPath) -> Float64:
    return path.world_SE3_ego[:, :2, 3]
