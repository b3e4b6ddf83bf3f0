"""The seam between neighbouring chunks: the same view from both, which a simulation that drives on would see jump."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from genre_tasks.metrics.image_quality import psnr
from genre_tasks.render import render_views
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import FIRST_ACTOR, SceneGraph
from genre_tasks.scene.novel_poses import novel_view_poses
from genre_tasks.scene.novel_views import NovelView

SHIFTS_M = (0.0, 2.0, -2.0)
HIDDEN_LOGIT = -30.0


@dataclass(frozen=True)
class SeamView:
    """A view at the border, and how alike both chunks' scenes show it: PSNR between the two, dB."""

    camera: str
    frame: int
    shift_m: float
    psnr_db: float


def seam(
    before: tuple[Chunk, SceneGraph], after: tuple[Chunk, SceneGraph], shifts_m: Sequence[float] = SHIFTS_M
) -> tuple[SeamView, ...]:
    """The last frame of ``before`` and the first of ``after``, each camera and shift, rendered from both scenes.

    Actors are left out: a chunk knows nothing of theirs outside of its frames. So are gains: both scenes are at their
    own exposure. Raises ``ValueError`` for chunks that are no neighbours.
    """
    if before[0].log != after[0].log or after[0].frames[0] != before[0].frames[-1] + 1:
        raise ValueError(f"expected chunks that follow each other, got {before[0].index} and {after[0].index}")
    out = []
    for (own, scene), frame, (other, beyond) in (
        (before, before[0].frames[-1], after),
        (after, after[0].frames[0], before),
    ):
        views = novel_view_poses(own, shifts_m, [frame])
        images = zip(views, _static(scene, views), _static(beyond, list(_moved(views, own, other))), strict=True)
        out += [SeamView(v.camera, frame, v.shift_m, psnr(a, b)) for v, a, b in images]
    return tuple(out)


def medians(views: Sequence[SeamView]) -> dict[float, float]:
    """Median PSNR in dB by distance from the path."""
    distances = sorted({abs(v.shift_m) for v in views})
    return {d: statistics.median(v.psnr_db for v in views if abs(v.shift_m) == d) for d in distances}


def _moved(views: Sequence[NovelView], own: Chunk, other: Chunk) -> Iterator[NovelView]:
    """The same places in the other chunk's coordinates."""
    other_SE3_own = np.linalg.inv(other.world_SE3_chunk) @ own.world_SE3_chunk
    for view in views:
        yield replace(view, chunk_SE3_camera=other_SE3_own @ view.chunk_SE3_camera)


def _static(scene: SceneGraph, views: Sequence[NovelView]) -> list[np.ndarray]:
    """Renders [H, W, 3] in [0, 1], float32, without actors."""
    g = scene.gaussians
    hidden = torch.where(
        (scene.nodes >= FIRST_ACTOR)[:, None], HIDDEN_LOGIT, g.logit_opacities.reshape(len(g.means), 1)
    )
    bare = replace(g, logit_opacities=hidden.reshape(g.logit_opacities.shape))
    still = replace(scene, gaussians=bare)
    with torch.no_grad():
        return [render_views(still, [v]).color[0].clamp(0, 1).cpu().numpy() for v in views]
