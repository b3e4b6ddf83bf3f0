"""Recorded images that the fixer samples colours from, and which of their pixels a novel view can see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from genre_tasks.errors import InputError
from genre_tasks.fixer.warping import MIN_ALPHA, SourceImage
from genre_tasks.render.surface import render_surfaces
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.image_decoding import decode_image
from genre_tasks.scene.lidar_map import lidar_scene
from genre_tasks.scene.novel_views import NovelView
from genre_tasks.scene.projection import NEAR_M

OCCLUDING_POINTS = 60_000
"""LiDAR points whose discs hide things from source images."""


def recorded(chunk: Chunk) -> tuple[SourceImage, ...]:
    """The chunk's source images at the working resolution, with the depth from which LiDAR's points hide things.

    Raises ``InputError`` for an unreadable image.
    """
    views = [v if v.blur is None else replace(v, blur=None) for v in chunk.of_role("source")]  # depth has none
    with torch.no_grad():
        map_ = render_surfaces(lidar_scene(chunk, OCCLUDING_POINTS), views)
    depth = torch.where(map_.alpha >= MIN_ALPHA, map_.expected_depth(), torch.zeros_like(map_.alpha))
    out = []
    for view, hidden_at in zip(views, depth, strict=True):
        image = _own_colours(view).permute(2, 0, 1)
        if view.own is not None:  # what lies behind the vehicle is hidden by it
            hidden_at = torch.where(torch.from_numpy(view.own), NEAR_M, hidden_at)
        out.append(
            SourceImage(view.camera, view.frame, view.chunk_SE3_camera, view.lens, image, hidden_at, view.shutter)
        )
    return tuple(out)


def _own_colours(view: View) -> Tensor:
    """[H, W, 3] the image, at the scene's own exposure where its gain is known."""
    image = decode_image(view.image, view.lens.width_px, view.lens.height_px)
    if view.log_gain is None:
        return image
    from genre_tasks.effects.exposure import neutral

    return neutral(image, image.new_tensor(view.log_gain))


def references(chunk: Chunk, views: Sequence[NovelView], sources: Sequence[SourceImage]) -> list[SourceImage]:
    """The reference of each view. Raises ``InputError`` for one that is no source view of the chunk."""
    known = {(s.camera, s.frame): s for s in sources}
    for view in views:
        if view.reference not in known:
            raise InputError(
                "the reference of a novel view is no view of the chunk",
                remedy="Render the novel views of this chunk again.",
                log=chunk.log,
                chunk=chunk.index,
                camera=view.reference[0],
                frame=view.reference[1],
                stage="fnet",
            )
    return [known[v.reference] for v in views]
