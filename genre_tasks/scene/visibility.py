"""Colours of LiDAR points from source images, with occlusion respected (paper Sec. III-A)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.types import Float32, Lens
from genre_tasks.scene.chunk import View
from genre_tasks.scene.moving_actors import Path
from genre_tasks.scene.projection import project, splat_depth

GREY = 128
"""The colour of points that no source image saw."""

FOOTPRINT_M = 0.08
"""Half the side of the square that a point hides: about half the distance between LiDAR rings at 40 m."""

RELATIVE_TOLERANCE, ABSOLUTE_TOLERANCE_M = 0.08, 0.2
"""A point is seen unless something is nearer by more than this. On the ground, seen from 1.6 m, a footprint's
front edge is nearer by FOOTPRINT / 1.6 = 5 % of the distance; the rest covers the pixel raster."""

_BUFFER_WIDTH_PX = 640
"""Depth maps for occlusion have this width at any working resolution: it fits the LiDAR's density."""

_FRAME_PENALTY = 1e3
"""On actors the view nearest in time wins (shading and reflections move), then the nearest in space."""


@dataclass
class Cloud:
    """Points that get colours: the background (``path`` None, chunk coordinates), or an actor's, in box coordinates."""

    positions: Float32
    frames: NDArray[np.int16]
    path: Path | None = None

    def at(self, frame: int) -> Float32 | None:
        """Positions in chunk coordinates at a frame, ``None`` where the actor does not exist."""
        if self.path is None:
            return self.positions
        pose = self.path.pose(frame)
        if pose is None:
            return None
        return (self.positions @ pose[:3, :3].T.astype(np.float32) + pose[:3, 3].astype(np.float32)).astype(np.float32)


def color_clouds(
    clouds: Sequence[Cloud], images: Iterable[tuple[View, NDArray[np.uint8]]]
) -> list[tuple[NDArray[np.uint8], NDArray[np.bool_]]]:
    """(colours [P, 3] uint8, coloured [P] bool) of each cloud, from (view, pixels [H, W, 3] of its lens) pairs.

    Each point takes the pixel of the view that resolves it best (fewest metres a pixel), among those that see it: a
    point is hidden where the depth map splatted from all clouds, actors where they are at the view's frame, is nearer.
    """
    colors = [np.full((len(c.positions), 3), GREY, np.uint8) for c in clouds]
    scores = [np.full(len(c.positions), np.inf, np.float32) for c in clouds]
    for view, pixels in images:
        posed = [c.at(view.frame) for c in clouds]
        present = [k for k, p in enumerate(posed) if p is not None and len(p)]
        if not present:
            continue
        starts = np.cumsum([0, *(len(clouds[k].positions) for k in present)])
        index, uv, depth = visible(np.concatenate([posed[k] for k in present]), view)
        score = depth / np.float32(view.lens.fx_px)
        color = pixels[uv[:, 1].astype(np.int64), uv[:, 0].astype(np.int64)]
        for n, k in enumerate(present):
            low, high = np.searchsorted(index, [starts[n], starts[n + 1]])
            own, rank = index[low:high] - starts[n], score[low:high]
            if clouds[k].path is not None:
                rank = rank + _FRAME_PENALTY * np.abs(clouds[k].frames[own].astype(np.float32) - view.frame)
            better = rank < scores[k][own]
            scores[k][own[better]] = rank[better]
            colors[k][own[better]] = color[low:high][better]
    return [(c, np.isfinite(s)) for c, s in zip(colors, scores, strict=True)]


def buffer_lens(lens: Lens) -> Lens:
    """The lens of the occlusion depth maps."""
    return lens.of_width(_BUFFER_WIDTH_PX)


def visible(points: Float32, view: View) -> tuple[NDArray[np.int64], Float32, Float32]:
    """Points [P, 3] that a view sees unoccluded: index [M] (increasing), pixels [M, 2] of its lens, depth [M]."""
    lens = buffer_lens(view.lens)
    seen = project(points, view.chunk_SE3_camera, lens)
    nearest = splat_depth(seen, lens, FOOTPRINT_M)
    column, row = seen.uv[:, 0].astype(np.int64), seen.uv[:, 1].astype(np.int64)
    front = nearest[row, column] * np.float32(1 + RELATIVE_TOLERANCE) + np.float32(ABSOLUTE_TOLERANCE_M)
    ok = seen.depth <= front
    scale = np.array([view.lens.width_px / lens.width_px, view.lens.height_px / lens.height_px], np.float32)
    uv = np.minimum(seen.uv[ok] * scale, np.array([view.lens.width_px - 1, view.lens.height_px - 1], np.float32))
    return seen.index[ok], uv, seen.depth[ok]
