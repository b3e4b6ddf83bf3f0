"""The LiDAR depth term of the loss: it can only pull where there are returns."""

from __future__ import annotations

import numpy as np

from genre_tasks.effects.measurements import Seen
from genre_tasks.effects.types import Effect, Measured
from genre_tasks.scene.lidar_depth import lidar_depth


def measure(seen: Seen) -> Measured:
    """The share of the source images' pixels that have a depth in the loss."""
    shares = [float((lidar_depth(seen.chunk, view) > 0).float().mean()) for view in seen.sources]
    return Measured(100 * float(np.mean(shares)), "returns that the image sees, of its own frame")


EFFECT = Effect("lidar_depth", "pixels with a LiDAR return", "%", 0.1, "a depth term in the loss", measure)
