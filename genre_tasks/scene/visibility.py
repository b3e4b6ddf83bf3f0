"""Colours of LiDAR points from source images, with occlusion respected (paper Sec. III-A)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.types import Float32, Lens
from genre_tasks.scene.actor_track import ActorTrack
from genre_tasks.scene.chunk import View
from genre_tasks.scene.projection import project, splat_depth

GREY = 128
"""The colour of points that no source image saw."""

FOOTPRINT_M = 0.08
"""Half the side of the square that a point hides: about half the distance between LiDAR rings at 40 m."""

RELATIVE_TOLERANCE = 0.08
ABSOLUTE_TOLERANCE_M = 0.2
"""A point is seen unless something is nearer by more than this. On the ground, seen from 1.6 m, a footprint's
front edge is nearer by FOOTPRINT / 1.6 = 5 % of the distance; the rest covers the pixel raster."""

# Depth maps for occlusion have this width at any working resolution: it fits the LiDAR's density.
_BUFFER_WIDTH_PX = 640

# On actors the view nearest in time wins (shading and reflections move), then the nearest in space.
_FRAME_PENALTY = 1e3


@dataclass
class PointCloud:
    """Points that get colours: the background's, or an actor's.

    Attributes:
        positions: [P, 3] metres, in chunk coordinates, or in box coordinates where there is a ``track``.
        frames: [P] log frame of each point's sweep.
        track: the actor's; ``None`` for the background.
    """

    positions: Float32
    frames: NDArray[np.int16]
    track: ActorTrack | None = None

    def positions_at(self, frame: int) -> Float32 | None:
        """Gives the points' positions [P, 3] in chunk coordinates at a log frame.

        Args:
            frame: log frame.

        Returns:
            [P, 3] float32 metres, ``None`` where the actor does not exist.
        """
        if self.track is None:
            return self.positions
        pose = self.track.pose(frame)
        if pose is None:
            return None
        return (self.positions @ pose[:3, :3].T.astype(np.float32) + pose[:3, 3].astype(np.float32)).astype(np.float32)


def color_point_clouds(
    clouds: Sequence[PointCloud], images: Iterable[tuple[View, NDArray[np.uint8]]]
) -> list[tuple[NDArray[np.uint8], NDArray[np.bool_]]]:
    """Colours points from images.

    Each point takes the pixel of the view that resolves it best (fewest metres a pixel), among those that see it. For
    points of actors the view nearest in time comes first. A point is hidden where the depth map of all clouds, with
    actors where they are at the view's frame, is nearer.

    Args:
        clouds: all that may hide each other.
        images: views and their pixels [H, W, 3], of their lenses' size.

    Returns:
        For each cloud colours [P, 3] uint8, ``GREY`` where no view sees the point, and whether one does [P].
    """
    colors = [np.full((len(c.positions), 3), GREY, np.uint8) for c in clouds]
    scores = [np.full(len(c.positions), np.inf, np.float32) for c in clouds]
    for view, pixels in images:
        posed = [c.positions_at(view.frame) for c in clouds]
        present = [k for k, p in enumerate(posed) if p is not None and len(p)]
        if not present:
            continue
        # All clouds in one depth map: an actor hides the background, and the other way round.
        starts = np.cumsum([0, *(len(clouds[k].positions) for k in present)])
        index, uv, depth = find_visible_points(np.concatenate([posed[k] for k in present]), view)
        # Metres a pixel.
        score = depth / np.float32(view.lens.fx_px)
        color = pixels[uv[:, 1].astype(np.int64), uv[:, 0].astype(np.int64)]
        for n, k in enumerate(present):
            # Indices rise, so each cloud's points lie next to each other.
            low, high = np.searchsorted(index, [starts[n], starts[n + 1]])
            in_cloud = index[low:high] - starts[n]
            rank = score[low:high]
            if clouds[k].track is not None:
                rank = rank + _FRAME_PENALTY * np.abs(clouds[k].frames[in_cloud].astype(np.float32) - view.frame)
            better = rank < scores[k][in_cloud]
            scores[k][in_cloud[better]] = rank[better]
            colors[k][in_cloud[better]] = color[low:high][better]
    return [(c, np.isfinite(s)) for c, s in zip(colors, scores, strict=True)]


def occlusion_lens(lens: Lens) -> Lens:
    """Gives the lens of the depth maps that decide on occlusion: the same view at a fixed width, with square pixels.

    Images of a rig of several shapes are stretched, and squares in them would hide what lies farther along the road.
    """
    height = _BUFFER_WIDTH_PX * lens.height_px / lens.width_px * lens.fx_px / lens.fy_px
    return lens.resized(_BUFFER_WIDTH_PX, max(1, round(height)))


def find_visible_points(points: Float32, view: View) -> tuple[NDArray[np.int64], Float32, Float32]:
    """Finds the points that a view sees unoccluded by others.

    Args:
        points: [P, 3] metres, chunk coordinates.
        view: whose pose and lens count; a rolling shutter is left out.

    Returns:
        Indices [M] into ``points``, rising; pixels [M, 2] of the view's lens; depths [M] in metres.
    """
    lens = occlusion_lens(view.lens)
    inside = project(points, view.chunk_SE3_camera, lens)
    nearest = splat_depth(inside, lens, FOOTPRINT_M)
    column = inside.uv[:, 0].astype(np.int64)
    row = inside.uv[:, 1].astype(np.int64)
    front = nearest[row, column] * np.float32(1 + RELATIVE_TOLERANCE) + np.float32(ABSOLUTE_TOLERANCE_M)
    # Indices and ``take``, since a mask in brackets takes several times as long.
    visible = np.flatnonzero(inside.depth <= front)
    # From the depth map's pixels to those of the view's own lens.
    scale = np.array([view.lens.width_px / lens.width_px, view.lens.height_px / lens.height_px], np.float32)
    last_pixel = np.array([view.lens.width_px - 1, view.lens.height_px - 1], np.float32)
    uv = np.minimum(inside.uv.take(visible, axis=0) * scale, last_pixel)
    return inside.index.take(visible), uv, inside.depth.take(visible)
