"""The distant region: Gaussians on a far shell, for the sky and what LiDAR did not reach."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from genre_tasks.logs.types import Float64
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.image_decoding import decode_pixels
from genre_tasks.scene.lens_distortion import pixels_to_rays
from genre_tasks.scene.projection import project, splat_depth
from genre_tasks.scene.visibility import PointCloud

LOWEST_SINE = -0.08
"""The shell reaches this far below the horizon (5°): roads and hills that LiDAR does not reach."""

OPACITY = 0.8
OVERLAP = 0.7
"""Standard deviation per spacing of neighbours on the shell."""

SKY_FOOTPRINT_M = 0.15
"""Half the square that a LiDAR point hides: wider than in colouring, so that no near surface colours the sky."""

_SAMPLE_WIDTH_PX = 160
# If no pixel of any source view sees past the near points.
_DEFAULT_SKY = (0.75, 0.8, 0.85)


def fibonacci_directions(count: int, lowest_sine: float = LOWEST_SINE) -> Float64:
    """Spreads directions evenly over a sphere, without those that point far down.

    Args:
        count: how many.
        lowest_sine: least z of a direction.

    Returns:
        Unit vectors [count, 3], in falling order of z.

    >>> directions = fibonacci_directions(100, lowest_sine=0.0)
    >>> directions.shape, bool((directions[:, 2] > 0).all())
    ((100, 3), True)
    """
    n = np.arange(count) + 0.5
    z = 1.0 - (1.0 - lowest_sine) * n / count
    # Turned on by the golden angle from point to point, so that no two rows line up.
    azimuth = np.pi * (1 + 5**0.5) * n
    horizontal = np.sqrt(1 - z * z)
    return np.stack([horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), z], 1)


def build_distant_shell(chunk: Chunk, count: int, radius_m: float) -> Gaussians:
    """Places Gaussians on a shell about the middle of the path, coloured by what source views see past LiDAR.

    Args:
        chunk: whose source views colour the shell.
        count: number of Gaussians; each is as large as their spacing.
        radius_m: of the shell.

    Returns:
        ``count`` Gaussians in chunk coordinates.
    """
    directions = fibonacci_directions(count)
    centre = chunk.chunk_SE3_ego[:, :3, 3].mean(0)
    # The area of the shell, 2π (1 − lowest sine) r², for each Gaussian.
    spacing = radius_m * np.sqrt(2 * np.pi * (1 - LOWEST_SINE) / max(count, 1))
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1.0
    colors = _shell_colors(chunk, directions, centre, radius_m)
    return Gaussians(
        means=torch.from_numpy((centre + radius_m * directions).astype(np.float32)),
        log_scales=torch.full((count, 3), float(np.log(OVERLAP * spacing))),
        quats=quats,
        logit_opacities=torch.full((count,), float(np.log(OPACITY / (1 - OPACITY)))),
        colors=torch.from_numpy(colors.astype(np.float32)),
    )


def _shell_colors(chunk: Chunk, directions: Float64, centre: Float64, radius_m: float) -> Float64:
    # Mean colour [N, 3] of the sky pixels nearest to each direction; elsewhere the nearest coloured neighbour's.
    from scipy.spatial import cKDTree

    if not len(directions):
        return np.zeros((0, 3))
    background = PointCloud(chunk.static.positions, chunk.static.frames)
    tree = cKDTree(directions)
    total = np.zeros((len(directions), 3))
    weight = np.zeros(len(directions))
    for view in chunk.views_with_role("source"):
        rays, colors = find_sky_pixels(view, chunk, background)
        # Where the pixel's ray meets the shell: parallax over the path is small against the radius, but not nothing.
        hit = view.chunk_SE3_camera[:3, 3] - centre + radius_m * rays
        nearest = tree.query(hit / np.linalg.norm(hit, axis=1, keepdims=True))[1] if len(rays) else np.empty(0, int)
        weight += np.bincount(nearest, minlength=len(directions))
        for c in range(3):
            total[:, c] += np.bincount(nearest, colors[:, c], len(directions))
    covered = weight > 0
    if not covered.any():
        return np.broadcast_to(np.array(_DEFAULT_SKY), (len(directions), 3)).copy()
    out = total / np.maximum(weight, 1)[:, None]
    # The sky changes slowly, so that a direction no camera looked at takes its neighbour's colour.
    out[~covered] = out[covered][cKDTree(directions[covered]).query(directions[~covered])[1]]
    return out


def find_sky_pixels(view: View, chunk: Chunk, background: PointCloud) -> tuple[Float64, Float64]:
    """Finds the pixels of a view that see past all LiDAR points.

    Pixels are those of the image at a width of 160. Only pixels above ``LOWEST_SINE`` count: below, the road would
    colour the shell.

    Args:
        view: a source view.
        chunk: whose actors hide the sky, too.
        background: the chunk's static points.

    Returns:
        Unit rays [M, 3] in chunk axes, and colours [M, 3] in [0, 1].
    """
    lens = view.lens.resized_to_width(_SAMPLE_WIDTH_PX)
    points = [background.positions]
    for actor in chunk.actors:
        index = np.flatnonzero(actor.frames == view.frame)
        if len(index):
            pose = actor.chunk_SE3_box[index[0]].astype(np.float32)
            points.append(actor.points.positions @ pose[:3, :3].T + pose[:3, 3])
    # Pixels without any point near them: LiDAR had no return from the sky.
    depth = splat_depth(project(np.concatenate(points), view.chunk_SE3_camera, lens), lens, SKY_FOOTPRINT_M)
    u, v = np.meshgrid(np.arange(lens.width_px) + 0.5, np.arange(lens.height_px) + 0.5)
    x, y = pixels_to_rays(u, v, lens)
    rays = np.stack([x, y, np.ones_like(u)], -1)
    rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)) @ view.chunk_SE3_camera[:3, :3].T
    sky: NDArray[np.bool_] = np.isinf(depth) & (rays[..., 2] > LOWEST_SINE)
    if view.ego_mask is not None:
        # LiDAR has no point on the recording vehicle either.
        rows = (np.arange(lens.height_px) + 0.5) * view.ego_mask.shape[0] / lens.height_px
        columns = (np.arange(lens.width_px) + 0.5) * view.ego_mask.shape[1] / lens.width_px
        sky &= ~view.ego_mask[np.ix_(rows.astype(np.int64), columns.astype(np.int64))]
    colors = decode_pixels(view.image, lens.width_px, lens.height_px)
    return rays[sky], colors[sky].astype(np.float64) / 255.0
