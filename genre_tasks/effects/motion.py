"""How fast a camera moves over the scene, in pixels: rolling shutter and motion blur are the same property."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from genre_tasks.effects.seen import Seen
from genre_tasks.effects.types import Measured
from genre_tasks.logs.types import Float64
from genre_tasks.scene.chunk import View

QUANTILE = 0.95
"""Of the returns in a view: the near part moves fastest over the image, the fastest of all would be a stray one."""


def pixel_speeds(seen: Seen) -> dict[str, float]:
    """Pixels a second of each camera at the working resolution, the fastest of its source views.

    The flow of the view's LiDAR returns under its velocity, at the 95th percentile, and f · |ω|. Driving ahead moves
    what is off the axis too: (x · v_z − v_x) · f / Z. A camera without returns or a second image is left out.
    """
    out: dict[str, float] = {}
    for view, returns in zip(seen.sources, seen.returns, strict=True):
        later = _next(seen, view)
        if later is None or not len(returns.depth):
            continue
        (vx, vy, vz), turn = _rates(view, later)
        lens = view.lens
        x = (returns.uv[:, 0] - lens.cx_px) / lens.fx_px
        y = (returns.uv[:, 1] - lens.cy_px) / lens.fy_px
        flow = np.hypot(lens.fx_px * (x * vz - vx), lens.fy_px * (y * vz - vy)) / returns.depth
        speed = float(np.quantile(flow, QUANTILE)) + max(lens.fx_px, lens.fy_px) * turn
        out[view.camera] = max(out.get(view.camera, 0.0), speed)
    return out


def displaced(seen: Seen, seconds: Mapping[str, float], said: str) -> Measured:
    """Displacement in the image over each camera's time, of the fastest camera; ``said`` is of what the time is."""
    moved = {name: speed * seconds[name] for name, speed in pixel_speeds(seen).items() if name in seconds}
    if not moved:
        return Measured(None, f"no camera that is {said} for a stated time has two images and LiDAR returns")
    name = max(moved, key=lambda n: moved[n])
    return Measured(moved[name], f"{name} is {said} for {1e3 * seconds[name]:g} ms")


def _next(seen: Seen, view: View) -> View | None:
    """The same camera's next image; the previous one at the chunk's end."""
    others = [v for v in seen.chunk.views if v.camera == view.camera and v.timestamp_s != view.timestamp_s]
    after = [v for v in others if v.frame > view.frame]
    return min(after or others, key=lambda v: abs(v.frame - view.frame), default=None)


def _rates(view: View, other: View) -> tuple[Float64, float]:
    """Velocity [3] in the camera's axes, m/s, and the rate of turn, rad/s."""
    seconds = other.timestamp_s - view.timestamp_s
    relative = np.linalg.inv(view.chunk_SE3_camera) @ other.chunk_SE3_camera
    turn = float(Rotation.from_matrix(relative[:3, :3]).magnitude())
    return relative[:3, 3] / seconds, turn / abs(seconds)
