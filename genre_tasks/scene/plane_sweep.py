"""Depth maps of images from other images of the same scene: plane sweep, then semi-global matching.

The image is compared with its neighbours as if all of it lay at one depth, depth after depth (Collins 1996). Each
pixel then takes the depth at which the images agree and which its neighbours in the image share (Hirschmüller 2008).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from genre_tasks.logs.brown_conrady import distort
from genre_tasks.logs.types import Float32, Float64, Lens
from genre_tasks.scene.chunk import View
from genre_tasks.scene.image_decoding import decode_pixels
from genre_tasks.scene.lens_distortion import pixels_to_rays
from genre_tasks.scene.transforms import invert_se3
from genre_tasks.srgb import LUMA_WEIGHTS

NEAREST_M = 4.0
"""Nearest depth that is tried; LiDAR sees what is nearer."""

FARTHEST_M = 200.0
"""Farthest depth that is tried: it stands for everything without parallax."""

DEPTH_COUNT = 64
"""Depths that are tried, evenly spaced in inverse depth, as parallax is."""

WINDOW_PX = 5
"""Side of the square in which two images are compared."""

# Added to the variance of a window: without texture, noise would decide.
_VARIANCE_FLOOR = 1e-5
# Cost of a pixel that no neighbour sees: as if nothing could be said of it.
_UNKNOWN_COST = 1.0
_MOST_COST = 1.5
_NOT_SEEN = 9.0
# Penalties of semi-global matching, in units of the cost: of one step in depth, and of a jump.
_STEP_PENALTY = 0.15
_JUMP_PENALTY = 0.6
_LEAST_JUMP_PENALTY = 1.5 * _STEP_PENALTY
# A jump of depth is cheaper where brightness jumps: both do at the edge of a thing.
_EDGE_WEIGHT = 10.0
_LEAST_DEPTH_M = 0.5


@dataclass(frozen=True)
class SweepImage:
    """An image prepared for comparison with others.

    Attributes:
        lens: at the size of the images compared.
        chunk_SE3_camera: [4, 4].
        luma: [H, W] brightness in [0, 1].
        contrast: [H, W] standard deviation of the brightness within the window around a pixel.
        normalised: [H, W] brightness without the mean and contrast of its window, so that exposure does not matter.
    """

    lens: Lens
    chunk_SE3_camera: Float64
    luma: Tensor
    contrast: Tensor
    normalised: Tensor

    @staticmethod
    def from_view(view: View, width_px: int) -> SweepImage:
        """Decodes a view's image.

        Args:
            view: of a chunk.
            width_px: width at which images are compared.

        Returns:
            The image.

        Raises:
            InputError: the image cannot be decoded.
        """
        lens = view.lens.resized_to_width(width_px)
        pixels = decode_pixels(view.image, lens.width_px, lens.height_px)
        luma = torch.from_numpy(pixels.astype(np.float32) / np.float32(255)) @ torch.tensor(LUMA_WEIGHTS)
        mean = _window_mean(luma[None])[0]
        variance = _window_mean((luma * luma)[None])[0] - mean * mean
        contrast = (variance.clamp_min(0) + _VARIANCE_FLOOR).sqrt()
        return SweepImage(lens, view.chunk_SE3_camera, luma, contrast, (luma - mean) / contrast)


def compute_depth_map(reference: SweepImage, neighbours: Sequence[SweepImage]) -> Float32:
    """Estimates the depth of every pixel of an image.

    Args:
        reference: the image.
        neighbours: images from other places that see some of the same; at least one.

    Returns:
        [H, W] metres along the camera's axis, from ``NEAREST_M`` to ``FARTHEST_M``. Where nothing tells the depth it
        follows from the pixels around.
    """
    inverse_depths = np.linspace(1 / NEAREST_M, 1 / FARTHEST_M, DEPTH_COUNT)
    cost = _sweep(reference, neighbours, inverse_depths)
    total = _aggregate(np.ascontiguousarray(cost.permute(1, 2, 0).numpy()), reference.luma.numpy())
    return _interpolate_minimum(total, inverse_depths)


def unproject_pixels(lens: Lens) -> Float64:
    """Finds the rays of all pixel centres.

    Args:
        lens: of H × W pixels; its distortion is undone.

    Returns:
        [H, W, 3] in camera axes, with z = 1.
    """
    u, v = np.meshgrid(np.arange(lens.width_px) + 0.5, np.arange(lens.height_px) + 0.5)
    x, y = pixels_to_rays(u, v, lens)
    return np.stack([x, y, np.ones_like(x)], -1)


def _sweep(reference: SweepImage, neighbours: Sequence[SweepImage], inverse_depths: Float64) -> Tensor:
    """Compares an image with its neighbours at every depth: cost [D, H, W], 0 where they are alike."""
    rays = torch.from_numpy(unproject_pixels(reference.lens).astype(np.float32))
    depth = torch.from_numpy((1 / inverse_depths).astype(np.float32))[:, None, None]
    costs = torch.stack([_compare(reference, neighbour, rays, depth) for neighbour in neighbours])
    is_seen = costs < _NOT_SEEN
    seen_count = is_seen.sum(0)
    # The better half of the neighbours: in the others something else may hide the surface.
    half = (seen_count + 1) // 2
    sums = costs.sort(0).values.cumsum(0)
    mean = torch.gather(sums, 0, (half - 1).clamp_min(0)[None])[0] / half.clamp_min(1)
    return torch.where(seen_count > 0, mean, _UNKNOWN_COST)


def _compare(reference: SweepImage, neighbour: SweepImage, rays: Tensor, depth: Tensor) -> Tensor:
    """1 less the correlation of two images, [D, H, W]; ``_NOT_SEEN`` where the neighbour does not see the pixel."""
    neighbour_SE3_reference = invert_se3(neighbour.chunk_SE3_camera) @ reference.chunk_SE3_camera
    pose = torch.from_numpy(neighbour_SE3_reference.astype(np.float32))
    # Turned once and scaled by each depth, rather than the other way round.
    turned = rays @ pose[:3, :3].T
    x, y, z = (turned[..., k] * depth + pose[k, 3] for k in range(3))
    x, y = x / z, y / z
    lens = neighbour.lens
    if any(lens.distortion):
        x, y = distort(x, y, lens.coefficients)
    # Pixels as ``grid_sample`` counts them: −1 and 1 are the image's edges.
    u = (x * lens.fx_px + lens.cx_px) * (2 / lens.width_px) - 1
    v = (y * lens.fy_px + lens.cy_px) * (2 / lens.height_px) - 1
    is_seen = (z > _LEAST_DEPTH_M) & (u.abs() < 1) & (v.abs() < 1)
    image = neighbour.normalised[None, None].expand(len(depth), 1, -1, -1)
    grid = torch.stack([u, v], -1)
    warped = functional.grid_sample(image, grid, padding_mode="border", align_corners=False)[:, 0]
    cost = 1 - _window_mean(reference.normalised * warped)
    return torch.where(is_seen, cost.clamp(0, _MOST_COST), _NOT_SEEN)


def _window_mean(images: Tensor) -> Tensor:
    """Mean of images [N, H, W] over the window around each pixel, smaller at the edges."""
    padding = WINDOW_PX // 2
    return functional.avg_pool2d(images[:, None], WINDOW_PX, 1, padding, count_include_pad=False)[:, 0]


def _aggregate(cost: Float32, luma: Float32) -> Float32:
    """Sums the cost [H, W, D] of the best paths that end in a pixel, from left, right, above and below."""
    total = np.zeros_like(cost)
    for axis in (0, 1):
        lines = cost.swapaxes(0, 1) if axis else cost
        brightness = luma.T if axis else luma
        # Backwards as well: a view into the same arrays, so that sums land where they belong.
        for step in (1, -1):
            total_lines = total.swapaxes(0, 1) if axis else total
            _add_path_costs(lines[::step], brightness[::step], total_lines[::step])
    return total


def _add_path_costs(cost: Float32, luma: Float32, total: Float32) -> None:
    """Adds to ``total`` [L, M, D] the cost of the best path along L to each of M lines' pixels."""
    path = cost[0]
    total[0] += path
    padded = np.full((path.shape[0], path.shape[1] + 2), np.inf, np.float32)
    for k in range(1, len(cost)):
        edge = 1 + _EDGE_WEIGHT * np.abs(luma[k] - luma[k - 1])
        jump = np.maximum(_JUMP_PENALTY / edge, _LEAST_JUMP_PENALTY)[:, None]
        least = path.min(1, keepdims=True)
        padded[:, 1:-1] = path
        step = np.minimum(padded[:, 2:], padded[:, :-2]) + np.float32(_STEP_PENALTY)
        # The least of the path before is taken away, or its costs would grow along the line without bound.
        path = cost[k] + np.minimum(np.minimum(path, step), least + jump.astype(np.float32)) - least
        total[k] += path


def _interpolate_minimum(cost: Float32, inverse_depths: Float64) -> Float32:
    """Depth [H, W] of the least cost, between the depths that were tried by a parabola through three of them."""
    best = cost.argmin(-1)
    middle = best.clip(1, len(inverse_depths) - 2)

    def cost_at(index: NDArray[np.int64]) -> Float64:
        return np.take_along_axis(cost, index[..., None], -1)[..., 0].astype(np.float64)

    before, at, after = cost_at(middle - 1), cost_at(middle), cost_at(middle + 1)
    offset = (0.5 * (before - after) / np.maximum(before - 2 * at + after, 1e-6)).clip(-0.5, 0.5)
    # At the nearest and farthest depth there is no parabola.
    position = np.where(best == middle, middle + offset, best)
    inverse = np.interp(position, np.arange(len(inverse_depths)), inverse_depths)
    return (1 / inverse).astype(np.float32)
