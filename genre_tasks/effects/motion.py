"""How fast a camera moves over the scene, in pixels: rolling shutter and motion blur are the same property."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from genre_tasks.effects.seen import Seen
from genre_tasks.logs.types import Float64
from genre_tasks.scene.chunk import View

DEPTH_QUANTILE = 0.05
"""The near part of a view moves fastest over the image; the nearest point of all would be a stray one."""


def pixel_speeds(seen: Seen) -> dict[str, float]:
    """Pixels a second of each camera at the working resolution, the fastest of its source views.

    f · v⊥ / Z + f · |ω|, with Z the near depth of the view's LiDAR returns; a camera without them is left out.
    """
    out: dict[str, float] = {}
    for view, returns in zip(seen.sources, seen.returns, strict=True):
        later = _next(seen, view)
        if later is None or not len(returns.depth):
            continue
        velocity, turn = _rates(view, later)
        focal = max(view.lens.fx_px, view.lens.fy_px)
        depth = float(np.quantile(returns.depth, DEPTH_QUANTILE))
        speed = focal * float(np.hypot(velocity[0], velocity[1])) / depth + focal * turn
        out[view.camera] = max(out.get(view.camera, 0.0), speed)
    return out


def _next(seen: Seen, view: View) -> View | None:
    """The same camera's next image; the previous one at the chunk's end."""
    others = [v for v in seen.chunk.views if v.camera == view.camera and v.timestamp_s != view.timestamp_s]
    after = [v for v in others if v.timestamp_s > view.timestamp_s]
    return min(after or others, key=lambda v: abs(v.timestamp_s - view.timestamp_s), default=None)


def _rates(view: View, other: View) -> tuple[Float64, float]:
    """Velocity [3] in the camera's axes, m/s, and the rate of turn, rad/s."""
    seconds = other.timestamp_s - view.timestamp_s
    relative = np.linalg.inv(view.chunk_SE3_camera) @ other.chunk_SE3_camera
    turn = float(Rotation.from_matrix(relative[:3, :3]).magnitude())
    return relative[:3, 3] / seconds, turn / abs(seconds)
