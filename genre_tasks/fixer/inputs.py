"""What the fixer repairs a view from: its render, the LiDAR map, and source images as the view would see them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from genre_tasks.fixer.source_images import find_references
from genre_tasks.fixer.view_surface import MIN_ALPHA, unproject_surface
from genre_tasks.fixer.warping import SourceImage, Warp, select_sources, warp
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.novel_views import NovelViews

# A warp needs both a depth and an image: it is blank if either of its inputs is.
FROM_INPUT = {
    "render": ("color", "alpha", "warped", "warp_mask", "warp_spread", "depth_gap"),
    "reference": (
        "reference",
        "warped",
        "warp_mask",
        "warp_spread",
        "lidar_warped",
        "lidar_warp_mask",
        "lidar_warp_spread",
    ),
    "lidar": (
        "lidar_color",
        "lidar_alpha",
        "lidar_warped",
        "lidar_warp_mask",
        "lidar_warp_spread",
        "depth_gap",
    ),
}
"""Input of the network (``network.INPUTS``) → the tensors of :class:`FixerInputs` that follow from it."""


@dataclass(frozen=True)
class FixerInputs:
    """B rendered views and what they are fixed from, all of one size; colours are sRGB, premultiplied by their alpha.

    Attributes:
        color: [B, 3, H, W] the render.
        alpha: [B, 1, H, W] of the render.
        lidar_color: [B, 3, H, W] the LiDAR map.
        lidar_alpha: [B, 1, H, W] of the LiDAR map.
        reference: [B, 3, H, W] the nearest source image, from its own viewpoint.
        warped: [B, 3, H, W] source images sampled by rendered depth, black where none sees the point.
        warp_mask: [B, 1, H, W] where ``warped`` sees the point.
        warp_spread: [B, 1, H, W] how far the images that see a point disagree.
        lidar_warped: [B, 3, H, W] source images sampled by the LiDAR map's depth: sparser, free of floaters.
        lidar_warp_mask: [B, 1, H, W] where ``lidar_warped`` sees the point.
        lidar_warp_spread: [B, 1, H, W] as ``warp_spread``.
        depth_gap: [B, 1, H, W] between rendered depth and the LiDAR map's, see :func:`depth_gap`.
    """

    color: Tensor
    alpha: Tensor
    lidar_color: Tensor
    lidar_alpha: Tensor
    reference: Tensor
    warped: Tensor
    warp_mask: Tensor
    warp_spread: Tensor
    lidar_warped: Tensor
    lidar_warp_mask: Tensor
    lidar_warp_spread: Tensor
    depth_gap: Tensor

    def map(self, function: Callable[[Tensor], Tensor]) -> FixerInputs:
        """Applies a function to every tensor.

        Args:
            function: takes and returns a tensor of B images.

        Returns:
            The inputs of what it returned.
        """
        return FixerInputs(*(function(getattr(self, field.name)) for field in fields(self)))

    def select(self, index: slice) -> FixerInputs:
        """Selects some of the views.

        Args:
            index: slice of the batch.

        Returns:
            Their inputs.
        """
        return self.map(lambda tensor: tensor[index])

    def crop(self, top: int, left: int, height: int, width: int) -> FixerInputs:
        """Cuts the same window out of every image.

        Args:
            top: first row.
            left: first column.
            height: rows of the window.
            width: columns of the window.

        Returns:
            The inputs of that window.
        """
        # All tensors by one window: images that were cropped apart would no longer be aligned.
        return self.map(lambda tensor: tensor[..., top : top + height, left : left + width])


def build_inputs(
    chunk: Chunk, novel: NovelViews, indices: Sequence[int], sources: Sequence[SourceImage]
) -> FixerInputs:
    """Gathers what views are fixed from.

    Args:
        chunk: that the views are of.
        novel: renders and LiDAR maps.
        indices: which of the novel views.
        sources: the chunk's source images, see :func:`~genre_tasks.fixer.source_images.load_source_images`.

    Returns:
        The inputs, in the order of ``indices``.

    Raises:
        InputError: the reference of a view is no source view of the chunk.
    """
    rows = list(indices)
    references = find_references(chunk, [novel.views[i] for i in rows], sources)
    warps = [_warp_sources(chunk, novel, i, sources) for i in rows]
    by_render = [pair[0] for pair in warps]
    by_lidar = [pair[1] for pair in warps]
    gap = depth_gap(novel.depth[rows], novel.alpha[rows], novel.lidar_depth[rows], novel.lidar_alpha[rows])
    return FixerInputs(
        color=novel.color[rows].permute(0, 3, 1, 2),
        alpha=novel.alpha[rows].unsqueeze(1),
        lidar_color=novel.lidar_color[rows].permute(0, 3, 1, 2),
        lidar_alpha=novel.lidar_alpha[rows].unsqueeze(1),
        # Novel views may be on another device than the images.
        reference=torch.stack([s.image for s in references]).to(novel.color),
        warped=torch.stack([w.color for w in by_render]),
        warp_mask=torch.stack([w.mask for w in by_render]),
        warp_spread=torch.stack([w.spread for w in by_render]),
        lidar_warped=torch.stack([w.color for w in by_lidar]),
        lidar_warp_mask=torch.stack([w.mask for w in by_lidar]),
        lidar_warp_spread=torch.stack([w.spread for w in by_lidar]),
        depth_gap=gap.unsqueeze(1),
    )


def _warp_sources(chunk: Chunk, novel: NovelViews, index: int, sources: Sequence[SourceImage]) -> tuple[Warp, Warp]:
    """The sources as a view would see them, by rendered depth and by the LiDAR map's."""
    view = novel.views[index]
    actors = chunk.actors
    pose = view.chunk_SE3_camera
    # Both depths are warped by: the render's covers everything but has floaters, the map's is exact but sparse.
    rendered = unproject_surface(novel.depth[index], novel.alpha[index], pose, view.lens, actors, view.frame)
    lidar = unproject_surface(novel.lidar_depth[index], novel.lidar_alpha[index], pose, view.lens, actors, view.frame)
    # One selection serves both surfaces. It follows the LiDAR map, whose depth is free of floaters.
    selected = select_sources(lidar, sources, view.reference, actors, view.frame)
    return warp(rendered, selected, actors, view.frame), warp(lidar, selected, actors, view.frame)


def depth_gap(depth: Tensor, alpha: Tensor, lidar_depth: Tensor, lidar_alpha: Tensor) -> Tensor:
    """Measures how far the render's depth is from the LiDAR map's.

    Args:
        depth: [...] metres, of the render.
        alpha: [...] of the render.
        lidar_depth: [...] metres, of the LiDAR map.
        lidar_alpha: [...] of the LiDAR map.

    Returns:
        [...] in [0, 1]: four times the difference of the logarithms, 1 from about a quarter of the depth on; 0 where
        either depth is unknown.

    >>> one = torch.ones(1)
    >>> depth_gap(11 * one, one, 10 * one, one).item(), depth_gap(20 * one, one, 10 * one, one).item()
    (0.38..., 1.0)
    """
    # A nearly transparent pixel has a depth, but one of hardly anything.
    known = (alpha >= MIN_ALPHA) & (lidar_alpha >= MIN_ALPHA) & (depth > 0) & (lidar_depth > 0)
    # The logarithm makes twice as far and half as far the same gap.
    ratio = torch.where(known, depth / lidar_depth.clamp_min(1e-6), torch.ones_like(depth)).clamp_min(1e-6)
    return (4 * ratio.log().abs()).clamp(0, 1)


def mask_inputs(views: FixerInputs, inputs: Collection[str]) -> FixerInputs:
    """Blanks what follows from an input that a network does not use.

    Args:
        views: with all inputs.
        inputs: those of ``network.INPUTS`` that are used.

    Returns:
        The views, 0 in every tensor that follows from another input.
    """
    # Zero and not a smaller input: one architecture then serves every choice of inputs (paper Table 3).
    blank = {name for source, names in FROM_INPUT.items() if source not in inputs for name in names}
    return replace(views, **{name: torch.zeros_like(getattr(views, name)) for name in blank})
