"""The LiDAR of a rollout: the log's own sensor, on another path, among edited traffic."""

from __future__ import annotations

from contextlib import suppress
from functools import cached_property, lru_cache

import numpy as np

from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.errors import InputError
from genre_tasks.lidar_simulation.lidar_surfaces import LidarSurfaces
from genre_tasks.lidar_simulation.sensor import LidarSensor, estimate_sensor, to_ego_axes
from genre_tasks.lidar_simulation.simulate_sweep import LidarModel, SimulatedSweep, simulate_sweep
from genre_tasks.lidar_simulation.sweep_pattern import SweepPattern, build_pattern
from genre_tasks.logs.types import DrivingLog, Float64, Sweep
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene_edits.chunk_scene import ChunkScene

_PATTERNS_IN_MEMORY = 8
"""Consecutive poses ask for the same sweep or the next one, and for those that are missing in between."""


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
        self._surfaces = LidarSurfaces()
        self._latest: tuple[ChunkScene, SceneGraph] | None = None
        self._read_pattern = lru_cache(maxsize=_PATTERNS_IN_MEMORY)(self._build_pattern)

    @cached_property
    def sensor(self) -> LidarSensor:
        """Where the sensor sits, by the first sweep that can be read.

        Raises:
            InputError: the log has no sweep.
        """
        # One by one, as reading a sweep may take long.
        sweeps = (self._read_sweep(frame) for frame in self._frames)
        row, sweep = next(((row, sweep) for row, sweep in enumerate(sweeps) if sweep is not None), (0, None))
        if sweep is None:
            raise self._describe_no_sweep()
        stated_m = None
        if sweep.sensor_world is not None:
            stated_m = self._poses[row, :3, :3].T @ (sweep.sensor_world - self._poses[row, :3, 3])
        # A log of one frame has no steps; its sweep lasts about as long.
        steps = np.diff(self._times_s) if len(self._times_s) > 1 else np.ptp(sweep.timestamps_s)
        frame_s = float(np.median(steps))
        points = to_ego_axes(sweep, self._times_s, self._poses)
        return estimate_sensor(points, sweep.timestamps_s, frame_s, stated_m)

    def pattern_at(self, frame: float) -> SweepPattern:
        """Gives the rays of the recorded sweep that is nearest to a moment.

        Args:
            frame: of the log, or a moment between two.

        Returns:
            Its rays.

        Raises:
            InputError: the log has no sweep.
        """
        # The nearest first: sequences may lack sweeps.
        for candidate in sorted(self._frames, key=lambda known: abs(known - frame)):
            pattern = self._read_pattern(candidate)
            if pattern is not None:
                return pattern
        raise self._describe_no_sweep()

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
        if self._latest is None or self._latest[0] is not chunk_scene:
            self._latest = (chunk_scene, self._surfaces.build(chunk_scene))
        frame = float(path.frames[index])
        return simulate_sweep(
            self._latest[1],
            self.pattern_at(frame),
            frame,
            np.linalg.inv(chunk_scene.chunk.world_SE3_chunk) @ path.world_SE3_ego,
            path.times_s - path.times_s[index],
            self._model,
        )

    def _build_pattern(self, frame: int) -> SweepPattern | None:
        sweep = self._read_sweep(frame)
        if sweep is None:
            return None
        points = to_ego_axes(sweep, self._times_s, self._poses)
        offsets = sweep.timestamps_s - self._times_s[self._frames.index(frame)]
        return build_pattern(points, offsets, sweep.intensity.astype(np.float64), self.sensor)

    def _read_sweep(self, frame: int) -> Sweep | None:
        # One that cannot be read is as good as none: reconstruction went on without it, too.
        with suppress(InputError):
            return self._log.sweep(frame)
        return None

    def _describe_no_sweep(self) -> InputError:
        problem = "the log has no LiDAR sweep, whose rays a simulated one could have"
        return InputError(problem, remedy="Simulate without lidar.", log=self._log.uri)

    @cached_property
    def _path(self) -> list[tuple[int, float, Float64]]:
        """Frame, seconds and pose, of frames that have both."""
        path = []
        for frame in range(self._log.frame_count):
            with suppress(InputError):
                path.append((frame, self._log.frame_timestamp_s(frame), self._log.world_SE3_lidar(frame)))
        return path

    @cached_property
    def _frames(self) -> list[int]:
        return [frame for frame, _, _ in self._path]

    @cached_property
    def _times_s(self) -> Float64:
        return np.array([time_s for _, time_s, _ in self._path])

    @cached_property
    def _poses(self) -> Float64:
        return np.stack([pose for _, _, pose in self._path])
