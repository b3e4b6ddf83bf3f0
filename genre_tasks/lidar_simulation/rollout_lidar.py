"""The LiDAR of a rollout: the log's own sensor, on another path, among edited traffic."""

from __future__ import annotations

from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.errors import InputError
from genre_tasks.lidar_simulation.lidar_surfaces import build_lidar_surfaces
from genre_tasks.lidar_simulation.sensor import LidarSensor, estimate_sensor, to_ego_axes
from genre_tasks.lidar_simulation.simulate_sweep import LidarModel, SimulatedSweep, simulate_sweep
from genre_tasks.lidar_simulation.sweep_pattern import SweepPattern, build_pattern
from genre_tasks.logs.types import DrivingLog, Float64, Sweep
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene_edits.chunk_scene import ChunkScene


class LidarSimulator:
    """Simulates the sweeps of a log's LiDAR.

    Args:
        log: whose sweeps say where the sensor is and which rays it sends.
        model: what comes back; ``None``: the default one.

    Example::

        simulator = LidarSimulator(open_log("pandaset:PATH/002"))
        for images in render_rollout(source, path, rig):
            sweep = simulator.simulate(path, images.index, images.chunk_scene)
    """

    def __init__(self, log: DrivingLog, model: LidarModel | None = None) -> None:
        self._log = log
        self._model = model or LidarModel()
        self._surfaces: tuple[ChunkScene, SceneGraph] | None = None
        # Two, since consecutive poses mostly ask for the same sweep or the next one.
        self._read_pattern = lru_cache(maxsize=2)(self._build_pattern)

    @cached_property
    def sensor(self) -> LidarSensor:
        """Where the sensor sits, by the first sweep.

        Raises:
            InputError: the log has no sweep.
        """
        frame = int(self._sweep_frames[0])
        sweep = self._require_sweep(frame)
        frame_s = float(np.median(np.diff(self._times_s))) if len(self._times_s) > 1 else float(
            np.ptp(sweep.timestamps_s)
        )
        return estimate_sensor(to_ego_axes(sweep, self._times_s, self._poses), sweep.timestamps_s, frame_s)

    def pattern_at(self, frame: float) -> SweepPattern:
        """Gives the rays of the recorded sweep that is nearest to a moment.

        Args:
            frame: of the log, or a moment between two.

        Returns:
            Its rays; the last two patterns stay in memory.

        Raises:
            InputError: the log has no sweep, or that one cannot be read.
        """
        frames = self._sweep_frames
        return self._read_pattern(int(frames[np.abs(frames - frame).argmin()]))

    def simulate(self, path: EgoPath, index: int, chunk_scene: ChunkScene) -> SimulatedSweep:
        """Simulates the sweep at a pose of a path; the vehicle moves along the path while the sensor turns.

        Args:
            path: in the log's world.
            index: of the pose.
            chunk_scene: what the sensor meets, actors as edited.

        Returns:
            The sweep, in coordinates of the chunk.

        Raises:
            InputError: the log has no sweep.
        """
        if self._surfaces is None or self._surfaces[0] is not chunk_scene:
            self._surfaces = (chunk_scene, build_lidar_surfaces(chunk_scene))
        frame = float(path.frames[index])
        return simulate_sweep(
            self._surfaces[1],
            self.pattern_at(frame),
            frame,
            np.linalg.inv(chunk_scene.chunk.world_SE3_chunk) @ path.world_SE3_ego,
            path.times_s - path.times_s[index],
            self._model,
        )

    def _build_pattern(self, frame: int) -> SweepPattern:
        sweep = self._require_sweep(frame)
        points = to_ego_axes(sweep, self._times_s, self._poses)
        return build_pattern(points, sweep.timestamps_s - self._times_s[frame], sweep.intensity, self.sensor)

    def _require_sweep(self, frame: int) -> Sweep:
        sweep = self._log.sweep(frame)
        if sweep is None:
            raise InputError("there is no LiDAR sweep", remedy="Simulate without lidar.", log=self._log.uri, frame=frame)
        return sweep

    @cached_property
    def _sweep_frames(self) -> NDArray[np.int64]:
        frames = [frame for frame in range(self._log.frame_count) if self._log.sweep(frame) is not None]
        if not frames:
            problem = "the log has no LiDAR sweep, whose rays a simulated one could have"
            raise InputError(problem, remedy="Simulate without lidar.", log=self._log.uri)
        return np.array(frames, np.int64)

    @cached_property
    def _times_s(self) -> Float64:
        return np.array([self._log.frame_timestamp_s(frame) for frame in range(self._log.frame_count)])

    @cached_property
    def _poses(self) -> Float64:
        return np.stack([self._log.world_SE3_lidar(frame) for frame in range(self._log.frame_count)])
