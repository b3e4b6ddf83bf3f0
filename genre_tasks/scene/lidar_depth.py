"""LiDAR depth maps of single frames, for the depth term of the loss (paper Eq. 9)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from genre_tasks.logs.types import Float32
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.projection import project, splat_depth
from genre_tasks.scene.visibility import ABSOLUTE_TOLERANCE_M, FOOTPRINT_M, RELATIVE_TOLERANCE, buffer_lens

_FOOTPRINT_SCALE = 2.0
"""A single sweep is sparser than a chunk's points: each return hides more."""


def lidar_depth(chunk: Chunk, view: View) -> Tensor:
    """[H, W] float32 metres along the camera's axis: the nearest return per pixel of the view's frame, 0 where none.

    LiDAR and camera stand apart, so the LiDAR sees background that the camera does not: a return behind a nearer one's
    footprint is left out. All 0 where the frame has no sweep.
    """
    height, width = view.lens.height_px, view.lens.width_px
    points = frame_points(chunk, view.frame)
    coarse = buffer_lens(view.lens)
    seen = project(points, view.chunk_SE3_camera, coarse, view.shutter)
    nearest = splat_depth(seen, coarse, _FOOTPRINT_SCALE * FOOTPRINT_M)
    front = nearest[seen.uv[:, 1].astype(np.int64), seen.uv[:, 0].astype(np.int64)]
    tolerance = np.float32(1 + _FOOTPRINT_SCALE * RELATIVE_TOLERANCE)
    kept = project(
        points[seen.index[seen.depth <= front * tolerance + np.float32(ABSOLUTE_TOLERANCE_M)]],
        view.chunk_SE3_camera,
        view.lens,
        view.shutter,
    )
    out = np.full(height * width, np.inf, np.float32)
    np.minimum.at(out, kept.uv[:, 1].astype(np.int64) * width + kept.uv[:, 0].astype(np.int64), kept.depth)
    out[np.isinf(out)] = 0.0
    return torch.from_numpy(out.reshape(height, width))


def frame_points(chunk: Chunk, frame: int) -> Float32:
    """Points [P, 3] of one frame's sweep in chunk coordinates: background, and actors where they are at that frame."""
    parts = [chunk.static.positions[chunk.static.frames == frame]]
    for actor in chunk.actors:
        at = np.flatnonzero(actor.frames == frame)
        if len(at):
            pose = actor.chunk_SE3_box[at[0]].astype(np.float32)
            parts.append(actor.points.positions[actor.points.frames == frame] @ pose[:3, :3].T + pose[:3, 3])
    return np.concatenate(parts)
