"""A path of the ego vehicle through a log: where it is, and what moment of the log the traffic is at."""

from __future__ import annotations

from dataclasses import dataclass

from genre_tasks.logs.types import Float64


@dataclass(frozen=True)
class EgoPath:
    """P poses of the ego vehicle.

    Attributes:
        times_s: [P] float64 seconds since the first pose, rising.
        frames: [P] float64 log frames, or moments between them: where the traffic is then.
        world_SE3_ego: [P, 4, 4] float64, x forward, y left, z up, in the log's world; the origin is that of
            ``DrivingLog.world_SE3_lidar``.
    """

    times_s: Float64
    frames: Float64
    world_SE3_ego: Float64

    def __len__(self) -> int:
        return len(self.times_s)
