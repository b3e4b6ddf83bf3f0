"""The distant region: a fixed number of Gaussians on a far shell, for the sky and what LiDAR did not reach."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from genre_tasks.logs.types import Float64
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.image_decoding import decode_pixels
from genre_tasks.scene.lens_distortion import rays_at
from genre_tasks.scene.projection import project, splat_depth
from genre_tasks.scene.visibility import Cloud

LOWEST_SINE = -0.08
"""The shell reaches this far below the horizon (5°): roads and hills that LiDAR does not reach."""

OPACITY = 0.8
OVERLAP = 0.7
"""Standard deviation per spacing of neighbours on the shell."""

SKY_FOOTPRINT_M = 0.15
"""Half the square that a LiDAR point hides: wider than in colouring, so that no near surface colours the sky."""

_SAMPLE_WIDTH_PX = 160
_PLAIN_SKY = (0.75, 0.8, 0.85)
"""If no pixel of any source view sees past the near points."""


def fibonacci_directions(count: int, lowest_sine: float = LOWEST_SINE) -> Float64:
    """Unit vectors [count, 3], evenly spread over the sphere above ``z = lowest_sine``."""
    n = np.arange(count) + 0.5
    z = 1.0 - (1.0 - lowest_sine) * n / count
    azimuth = np.pi * (1 + 5**0.5) * n
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z], 1)


def distant_region(chunk: Chunk, count: int, radius_m: float) -> Gaussians:
    """``count`` Gaussians on a shell about the path's centre, as large as their spacing, coloured by source views."""
    directions = fibonacci_directions(count)
    centre = chunk.chunk_SE3_ego[:, :3, 3].mean(0)
    spacing = radius_m * np.sqrt(2 * np.pi * (1 - LOWEST_SINE) / max(count, 1))
    means = torch.from_numpy((centre + radius_m * directions).astype(np.float32))
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1.0
    return Gaussians(
        means,
        torch.full((count, 3), float(np.log(OVERLAP * spacing))),
        quats,
        torch.full((count,), float(np.log(OPACITY / (1 - OPACITY)))),
        torch.from_numpy(_shell_colors(chunk, directions, centre, radius_m).astype(np.float32)),
    )


def _shell_colors(chunk: Chunk, directions: Float64, centre: Float64, radius_m: float) -> Float64:
    """Mean colour [N, 3] of the open pixels nearest to each direction; the nearest coloured neighbour's elsewhere."""
    from scipy.spatial import cKDTree

    if not len(directions):
        return np.zeros((0, 3))
    clouds = [Cloud(chunk.static.positions, chunk.static.frames)]
    tree = cKDTree(directions)
    total, weight = np.zeros((len(directions), 3)), np.zeros(len(directions))
    for view in chunk.of_role("source"):
        rays, colors = open_pixels(view, chunk, clouds[0])
        # Where the pixel's ray meets the shell: parallax over the path is small against the radius, but not nothing.
        hit = view.chunk_SE3_camera[:3, 3] - centre + radius_m * rays
        nearest = tree.query(hit / np.linalg.norm(hit, axis=1, keepdims=True))[1] if len(rays) else np.empty(0, int)
        weight += np.bincount(nearest, minlength=len(directions))
        for c in range(3):
            total[:, c] += np.bincount(nearest, colors[:, c], len(directions))
    seen = weight > 0
    if not seen.any():
        return np.broadcast_to(np.array(_PLAIN_SKY), (len(directions), 3)).copy()
    out = total / np.maximum(weight, 1)[:, None]
    out[~seen] = out[seen][cKDTree(directions[seen]).query(directions[~seen])[1]]
    return out


def open_pixels(view: View, chunk: Chunk, background: Cloud) -> tuple[Float64, Float64]:
    """Unit rays [M, 3] (chunk axes) and colours [M, 3] in [0, 1] of a view's pixels that see past all LiDAR points.

    Sampled at a width of 160 pixels. Only pixels above ``LOWEST_SINE`` count: below, the road would colour the shell.
    """
    lens = view.lens.of_width(_SAMPLE_WIDTH_PX)
    points = [background.positions]
    for actor in chunk.actors:
        at = np.flatnonzero(actor.frames == view.frame)
        if len(at):
            pose = actor.chunk_SE3_box[at[0]].astype(np.float32)
            points.append(actor.points.positions @ pose[:3, :3].T + pose[:3, 3])
    depth = splat_depth(project(np.concatenate(points), view.chunk_SE3_camera, lens), lens, SKY_FOOTPRINT_M)
    u, v = np.meshgrid(np.arange(lens.width_px) + 0.5, np.arange(lens.height_px) + 0.5)
    rays = np.stack([*rays_at(u, v, lens), np.ones_like(u)], -1)
    rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)) @ view.chunk_SE3_camera[:3, :3].T
    ok: NDArray[np.bool_] = np.isinf(depth) & (rays[..., 2] > LOWEST_SINE)
    colors = decode_pixels(view.image, lens.width_px, lens.height_px)
    return rays[ok], colors[ok].astype(np.float64) / 255.0
