"""Where the boxes of actors are in images."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from genre_tasks.scene.chunk import Actor, View
from genre_tasks.scene.novel_views import NovelView
from genre_tasks.scene.projection import NEAR_M

AnyView = View | NovelView


def project_box(actor: Actor, view: AnyView) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Finds the rectangle of pixels that an actor's box covers in a view.

    What is behind the camera plane is cut off there; the lens is taken to be free of distortion.

    Args:
        actor: with its poses in the chunk.
        view: recorded or novel.

    Returns:
        The first pixel (x, y) of the rectangle, and the one after its last: equal where the box is not in the image.
    """
    index = np.flatnonzero(actor.frames == view.frame)
    nothing = np.zeros(2, np.int64)
    if not len(index):
        return nothing, nothing
    corners = np.stack(np.meshgrid(*[(-s / 2, s / 2) for s in actor.size_m], indexing="ij"), -1).reshape(-1, 3)
    camera_SE3_box = np.linalg.inv(view.chunk_SE3_camera) @ actor.chunk_SE3_box[index[0]]
    points = corners @ camera_SE3_box[:3, :3].T + camera_SE3_box[:3, 3]
    if (points[:, 2] < NEAR_M).all():
        return nothing, nothing
    # Corners behind the camera plane are moved onto it: the rectangle then reaches the image's edge, as the box does.
    z = np.maximum(points[:, 2], NEAR_M)
    lens = view.lens
    u = (points[:, 0] / z * lens.fx_px + lens.cx_px).clip(0, lens.width_px)
    v = (points[:, 1] / z * lens.fy_px + lens.cy_px).clip(0, lens.height_px)
    return np.array([round(u.min()), round(v.min())]), np.array([round(u.max()), round(v.max())])
