"""The side of an actor that no camera saw, as a mirror image of the one that cameras saw.

Vehicles are symmetric but for their writing. An actor that is turned around or inserted shows a side for which there is
no evidence at all; what optimisation left there are Gaussians that no image constrained. Front and rear are no mirror
images of one another: where only the rear was seen, the front stays as bad as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.chunk import View
from genre_tasks.scene.gaussians import Gaussians, map_attributes
from genre_tasks.scene.transforms import invert_se3
from genre_tasks.scene_edits.actor_parts import ActorPart

UNSEEN_FRACTION = 0.1
"""A side is mirrored where cameras saw it less than this, in proportion to the other side."""

# Spherical harmonics that are odd in y, in the order of scene.spherical_harmonics.
_ODD_IN_Y = (0, 3, 4, 8, 9, 10)


def complete_by_symmetry(part: ActorPart, node: ActorNode, views: Sequence[View]) -> ActorPart:
    """Replaces the half of an actor that no camera saw by the mirrored other half.

    Args:
        part: the actor. One that deforms is returned as it is: who walks is not symmetric.
        node: its path.
        views: recorded images of the chunk, in whose coordinates the path is.

    Returns:
        The completed actor; the same object where both sides were seen, or neither.
    """
    left, right = measure_side_views(node, views)
    if part.deformation is not None or min(left, right) >= UNSEEN_FRACTION * max(left, right):
        return part
    side = 1.0 if left > right else -1.0
    rows = torch.nonzero(part.gaussians.means[:, 1] * side >= 0)[:, 0]
    seen = map_attributes(lambda x: x.index_select(0, rows), part.gaussians)
    harmonics = part.spherical_harmonics
    if harmonics is not None:
        seen_harmonics = harmonics.index_select(0, rows)
        harmonics = torch.cat([seen_harmonics, _mirror_harmonics(seen_harmonics)])
    gaussians = map_attributes(lambda a, b: torch.cat([a, b]), seen, _mirror(seen))
    return replace(part, gaussians=gaussians, spherical_harmonics=harmonics)


def measure_side_views(node: ActorNode, views: Sequence[View]) -> tuple[float, float]:
    """Measures how much cameras saw of the two sides of an actor.

    Args:
        node: its path.
        views: recorded images.

    Returns:
        For the left and the right side the sum over images of the cosine at which the side is seen, divided by the
        squared distance in metres.
    """
    sums = [0.0, 0.0]
    for view in views:
        index = np.flatnonzero(node.frames == view.frame)
        if not len(index):
            continue
        box_SE3_camera = invert_se3(node.chunk_SE3_box[index[0]]) @ view.chunk_SE3_camera
        centre = invert_se3(box_SE3_camera)[:3, 3]
        lens = view.lens
        u = centre[0] / max(centre[2], 1e-6) * lens.fx_px + lens.cx_px
        if centre[2] <= 0 or not 0 <= u <= lens.width_px:
            continue
        position = box_SE3_camera[:3, 3]
        # A side is seen from outside of its plane alone.
        outside = abs(position[1]) - node.size_m[1] / 2
        if outside > 0:
            distance = float(np.linalg.norm(position))
            sums[0 if position[1] > 0 else 1] += float(outside) / distance**3
    return sums[0], sums[1]


def _mirror(gaussians: Gaussians) -> Gaussians:
    # Across the plane y = 0 of the box: a rotation's axis is a pseudovector, so its other two components change sign.
    return replace(
        gaussians,
        means=gaussians.means * torch.tensor([1.0, -1.0, 1.0]),
        quats=gaussians.quats * torch.tensor([1.0, -1.0, 1.0, -1.0]),
    )


def _mirror_harmonics(harmonics: Tensor) -> Tensor:
    signs = torch.ones(harmonics.shape[1])
    signs[[k for k in _ODD_IN_Y if k < len(signs)]] = -1.0
    return harmonics * signs[:, None]
