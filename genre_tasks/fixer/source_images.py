"""Recorded images that the fixer samples colours from, and which of their pixels a novel view can see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from genre_tasks.effects.color_gain import remove_gain
from genre_tasks.errors import InputError
from genre_tasks.fixer.view_surface import MIN_ALPHA
from genre_tasks.fixer.warping import SourceImage
from genre_tasks.image_memory import allocate_images
from genre_tasks.render.surface import render_surfaces
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.image_decoding import decode_image
from genre_tasks.scene.lidar_map import build_lidar_scene
from genre_tasks.scene.novel_views import NovelView
from genre_tasks.scene.projection import NEAR_M

OCCLUDING_POINTS = 60_000
"""LiDAR points whose discs hide things from source images."""


def load_source_images(chunk: Chunk) -> tuple[SourceImage, ...]:
    """Loads the chunk's source images at the working resolution, with the depth of what hides points from them.

    Args:
        chunk: with its plan's effects applied.

    Returns:
        One image for each source view, at the scene's own exposure.

    Raises:
        InputError: an image cannot be decoded.
    """
    # Depth has no motion blur, and without it each view is rendered once.
    views = [v if v.blur is None else replace(v, blur=None) for v in chunk.views_with_role("source")]
    lidar_scene = build_lidar_scene(chunk, OCCLUDING_POINTS)
    images = allocate_images(len(views), chunk.height_px, chunk.width_px, 3)
    depths = allocate_images(len(views), chunk.height_px, chunk.width_px)
    sources = []
    for view, image, depth in zip(views, images, depths, strict=True):
        image.copy_(_decode_without_gain(view))
        # One by one: colours, which a map has too, would take more memory than all depths.
        depth.copy_(_render_depth(lidar_scene, view))
        if view.ego_mask is not None:
            # The vehicle itself hides whatever lies behind it.
            depth[torch.from_numpy(view.ego_mask)] = NEAR_M
        source = SourceImage(
            camera=view.camera,
            frame=view.frame,
            chunk_SE3_camera=view.chunk_SE3_camera,
            lens=view.lens,
            image=image.permute(2, 0, 1),
            depth=depth,
            shutter=view.shutter,
        )
        sources.append(source)
    return tuple(sources)


@torch.no_grad()
def _render_depth(lidar_scene: SceneGraph, view: View) -> Tensor:
    """[H, W] metres, 0 where the map has no surface."""
    lidar_map = render_surfaces(lidar_scene, [view])
    known = lidar_map.alpha >= MIN_ALPHA
    return torch.where(known, lidar_map.expected_depth(), torch.zeros_like(lidar_map.alpha))[0]


def _decode_without_gain(view: View) -> Tensor:
    """[H, W, 3] the image, at the scene's own exposure where its gain is known."""
    image = decode_image(view.image, view.lens.width_px, view.lens.height_px)
    # Without this, neighbouring pixels that are taken from images of different gain would show seams.
    return image if view.log_gain is None else remove_gain(image, image.new_tensor(view.log_gain))


def find_references(chunk: Chunk, views: Sequence[NovelView], sources: Sequence[SourceImage]) -> list[SourceImage]:
    """Finds the reference image of each novel view.

    Args:
        chunk: that all are of, for messages.
        views: novel views, which name their references.
        sources: the chunk's source images.

    Returns:
        One source image for each view.

    Raises:
        InputError: a reference is no source view of the chunk.
    """
    # By name and not by index: sources may be a part of the chunk's.
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
