"""Colours that views see of a scene with spherical harmonics: by the kernel in float32 on the CPU, else in torch."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from genre_tasks.logs.types import Float64
from genre_tasks.render.cpu import check_status
from genre_tasks.render.kernel.library import load_kernel
from genre_tasks.scene.graph import FIRST_ACTOR, SH_COUNTS, SceneGraph
from genre_tasks.scene.spherical_harmonics import evaluate_sh_colors_by_view

COMPILED_SH_COUNTS = (SH_COUNTS[1], SH_COUNTS[2])
"""Counts of spherical harmonics that the kernel knows."""


class _ShGaussians(ctypes.Structure):
    # As in spherical_harmonics.h.
    _fields_ = [
        *((name, ctypes.c_int64) for name in ("count", "sh_count")),
        *((name, ctypes.c_void_p) for name in ("means", "colors", "coefficients", "coordinate_frame", "slot")),
        *((name, ctypes.c_int64) for name in ("views", "coordinate_frames", "splats")),
        *((name, ctypes.c_void_p) for name in ("camera_centers", "frame_offset")),
    ]


class CameraCenters:
    """Where V views look from, in the chunk and in the boxes of A actors; and where Gaussians are among the splats.

    Attributes:
        centers: [V, 1 + A, 3] float32 camera centres in metres: in the chunk, then in each actor's box.
        coordinate_frame: [N] int32, each Gaussian's own of these 1 + A.
        splats: number of splats, laid out as by ``SceneGraph.gaussians_at_frames``.
        slot: [N] int32 index of each Gaussian's splat at the first log frame.
        frame_offset: [V] int64, by how much later a moving Gaussian's splat of the view's frame comes.
    """

    def __init__(self, scene: SceneGraph, frames: Sequence[float], centres: Float64) -> None:
        """Lays out a scene's Gaussians for views.

        Args:
            scene: N Gaussians.
            frames: [V] log frame of each view.
            centres: [V, 3] camera centres in metres, chunk coordinates.
        """
        nodes = scene.nodes.numpy() if scene.actors else np.zeros(len(scene), np.int64)
        moves = nodes >= FIRST_ACTOR
        moving = int(moves.sum())
        still = len(nodes) - moving
        distinct = list(dict.fromkeys(frames))
        self.splats = still + moving * (len(distinct) if moving else 0)
        self.coordinate_frame = np.where(moves, nodes - FIRST_ACTOR + 1, 0).astype(np.int32)
        # Counted from 1 by the cumulative sums, hence the − 1.
        self.slot = np.where(moves, still + np.cumsum(moves), np.cumsum(~moves)).astype(np.int32) - np.int32(1)
        self.frame_offset = np.array([distinct.index(f) * moving for f in frames], np.int64)
        # An actor turns its Gaussians, so the direction in which one is seen must be measured in its box.
        rotation, translation, _ = scene.actor_poses(frames)
        in_boxes = np.einsum("vaij,vai->vaj", rotation, centres[:, None] - translation)  # Rᵀ (centre − t)
        self.centers = np.concatenate([centres[:, None], in_boxes], 1).astype(np.float32)

    def kernel_input(self, means: Tensor, colors: Tensor, coefficients: Tensor) -> _ShGaussians:
        """Describes Gaussians to the kernel, which reads the tensors in place.

        Args:
            means: [N, 3], contiguous float32 on the CPU, like the others.
            colors: [N, 3] the constant terms.
            coefficients: [N, K, 3] spherical harmonics.
        """
        return _ShGaussians(
            count=len(means),
            sh_count=coefficients.shape[1],
            means=means.data_ptr(),
            colors=colors.data_ptr(),
            coefficients=coefficients.data_ptr(),
            coordinate_frame=self.coordinate_frame.ctypes.data,
            slot=self.slot.ctypes.data,
            views=self.centers.shape[0],
            coordinate_frames=self.centers.shape[1],
            splats=self.splats,
            camera_centers=self.centers.ctypes.data,
            frame_offset=self.frame_offset.ctypes.data,
        )


class _ViewColors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, centers: CameraCenters, means: Tensor, colors: Tensor, coefficients: Tensor) -> Tensor:
        # Saved for the backward pass, too: the kernel reads the very same memory again.
        inputs = tuple(t.contiguous() for t in (means, colors, coefficients))
        out = torch.empty(len(centers.centers), centers.splats, 3)
        gaussians = centers.kernel_input(*inputs)
        status = load_kernel().genre_sh_colors(ctypes.byref(gaussians), torch.get_num_threads(), out.data_ptr())
        check_status(status)
        ctx.centers = centers
        ctx.save_for_backward(*inputs, out)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, color_gradient: Tensor) -> tuple[Tensor | None, ...]:
        *inputs, colors = ctx.saved_tensors
        color_gradient = color_gradient.contiguous()
        grads = [torch.empty_like(t) for t in inputs]
        gaussians = ctx.centers.kernel_input(*inputs)
        status = load_kernel().genre_sh_colors_backward(
            ctypes.byref(gaussians),
            torch.get_num_threads(),
            colors.data_ptr(),
            color_gradient.data_ptr(),
            *(g.data_ptr() for g in grads),
        )
        check_status(status)
        return None, *grads


def compute_view_dependent_colors(scene: SceneGraph, frames: Sequence[float], centres: Float64) -> Tensor:
    """Computes what several views see of a scene with spherical harmonics; the same bits at any number of threads.

    Args:
        scene: with spherical harmonics.
        frames: [V] log frame of each view.
        centres: [V, 3] camera centres in metres, chunk coordinates.

    Returns:
        Colours [V, S + F · M, 3], as by :func:`genre_tasks.scene.spherical_harmonics.evaluate_sh_colors_by_view`.

    Raises:
        ValueError: the scene has no spherical harmonics.
        ResourceError: the kernel is not compiled.
    """
    g = scene.gaussians
    coefficients = scene.spherical_harmonics
    # Degree 3 and other precisions are for experiments and tests: torch is fast enough for these.
    tensors = (g.means, g.colors, coefficients)
    on_cpu = all(t is not None and t.dtype == torch.float32 and t.device.type == "cpu" for t in tensors)
    if coefficients is None or not on_cpu or coefficients.shape[1] not in COMPILED_SH_COUNTS:
        return evaluate_sh_colors_by_view(scene, frames, centres)
    colors: Tensor = _ViewColors.apply(CameraCenters(scene, frames, centres), g.means, g.colors, coefficients)
    return colors
