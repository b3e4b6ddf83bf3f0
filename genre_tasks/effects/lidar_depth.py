"""LiDAR depth: the depth term of the loss, which has an effect only where an image has LiDAR returns."""

from __future__ import annotations

import numpy as np

from genre_tasks.effects.measurements import ChunkMeasurements
from genre_tasks.effects.types import Effect, Measurement
from genre_tasks.scene.lidar_depth import compute_lidar_depth


def measure(measurements: ChunkMeasurements) -> Measurement:
    """Measures how many pixels of the source images have a depth in the loss.

    Args:
        measurements: the chunk's LiDAR sweeps and source views.

    Returns:
        Percentage of the pixels, mean over the source images.
    """
    chunk = measurements.chunk
    fractions = [float((compute_lidar_depth(chunk, view) > 0).float().mean()) for view in measurements.source_views]
    return Measurement(100 * float(np.mean(fractions)), "returns that the image sees, of its own frame")


EFFECT = Effect(
    name="lidar_depth",
    property="pixels with a LiDAR return",
    unit="%",
    # Half a return in an image of 320×180: the term lowers the error of depth wherever it has returns at all.
    threshold=0.001,
    cost="a depth term in the loss",
    measure=measure,
)
