"""The image terms of the rendering loss as a compiled kernel: about a tenth of what they cost in torch.

``view_loss`` of :mod:`genre_tasks.losses.rendering_loss` defines the terms and is this kernel's oracle.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from genre_tasks.compiled.loader import load
from genre_tasks.config import LossConfig
from genre_tasks.errors import ResourceError
from genre_tasks.losses.build_image_loss import KERNEL
from genre_tasks.losses.targets import Target


@dataclass(frozen=True)
class ImageLoss:
    """Of V views: their losses, weights included, and the gradients of the sum of them.

    ``losses`` [V] float64; ``by_color`` [V, H, W, 3] and ``by_depth`` [V, H, W] float32.
    """

    losses: Tensor
    by_color: Tensor
    by_depth: Tensor


@cache
def load_image_loss(folder: Path = KERNEL.folder) -> ctypes.CDLL:
    """The kernel with its argument types declared, loaded once.

    Raises ``ResourceError`` and ``ConfigError`` as :func:`genre_tasks.compiled.loader.load`.
    """
    library = load(KERNEL, folder)
    p, i, d = ctypes.c_void_p, ctypes.c_int, ctypes.c_double
    library.genre_image_loss.argtypes = [i, i, i, *[p] * 7, d, d, d, i, p, p, p]
    return library


def takes(color: Tensor, depth: Tensor, targets: Sequence[Target]) -> bool:
    """Whether the kernel is made for these tensors: all float32 on the CPU."""
    used = [color, depth, *(x for t in targets for x in (t.image.image, t.image.mean, t.image.variance))]
    used += [t.depth for t in targets if t.depth is not None]
    return all(x.device.type == "cpu" and x.dtype == torch.float32 for x in used)


def image_loss(
    config: LossConfig,
    color: Tensor,  # [V, H, W, 3]
    depth: Tensor,  # [V, H, W] metres, 0 where nothing was rendered
    targets: Sequence[Target],
    weights: Sequence[float],
) -> ImageLoss:
    """Weighted sums of each view's terms except for the perceptual one, and their gradients; float32 on the CPU.

    Each view is computed by one thread, ``torch.get_num_threads()`` of them side by side: the bits do not depend on it.

    Raises:
        ValueError: shapes or numbers of views do not fit, or tensors are of another kind.
        ResourceError: the kernel is not compiled, or memory is short.
    """
    _check(color, depth, targets, weights)
    views, height, width = depth.shape
    color, depth = color.detach().contiguous(), depth.detach().contiguous()
    images, means, variances, sparse = (
        [None if x is None else x.contiguous() for x in column]
        for column in zip(*((t.image.image, t.image.mean, t.image.variance, t.depth) for t in targets), strict=True)
    )
    factors = torch.tensor(weights, dtype=torch.float64)
    terms = torch.empty(views, 3, dtype=torch.float64)
    by_color, by_depth = torch.empty_like(color), torch.empty_like(depth)
    status = load_image_loss().genre_image_loss(
        views,
        height,
        width,
        color.data_ptr(),
        depth.data_ptr(),
        _pointers(images),
        _pointers(means),
        _pointers(variances),
        _pointers(sparse),
        factors.data_ptr(),
        config.rgb,
        config.ssim,
        config.depth,
        torch.get_num_threads(),
        terms.data_ptr(),
        by_color.data_ptr(),
        by_depth.data_ptr(),
    )
    if status == 1:
        raise ResourceError("not enough memory for the image loss", remedy="Take fewer views or smaller images")
    if status:
        raise ResourceError(f"{KERNEL.title} failed", remedy="Report the images' size and the number of views")
    of_terms = torch.tensor([config.rgb, config.ssim, config.depth], dtype=torch.float64)
    return ImageLoss((terms * of_terms).sum(1) * factors, by_color, by_depth)


def _pointers(tensors: Sequence[Tensor | None]) -> ctypes.Array[ctypes.c_void_p]:
    return (ctypes.c_void_p * len(tensors))(*(None if t is None else t.data_ptr() for t in tensors))


def _check(color: Tensor, depth: Tensor, targets: Sequence[Target], weights: Sequence[float]) -> None:
    if color.ndim != 4 or color.shape[3] != 3 or depth.shape != color.shape[:3]:
        raise ValueError(
            f"expected colour [V, H, W, 3] and depth [V, H, W], got {tuple(color.shape)} and {tuple(depth.shape)}"
        )
    if not len(targets) == len(weights) == len(color):
        raise ValueError(f"expected {len(color)} targets and weights, got {len(targets)} and {len(weights)}")
    for t in targets:
        for name, x in (("image", t.image.image), ("mean", t.image.mean), ("variance", t.image.variance)):
            if x.shape != color.shape[1:]:
                raise ValueError(f"expected a target {name} of shape {tuple(color.shape[1:])}, got {tuple(x.shape)}")
        if t.depth is not None and t.depth.shape != depth.shape[1:]:
            raise ValueError(f"expected LiDAR depth of shape {tuple(depth.shape[1:])}, got {tuple(t.depth.shape)}")
    if not takes(color, depth, targets):
        raise ValueError("expected float32 tensors on the CPU")
