"""Renders what the cameras of a rig see along an ego path, pose after pose: nothing but the latest images is kept."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.render import render_views
from genre_tasks.render.types import RenderSettings
from genre_tasks.rollout.camera_motion import place_rollout_views
from genre_tasks.rollout.chunk_layout import lay_out_chunks
from genre_tasks.rollout.handover import Handover, cut_at_borders
from genre_tasks.rollout.rig import RigCamera, RolloutView
from genre_tasks.rollout.scene_schedule import SceneSchedule, ShownScene
from genre_tasks.scene_edits.chunk_scene import ChunkScene, SceneSource

__all__ = ["RolloutImages", "place_rollout_views", "render_rollout"]

DEFAULT_SETTINGS = RenderSettings()


@dataclass(frozen=True)
class RolloutImages:
    """What C cameras see at one pose of a path.

    Attributes:
        index: of the pose in the path.
        views: C of them, in coordinates of the chunk.
        chunk_scene: the chunk and scene that were rendered, with the traffic of the moment; of several scenes within
            a hand-over the one that counts most.
        color: [C, H, W, 3] sRGB premultiplied by alpha, in [0, 1].
        alpha: [C, H, W].
        depth: [C, H, W] metres, 0 where nothing is; of ``chunk_scene`` alone.
        chunk: number of the chunk whose background that is.
        blended_chunk: number of the chunk whose background is mixed in by a hand-over; ``None``: there is none.
        blend_weight: how much that background counts in colour and alpha.
    """

    index: int
    views: tuple[RolloutView, ...]
    chunk_scene: ChunkScene
    color: Tensor
    alpha: Tensor
    depth: Tensor
    chunk: int = 0
    blended_chunk: int | None = None
    blend_weight: float = 0.0


def render_rollout(
    source: SceneSource,
    path: EgoPath,
    rig: Sequence[RigCamera],
    settings: RenderSettings = DEFAULT_SETTINGS,
    handovers: Sequence[Handover] | None = None,
) -> Iterator[RolloutImages]:
    """Renders a path; actors are where they are at each pose's moment of the log.

    Rolling shutter and motion blur follow the path's own motion.

    Args:
        source: the scenes of a run.
        path: P poses, in the order in which chunks follow each other.
        rig: the cameras.
        settings: backend and threads.
        handovers: of :func:`~genre_tasks.rollout.handover.plan_handovers`; ``None``: cuts at the borders.

    Yields:
        The images of each pose.
    """
    layout = lay_out_chunks(source)
    schedule = SceneSchedule(source, layout, cut_at_borders(layout) if handovers is None else handovers)
    for index, (place, frame) in enumerate(zip(layout.find_places(path), path.frames, strict=True)):
        yield _render_pose(schedule.find(float(place), float(frame)), path, index, rig, settings)


def _render_pose(
    shown: Sequence[ShownScene], path: EgoPath, index: int, rig: Sequence[RigCamera], settings: RenderSettings
) -> RolloutImages:
    renders = []
    views = []
    for scene in shown:
        views.append(place_rollout_views(path, index, rig, scene.chunk_scene))
        # Without gradients the renderer keeps nothing for a backward pass, which takes memory.
        with torch.no_grad():
            renders.append(render_views(scene.chunk_scene.scene, views[-1], settings))
    color = renders[0].color.clamp(0, 1) * shown[0].weight
    alpha = renders[0].alpha * shown[0].weight
    for render, scene in zip(renders[1:], shown[1:], strict=True):
        # Over display colours: a fade that is linear there looks steady to the eye.
        color += render.color.clamp(0, 1) * scene.weight
        alpha += render.alpha * scene.weight
    others = [scene for scene in shown if scene.background != shown[0].background]
    return RolloutImages(
        index=index,
        views=views[0],
        chunk_scene=shown[0].chunk_scene,
        color=color,
        alpha=alpha,
        # A mean of two depths would lie on neither surface.
        depth=renders[0].expected_depth(),
        chunk=shown[0].background,
        blended_chunk=others[0].background if others else None,
        blend_weight=sum(scene.weight for scene in others),
    )
