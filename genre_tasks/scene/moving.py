"""How cameras move while an image is taken: from the poses of their images before and after it."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from genre_tasks.logs.types import RollingShutter
from genre_tasks.scene.chunk import View

Vector = tuple[float, float, float]


def motions(views: Sequence[View], cameras: Collection[str]) -> dict[tuple[str, int], tuple[Vector, Vector]]:
    """Velocity in m/s and turn in rad/s, in camera axes, of the ``cameras`` at their images, by camera and frame.

    From the poses before and after an image; a camera with one image, or with two at one time, is left out.
    """
    out: dict[tuple[str, int], tuple[Vector, Vector]] = {}
    for name in cameras:
        own = sorted((v for v in views if v.camera == name), key=lambda v: v.frame)
        for k, view in enumerate(own):
            before, after = own[max(k - 1, 0)], own[min(k + 1, len(own) - 1)]
            if after.timestamp_s > before.timestamp_s:
                out[name, view.frame] = _moving(view, before, after)
    return out


def frame_seconds(views: Sequence[View]) -> float:
    """Seconds from a frame to the next: one number for all cameras, whose clocks differ by microseconds."""
    times: dict[str, list[tuple[int, float]]] = {}
    for view in views:
        times.setdefault(view.camera, []).append((view.frame, view.timestamp_s))
    pairs = [(a, b) for own in times.values() for a, b in itertools.pairwise(sorted(own))]
    return float(np.median([(b[1] - a[1]) / (b[0] - a[0]) for a, b in pairs])) if pairs else 0.0


def shutters(views: Sequence[View], readout_s: Mapping[str, float]) -> dict[tuple[str, int], RollingShutter]:
    """Of each image, by camera and frame, of the cameras that take a while to be read out."""
    rolling = [name for name, seconds in readout_s.items() if seconds > 0]
    frame_s = frame_seconds(views)
    return {
        key: RollingShutter(readout_s[key[0]], velocity, turn, frame_s)
        for key, (velocity, turn) in motions(views, rolling).items()
    }


def _moving(view: View, before: View, after: View) -> tuple[Vector, Vector]:
    seconds = after.timestamp_s - before.timestamp_s
    axes = view.chunk_SE3_camera[:3, :3].T
    way = after.chunk_SE3_camera[:3, 3] - before.chunk_SE3_camera[:3, 3]
    turned = after.chunk_SE3_camera[:3, :3] @ before.chunk_SE3_camera[:3, :3].T
    vx, vy, vz = axes @ way / seconds
    wx, wy, wz = axes @ Rotation.from_matrix(turned).as_rotvec() / seconds
    return (float(vx), float(vy), float(vz)), (float(wx), float(wy), float(wz))
