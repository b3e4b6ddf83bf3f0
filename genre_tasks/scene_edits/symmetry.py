"""The faces of an actor that no camera saw, as mirror images of those that cameras saw.

An actor that is turned around or inserted shows faces for which there is no evidence at all; what optimisation left
there are Gaussians that no image constrained. Left and right sides of vehicles are mirror images but for their writing.
Front and rear are not, but a mirrored rear has the right outline and paint, which unconstrained Gaussians have not.
LiDAR points are mirrored about the same faces, so that simulated beams meet the surfaces that images show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.chunk import Points, View
from genre_tasks.scene.gaussians import Gaussians, map_attributes
from genre_tasks.scene.transforms import invert_se3
from genre_tasks.scene_edits.actor_parts import ActorPart

UNSEEN_FRACTION = 0.1
"""Cameras missed a face if they saw it less than this, in proportion to another one."""

# The front's share of a car's length that is hidden from behind: bonnet and windscreen.
MIRRORED_LENGTH = 0.25
"""Share of the length that is replaced at an end."""

# Spherical harmonics that are odd in x and in y, in the order of scene.spherical_harmonics.
_ODD_IN = ((2, 3, 6, 9, 12, 14), (0, 3, 4, 8, 9, 10))


@dataclass(frozen=True)
class _UnseenFace:
    # What lies farther than ``from_m`` from the box's middle is replaced by the mirrored other side. ``side`` is +1 or
    # −1: the end of the axis that was seen.
    axis: int
    side: float
    from_m: float


def complete_by_symmetry(part: ActorPart, node: ActorNode, views: Sequence[View]) -> ActorPart:
    """Replaces the faces of an actor that no camera saw by their mirrored opposites.

    Args:
        part: the actor. One that deforms is returned as it is: who walks is not symmetric.
        node: its path.
        views: recorded images of the chunk, in whose coordinates the path is.

    Returns:
        The completed actor; the same object where nothing is replaced. An end is replaced only where neither side was
        seen.
    """
    if part.deformation is not None:
        return part
    for face in _find_unseen_faces(node, views):
        part = _replace_face(part, face)
    return part


def complete_points_by_symmetry(points: Points, node: ActorNode, views: Sequence[View], *, deforms: bool) -> Points:
    """Replaces an actor's LiDAR points at the faces that no camera saw, as :func:`complete_by_symmetry` does Gaussians.

    Args:
        points: of the actor, in its box.
        node: its path.
        views: recorded images of the chunk, in whose coordinates the path is.
        deforms: whether the actor deforms, and so is left as it is.

    Returns:
        The completed points; the same object where nothing is replaced.
    """
    if deforms:
        return points
    for face in _find_unseen_faces(node, views):
        points = _replace_points(points, face)
    return points


def _find_unseen_faces(node: ActorNode, views: Sequence[View]) -> list[_UnseenFace]:
    # In the order in which they are replaced.
    faces = []
    front, rear = measure_face_views(node, views, axis=0)
    left, right = measure_face_views(node, views, axis=1)
    if min(left, right) < UNSEEN_FRACTION * max(left, right):
        faces.append(_UnseenFace(axis=1, side=1.0 if left > right else -1.0, from_m=0.0))
    # A side shows both ends in profile: what images constrained there is better than a mirrored end.
    if min(front, rear) + max(left, right) < UNSEEN_FRACTION * max(front, rear):
        from_m = (0.5 - MIRRORED_LENGTH) * node.size_m[0]
        faces.append(_UnseenFace(axis=0, side=1.0 if front > rear else -1.0, from_m=from_m))
    return faces


def measure_face_views(node: ActorNode, views: Sequence[View], axis: int) -> tuple[float, float]:
    """Measures how much cameras saw of two opposite faces of an actor.

    Args:
        node: its path.
        views: recorded images.
        axis: of the box: 0 for front and rear, 1 for the left and the right side.

    Returns:
        For the face at the axis's positive end and for the other one the sum over images of the cosine at which the
        face is seen, divided by the squared distance in metres.
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
        # A face is seen from outside of its plane alone.
        outside = abs(position[axis]) - node.size_m[axis] / 2
        if outside > 0:
            distance = float(np.linalg.norm(position))
            sums[0 if position[axis] > 0 else 1] += float(outside) / distance**3
    return sums[0], sums[1]


def _replace_face(part: ActorPart, face: _UnseenFace) -> ActorPart:
    position = part.gaussians.means[:, face.axis] * face.side
    kept = torch.nonzero(position >= -face.from_m)[:, 0]
    mirrored = torch.nonzero(position >= face.from_m)[:, 0]
    parts = (
        map_attributes(lambda x: x.index_select(0, kept), part.gaussians),
        _mirror(map_attributes(lambda x: x.index_select(0, mirrored), part.gaussians), face.axis),
    )
    harmonics = part.spherical_harmonics
    if harmonics is not None:
        signs = torch.ones(harmonics.shape[1])
        signs[[k for k in _ODD_IN[face.axis] if k < len(signs)]] = -1.0
        harmonics = torch.cat([harmonics[kept], harmonics[mirrored] * signs[:, None]])
    gaussians = map_attributes(lambda a, b: torch.cat([a, b]), *parts)
    return replace(part, gaussians=gaussians, spherical_harmonics=harmonics)


def _replace_points(points: Points, face: _UnseenFace) -> Points:
    position = points.positions[:, face.axis] * face.side
    mirrored = np.flatnonzero(position >= face.from_m)
    # LiDAR looks around farther than cameras: what it alone has measured is better than a hole.
    if not len(mirrored):
        return points
    kept = np.flatnonzero(position >= -face.from_m)
    flips = np.ones(3, np.float32)
    flips[face.axis] = -1.0
    rows = np.concatenate([kept, mirrored])
    return Points(
        positions=np.concatenate([points.positions[kept], points.positions[mirrored] * flips]),
        colors=points.colors[rows],
        colored=points.colored[rows],
        frames=points.frames[rows],
    )


def _mirror(gaussians: Gaussians, axis: int) -> Gaussians:
    flips = torch.ones(3)
    flips[axis] = -1.0
    # A rotation's axis is a pseudovector: the components along the mirror's plane change sign.
    return replace(
        gaussians,
        means=gaussians.means * flips,
        quats=gaussians.quats * torch.cat([torch.ones(1), -flips]),
    )
