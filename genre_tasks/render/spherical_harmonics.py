"""What views see of a scene with harmonics: compiled in float32 on the CPU, else as ``scene.harmonics`` has it."""

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
from genre_tasks.scene.graph import COUNTS, FIRST_ACTOR, SceneGraph
from genre_tasks.scene.spherical_harmonics import colors_by_view

COMPILED = (COUNTS[1], COUNTS[2])
"""Counts of harmonics that the kernel knows."""


class _Glossy(ctypes.Structure):
    """As in spherical_harmonics.h."""

    _fields_ = [
        *((name, ctypes.c_int64) for name in ("count", "harmonics")),
        *((name, ctypes.c_void_p) for name in ("means", "colors", "waves", "frame", "slot")),
        *((name, ctypes.c_int64) for name in ("views", "frames", "splats")),
        *((name, ctypes.c_void_p) for name in ("eyes", "later")),
    ]


class Eyes:
    """Where views at log frames look from, [V, 1 + A, 3], first in the chunk, then in the actors' boxes.

    And where the Gaussians are among the splats: see ``SceneGraph.posed``.
    """

    def __init__(self, scene: SceneGraph, frames: Sequence[float], centres: Float64) -> None:
        nodes = scene.nodes.numpy() if scene.actors else np.zeros(len(scene), np.int64)
        moves = nodes >= FIRST_ACTOR
        moving = int(moves.sum())
        still = len(nodes) - moving
        distinct = list(dict.fromkeys(frames))
        self.splats = still + moving * (len(distinct) if moving else 0)
        self.frame = np.where(moves, nodes - FIRST_ACTOR + 1, 0).astype(np.int32)
        self.slot = np.where(moves, still + np.cumsum(moves), np.cumsum(~moves)).astype(np.int32) - np.int32(1)
        self.later = np.array([distinct.index(f) * moving for f in frames], np.int64)
        rotation, translation, _ = scene.actor_poses(frames)
        in_boxes = np.einsum("vaij,vai->vaj", rotation, centres[:, None] - translation)  # Rᵀ (centre − t)
        self.eyes = np.concatenate([centres[:, None], in_boxes], 1).astype(np.float32)

    def glossy(self, means: Tensor, colors: Tensor, harmonics: Tensor) -> _Glossy:
        """For the kernel, of contiguous tensors."""
        tensors, places = (means, colors, harmonics), (self.frame, self.slot)
        pointers = *(t.data_ptr() for t in tensors), *(a.ctypes.data for a in places)
        sizes = self.eyes.shape[0], self.eyes.shape[1], self.splats
        return _Glossy(len(means), harmonics.shape[1], *pointers, *sizes, self.eyes.ctypes.data, self.later.ctypes.data)


class _Seen(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, eyes: Eyes, means: Tensor, colors: Tensor, harmonics: Tensor) -> Tensor:
        inputs = tuple(t.contiguous() for t in (means, colors, harmonics))
        out = torch.empty(len(eyes.eyes), eyes.splats, 3)
        check_status(
            load_kernel().genre_gloss(ctypes.byref(eyes.glossy(*inputs)), torch.get_num_threads(), out.data_ptr())
        )
        ctx.eyes = eyes
        ctx.save_for_backward(*inputs, out)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_seen: Tensor) -> tuple[Tensor | None, ...]:
        *inputs, seen = ctx.saved_tensors
        by_seen = by_seen.contiguous()
        grads = [torch.empty_like(t) for t in inputs]
        pointers = seen.data_ptr(), by_seen.data_ptr(), *(g.data_ptr() for g in grads)
        glossy = ctx.eyes.glossy(*inputs)
        check_status(load_kernel().genre_gloss_backward(ctypes.byref(glossy), torch.get_num_threads(), *pointers))
        return None, *grads


def seen_colors(scene: SceneGraph, frames: Sequence[float], centres: Float64) -> Tensor:
    """As :func:`genre_tasks.scene.spherical_harmonics.colors_by_view`; the same bits at any number of threads.

    Raises ``ValueError`` for a scene without harmonics, ``ResourceError`` where the kernel is not compiled.
    """
    g, harmonics = scene.gaussians, scene.harmonics
    tensors = (g.means, g.colors, harmonics)
    fits = all(t is not None and t.dtype == torch.float32 and t.device.type == "cpu" for t in tensors)
    if harmonics is None or not fits or harmonics.shape[1] not in COMPILED:
        return colors_by_view(scene, frames, centres)
    seen: Tensor = _Seen.apply(Eyes(scene, frames, centres), g.means, g.colors, harmonics)
    return seen
