"""Where boxes of actors are in images."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from genre_tasks.scene.chunk import Actor, View
from genre_tasks.scene.novel_views import NovelView
from genre_tasks.scene.projection import NEAR_M

Seeing = View | NovelView


def outline(actor: Actor, view: Seeing) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First pixel (x, y) of the box in the image, and that after its last: the same where it is not in the image.

    What is behind the camera plane is cut off there; lenses are taken to be free of distortion.
    """
    at = np.flatnonzero(actor.frames == view.frame)
    nothing = np.zeros(2, np.int64)
    if not len(at):
        return nothing, nothing
    corner = np.stack(np.meshgrid(*[(-s / 2, s / 2) for s in actor.size_m], indexing="ij"), -1).reshape(-1, 3)
    pose = np.linalg.inv(view.chunk_SE3_camera) @ actor.chunk_SE3_box[at[0]]
    points = corner @ pose[:3, :3].T + pose[:3, 3]
    if (points[:, 2] < NEAR_M).all():
        return nothing, nothing
    z = np.maximum(points[:, 2], NEAR_M)
    lens = view.lens
    u = (points[:, 0] / z * lens.fx_px + lens.cx_px).clip(0, lens.width_px)
    v = (points[:, 1] / z * lens.fy_px + lens.cy_px).clip(0, lens.height_px)
    return np.array([round(u.min()), round(v.min())]), np.array([round(u.max()), round(v.max())])
