"""LiDAR depth maps of single frames, for the depth term of the loss (paper Eq. 9)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from genre_tasks.logs.types import Float32
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.projection import project, splat_depth
from genre_tasks.scene.visibility import ABSOLUTE_TOLERANCE_M, FOOTPRINT_M, RELATIVE_TOLERANCE, occlusion_lens

# A single sweep is sparser than a chunk's points: each return hides more.
_FOOTPRINT_SCALE = 2.0


def compute_lidar_depth(chunk: Chunk, view: View) -> Tensor:
    """Projects the LiDAR returns of a view's frame into its image.

    Args:
        chunk: with the points of all sweeps.
        view: whose frame counts.

    Returns:
        [H, W] float32 metres along the camera's axis, the nearest return of each pixel; 0 where there is none, and
        everywhere if the frame has no sweep.
    """
    height = view.lens.height_px
    width = view.lens.width_px
    points = gather_frame_points(chunk, view.frame)
    # LiDAR and camera stand apart, so the LiDAR sees background that the camera does not: a return that lies behind a
    # nearer one's footprint is left out.
    coarse = occlusion_lens(view.lens)
    coarse_returns = project(points, view.chunk_SE3_camera, coarse, view.shutter)
    nearest = splat_depth(coarse_returns, coarse, _FOOTPRINT_SCALE * FOOTPRINT_M)
    front = nearest[coarse_returns.uv[:, 1].astype(np.int64), coarse_returns.uv[:, 0].astype(np.int64)]
    tolerance = np.float32(1 + _FOOTPRINT_SCALE * RELATIVE_TOLERANCE)
    visible = coarse_returns.depth <= front * tolerance + np.float32(ABSOLUTE_TOLERANCE_M)
    returns = project(points[coarse_returns.index[visible]], view.chunk_SE3_camera, view.lens, view.shutter)
    out = np.full(height * width, np.inf, np.float32)
    pixel = returns.uv[:, 1].astype(np.int64) * width + returns.uv[:, 0].astype(np.int64)
    # Several returns can share a pixel: the nearest one is what the camera sees.
    np.minimum.at(out, pixel, returns.depth)
    out[np.isinf(out)] = 0.0
    return torch.from_numpy(out.reshape(height, width))


def gather_frame_points(chunk: Chunk, frame: int) -> Float32:
    """Collects the points of one frame's sweep: background, and actors where they are at that frame.

    Args:
        chunk: with the points of all sweeps.
        frame: log frame.

    Returns:
        [P, 3] metres, chunk coordinates.
    """
    parts = [chunk.static.positions[chunk.static.frames == frame]]
    for actor in chunk.actors:
        index = np.flatnonzero(actor.frames == frame)
        if len(index):
            pose = actor.chunk_SE3_box[index[0]].astype(np.float32)
            parts.append(actor.points.positions[actor.points.frames == frame] @ pose[:3, :3].T + pose[:3, 3])
    return np.concatenate(parts)
