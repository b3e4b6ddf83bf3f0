"""Viewpoints beside the path, their nearest reference images, and the coloured points of the LiDAR map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from genre_tasks.config import InitialConfig
from genre_tasks.logs.types import Float64
from genre_tasks.scene.chunk import Chunk, Points, View
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.geometry import path_distance, shift_laterally
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.initialise import actor_cap, assembled, node_gaussians, select
from genre_tasks.scene.views import NovelView

LIDAR_OPACITY = 0.95


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
    """The coloured LiDAR points as discs on the surfaces they lie on, nearly opaque: actors move, nothing is distant.

    Discs, because the fixer looks images up by the map's depth: a ball as wide as its neighbours are far would stand
    out of a road that is seen at a grazing angle. Points without colour are left out.
    """
    config, cap = InitialConfig(opacity=LIDAR_OPACITY), actor_cap(max_points, chunk)
    nothing = Gaussians.unpacked(torch.zeros(0, 14))

    def discs(points: Points, distance: NDArray[np.floating], count: int) -> Gaussians:
        colored = points.colored
        return node_gaussians(select(points, colored), distance[colored], count, config) if colored.any() else nothing

    actors = [discs(a.points, np.zeros(len(a.points)), cap) for a in chunk.actors]
    distance = path_distance(chunk.static.positions, chunk.chunk_SE3_ego)
    static = discs(chunk.static, distance, max_points - sum(len(a) for a in actors))
    return assembled(chunk, static, nothing, actors)
