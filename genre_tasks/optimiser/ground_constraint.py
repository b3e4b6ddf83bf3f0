"""Keeps what LiDAR measured as ground on the ground: steps move its discs along their plane and turn them within it.

Cameras see a road at a grazing angle from one height, so its depth is what images constrain least and LiDAR most. An
unconstrained optimiser paints lane markings with discs that stand above the road, tilted towards the recorded cameras.
That looks right on the path and smears three metres beside it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from genre_tasks.render.surface import compute_normals
from genre_tasks.scene.graph import STATIC, SceneGraph
from genre_tasks.scene.rotations import multiply_quats

MIN_UPRIGHT = 0.9
"""Least cosine between a disc's normal and the vertical for it to count as lying: slopes up to 26 degrees."""

MAX_FLATNESS = 0.5
"""A disc is flat if its shortest side is less than this fraction of its middle one."""


def compute_ground_constraint(scene: SceneGraph) -> Tensor:
    """Finds the Gaussians that lie on the ground, and the plane in which each may move.

    These are static discs that are flat and lie, the roof of a parked car too, since LiDAR measured it as well.

    Args:
        scene: at the start of an optimisation.

    Returns:
        [N, 11] per Gaussian: its normal [3], its unit quaternion q [4], and q after half a turn within the plane [4].
        A quaternion plus any mix of the last two keeps the disc in its plane. 0 for Gaussians off the ground.
    """
    splats = scene.gaussians.activate()
    normals = compute_normals(splats)
    sides = splats.scales
    # z is up in chunk coordinates. A disc has two faces, and it is chance which of them its normal belongs to.
    is_ground = (scene.nodes == STATIC) & (normals[:, 2].abs() >= MIN_UPRIGHT)
    is_ground &= sides.min(1).values < MAX_FLATNESS * sides.median(1).values
    quats = torch.nn.functional.normalize(splats.quats, dim=1)
    # (0, n) q is the direction in which q changes while the disc turns about its normal n.
    half_turns = torch.cat([torch.zeros_like(normals[:, :1]), normals], 1)
    turned_quats = multiply_quats(half_turns, quats)
    constraint = torch.cat([normals, quats, turned_quats], 1)
    return torch.where(is_ground[:, None], constraint, torch.zeros_like(normals[:, :1]))


def project_onto_ground(delta: Tensor, constraint: Tensor) -> Tensor:
    """Removes from a step what would lead out of the ground's planes.

    Args:
        delta: [N, 14] step in the packed attributes.
        constraint: [N, 11] of :func:`compute_ground_constraint`.

    Returns:
        [N, 14]; rows off the ground as they were. Differentiable in ``delta``.

    >>> up = torch.tensor([[0.0, 0, 1, 1, 0, 0, 0, 0, 0, 0, 1]])
    >>> project_onto_ground(torch.ones(1, 14), up)[0, :10].tolist()
    [1.0, 1.0, 0.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 1.0]
    """
    means = delta[:, :3]
    quats = delta[:, 6:10]
    normals = constraint[:, :3]
    unit_quats = constraint[:, 3:7]
    turned_quats = constraint[:, 7:]
    means = means - normals * (normals * means).sum(1, keepdim=True)
    # Along q itself only the quaternion's length changes, which the renderer divides out again.
    # Any direction but these two would tilt the disc out of its plane.
    lengthening = unit_quats * (unit_quats * quats).sum(1, keepdim=True)
    turning = turned_quats * (turned_quats * quats).sum(1, keepdim=True)
    # Off the ground the projection would be 0, not the step; the means need no choice, since the normal is 0.
    quats = torch.where((constraint != 0).any(1, keepdim=True), lengthening + turning, quats)
    return torch.cat([means, delta[:, 3:6], quats, delta[:, 10:]], 1)
