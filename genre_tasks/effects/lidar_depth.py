"""The LiDAR depth term of the loss: it can only pull where there are returns."""

from __future__ import annotations

import numpy as np

from genre_tasks.effects.seen import Seen
from genre_tasks.effects.types import Effect, Measured


def measure(seen: Seen) -> Measured:
    """The share of the source images' pixels with a return of their own frame's sweep."""
    shares = []
    for view, returns in zip(seen.sources, seen.returns, strict=True):
        pixel = returns.uv.astype(np.int64)
        hit = np.unique(pixel[:, 1] * view.lens.width_px + pixel[:, 0])
        shares.append(len(hit) / (view.lens.width_px * view.lens.height_px))
    return Measured(100 * float(np.mean(shares)), "returns of an image's own frame")


EFFECT = Effect("lidar_depth", "pixels with a LiDAR return", "%", 0.1, "a depth term in the loss", measure)
