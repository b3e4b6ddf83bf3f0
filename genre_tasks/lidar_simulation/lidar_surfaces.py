"""The surfaces that a simulated LiDAR meets: fine discs on the chunk's LiDAR points, in the nodes of its scene.

A scene that was fitted to images has them right, and its depth only as far as images say it: Gaussians of a few
decimetres hold a wall's colours wherever within them they stand. A range of centimetres needs the points themselves.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from genre_tasks.config import InitialConfig
from genre_tasks.scene.chunk import Actor, Chunk, Points
from genre_tasks.scene.gaussians import Gaussians, map_attributes
from genre_tasks.scene.graph import FIRST_ACTOR, SceneGraph
from genre_tasks.scene.initial_gaussians import assemble_scene, fit_discs, select_points
from genre_tasks.scene.transforms import distance_to_path
from genre_tasks.scene_edits.chunk_scene import ChunkScene

MAX_DISCS = 250_000
MAX_ACTOR_DISCS = 20_000
MIN_VOXEL_M = 0.05
MAX_RANGE_M = 120.0

MAX_THICKNESS_M = 0.01
"""Of a disc: about the noise of a good LiDAR's ranges. What is thicker would answer before the ray is at its middle."""

MIN_ACTOR_POINTS = 50
"""An actor with fewer points has the Gaussians of the scene in place of discs."""

_NODES_IN_MEMORY = 256
_NO_NODE = -1

_CONFIG = InitialConfig(opacity=0.95, neighbours=12)


class LidarSurfaces:
    """Fits discs to the LiDAR points of chunks, and keeps them: a rollout puts the same points together anew.

    Args:
        max_discs: bounds the number of discs of a background.
    """

    def __init__(self, max_discs: int = MAX_DISCS) -> None:
        self._max_discs = max_discs
        # By the points themselves, which are held so that no other object takes their identity.
        self._fitted: OrderedDict[int, tuple[Points, Gaussians]] = OrderedDict()

    def build(self, chunk_scene: ChunkScene) -> SceneGraph:
        """Fits discs to a chunk's LiDAR points; points that no LiDAR measured are left out.

        Args:
            chunk_scene: whose actors are where the scene has them, so that edits of the traffic count.

        Returns:
            A scene with the nodes of ``chunk_scene.scene``, and without a distant region.

        Raises:
            ValueError: chunk and scene do not have the same actors.
        """
        chunk = chunk_scene.chunk
        scene = chunk_scene.scene
        if len(chunk.actors) != len(scene.actors):
            raise ValueError(f"expected the actors of one chunk, got {len(chunk.actors)} and {len(scene.actors)}")
        static = self._reuse(chunk.static, lambda: _fit_static(chunk, self._max_discs))
        # A shadow is part of its actor's node, and no beam meets it.
        nodes = scene.nodes.masked_fill(chunk_scene.find_shadows(), _NO_NODE)
        solid = replace(scene, nodes=nodes)
        actors = [self._build_actor(actor, solid, k) for k, actor in enumerate(chunk.actors)]
        nothing_distant = Gaussians.unpack(torch.zeros(0, 14))
        surfaces = assemble_scene(chunk, static, nothing_distant, actors)
        # The scene's boxes: an edit moves them.
        return replace(surfaces, actors=scene.actors)

    def _build_actor(self, actor: Actor, scene: SceneGraph, number: int) -> Gaussians:
        if len(actor.points) < MIN_ACTOR_POINTS:
            rows = torch.nonzero(scene.nodes == FIRST_ACTOR + number)[:, 0]
            return map_attributes(lambda values: values.index_select(0, rows), scene.gaussians)
        return self._reuse(actor.points, lambda: _fit_actor(actor))

    def _reuse(self, points: Points, fit: Callable[[], Gaussians]) -> Gaussians:
        if id(points) not in self._fitted:
            self._fitted[id(points)] = (points, fit())
        self._fitted.move_to_end(id(points))
        while len(self._fitted) > _NODES_IN_MEMORY:
            self._fitted.popitem(last=False)
        return self._fitted[id(points)][1]


def _fit_static(chunk: Chunk, max_discs: int) -> Gaussians:
    distance = distance_to_path(chunk.static.positions, chunk.chunk_SE3_ego)
    used = (chunk.static.frames >= 0) & (distance < MAX_RANGE_M)
    # A point file has no sweep that its points could be of.
    if not used.any():
        used = distance < MAX_RANGE_M
    return _flatten(fit_discs(select_points(chunk.static, used), distance[used], max_discs, _CONFIG))


def _fit_actor(actor: Actor) -> Gaussians:
    return _flatten(fit_discs(actor.points, np.zeros(len(actor.points)), MAX_ACTOR_DISCS, _CONFIG, MIN_VOXEL_M))


def _flatten(discs: Gaussians) -> Gaussians:
    thickness = discs.log_scales[:, 2:].clamp_max(float(np.log(MAX_THICKNESS_M)))
    return replace(discs, log_scales=torch.cat([discs.log_scales[:, :2], thickness], 1))
