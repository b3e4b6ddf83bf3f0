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
from genre_tasks.rollout.chunk_layout import ChunkLayout, lay_out_chunks
from genre_tasks.rollout.handover import Handover, cut_at_borders
from genre_tasks.rollout.rig import RigCamera, RolloutView
from genre_tasks.rollout.traffic import extend_traffic
from genre_tasks.scene_edits.chunk_scene import ChunkScene, SceneSource

__all__ = ["RolloutImages", "place_rollout_views", "render_rollout"]

DEFAULT_SETTINGS = RenderSettings()


@dataclass(frozen=True)
class RolloutImages:
    """What C cameras see at one pose of a path.

    Attributes:
        index: of the pose in the path.
        views: C of them, in coordinates of the chunk.
        chunk_scene: the chunk and scene that were rendered, with the traffic of the moment; within a hand-over those
            that count more.
        color: [C, H, W, 3] sRGB premultiplied by alpha, in [0, 1].
        alpha: [C, H, W].
        depth: [C, H, W] metres, 0 where nothing is; of ``chunk_scene`` alone.
        chunk: number of that chunk.
        blended_chunk: number of the chunk whose scene is mixed in by a hand-over; ``None``: there is none.
        blend_weight: how much that scene counts in colour and alpha, 0 to 0.5.
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


@dataclass(frozen=True)
class ShownScene:
    """A scene and how much it counts at a moment.

    Attributes:
        chunk: its number.
        chunk_scene: what is rendered.
        weight: in [0, 1]; those of a moment add up to 1.
    """

    chunk: int
    chunk_scene: ChunkScene
    weight: float


class SceneSchedule:
    """Which scenes show a pose; the background of at most two chunks is in memory.

    The background is that of the place where the vehicle is, and the traffic that of the log's moment: a vehicle that
    brakes stays where an earlier chunk has recorded the street.

    Args:
        source: the scenes of a run.
        layout: of its chunks.
        handovers: between chunks that follow each other, in their order.
    """

    def __init__(self, source: SceneSource, layout: ChunkLayout, handovers: Sequence[Handover]) -> None:
        self._source = source
        self._layout = layout
        self._handovers = handovers
        # By the chunk that is shown and those whose traffic was added.
        self._extended: dict[tuple[int, ...], ChunkScene] = {}

    def find(self, place: float, frame: float) -> tuple[ShownScene, ...]:
        """Finds the scenes of a pose.

        Args:
            place: log frame at which the recorded vehicle was there.
            frame: log frame of the traffic.

        Returns:
            One scene, or two within a hand-over; the one that counts more comes first.
        """
        weights = {self._source.chunk_numbers[0]: 1.0}
        for handover in self._handovers:
            weight = handover.weigh(place)
            if weight > 0:
                weights = {handover.after: weight, handover.before: 1 - weight}
        shown = sorted((number for number, weight in weights.items() if weight > 0), key=lambda n: -weights[n])
        traffic = self._layout.find_traffic(frame)
        scenes = {number: self._load(number, traffic) for number in shown}
        # Those of the poses before are dropped.
        self._extended = {key: scene for key, scene in self._extended.items() if key[0] in scenes}
        return tuple(ShownScene(number, scene, weights[number]) for number, scene in scenes.items())

    def _load(self, number: int, traffic: Sequence[int]) -> ChunkScene:
        others = [other for other in traffic if other != number]
        if not others:
            return self._source.load(number)
        key = (number, *others)
        # Kept from pose to pose: it copies the Gaussians where actors are added.
        if key not in self._extended:
            scene = self._source.load(number)
            for other in others:
                scene = extend_traffic(scene, self._source.load(other))
            self._extended = {k: v for k, v in self._extended.items() if k[0] != number} | {key: scene}
        return self._extended[key]


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
    color = renders[0].color.clamp(0, 1)
    alpha = renders[0].alpha
    if len(shown) > 1:
        # Over display colours: a fade that is linear there looks steady to the eye.
        color = torch.lerp(color, renders[1].color.clamp(0, 1), shown[1].weight)
        alpha = torch.lerp(alpha, renders[1].alpha, shown[1].weight)
    return RolloutImages(
        index=index,
        views=views[0],
        chunk_scene=shown[0].chunk_scene,
        color=color,
        alpha=alpha,
        # A mean of two depths would lie on neither surface.
        depth=renders[0].expected_depth(),
        chunk=shown[0].chunk,
        blended_chunk=shown[1].chunk if len(shown) > 1 else None,
        blend_weight=shown[1].weight if len(shown) > 1 else 0.0,
    )
