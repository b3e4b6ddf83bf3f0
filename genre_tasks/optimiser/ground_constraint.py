"""What LiDAR measured as ground stays on it: a step moves its discs along their plane and turns them within it.

Seen at a grazing angle from one height, a road's depth is what images say least about, and LiDAR most: left free, the
optimiser paints markings with discs that stand above the road, tilted towards the recorded cameras. On the path that
looks right, three metres beside it they smear.
"""

from __future__ import annotations

import torch
from torch import Tensor

from genre_tasks.render.surface import normals
from genre_tasks.scene.graph import STATIC, SceneGraph
from genre_tasks.scene.transforms import quat_multiply

MIN_UPRIGHT = 0.9
"""Cosine between a disc's normal and up, from which on it lies: slopes up to 26 degrees."""

FLAT = 0.5
"""A disc's shortest side, per its middle one, below which it is flat."""


def ground_planes(scene: SceneGraph) -> Tensor:
    """[N, 11]: the normal, the unit quaternion, and the same turned by half a turn in the plane; 0 off the ground.

    A quaternion plus any mix of the latter two has the disc in its plane still. Flat static Gaussians that lie are
    ground, a parked car's roof too: LiDAR measured that as well.
    """
    splats = scene.gaussians.activated()
    across = normals(splats)
    sides = splats.scales
    lies = (scene.nodes == STATIC) & (across[:, 2].abs() >= MIN_UPRIGHT)
    lies &= sides.min(1).values < FLAT * sides.median(1).values
    own = torch.nn.functional.normalize(splats.quats, dim=1)
    turned = quat_multiply(torch.cat([torch.zeros_like(across[:, :1]), across], 1), own)
    return torch.where(lies[:, None], torch.cat([across, own, turned], 1), torch.zeros_like(across[:, :1]))


def along_ground(delta: Tensor, planes: Tensor) -> Tensor:
    """``delta`` [N, 14] of the packed attributes without what leads out of the planes [N, 11]."""
    means, quats = delta[:, :3], delta[:, 6:10]
    normal, own, turned = planes[:, :3], planes[:, 3:7], planes[:, 7:]
    means = means - normal * (normal * means).sum(1, keepdim=True)
    within = own * (own * quats).sum(1, keepdim=True) + turned * (turned * quats).sum(1, keepdim=True)
    quats = torch.where((planes != 0).any(1, keepdim=True), within, quats)
    return torch.cat([means, delta[:, 3:6], quats, delta[:, 10:]], 1)
