"""What a per-scene training starts from: the schedule of density control, extents of nodes, a scene without motion."""

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
"""Length of the run that the published schedule of density control is for (Kerbl et al. 2023)."""

CAMERA_MARGIN = 1.1
"""The scene's extent is the farthest camera's distance from the cameras' mean, times this (Kerbl et al., gsplat)."""

MIN_EXTENT_M = 1.0
"""For a vehicle at standstill with one camera, whose extent would be zero."""

ACTOR_EXTENT = (0.75, 0.75, 0.5)
"""An actor's extent is the largest of length, width and height times these (the code of Street Gaussians)."""


def scale_density_schedule(config: PerSceneConfig, views: int) -> DensityConfig:
    """Scales the published schedule of density control to the length of a run, as gsplat's ``steps_scaler`` does.

    However short the run is, it renders all views between two densifications. A mean over fewer views would densify
    nearly everything.

    Args:
        config: length of the run, and the schedule for the published length.
        views: number of views.

    Returns:
        The schedule in iterations of this run; thresholds are left alone.

    >>> scale_density_schedule(PerSceneConfig(iterations=3000), views=15).every
    15
    """
    scale = config.iterations / PUBLISHED_ITERATIONS
    published = config.density
    # Thresholds stay as they are: they do not depend on the length of the run.
    return published.model_copy(
        update={
            "start": round(scale * published.start),
            "stop": round(scale * published.stop),
            "every": max(views, round(scale * published.every)),
            "reset_every": max(1, round(scale * published.reset_every)),
        }
    )


def measure_node_extents(scene: SceneGraph, source: Sequence[Target]) -> Tensor:
    """Measures the length that sizes and steps are relative to, for every node of a scene.

    Args:
        scene: the scene graph with its actors.
        source: the supervised views.

    Returns:
        [2 + actors] metres: of the cameras for the static and the distant node, of the box for each actor.
    """
    positions = np.stack([target.chunk_SE3_camera[:3, 3] for target in source])
    reach_m = float(np.linalg.norm(positions - positions.mean(0), axis=1).max())
    # Both nodes that do not move, static and distant, have the cameras' extent.
    extents = [max(CAMERA_MARGIN * reach_m, MIN_EXTENT_M)] * FIRST_ACTOR
    for actor in scene.actors:
        extents.append(max(factor * side for factor, side in zip(ACTOR_EXTENT, actor.size_m, strict=True)))
    return torch.tensor(extents, dtype=torch.float32)


def freeze_actors(scene: SceneGraph) -> SceneGraph:
    """Takes the motion out of a scene: each actor stays where it is in the middle frame of its path.

    Args:
        scene: the scene graph with its actors.

    Returns:
        A scene without actors, whose Gaussians belong to the static node; the distant node stays.
    """
    # Every pose of the scene has all Gaussians; each row is then taken from the pose of its actor.
    poses = [scene.gaussians]
    pose_of = torch.zeros(len(scene), dtype=torch.long)
    for k, actor in enumerate(scene.actors):
        # The middle frame, from which an actor is never farther than half its path.
        poses.append(scene.gaussians_at(int(actor.frames[len(actor.frames) // 2])))
        pose_of[scene.nodes == FIRST_ACTOR + k] = k + 1
    rows = torch.arange(len(scene))
    frozen = {f.name: torch.stack([getattr(pose, f.name) for pose in poses])[pose_of, rows] for f in fields(Gaussians)}
    nodes = torch.where(scene.nodes == DISTANT, DISTANT, STATIC)
    return replace(scene, gaussians=Gaussians(**frozen), nodes=nodes, actors=())
