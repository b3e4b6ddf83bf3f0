"""The distant region: what LiDAR does not reach and parallax does not move."""

from __future__ import annotations

import numpy as np

from genre_tasks.effects.measurements import Seen
from genre_tasks.effects.types import Effect, Measured
from genre_tasks.logs.types import Float32
from genre_tasks.scene.chunk import View
from genre_tasks.scene.projection import project

CELL_PX = 8
PARALLAX_PX = 0.5
STANDSTILL_M = 0.1
"""A vehicle that travels less has no parallax to tell far from near by."""


def measure(seen: Seen) -> Measured:
    """The share of the source images without a static LiDAR return near enough to show parallax over the chunk."""
    centres = seen.chunk.chunk_SE3_ego[:, :3, 3]
    base = float(np.linalg.norm(centres - centres[:1], axis=1).max())
    swept = seen.chunk.static.positions[seen.chunk.static.frames >= 0]
    far = [_without(swept, view, base) for view in seen.sources]
    said = f"over {base:.1f} m of path" if base >= STANDSTILL_M else "the vehicle stands: returns alone count"
    return Measured(100 * float(np.mean(far)), f"cells of {CELL_PX} pixels, {said}")


def _without(points: Float32, view: View, base_m: float) -> float:
    lens = view.lens
    found = project(points, view.chunk_SE3_camera, lens)
    reach = lens.fx_px * base_m / PARALLAX_PX if base_m >= STANDSTILL_M else np.inf
    near = found.depth < reach
    columns, rows = -(-lens.width_px // CELL_PX), -(-lens.height_px // CELL_PX)
    cell = (found.uv[near] // CELL_PX).astype(np.int64)
    filled = np.zeros((rows, columns), bool)
    filled[cell[:, 1], cell[:, 0]] = True
    return 1 - float(filled.mean())


EFFECT = Effect(
    "distant_region", "image area without a return or parallax", "%", 1.0, "initial.distant_count Gaussians", measure
)
