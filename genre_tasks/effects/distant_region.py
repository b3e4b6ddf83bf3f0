"""Distant region: the part of the images that LiDAR does not reach and parallax does not move."""

from __future__ import annotations

from functools import partial

import numpy as np

from genre_tasks.effects.measurements import ChunkMeasurements
from genre_tasks.effects.types import Effect, Measurement
from genre_tasks.logs.types import Float32
from genre_tasks.scene.chunk import View
from genre_tasks.scene.projection import project
from genre_tasks.threads import map_single_threaded

BLOCK_PX = 8
"""Images are divided into blocks of so many pixels; a block with a return counts as near."""

PARALLAX_PX = 0.5
"""A point is near where it moves by at least so many pixels while the vehicle travels through the chunk."""

# A vehicle that travels less has no parallax to tell far from near by.
STANDSTILL_M = 0.1


def measure(measurements: ChunkMeasurements) -> Measurement:
    """Measures the area of the source images without a static LiDAR return that is near enough to show parallax.

    Args:
        measurements: the chunk's poses and LiDAR points.

    Returns:
        Percentage of the image area, mean over the source images.
    """
    centers = measurements.chunk.chunk_SE3_ego[:, :3, 3]
    # The distance from the start and not the length of the path: driving in a circle adds no parallax.
    baseline_m = float(np.linalg.norm(centers - centers[:1], axis=1).max())
    static = measurements.chunk.static
    swept_points = static.positions[static.frames >= 0]
    far_fraction = partial(_far_fraction, swept_points, baseline_m=baseline_m)
    fractions = map_single_threaded(far_fraction, measurements.source_views)
    if baseline_m >= STANDSTILL_M:
        baseline = f"over {baseline_m:.1f} m of path"
    else:
        baseline = "the vehicle stands: returns alone count"
    return Measurement(100 * float(np.mean(fractions)), f"cells of {BLOCK_PX} pixels, {baseline}")


def _far_fraction(points: Float32, view: View, baseline_m: float) -> float:
    """Fraction of the blocks of a view's image into which no near point falls."""
    lens = view.lens
    projected = project(points, view.chunk_SE3_camera, lens)
    max_depth = lens.fx_px * baseline_m / PARALLAX_PX if baseline_m >= STANDSTILL_M else np.inf
    near = projected.depth < max_depth
    columns = -(-lens.width_px // BLOCK_PX)
    rows = -(-lens.height_px // BLOCK_PX)
    # Blocks instead of pixels: even on a near wall LiDAR returns are sparser than pixels.
    block = (projected.uv[near] // BLOCK_PX).astype(np.int64)
    has_return = np.zeros((rows, columns), bool)
    has_return[block[:, 1], block[:, 0]] = True
    return 1 - float(has_return.mean())


EFFECT = Effect(
    name="distant_region",
    property="image area without a return or parallax",
    unit="%",
    threshold=1.0,
    cost="initial.distant_count Gaussians",
    measure=measure,
)
