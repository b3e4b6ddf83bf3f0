"""Anti-aliasing: one view sees a surface from much nearer or farther than another does.

The renderer blurs footprints to about a pixel, whatever they cover. Without making up for it, a small Gaussian that was
fitted where it fills a pixel is too bright and too large from afar, and leaves gaps from nearby. The images of one
drive, which see the road ahead from 60 m and from 5 m, then ask for different Gaussians.

A shift of three metres changes a footprint by little more than driving does anyway. The property is therefore measured
over all views together: the source images, and the views at a shift that are rendered from them. A vehicle that drives
on sees most things at about twice the size that it first saw them at, one that stands does not.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from genre_tasks.effects.measurements import ChunkMeasurements
from genre_tasks.effects.types import Effect, Measurement
from genre_tasks.logs.types import Float32, Float64
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.transforms import shift_laterally
from genre_tasks.scene.visibility import find_visible_points

# A tenth of a decibel at 3 m is gained from about 1.65 on (a validation street at standstill: ratio 1.55, 0.06 dB; two
# that are driven through: 2.3, 0.4 and 0.6 dB). But images get softer: what PSNR gains below 2, perceptual and kernel
# distances lose, by 2 to 5 %.
THRESHOLD = 2.0

SHIFT_M = 3.0
# A median needs few points. They are thinned before the test for occlusion, which then takes a fraction of the time.
_POINT_STRIDE = 25


def measure(measurements: ChunkMeasurements) -> Measurement:
    """Measures how much larger a point is in the view that shows it largest than in the one that shows it smallest.

    Args:
        measurements: the chunk's points and views.

    Returns:
        The median ratio over LiDAR points. Views are the source images, and those at ±3 m that are rendered from them.
    """
    chunk = measurements.chunk
    points = chunk.static.positions[chunk.static.frames >= 0][::_POINT_STRIDE]
    ratio = footprint_ratios(chunk, points)
    known = np.isfinite(ratio)
    if not known.any():
        return Measurement(None, "no point is seen")
    explanation = f"of {int(known.sum())} points, over source images and views at ±{SHIFT_M:g} m"
    return Measurement(float(np.median(ratio[known])), explanation)


def footprint_ratios(chunk: Chunk, points: Float32) -> Float64:
    """Computes the ratio of each point's largest footprint over its smallest, over source and shifted views.

    Args:
        chunk: whose views count.
        points: [P, 3] metres, chunk coordinates.

    Returns:
        [P] at least 1; NaN where no view sees the point.
    """
    largest = np.full(len(points), np.nan)
    smallest = np.full(len(points), np.nan)
    for view in _source_and_shifted_views(chunk):
        index, _, depth = find_visible_points(points, view)
        size = view.lens.fx_px / depth
        # fmax and fmin ignore NaN, so that the first view that sees a point starts its range.
        largest[index] = np.fmax(largest[index], size)
        smallest[index] = np.fmin(smallest[index], size)
    return np.asarray(largest / smallest)


def _source_and_shifted_views(chunk: Chunk) -> list[View]:
    sources = chunk.views_with_role("source")
    views = list(sources)
    for view in sources:
        ego = chunk.chunk_SE3_ego[chunk.frames.index(view.frame)]
        poses = (shift_laterally(view.chunk_SE3_camera, ego, shift) for shift in (-SHIFT_M, SHIFT_M))
        views += [replace(view, chunk_SE3_camera=pose) for pose in poses]
    return views


EFFECT = Effect(
    name="anti_aliasing",
    property="ratio of a point's footprints between views",
    unit="ratio",
    threshold=THRESHOLD,
    cost="two determinants a Gaussian",
    measure=measure,
)
