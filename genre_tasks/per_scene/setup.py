"""What a per-scene training starts from: the timetable for its length, the lengths it measures by, a static scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np
import torch
from torch import Tensor

from genre_tasks.config import DensityConfig, PerSceneConfig
from genre_tasks.losses.targets import Target
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import DISTANT, FIRST_ACTOR, STATIC, SceneGraph

PUBLISHED_ITERATIONS = 30_000
CAMERA_MARGIN = 1.1
"""The scene's extent is the farthest camera's distance from their mean, times this (Kerbl et al., gsplat)."""
MIN_EXTENT_M = 1.0
"""For a vehicle at standstill with one camera, whose extent would be zero."""
ACTOR_EXTENT = (0.75, 0.75, 0.5)
"""An actor's extent: the largest of length, width and height, times these (the code of Street Gaussians)."""


def timetable(config: PerSceneConfig, views: int) -> DensityConfig:
    """Density control for a run of ``config.iterations``, all times scaled alike (gsplat's ``steps_scaler``).

    But all ``views`` are seen between two growths, however short the run: a mean over fewer would grow nearly all.
    """
    part, table = config.iterations / PUBLISHED_ITERATIONS, config.density
    times = {"start": round(part * table.start), "stop": round(part * table.stop)}
    steps = {"every": max(views, round(part * table.every)), "reset_every": max(1, round(part * table.reset_every))}
    return table.model_copy(update=times | steps)


def node_extents(scene: SceneGraph, source: Sequence[Target]) -> Tensor:
    """Metres [2 + actors], by node: of the cameras for the static and the distant, of its box for an actor."""
    positions = np.stack([t.chunk_SE3_camera[:3, 3] for t in source])
    reach = float(np.linalg.norm(positions - positions.mean(0), axis=1).max())
    extents = [max(CAMERA_MARGIN * reach, MIN_EXTENT_M)] * FIRST_ACTOR
    extents += [max(k * side for k, side in zip(ACTOR_EXTENT, a.size_m, strict=True)) for a in scene.actors]
    return torch.tensor(extents, dtype=torch.float32)


def world_static(scene: SceneGraph) -> SceneGraph:
    """The scene without motion: each actor's Gaussians stay where it is in the middle frame of its path.

    The distant region stays a node of its own.
    """
    parts = [scene.gaussians]
    where = torch.zeros(len(scene), dtype=torch.long)
    for k, actor in enumerate(scene.actors):
        parts.append(scene.at(int(actor.frames[len(actor.frames) // 2])))
        where[scene.nodes == FIRST_ACTOR + k] = k + 1
    rows = torch.arange(len(scene))
    placed = {f.name: torch.stack([getattr(p, f.name) for p in parts])[where, rows] for f in fields(Gaussians)}
    nodes = torch.where(scene.nodes == DISTANT, DISTANT, STATIC)
    return replace(scene, gaussians=Gaussians(**placed), nodes=nodes, actors=())
