"""Lens distortion: straight lines are curved in the image."""

from __future__ import annotations

import numpy as np

from genre_tasks.effects.measurements import Seen
from genre_tasks.effects.types import Effect, Measured
from genre_tasks.scene.lens_distortion import distort

_GRID = 33


def measure(seen: Seen) -> Measured:
    """The largest shift of a pixel by the lens, over a grid of the image."""
    shifts = {}
    for view in {v.camera: v for v in seen.sources}.values():
        lens = view.lens
        u, v = np.meshgrid(np.linspace(0, lens.width_px, _GRID), np.linspace(0, lens.height_px, _GRID))
        x, y = ((u - lens.cx_px) / lens.fx_px).astype(np.float32), ((v - lens.cy_px) / lens.fy_px).astype(np.float32)
        bent = distort(x, y, lens.coefficients) if any(lens.distortion) else (x, y)
        shifts[view.camera] = float(np.hypot((bent[0] - x) * lens.fx_px, (bent[1] - y) * lens.fy_px).max())
    name = max(shifts, key=lambda n: shifts[n])
    return Measured(shifts[name], f"at the corner of {name}" if shifts[name] else "images are undistorted")


EFFECT = Effect(
    "lens_distortion", "shift of a pixel by the lens", "px", 0.9, "a distorted projection of each Gaussian", measure
)
