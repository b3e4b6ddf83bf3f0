"""The seam between neighbouring chunks: what a simulation that drives on from one to the next would see jump."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from genre_tasks.logs.types import Float32
from genre_tasks.metrics.image_quality import psnr
from genre_tasks.render import render_views
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import FIRST_ACTOR, SceneGraph
from genre_tasks.scene.novel_poses import place_novel_views
from genre_tasks.scene.novel_views import NovelView

SHIFTS_M = (0.0, 2.0, -2.0)
"""Where the seam is looked at: on the path, and to the left and right of it."""

HIDDEN_LOGIT = -30.0
"""Logit opacity of a Gaussian that no renderer draws."""


@dataclass(frozen=True)
class SeamView:
    """A view at the border of two chunks, and how alike both scenes show it.

    Attributes:
        camera: name of the camera.
        frame: the log's frame.
        shift_m: distance to the left of the path, metres.
        psnr_db: PSNR between the renders of both scenes, dB.
    """

    camera: str
    frame: int
    shift_m: float
    psnr_db: float


def measure_seam(
    before: tuple[Chunk, SceneGraph], after: tuple[Chunk, SceneGraph], shifts_m: Sequence[float] = SHIFTS_M
) -> tuple[SeamView, ...]:
    """Renders the last frame of a chunk and the first of the next from both scenes, and compares the renders.

    Actors are left out, since a chunk knows nothing of them outside of its frames. So are exposure gains: both scenes
    are at their own exposure.

    Args:
        before: a chunk with its scene.
        after: the chunk that follows it, with its scene.
        shifts_m: distances to the left of the path, metres.

    Returns:
        One entry for each of the two frames, each shift and each camera.

    Raises:
        ValueError: the chunks are no neighbours.
    """
    if before[0].log != after[0].log or after[0].frames[0] != before[0].frames[-1] + 1:
        raise ValueError(f"expected chunks that follow each other, got {before[0].index} and {after[0].index}")
    seam_views = []
    # Both ways, since each chunk places the views of its own frame.
    for (chunk, scene), frame, (other_chunk, other_scene) in (
        (before, before[0].frames[-1], after),
        (after, after[0].frames[0], before),
    ):
        views = place_novel_views(chunk, shifts_m, [frame])
        renders = _render_static(scene, views)
        other_renders = _render_static(other_scene, _move_to_chunk(views, chunk, other_chunk))
        for view, image, other_image in zip(views, renders, other_renders, strict=True):
            seam_views.append(SeamView(view.camera, frame, view.shift_m, psnr(image, other_image)))
    return tuple(seam_views)


def median_psnr_by_distance(views: Sequence[SeamView]) -> dict[float, float]:
    """Summarises a seam.

    Args:
        views: of one or more seams.

    Returns:
        Median PSNR in dB by distance from the path in metres, both sides together.

    >>> median_psnr_by_distance([SeamView("front", 0, 2.0, 30.0), SeamView("front", 0, -2.0, 32.0)])
    {2.0: 31.0}
    """
    distances = sorted({abs(view.shift_m) for view in views})
    return {d: statistics.median(view.psnr_db for view in views if abs(view.shift_m) == d) for d in distances}


def _move_to_chunk(views: Sequence[NovelView], chunk: Chunk, other: Chunk) -> list[NovelView]:
    """The same places in the other chunk's coordinates."""
    # Each chunk has an origin of its own: one place has other coordinates in either.
    other_SE3_chunk = np.linalg.inv(other.world_SE3_chunk) @ chunk.world_SE3_chunk
    return [replace(view, chunk_SE3_camera=other_SE3_chunk @ view.chunk_SE3_camera) for view in views]


def _render_static(scene: SceneGraph, views: Sequence[NovelView]) -> list[Float32]:
    """Renders [H, W, 3] in [0, 1], float32, without actors."""
    gaussians = scene.gaussians
    # Hidden rather than removed: the scene's other per-Gaussian tensors keep their rows.
    opacities = torch.where(scene.nodes >= FIRST_ACTOR, HIDDEN_LOGIT, gaussians.logit_opacities)
    # The caller's scene stays as it is.
    static = replace(scene, gaussians=replace(gaussians, logit_opacities=opacities))
    with torch.no_grad():
        # One view at a time: images of all cameras together would need several times the memory.
        return [render_views(static, [view]).color[0].clamp(0, 1).cpu().numpy() for view in views]
