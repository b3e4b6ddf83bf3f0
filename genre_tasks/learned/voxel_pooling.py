"""Gaussians to voxels: the scene graph's nodes as one batch that do not touch (paper Sec. III-A, III-C)."""

from __future__ import annotations

import torch
from torch import Tensor

from genre_tasks.learned.sparse_conv import pack
from genre_tasks.learned.sparse_unet import VoxelPyramid
from genre_tasks.scene.graph import DISTANT, FIRST_ACTOR, SceneGraph

NEAR_M = 10.0
"""Within this distance of the cameras static voxels have the base width; it doubles with each doubling of distance, as
LiDAR points thin out."""
MAX_OCTAVE = 15
DISTANT_FACTOR = 2.0
ACTOR_FACTOR = 0.5
STATIC_BATCH, DISTANT_BATCH, ACTOR_BATCH = 0, 32, 64


def voxel_pyramid(scene: SceneGraph, centre: Tensor, width_m: float, levels: int) -> VoxelPyramid:
    """Voxels of ``width_m`` near ``centre`` [3] (the mean camera position), in octaves of distance from it.

    Static and distant Gaussians lie in chunk coordinates; each actor's in its box frame, where voxels are smaller.
    Moving scene and cameras by a multiple of the coarsest voxel changes nothing.
    """
    batch, width = octave_batches(scene, centre, width_m)
    coordinates = torch.floor(scene.gaussians.means.double() / width[:, None].double()).clamp(-1e9, 1e9).long()
    return VoxelPyramid.of(pack(batch, coordinates), levels)


def octave_batches(scene: SceneGraph, centre: Tensor, width_m: float) -> tuple[Tensor, Tensor]:
    """For each Gaussian its batch [N] int64 and its voxel's width [N] in metres."""
    distance = (scene.gaussians.means - centre).norm(dim=1)
    octave = torch.log2(distance.clamp_min(NEAR_M) / NEAR_M).floor().long().clamp(0, MAX_OCTAVE)
    actor = scene.nodes >= FIRST_ACTOR
    distant = scene.nodes == DISTANT
    batch = torch.where(distant, DISTANT_BATCH + octave, STATIC_BATCH + octave)
    batch = torch.where(actor, ACTOR_BATCH + scene.nodes - FIRST_ACTOR, batch)
    width = width_m * 2.0 ** octave.to(torch.float32) * torch.where(distant, DISTANT_FACTOR, 1.0)
    return batch, torch.where(actor, torch.full_like(width, width_m * ACTOR_FACTOR), width)
