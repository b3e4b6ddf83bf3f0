"""Rolling shutter: rows are read one after the other while the camera moves."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.spatial.transform import Rotation

from genre_tasks.effects.motion import displaced
from genre_tasks.effects.seen import Seen
from genre_tasks.effects.types import Effect, Fitted, Measured
from genre_tasks.logs.types import RollingShutter
from genre_tasks.scene.chunk import View


def measure(seen: Seen) -> Measured:
    """Displacement in the image between the first and the last row, of the fastest camera."""
    return displaced(seen, {n: c.readout_s for n, c in seen.cameras.items() if c.readout_s > 0}, "read out")


def needs(seen: Seen) -> str | None:
    """A readout time."""
    return None if any(c.readout_s > 0 for c in seen.cameras.values()) else "the log states no readout time"


def fit(seen: Seen) -> Fitted:
    """How each camera that states a readout time moves, from its poses before and after an image.

    A camera with one image, or with two at one time, is left without a shutter.
    """
    out: dict[tuple[str, int], RollingShutter] = {}
    frame_s = _frame_s(seen)
    for name, camera in seen.cameras.items():
        views = sorted((v for v in seen.chunk.views if v.camera == name), key=lambda v: v.frame)
        for k, view in enumerate(views):
            before, after = views[max(k - 1, 0)], views[min(k + 1, len(views) - 1)]
            seconds = after.timestamp_s - before.timestamp_s
            if camera.readout_s > 0 and seconds > 0:
                out[name, view.frame] = _moving(view, before, after, camera.readout_s, frame_s)
    return Fitted(shutters=out)


def _frame_s(seen: Seen) -> float:
    """Seconds from a frame to the next: one number for all cameras, whose clocks differ by microseconds."""
    times: dict[str, list[tuple[int, float]]] = {}
    for view in seen.chunk.views:
        times.setdefault(view.camera, []).append((view.frame, view.timestamp_s))
    pairs = [(a, b) for own in times.values() for a, b in itertools.pairwise(sorted(own))]
    return float(np.median([(b[1] - a[1]) / (b[0] - a[0]) for a, b in pairs])) if pairs else 0.0


def _moving(view: View, before: View, after: View, readout_s: float, frame_s: float) -> RollingShutter:
    seconds = after.timestamp_s - before.timestamp_s
    axes = view.chunk_SE3_camera[:3, :3].T
    way = after.chunk_SE3_camera[:3, 3] - before.chunk_SE3_camera[:3, 3]
    turned = after.chunk_SE3_camera[:3, :3] @ before.chunk_SE3_camera[:3, :3].T
    vx, vy, vz = axes @ way / seconds
    wx, wy, wz = axes @ Rotation.from_matrix(turned).as_rotvec() / seconds
    return RollingShutter(readout_s, (float(vx), float(vy), float(vz)), (float(wx), float(wy), float(wz)), frame_s)


EFFECT = Effect(
    "rolling_shutter", "displacement during the readout", "px", 4.0, "a pose for each row", measure, needs, fit=fit
)
