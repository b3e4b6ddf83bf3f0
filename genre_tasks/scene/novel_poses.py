"""Novel viewpoints beside the path, and the recorded image nearest to each."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from genre_tasks.logs.types import Float64
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.novel_views import NovelView
from genre_tasks.scene.transforms import shift_laterally


def place_novel_views(
    chunk: Chunk, shifts_m: Sequence[float], frames: Sequence[int] | None = None, every: int = 1
) -> tuple[NovelView, ...]:
    """Moves the chunk's cameras sideways with the whole rig.

    Args:
        chunk: whose cameras; one without an image at a frame has no novel view there.
        shifts_m: metres to the left.
        frames: log frames; by default those of source views.
        every: n from 1: each shift is used at every n-th of the frames, and each starts one frame after the one before.

    Returns:
        Novel views ordered by (shift, frame, camera), with the lenses of the rig and a global shutter.

    Raises:
        ValueError: a frame is outside the chunk.
    """
    sources = chunk.views_with_role("source")
    chosen = {v.frame for v in sources} if frames is None else set(frames)
    unknown = sorted(chosen - set(chunk.frames))
    if unknown:
        raise ValueError(
            f"expected frames of chunk {chunk.index}, {chunk.frames[0]} to {chunk.frames[-1]}, got {unknown}"
        )
    out = []
    for turn, shift_m in enumerate(shifts_m):
        # Shifts take turns: what one side does not see at a frame, it sees at the next one, a metre or two farther on.
        taken = {frame for k, frame in enumerate(sorted(chosen)) if (k - turn) % every == 0}
        for view in chunk.views:
            # Every camera's recorded pose is moved by itself, because cameras of a rig do not fire at one moment.
            if view.frame in taken:
                ego = chunk.chunk_SE3_ego[chunk.frames.index(view.frame)]
                pose = shift_laterally(view.chunk_SE3_camera, ego, shift_m)
                nearest = find_nearest_reference(view.camera, pose, sources)
                reference = (nearest.camera, nearest.frame)
                out.append(NovelView(view.camera, view.frame, shift_m, pose, view.lens, reference))
    return tuple(out)


def find_nearest_reference(camera: str, chunk_SE3_camera: Float64, sources: Sequence[View]) -> View:
    """Finds the source view nearest to a pose: same camera first, then distance, then angle, then the earlier frame.

    Args:
        camera: name of the novel view's camera.
        chunk_SE3_camera: [4, 4] of the novel view.
        sources: source views of the chunk, at least one.
    """

    def rank(view: View) -> tuple[bool, float, float, int]:
        turn = view.chunk_SE3_camera[:3, :3].T @ chunk_SE3_camera[:3, :3]
        # Rounding can lift the cosine of equal rotations above 1, where the arc cosine is NaN.
        angle = float(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
        distance = float(np.linalg.norm(view.chunk_SE3_camera[:3, 3] - chunk_SE3_camera[:3, 3]))
        # Rounded: equal poses must tie, whatever the last bits of their distances are.
        return view.camera != camera, round(distance, 3), round(angle, 4), view.frame

    return min(sources, key=rank)
