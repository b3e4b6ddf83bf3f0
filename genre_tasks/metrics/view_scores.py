"""Scores of single images against their truth, without the pixels that show the ego vehicle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from genre_tasks.metrics.color_fit import cc_psnr
from genre_tasks.metrics.image_quality import psnr, ssim
from genre_tasks.metrics.perceptual import perceptual_distance
from genre_tasks.metrics.results import ViewScore
from genre_tasks.scene.chunk import View
from genre_tasks.scene.novel_views import NovelView
from genre_tasks.threads import map_single_threaded


def show_truth_on_ego(views: Sequence[View | NovelView], images: Tensor, truths: Tensor) -> Tensor:
    """Puts the truth where an image shows the ego vehicle, which is neither an error of the scene nor its merit.

    Args:
        views: V views; only recorded ones can have a mask.
        images: [V, H, W, 3].
        truths: [V, H, W, 3].

    Returns:
        [V, H, W, 3]; ``images`` itself where no view has a mask.
    """
    # A mask alone would not do: perceptual features and SSIM's windows reach over its edge.
    masks = _outside_ego(views)
    if all(mask is None for mask in masks):
        return images
    return torch.stack(
        [
            image if mask is None else torch.where(torch.from_numpy(mask)[..., None], image, truth)
            for mask, image, truth in zip(masks, images, truths, strict=True)
        ]
    )


def score_views(views: Sequence[View | NovelView], images: Tensor, truths: Tensor) -> list[ViewScore]:
    """Computes PSNR, SSIM and perceptual distance of each image, without the pixels that show the ego vehicle.

    Args:
        views: V views.
        images: [V, H, W, 3] sRGB in [0, 1], the images to judge.
        truths: [V, H, W, 3] what they should show.

    Returns:
        V scores.
    """
    images = show_truth_on_ego(views, images, truths)
    with torch.no_grad():
        # It has threads of its own, so it runs before the others share them.
        perceptual = perceptual_distance()(images, truths).tolist()
    # scikit-image works on one thread: images go side by side.
    arguments = [
        (image.numpy(), truth.numpy(), mask)
        for image, truth, mask in zip(images, truths, _outside_ego(views), strict=True)
    ]
    psnr_and_ssim = map_single_threaded(lambda pair: (psnr(*pair), ssim(*pair)), arguments)
    return [
        ViewScore(
            camera=view.camera,
            frame=view.frame,
            shift_m=view.shift_m if isinstance(view, NovelView) else 0.0,
            psnr=view_psnr,
            ssim=view_ssim,
            perceptual=view_perceptual,
        )
        for view, (view_psnr, view_ssim), view_perceptual in zip(views, psnr_and_ssim, perceptual, strict=True)
    ]


def fitted_psnr(views: Sequence[View | NovelView], images: Tensor, truths: Tensor) -> list[float]:
    """Computes PSNR of each image after its colours were fitted, without the pixels that show the ego vehicle.

    Args:
        views: V views.
        images: [V, H, W, 3] sRGB in [0, 1], the images to judge.
        truths: [V, H, W, 3] what they should show.

    Returns:
        V values, dB.
    """
    arguments = list(zip(images, truths, _outside_ego(views), strict=True))
    # The fit multiplies matrices, whose sums depend on the number of threads: each image has one.
    return map_single_threaded(lambda pair: cc_psnr(pair[0].numpy(), pair[1].numpy(), pair[2]), arguments)


def _outside_ego(views: Sequence[View | NovelView]) -> list[NDArray[np.bool_] | None]:
    """For each view a mask [H, W] of the pixels that count, ``None`` where all do."""
    return [~v.ego_mask if isinstance(v, View) and v.ego_mask is not None else None for v in views]
