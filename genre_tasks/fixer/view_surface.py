"""The surface that a view shows: one 3D point for each pixel, and the actor that it is on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from genre_tasks.logs.types import Float64, Lens
from genre_tasks.scene.chunk import Actor
from genre_tasks.scene.lens_distortion import pixels_to_rays

MIN_ALPHA = 0.5
"""A depth is trusted where at least half of the ray's light is accounted for."""

NO_ACTOR = -1

# Boxes are drawn tight; mirrors and wheels stick out.
_BOX_MARGIN = 1.1

# Which images see a surface, and how much of it, is known well enough from every eighth pixel.
_STRIDE = 8


@dataclass(frozen=True)
class Surface:
    """The points that a view's pixels show.

    Attributes:
        points: [..., 3] metres, chunk coordinates at the view's frame.
        known: [...] true where the depth is known.
        actor: [...] index of the actor that a point is on, ``NO_ACTOR`` for none.
    """

    points: Tensor
    known: Tensor
    actor: Tensor


def unproject_surface(
    depth: Tensor,  # [H, W]
    alpha: Tensor,  # [H, W]
    chunk_SE3_camera: Float64,  # [4, 4]
    lens: Lens,
    actors: Sequence[Actor],
    frame: int,
) -> Surface:
    """Finds the points that a view shows, from its depth.

    Args:
        depth: metres along the camera's axis, not premultiplied.
        alpha: a depth is known where it is at least ``MIN_ALPHA``.
        chunk_SE3_camera: pose of the view.
        lens: of the view, distortion included.
        actors: of the chunk.
        frame: of the view, at which the actors' boxes count.

    Returns:
        The surface, [H, W].
    """
    height, width = depth.shape
    known = torch.isfinite(depth) & (depth > 0) & (alpha >= MIN_ALPHA)
    # Unknown depths could be NaN or infinite: 1 m stands in, and ``known`` tells them apart.
    z = torch.where(known, depth, torch.ones_like(depth))
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    if any(lens.distortion):
        # Undistorting iterates, in float64 as the lens's inverse does elsewhere.
        x, y = (torch.from_numpy(ray).to(z) * z for ray in pixels_to_rays(u.double().numpy(), v.double().numpy(), lens))
    else:
        x = (u.to(z) - lens.cx_px) / lens.fx_px * z
        y = (v.to(z) - lens.cy_px) / lens.fy_px * z
    points = move_points(torch.stack([x, y, z], -1), chunk_SE3_camera)
    return Surface(points, known, _find_actors(points, known, actors, frame))


def move_points(points: Tensor, transform: NDArray[np.floating[Any]]) -> Tensor:
    """Applies a rigid transform to points.

    Args:
        points: [..., 3].
        transform: [4, 4].

    Returns:
        [..., 3] of the points' dtype.

    >>> shift = np.eye(4)
    >>> shift[:3, 3] = 1, 2, 3
    >>> move_points(torch.zeros(1, 3), shift).tolist()
    [[1.0, 2.0, 3.0]]
    """
    matrix = torch.as_tensor(transform).to(points)
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def surface_at_frame(surface: Surface, actors: Sequence[Actor], frame: int, other_frame: int) -> tuple[Tensor, Tensor]:
    """Moves the points on actors to where they are at another frame.

    Args:
        surface: at ``frame``.
        actors: of the chunk.
        frame: of the log.
        other_frame: of the log.

    Returns:
        Points [..., 3] at ``other_frame``, and [...] true where they are known and exist then.
    """
    points = surface.points
    exists = surface.known
    if other_frame == frame:
        return points, exists
    for k in torch.unique(surface.actor).tolist():
        if k == NO_ACTOR:
            continue
        on_actor = surface.actor == k
        pose = _pose_at_frame(actors[k], frame)
        other_pose = _pose_at_frame(actors[k], other_frame)
        if pose is None or other_pose is None:
            # An actor that is absent at either frame has no place where its points could be looked up.
            exists = exists & ~on_actor
            continue
        points = points.clone()
        points[on_actor] = move_points(points[on_actor], other_pose @ np.linalg.inv(pose))
    return points, exists


def subsample_surface(surface: Surface) -> Surface:
    """Takes every eighth pixel of a surface.

    Args:
        surface: [H, W].

    Returns:
        The coarse surface, see :func:`subsample`.
    """
    return Surface(subsample(surface.points), subsample(surface.known), subsample(surface.actor))


def subsample(image: Tensor) -> Tensor:
    """Takes every eighth pixel, from the middle of its block.

    Args:
        image: [H, W, …].

    Returns:
        [H / 8, W / 8, …]; the middle row and column of an image that is smaller than a block.

    >>> subsample(torch.arange(16)[None]).tolist()
    [[4, 12]]
    """
    rows, columns = (slice(min(_STRIDE, size) // 2, None, _STRIDE) for size in image.shape[:2])
    return image[rows, columns]


def _pose_at_frame(actor: Actor, frame: int) -> Float64 | None:
    index = np.flatnonzero(actor.frames == frame)
    return actor.chunk_SE3_box[index[0]] if len(index) else None


def _find_actors(points: Tensor, known: Tensor, actors: Sequence[Actor], frame: int) -> Tensor:
    """[...] the actor whose box at ``frame`` holds the point, ``NO_ACTOR`` for none."""
    found = torch.full(known.shape, NO_ACTOR)
    for k, actor in enumerate(actors):
        pose = _pose_at_frame(actor, frame)
        if pose is None:
            continue
        half_size = torch.tensor(actor.size_m).to(points) / 2 * _BOX_MARGIN
        center = torch.as_tensor(pose[:3, 3]).to(points)
        # A cheap test first: few pixels are anywhere near a box.
        near = known & ((points - center).abs().amax(-1) < half_size.norm())
        if bool(near.any()):
            in_box = move_points(points[near], np.linalg.inv(pose))
            found[near] = torch.where((in_box.abs() < half_size).all(-1), torch.tensor(k), found[near])
    return found
