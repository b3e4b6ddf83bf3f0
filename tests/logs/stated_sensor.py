"""Checks that a log's sweeps say where its main LiDAR is, and that simulated rays start there."""

from __future__ import annotations

import numpy as np

from genre_tasks.lidar_simulation.rollout_lidar import LidarSimulator
from genre_tasks.logs.types import DrivingLog, Float64


def check_stated_sensor(log: DrivingLog, truth: DrivingLog, vehicle_SE3_lidar: Float64) -> None:
    """Compares the stated places with those of the log that a dataset was written from.

    Args:
        log: read from the dataset; all points of a sweep have one time, so that nothing else tells the place.
        truth: that the dataset was written from.
        vehicle_SE3_lidar: [4, 4] where the LiDAR was mounted.
    """
    for frame in range(truth.frame_count):
        sweep = log.sweep(frame)
        assert sweep is not None and sweep.sensor_world is not None
        expected = (truth.world_SE3_lidar(frame) @ vehicle_SE3_lidar)[:3, 3]
        np.testing.assert_allclose(sweep.sensor_world, expected, atol=1e-9)
    np.testing.assert_allclose(LidarSimulator(log).sensor.position_m, vehicle_SE3_lidar[:3, 3], atol=1e-9)
