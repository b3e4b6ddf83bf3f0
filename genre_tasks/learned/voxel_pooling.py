"""Gaussians to voxels: the scene graph's nodes as one batch that do not touch (paper Sec. III-A, III-C)."""

from __future__ import annotations

import torch
from torch import Tensor

from genre_tasks.learned.sparse_conv import pack_keys
from genre_tasks.learned.sparse_unet import VoxelPyramid
from genre_tasks.scene.graph import DISTANT, FIRST_ACTOR, SceneGraph

NEAR_M = 10.0
"""Within this distance of the cameras static voxels have the base width. It doubles with each doubling of distance, as
LiDAR points thin out."""

MAX_OCTAVE = 15
"""Voxels do not grow beyond this octave of distance: 330 km."""

DISTANT_FACTOR = 2.0
"""Voxels of the distant region are wider than static ones by this factor."""

ACTOR_FACTOR = 0.5
"""Voxels of actors are narrower than the nearest static ones by this factor, since vehicles are small."""

STATIC_BATCH = 0
DISTANT_BATCH = 32
ACTOR_BATCH = 64
"""First batch number of each kind of node; an octave of distance or an actor is one batch."""


def build_voxel_pyramid(scene: SceneGraph, centre: Tensor, width_m: float, levels: int) -> VoxelPyramid:
    """Sorts a scene's Gaussians into voxels, in octaves of distance from the cameras.

    Static and distant Gaussians lie in chunk coordinates. Each actor's lie in its box frame, where voxels are smaller.
    Moving scene and cameras together by a multiple of the coarsest voxel changes nothing.

    Args:
        scene: N Gaussians.
        centre: [3] the mean camera position in chunk coordinates, metres.
        width_m: width of a static voxel near the cameras.
        levels: number of levels; each has voxels twice as wide as the one before.

    Returns:
        The voxels of all levels and their neighbourhoods.
    """
    batch, width = assign_batches(scene, centre, width_m)
    # In float64, so that a Gaussian far from the origin does not change its voxel by rounding.
    coordinates = torch.floor(scene.gaussians.means.double() / width[:, None].double()).clamp(-1e9, 1e9).long()
    return VoxelPyramid.from_keys(pack_keys(batch, coordinates), levels)


def assign_batches(scene: SceneGraph, centre: Tensor, width_m: float) -> tuple[Tensor, Tensor]:
    """Chooses the batch and the voxel width of every Gaussian; voxels of different batches never touch.

    Args:
        scene: N Gaussians.
        centre: [3] the mean camera position in chunk coordinates, metres.
        width_m: width of a static voxel near the cameras.

    Returns:
        Batch numbers [N] int64, and widths [N] in metres.
    """
    distance = (scene.gaussians.means - centre).norm(dim=1)
    octave = torch.log2(distance.clamp_min(NEAR_M) / NEAR_M).floor().long().clamp(0, MAX_OCTAVE)
    actor = scene.nodes >= FIRST_ACTOR
    distant = scene.nodes == DISTANT
    # Each octave is a batch of its own, since voxels of two widths have no common grid.
    batch = torch.where(distant, DISTANT_BATCH + octave, STATIC_BATCH + octave)
    batch = torch.where(actor, ACTOR_BATCH + scene.nodes - FIRST_ACTOR, batch)
    width = width_m * 2.0 ** octave.to(torch.float32) * torch.where(distant, DISTANT_FACTOR, 1.0)
    # An actor moves: its distance at one moment must not choose its voxels.
    return batch, torch.where(actor, torch.full_like(width, width_m * ACTOR_FACTOR), width)
