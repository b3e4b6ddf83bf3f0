"""PSNR of views, for benchmarks that render without the evaluation stage."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from benchmarks.common.pipeline_inputs import images_of
from genre_tasks.losses.targets import Target
from genre_tasks.scene.graph import SceneGraph


def mean_psnr(scene: SceneGraph, views: Sequence[Target]) -> float:
    """dB, over the views."""
    return float(psnr_of(images_of(scene, views), torch.stack([t.image.image for t in views])).mean())


def psnr_of(images: Tensor, truth: Tensor) -> Tensor:
    """[V] dB of [V, H, W, 3] twice."""
    return -10 * torch.log10((images - truth).square().mean((1, 2, 3)).clamp_min(1e-10))
