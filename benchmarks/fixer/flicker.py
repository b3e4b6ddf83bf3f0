"""Flicker: how much consecutive images differ where they show the same points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from benchmarks.common.bench import Row
from benchmarks.common.novel_view_truth import views_at_shift
from benchmarks.common.pipeline_inputs import PipelineInputs
from benchmarks.common.task import SIDE_M
from flows.pipeline.log_cache import cached_log
from genre_tasks.config import FnetConfig
from genre_tasks.fixer.network import Fnet
from genre_tasks.rollout.flicker import DepthView, WarpedDifference, measure_warped_difference
from genre_tasks.scene.chunk import Actor
from genre_tasks.scene.novel_views import NovelViews
from genre_tasks.stages.fnet import fix_views
from genre_tasks.stages.novel_views import render_novel


@torch.no_grad()
def measure_flicker(network: Fnet, config: FnetConfig, inputs: PipelineInputs, log: str) -> Row:
    """Measures the flicker of the first camera's renders, fixed images and true images to the left of the path.

    A sharp image differs more from its resampled neighbour than a blurred one: the truth's flicker tells how much
    comes from sharpness alone.

    Args:
        network: the fixer.
        config: of its stage.
        inputs: the scene and its chunk.
        log: URI of the log.

    Returns:
        Number of frames and the flicker of ``render``, ``fixed`` and, where the log has a truth, ``truth``.
    """
    chunk = inputs.chunk
    truth = cached_log(log).truth
    camera = chunk.views[0].camera
    # One side alone: between the two sides consecutive images would jump by six metres.
    left = [v for v in views_at_shift(chunk, SIDE_M) if v.camera == camera and v.shift_m > 0]
    # Consecutive frames are compared, so their order is all that counts.
    views = sorted(left, key=lambda v: v.frame)
    novel = render_novel(chunk, inputs.gnet, views, inputs.config.novel_views.lidar_max_points)
    images = {"render": novel.color.clamp(0, 1), "fixed": fix_views(network, config, chunk, novel).color}
    if truth is not None:
        cast = [truth.image(v.frame, chunk.world_SE3_chunk @ v.chunk_SE3_camera, v.lens) for v in views]
        images["truth"] = torch.from_numpy(np.stack(cast).astype(np.float32) / np.float32(255))
    return {"frames": len(views)} | {name: flicker(image, novel, chunk.actors) for name, image in images.items()}


def flicker(images: Tensor, novel: NovelViews, actors: Sequence[Actor] = ()) -> float:
    """Compares each image with the next one, warped to it by rendered depth.

    Args:
        images: [V, H, W, 3] sRGB in [0, 1].
        novel: V views in the order of frames, with their depth.
        actors: points on them move along.

    Returns:
        Mean absolute difference over pixels and channels. A point that is outside of the next image or hidden there
        does not count.
    """
    depths = [DepthView(v, a, d) for v, a, d in zip(novel.views, novel.alpha, novel.depth, strict=True)]
    total = WarpedDifference()
    for k in range(len(images) - 1):
        # Summed over pixels of all pairs, so that a pair with little overlap weighs little.
        total += measure_warped_difference((images[k], images[k + 1]), depths[k], depths[k + 1], actors)
    # Without any overlap the sum is zero, and so is the flicker.
    return total.mean
