"""The image terms of the rendering loss as a compiled kernel, ten times as fast as in torch.

:func:`genre_tasks.losses.rendering_loss.view_loss` defines the terms, and the tests hold the kernel against it.
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
    """The losses of V views, and the gradients of their sum with respect to the rendered images.

    Attributes:
        losses: [V] float64, each multiplied by its view's weight.
        color_gradient: [V, H, W, 3] with respect to the colours.
        depth_gradient: [V, H, W] with respect to the depths.
    """

    losses: Tensor
    color_gradient: Tensor
    depth_gradient: Tensor


@cache
def load_image_loss(folder: Path = KERNEL.folder) -> ctypes.CDLL:
    """Loads the kernel and declares its argument types, once per process.

    Args:
        folder: where its compiled libraries are.

    Raises:
        ResourceError: the kernel is not compiled, or is older than its sources.
        ConfigError: ``GENRE_RENDER_ISA`` names an instruction set that this machine lacks.
    """
    library = load(KERNEL, folder)
    pointer = ctypes.c_void_p
    number = ctypes.c_int
    real = ctypes.c_double
    # Undeclared, ctypes would pass an address as a 32-bit integer.
    library.genre_image_loss.argtypes = [
        *[number] * 3,  # views, height, width
        *[pointer] * 2,  # colours, depths
        *[pointer] * 4,  # per view: image, mean, variance, LiDAR depth
        pointer,  # weights of the views
        *[real] * 3,  # weights of the terms
        number,  # threads
        *[pointer] * 3,  # results: terms, colour gradient, depth gradient
    ]
    return library


def is_supported(color: Tensor, depth: Tensor, targets: Sequence[Target]) -> bool:
    """Tells whether the kernel can process these tensors: all must be float32 and on the CPU.

    Args:
        color: [V, H, W, 3] rendered colours.
        depth: [V, H, W] rendered depths.
        targets: the V targets that they are compared with.
    """
    # Other devices and precisions, as in tests, are for ``torch_image_loss``.
    tensors: list[Tensor | None] = [color, depth]
    for target in targets:
        tensors += [target.image.pixels, target.image.mean, target.image.variance, target.depth]
    return all(t is None or (t.device.type == "cpu" and t.dtype == torch.float32) for t in tensors)


def image_loss(
    config: LossConfig,
    color: Tensor,  # [V, H, W, 3]
    depth: Tensor,  # [V, H, W] metres, 0 where nothing was rendered
    targets: Sequence[Target],
    weights: Sequence[float],
) -> ImageLoss:
    """Computes each view's weighted L1, SSIM and depth terms and their gradients.

    Each view is computed by one thread, ``torch.get_num_threads()`` of them at once. The bits do not depend on the
    number of threads.

    Args:
        config: weights of the terms; the perceptual term is not computed here.
        color: rendered colours, float32 on the CPU.
        depth: rendered depths, float32 on the CPU.
        targets: V targets of the images' size.
        weights: V weights of the views.

    Returns:
        The losses of the views and the gradients of their sum.

    Raises:
        ValueError: shapes or numbers of views do not fit, or a tensor is not float32 on the CPU.
        ResourceError: the kernel is not compiled, or memory is short.
    """
    _check_inputs(color, depth, targets, weights)
    views, height, width = depth.shape
    color = color.detach().contiguous()
    depth = depth.detach().contiguous()
    # Contiguous copies must live until the kernel returns, as it only gets their addresses.
    images = [target.image.pixels.contiguous() for target in targets]
    # Where an image has no statistics, the kernel computes them row by row.
    means = [_contiguous(target.image.mean) for target in targets]
    variances = [_contiguous(target.image.variance) for target in targets]
    lidar_depths = [_contiguous(target.depth) for target in targets]
    # In float64, as the kernel's sums are.
    view_weights = torch.tensor(weights, dtype=torch.float64)
    terms = torch.empty(views, 3, dtype=torch.float64)
    color_gradient = torch.empty_like(color)
    depth_gradient = torch.empty_like(depth)
    status = load_image_loss().genre_image_loss(
        views,
        height,
        width,
        color.data_ptr(),
        depth.data_ptr(),
        _pointers(images),
        _pointers(means),
        _pointers(variances),
        _pointers(lidar_depths),
        view_weights.data_ptr(),
        config.rgb,
        config.ssim,
        config.depth,
        torch.get_num_threads(),
        terms.data_ptr(),
        color_gradient.data_ptr(),
        depth_gradient.data_ptr(),
    )
    _check_status(status)
    term_weights = torch.tensor([config.rgb, config.ssim, config.depth], dtype=torch.float64)
    return ImageLoss((terms * term_weights).sum(1) * view_weights, color_gradient, depth_gradient)


def _check_status(status: int) -> None:
    if status == 1:
        raise ResourceError("not enough memory for the image loss", remedy="Take fewer views or smaller images")
    if status:
        raise ResourceError(f"{KERNEL.title} failed", remedy="Report the images' size and the number of views")


def _contiguous(tensor: Tensor | None) -> Tensor | None:
    return None if tensor is None else tensor.contiguous()


def _pointers(tensors: Sequence[Tensor | None]) -> ctypes.Array[ctypes.c_void_p]:
    """The addresses of tensors as a C array; a null pointer stands for ``None``."""
    # A view without LiDAR depth has a null pointer, and then no depth term.
    return (ctypes.c_void_p * len(tensors))(*(None if t is None else t.data_ptr() for t in tensors))


def _check_inputs(color: Tensor, depth: Tensor, targets: Sequence[Target], weights: Sequence[float]) -> None:
    """Raises ``ValueError`` for what the kernel, which knows no shapes, would read out of bounds."""
    if color.ndim != 4 or color.shape[3] != 3 or depth.shape != color.shape[:3]:
        raise ValueError(
            f"expected colour [V, H, W, 3] and depth [V, H, W], got {tuple(color.shape)} and {tuple(depth.shape)}"
        )
    # The kernel knows no shapes: what passes here is read without another check.
    if not len(targets) == len(weights) == len(color):
        raise ValueError(f"expected {len(color)} targets and weights, got {len(targets)} and {len(weights)}")
    for target in targets:
        # By name, so that the error says which statistic is of another image.
        parts = {"image": target.image.pixels, "mean": target.image.mean, "variance": target.image.variance}
        for name, part in parts.items():
            if part is not None and part.shape != color.shape[1:]:
                raise ValueError(f"expected a target {name} of shape {tuple(color.shape[1:])}, got {tuple(part.shape)}")
        if target.depth is not None and target.depth.shape != depth.shape[1:]:
            raise ValueError(f"expected LiDAR depth of shape {tuple(depth.shape[1:])}, got {tuple(target.depth.shape)}")
    if not is_supported(color, depth, targets):
        raise ValueError("expected float32 tensors on the CPU")
