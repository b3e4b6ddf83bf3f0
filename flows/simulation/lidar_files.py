"""LiDAR sweeps of a rollout as Parquet, one file a pose: ``lidar/000012.parquet``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa

from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.lidar_simulation.rollout_lidar import LidarSimulator
from genre_tasks.lidar_simulation.simulate_sweep import SimulatedSweep
from genre_tasks.logs.types import DrivingLog, Float64
from genre_tasks.rollout.render_rollout import RolloutImages
from storage.codecs.tables import column, schema, write_table

LIDAR_FOLDER = "lidar"

_ASSUMED_PLACE = (
    "the log does not say where its LiDAR is, and its sweeps do not show a spin: rays start at the ego vehicle's origin"
)

SWEEP = schema(
    "lidar_sweep/1",
    [
        column("x", pa.float64(), "metres, in the log's world"),
        column("y", pa.float64(), "metres, in the log's world"),
        column("z", pa.float64(), "metres, in the log's world"),
        column("intensity", pa.float32(), "0 to 1: luminance of the surface's colour in linear light, not a laser's"),
        column("time_s", pa.float64(), "seconds since the pose's time, when the beam was sent"),
        column("frame", pa.float64(), "log frame of the traffic, or a moment between two"),
        column("ring", pa.int32(), "beam of the sensor from the lowest up; -1 where it is not known"),
    ],
)


class LidarSweeps:
    """Writes the sweep of each pose; a ``RolloutOutput``.

    Args:
        folder: of the rollout.
        log: whose sensor is simulated.
        path: of the rollout.

    Raises:
        InputError: at the first pose, where the log has no sweep.
    """

    def __init__(self, folder: Path, log: DrivingLog, path: EgoPath) -> None:
        self._folder = folder / LIDAR_FOLDER
        self._folder.mkdir(exist_ok=True)
        self._simulator = LidarSimulator(log)
        self._path = path

    def write(self, images: RolloutImages) -> None:
        """Simulates and writes the sweep of a pose."""
        sweep = self._simulator.simulate(self._path, images.index, images.chunk_scene)
        path = self._folder / f"{images.index:06d}.parquet"
        write_sweep(path, sweep, images.chunk_scene.chunk.world_SE3_chunk)

    def close(self) -> None:
        """Nothing is left to do: every file is complete."""

    def abort(self) -> None:
        """Nothing is under way between two poses."""

    def list_warnings(self) -> tuple[str, ...]:
        """Says so where rays start at an assumed place."""
        return (_ASSUMED_PLACE,) if self._simulator.sensor.is_assumed else ()


def write_sweep(path: Path, sweep: SimulatedSweep, world_SE3_chunk: Float64) -> None:
    """Writes the returns of a sweep; rays without one are left out.

    Args:
        path: the new file.
        sweep: in coordinates of a chunk.
        world_SE3_chunk: [4, 4] of that chunk.
    """
    returned = np.isfinite(sweep.range_m)
    points = sweep.points[returned] @ world_SE3_chunk[:3, :3].T + world_SE3_chunk[:3, 3]
    columns = {
        "x": points[:, 0],
        "y": points[:, 1],
        "z": points[:, 2],
        "intensity": sweep.intensity[returned].astype(np.float32),
        "time_s": sweep.times_s[returned],
        "frame": np.full(len(points), sweep.frame, np.float64),
        "ring": sweep.ring[returned].astype(np.int32),
    }
    write_table(path, SWEEP, {name: np.ascontiguousarray(values) for name, values in columns.items()})
