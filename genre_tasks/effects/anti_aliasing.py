"""Anti-aliasing: a view sees a surface from much nearer or farther than another does.

The renderer blurs footprints to about a pixel, whatever they cover. Without making up for it, a small Gaussian that was
fitted where it fills a pixel is too bright and too large from afar, and leaves gaps from nearby: the images of one
drive alone, which see the road ahead from 60 m and from 5 m, ask different things of it.

Three metres to a side change a footprint by little more than driving does anyway, so the gate asks how far footprints
are apart over all views together, those that a scene is made from and those rendered beside them: a vehicle that drives
on sees most things at about twice the size that it first saw them at, one that stands does not.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from genre_tasks.effects.seen import Seen
from genre_tasks.effects.types import Effect, Measured
from genre_tasks.scene.chunk import View
from genre_tasks.scene.coloring import visible
from genre_tasks.scene.geometry import shift_laterally

THRESHOLD = 2.0
"""A tenth of a decibel at 3 m is gained from about 1.65 on (a validation street at standstill: ratio 1.55, 0.06 dB; two
that are driven through: 2.3, 0.4 and 0.6 dB). But images get softer: what PSNR gains below 2, perceptual and kernel
distances lose, by 2 to 5 %."""

SHIFT_M = 3.0
_EVERY = 25


def measure(seen: Seen) -> Measured:
    """How much larger a point is in the view that shows it largest than in the one that shows it smallest.

    The median over LiDAR points; views are the source images, and those at ±3 m that are rendered from them.
    """
    points = seen.chunk.static.positions[seen.chunk.static.frames >= 0][::_EVERY]
    largest, smallest = np.full(len(points), -np.inf), np.full(len(points), np.inf)
    for view in _views(seen):
        index, _, depth = visible(points, view)
        size = np.log(view.lens.fx_px / depth)
        largest[index], smallest[index] = np.maximum(largest[index], size), np.minimum(smallest[index], size)
    known = np.isfinite(largest)
    if not known.any():
        return Measured(None, "no point is seen")
    ratio = float(np.exp(np.median(largest[known] - smallest[known])))
    return Measured(ratio, f"of {int(known.sum())} points, over source images and views at ±{SHIFT_M:g} m")


def _views(seen: Seen) -> list[View]:
    """Source views, and each at ±3 m."""
    out = list(seen.sources)
    for view in seen.sources:
        ego = seen.chunk.chunk_SE3_ego[seen.chunk.frames.index(view.frame)]
        poses = (shift_laterally(view.chunk_SE3_camera, ego, shift) for shift in (-SHIFT_M, SHIFT_M))
        out += [replace(view, chunk_SE3_camera=pose) for pose in poses]
    return out


EFFECT = Effect(
    "anti_aliasing",
    "ratio of a point's footprints between views",
    "ratio",
    THRESHOLD,
    "two determinants a Gaussian",
    measure,
)
