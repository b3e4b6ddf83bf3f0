"""Viewpoints beside the path, their nearest reference images, and the coloured points of the LiDAR map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from genre_tasks.logs.types import Float64
from genre_tasks.scene.chunk import Chunk, Points, View
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.geometry import path_distance, shift_laterally
from genre_tasks.scene.graph import FIRST_ACTOR, STATIC, ActorNode, SceneGraph
from genre_tasks.scene.ground import CELL_M
from genre_tasks.scene.initialise import MAX_SCALE_VOXELS, SPACING, neighbour_spacing
from genre_tasks.scene.views import NovelView
from genre_tasks.scene.voxels import group, levels, voxel_size_for

LIDAR_OPACITY = 0.95
_LIDAR_SCALE_M = (0.01, 1.0)
_ACTOR_SHARE = 0.02
"""Of the LiDAR map's points, at most this share is one actor's, and at most half all actors'."""


def novel_view_poses(
    chunk: Chunk, shifts_m: Sequence[float], frames: Sequence[int] | None = None
) -> tuple[NovelView, ...]:
    """The chunk's views moved ``shift_m`` to the left with the whole rig, ordered by (shift, frame, camera).

    ``frames`` are log frames; by default those of source views. A camera without an image at a frame has no novel view
    there. Raises ``ValueError`` for a frame outside the chunk.
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


def lidar_scene(chunk: Chunk, max_points: int) -> SceneGraph:
    """The coloured LiDAR points as small isotropic Gaussians in a scene graph: actors move, nothing is distant.

    Points without colour are left out. Sizes follow from the spacing of the thinned points.
    """
    cap = max(1, int(max_points * min(_ACTOR_SHARE, 0.5 / max(len(chunk.actors), 1))))
    actors = [_blobs(a.points, np.zeros(len(a.points)), cap) for a in chunk.actors]
    left = max_points - sum(len(a) for a in actors)
    static = _blobs(chunk.static, path_distance(chunk.static.positions, chunk.chunk_SE3_ego), left)
    parts = [static, *actors]
    ids = [STATIC, *(FIRST_ACTOR + k for k in range(len(actors)))]
    nodes = torch.cat([torch.full((len(p),), k, dtype=torch.int64) for p, k in zip(parts, ids, strict=True)])
    paths = tuple(ActorNode(a.track_id, a.label, a.size_m, a.frames, a.chunk_SE3_box) for a in chunk.actors)
    return SceneGraph(Gaussians.unpacked(torch.cat([p.packed() for p in parts])), nodes, paths)


def _blobs(points: Points, distance: np.ndarray, max_count: int) -> Gaussians:
    positions, colors = points.positions[points.colored], points.colors[points.colored]
    level = levels(distance[points.colored])
    size = voxel_size_for(positions, level, max_count)
    voxels = group(positions, level, size)
    means = voxels.mean(positions)
    count = len(means)
    own = size * np.exp2(voxels.mean(level[:, None])[:, 0])
    spacing = neighbour_spacing(means, size) if count else np.empty(0)
    scale = np.minimum(SPACING * spacing, MAX_SCALE_VOXELS * np.maximum(own, CELL_M)).clip(*_LIDAR_SCALE_M)
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1.0
    return Gaussians(
        torch.from_numpy(means.astype(np.float32)),
        torch.from_numpy(np.log(scale).astype(np.float32))[:, None].expand(count, 3),
        quats,
        torch.full((count,), float(np.log(LIDAR_OPACITY / (1 - LIDAR_OPACITY)))),
        torch.from_numpy((voxels.mean(colors) / 255.0).astype(np.float32)),
    )
