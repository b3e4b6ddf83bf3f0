"""How fast a camera moves over the scene, in pixels: rolling shutter and motion blur are the same property."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from genre_tasks.effects.measurements import Seen
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


Vector = tuple[float, float, float]


def motions(seen: Seen, cameras: Collection[str]) -> tuple[dict[tuple[str, int], tuple[Vector, Vector]], float]:
    """Velocity in m/s and turn in rad/s, in camera axes, of the ``cameras`` at their images, by camera and frame.

    And the seconds from a frame to the next. From the poses before and after an image; a camera with one image, or with
    two at one time, is left out.
    """
    out: dict[tuple[str, int], tuple[Vector, Vector]] = {}
    for name in (n for n in seen.cameras if n in cameras):
        views = sorted((v for v in seen.chunk.views if v.camera == name), key=lambda v: v.frame)
        for k, view in enumerate(views):
            before, after = views[max(k - 1, 0)], views[min(k + 1, len(views) - 1)]
            if after.timestamp_s > before.timestamp_s:
                out[name, view.frame] = _moving(view, before, after)
    return out, _frame_s(seen)


def _frame_s(seen: Seen) -> float:
    """Seconds from a frame to the next: one number for all cameras, whose clocks differ by microseconds."""
    times: dict[str, list[tuple[int, float]]] = {}
    for view in seen.chunk.views:
        times.setdefault(view.camera, []).append((view.frame, view.timestamp_s))
    pairs = [(a, b) for own in times.values() for a, b in itertools.pairwise(sorted(own))]
    return float(np.median([(b[1] - a[1]) / (b[0] - a[0]) for a, b in pairs])) if pairs else 0.0


def _moving(view: View, before: View, after: View) -> tuple[Vector, Vector]:
    seconds = after.timestamp_s - before.timestamp_s
    axes = view.chunk_SE3_camera[:3, :3].T
    way = after.chunk_SE3_camera[:3, 3] - before.chunk_SE3_camera[:3, 3]
    turned = after.chunk_SE3_camera[:3, :3] @ before.chunk_SE3_camera[:3, :3].T
    vx, vy, vz = axes @ way / seconds
    wx, wy, wz = axes @ Rotation.from_matrix(turned).as_rotvec() / seconds
    return (float(vx), float(vy), float(vz)), (float(wx), float(wy), float(wz))


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
