"""Viewpoints beside the path, and their nearest reference images."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from genre_tasks.logs.types import Float64
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.novel_views import NovelView
from genre_tasks.scene.transforms import shift_laterally


def novel_view_poses(
    chunk: Chunk, shifts_m: Sequence[float], frames: Sequence[int] | None = None
) -> tuple[NovelView, ...]:
    """The chunk's views moved ``shift_m`` to the left with the whole rig, ordered by (shift, frame, camera).

    Novel cameras have the lenses of the rig, and a global shutter. ``frames`` are log frames; by default those of
    source views. A camera without an image at a frame has no novel view there. Raises ``ValueError`` for a frame
    outside the chunk.
    """
    chosen = {v.frame for v in chunk.of_role("source")} if frames is None else set(frames)
    unknown = sorted(chosen - set(chunk.frames))
    if unknown:
        raise ValueError(
            f"expected frames of chunk {chunk.index}, {chunk.frames[0]} to {chunk.frames[-1]}, got {unknown}"
        )
    sources = chunk.of_role("source")
    out = []
    for shift_m in shifts_m:
        for view in chunk.views:
            if view.frame in chosen:
                ego = chunk.chunk_SE3_ego[chunk.frames.index(view.frame)]
                pose = shift_laterally(view.chunk_SE3_camera, ego, shift_m)
                near = nearest_reference(view.camera, pose, sources)
                reference = (near.camera, near.frame)
                out.append(NovelView(view.camera, view.frame, shift_m, pose, view.lens, reference))
    return tuple(out)


def nearest_reference(camera: str, chunk_SE3_camera: Float64, sources: Sequence[View]) -> View:
    """The source view nearest to a pose: same camera first, then distance, then angle, then the earlier frame."""

    def rank(view: View) -> tuple[bool, float, float, int]:
        turn = view.chunk_SE3_camera[:3, :3].T @ chunk_SE3_camera[:3, :3]
        angle = float(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
        distance = float(np.linalg.norm(view.chunk_SE3_camera[:3, 3] - chunk_SE3_camera[:3, 3]))
        return view.camera != camera, round(distance, 3), round(angle, 4), view.frame

    return min(sources, key=rank)
