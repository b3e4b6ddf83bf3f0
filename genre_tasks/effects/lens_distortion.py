"""Lens distortion: straight lines are curved in the image."""

from __future__ import annotations

import numpy as np

from genre_tasks.effects.measurements import ChunkMeasurements
from genre_tasks.effects.types import Effect, Measurement
from genre_tasks.logs.brown_conrady import distort
from genre_tasks.logs.types import Lens

_GRID_SIZE = 33


def measure(measurements: ChunkMeasurements) -> Measurement:
    """Measures how far a lens shifts a pixel, at most.

    Args:
        measurements: the chunk's cameras.

    Returns:
        Pixels at the working resolution, of the camera that shifts them farthest.
    """
    # A camera has one lens in all frames, so the last view stands for all.
    lenses = {view.camera: view.lens for view in measurements.source_views}
    shifts = {camera: max_shift_px(lens) for camera, lens in lenses.items()}
    camera = max(shifts, key=lambda name: shifts[name])
    explanation = f"at the corner of {camera}" if shifts[camera] else "images are undistorted"
    return Measurement(shifts[camera], explanation)


def max_shift_px(lens: Lens) -> float:
    """Computes the largest shift of a pixel by a lens, over a grid of the image.

    Args:
        lens: intrinsics, with or without distortion coefficients.

    Returns:
        Pixels; 0 without distortion.

    >>> max_shift_px(Lens(100.0, 100.0, 50.0, 50.0, 100, 100))
    0.0
    >>> round(max_shift_px(Lens(100.0, 100.0, 50.0, 50.0, 100, 100, (-0.1, 0.0, 0.0, 0.0, 0.0))), 2)
    3.54
    """
    # Distortion may turn back before the corners, so that these alone would not do.
    u, v = np.meshgrid(np.linspace(0, lens.width_px, _GRID_SIZE), np.linspace(0, lens.height_px, _GRID_SIZE))
    x = ((u - lens.cx_px) / lens.fx_px).astype(np.float32)
    y = ((v - lens.cy_px) / lens.fy_px).astype(np.float32)
    distorted_x, distorted_y = distort(x, y, lens.coefficients) if any(lens.distortion) else (x, y)
    return float(np.hypot((distorted_x - x) * lens.fx_px, (distorted_y - y) * lens.fy_px).max())


EFFECT = Effect(
    name="lens_distortion",
    property="shift of a pixel by the lens",
    unit="px",
    threshold=0.9,
    cost="a distorted projection of each Gaussian",
    measure=measure,
)
