"""Renders that the evaluation compares with images: batch by batch, as the cameras would have recorded them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TypeVar

import torch
from torch import Tensor

from genre_tasks.effects.color_gain import apply_gain
from genre_tasks.progress import Progress
from genre_tasks.render import render_views
from genre_tasks.render.types import RenderSettings
from genre_tasks.scene.chunk import View
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.novel_views import NovelView

BATCH_PIXELS = 2**20
"""A batch has about so many pixels: larger ones are no faster and take more memory."""

AnyView = TypeVar("AnyView", bound=View | NovelView)
Item = TypeVar("Item")


class ImageProgress:
    """Counts images for a progress callback."""

    def __init__(self, progress: Progress, total: int, stage: str) -> None:
        """Reports that no image is done yet.

        Args:
            progress: the callback.
            total: number of images.
            stage: the evaluated stage, for the callback's note.
        """
        self._progress = progress
        self._total = total
        self._note = f"evaluating {stage}"
        self._done = 0
        self.add(0)

    def add(self, count: int) -> None:
        """Reports further images.

        Args:
            count: number of images done since the last call.
        """
        self._done += count
        self._progress(self._done, self._total, self._note)


def split_into_batches(items: Sequence[Item], width_px: int, height_px: int) -> Iterator[list[Item]]:
    """Splits views into batches of about ``BATCH_PIXELS``.

    Args:
        items: views, or what stands for them.
        width_px: of one image.
        height_px: of one image.

    Yields:
        Batches of at least one item, in order.

    >>> [len(batch) for batch in split_into_batches(range(5), 1024, 512)]
    [2, 2, 1]
    """
    # An image larger than a batch still has to be rendered, alone.
    size = max(1, BATCH_PIXELS // (width_px * height_px))
    for start in range(0, len(items), size):
        yield list(items[start : start + size])


def render_batches(
    scene: SceneGraph, views: Sequence[AnyView], settings: RenderSettings, progress: ImageProgress | None
) -> Iterator[tuple[list[AnyView], Tensor]]:
    """Renders views as their cameras would have recorded them.

    Args:
        scene: to render.
        views: of one image size.
        settings: of the renderer.
        progress: counts the images, if given.

    Yields:
        Batches of views with their images [B, H, W, 3] in [0, 1], on the CPU. What no Gaussian covers is black.
    """
    if not views:
        return
    lens = views[0].lens
    for batch in split_into_batches(views, lens.width_px, lens.height_px):
        # Not around the loop: a generator that is suspended inside would turn gradients off for its caller.
        with torch.no_grad():
            color = apply_view_gains(render_views(scene, batch, settings).color.cpu(), batch)
        # Clamped after the gain, as a camera's sensor clips after its exposure.
        yield batch, color.clamp(0, 1)
        if progress is not None:
            progress.add(len(batch))


def apply_view_gains(color: Tensor, views: Sequence[View | NovelView]) -> Tensor:
    """Applies to renders the gains with which the cameras recorded the views.

    Args:
        color: [V, H, W, 3] sRGB.
        views: V views; novel views have no gain.

    Returns:
        [V, H, W, 3]; ``color`` itself where no view has a gain.
    """
    # Scenes have one exposure. Held-out images are judged at the one that source views around them suggest.
    gains = {k: view.log_gain for k, view in enumerate(views) if isinstance(view, View) and view.log_gain is not None}
    if not gains:
        return color
    # A copy, because the caller's renders must stay as they were.
    color = color.clone()
    for k, gain in gains.items():
        color[k] = apply_gain(color[k], color.new_tensor(gain))
    return color
