"""Renders what the cameras of a rig see along an ego path, pose after pose: nothing but the latest images is kept."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.render import render_views
from genre_tasks.render.types import RenderSettings
from genre_tasks.rollout.rig import RigCamera, RolloutView
from genre_tasks.scene_edits.chunk_scene import ChunkScene, SceneSource

DEFAULT_SETTINGS = RenderSettings()


@dataclass(frozen=True)
class RolloutImages:
    """What C cameras see at one pose of a path.

    Attributes:
        index: of the pose in the path.
        views: C of them, in coordinates of the chunk.
        chunk_scene: the chunk and scene that were rendered.
        color: [C, H, W, 3] sRGB premultiplied by alpha, in [0, 1].
        alpha: [C, H, W].
        depth: [C, H, W] metres, 0 where nothing is.
    """

    index: int
    views: tuple[RolloutView, ...]
    chunk_scene: ChunkScene
    color: Tensor
    alpha: Tensor
    depth: Tensor


def render_rollout(
    source: SceneSource, path: EgoPath, rig: Sequence[RigCamera], settings: RenderSettings = DEFAULT_SETTINGS
) -> Iterator[RolloutImages]:
    """Renders a path; actors are where they are at each pose's moment of the log.

    Args:
        source: the scenes of a run.
        path: P poses, in the order in which chunks follow each other.
        rig: the cameras.
        settings: backend and threads.

    Yields:
        The images of each pose.
    """
    for index, frame in enumerate(path.frames):
        chunk_scene = source.load(_find_chunk(source, float(frame)))
        views = place_rollout_views(path, index, rig, chunk_scene)
        # Without gradients the renderer keeps nothing for a backward pass, which takes memory.
        with torch.no_grad():
            image = render_views(chunk_scene.scene, views, settings)
        yield RolloutImages(index, views, chunk_scene, image.color.clamp(0, 1), image.alpha, image.expected_depth())


def place_rollout_views(
    path: EgoPath, index: int, rig: Sequence[RigCamera], chunk_scene: ChunkScene
) -> tuple[RolloutView, ...]:
    """Places the cameras of a rig at one pose of a path.

    Args:
        path: in the log's world.
        index: of the pose.
        rig: C cameras.
        chunk_scene: in whose coordinates the views are.

    Returns:
        C views.
    """
    chunk_SE3_ego = np.linalg.inv(chunk_scene.chunk.world_SE3_chunk) @ path.world_SE3_ego[index]
    frame = float(path.frames[index])
    return tuple(RolloutView(c.name, frame, chunk_SE3_ego @ c.ego_SE3_camera, c.lens) for c in rig)


def _find_chunk(source: SceneSource, frame: float) -> int:
    for number in source.chunk_numbers:
        if round(frame) <= source.load(number).chunk.frames[-1]:
            return number
    return source.chunk_numbers[-1]
