"""Anti-aliasing: a novel view sees a surface from much nearer or farther than any image did."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from genre_tasks.effects.seen import Seen
from genre_tasks.effects.types import Effect, Measured
from genre_tasks.scene.coloring import visible
from genre_tasks.scene.geometry import shift_laterally

SHIFT_M = 3.0
QUANTILE = 0.95
_EVERY = 25


def measure(seen: Seen) -> Measured:
    """The ratio of a point's size in a view at ±3 m and in the image that shows it nearest to that size.

    The 95th percentile over LiDAR points.
    """
    points = seen.chunk.static.positions[seen.chunk.static.frames >= 0][::_EVERY]
    sizes = np.full((len(seen.sources), len(points)), np.nan)
    for k, view in enumerate(seen.sources):
        index, _, depth = visible(points, view)
        sizes[k, index] = np.log(view.lens.fx_px / depth)
    ratios = []
    for view in seen.sources:
        ego = seen.chunk.chunk_SE3_ego[seen.chunk.frames.index(view.frame)]
        for shift in (-SHIFT_M, SHIFT_M):
            moved = replace(view, chunk_SE3_camera=shift_laterally(view.chunk_SE3_camera, ego, shift))
            index, _, depth = visible(points, moved)
            known = np.isfinite(sizes[:, index]).any(0)
            apart = np.abs(sizes[:, index[known]] - np.log(view.lens.fx_px / depth[known]))
            ratios.append(np.exp(np.nanmin(apart, 0)))
    every = np.concatenate(ratios) if ratios else np.zeros(0)
    if not len(every):
        return Measured(None, "no point is seen from the path and beside it")
    return Measured(float(np.quantile(every, QUANTILE)), f"{QUANTILE:.0%} of points are below it at ±{SHIFT_M:g} m")


EFFECT = Effect(
    "anti_aliasing", "ratio of footprints beside the path", "ratio", 2.0, "a filter a Gaussian", measure, marks=True
)
