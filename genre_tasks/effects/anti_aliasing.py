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

from genre_tasks.effects.measurements import Seen
from genre_tasks.effects.types import Effect, Measured
from genre_tasks.logs.types import Float32, Float64
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.transforms import shift_laterally
from genre_tasks.scene.visibility import visible

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
    ratio = ratios(seen.chunk, points)
    known = np.isfinite(ratio)
    if not known.any():
        return Measured(None, "no point is seen")
    text = f"of {int(known.sum())} points, over source images and views at ±{SHIFT_M:g} m"
    return Measured(float(np.median(ratio[known])), text)


def ratios(chunk: Chunk, points: Float32) -> Float64:
    """Largest over smallest footprint [P] of points [P, 3] in the views, NaN where none sees a point."""
    largest, smallest = np.full(len(points), np.nan), np.full(len(points), np.nan)
    for view in _views(chunk):
        index, _, depth = visible(points, view)
        size = view.lens.fx_px / depth
        largest[index], smallest[index] = np.fmax(largest[index], size), np.fmin(smallest[index], size)
    return np.asarray(largest / smallest)


def _views(chunk: Chunk) -> list[View]:
    """Source views, and each at ±3 m."""
    sources = chunk.of_role("source")
    out = list(sources)
    for view in sources:
        ego = chunk.chunk_SE3_ego[chunk.frames.index(view.frame)]
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
