"""Views beside the path that judge, and their ray-cast images, kept in the store: one cast serves every method."""

from __future__ import annotations

import numpy as np
import torch

from flows.pipeline.log_cache import opened_log
from flows.training.training_scenes import spread
from genre_tasks.losses.targets import Target, of_fixed
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.novel_poses import novel_view_poses
from genre_tasks.scene.novel_views import FixedViews, NovelView
from storage.address import Address
from storage.code_digest import code_digest
from storage.keys import digest_value
from storage.local import open_store

TRUE_VIEWS = 12
"""So many views a shift are ray-cast (half a second each), spread evenly over sides, frames and cameras."""


def views_at(chunk: Chunk, shift_m: float, count: int | None = None) -> tuple[NovelView, ...]:
    """Both sides of every frame, or ``count`` of these views spread evenly."""
    views = novel_view_poses(chunk, (shift_m, -shift_m), chunk.frames)
    return views if count is None else spread(views, count)


def true_targets(log: str, store: str, chunk: Chunk, shift_m: float, count: int = TRUE_VIEWS) -> tuple[Target, ...]:
    """What the cameras would have seen at the shift, from the store or cast now; none where the log cannot tell."""
    opened = opened_log(log)
    if opened.truth is None:
        return ()
    views, kept = views_at(chunk, shift_m, count), open_store(store)
    where = [[v.frame, v.camera, v.shift_m, v.lens.width_px, v.lens.height_px] for v in views]
    code = code_digest(type(opened).__module__)
    key = digest_value({"log": opened.digest(), "code": code, "views": where})
    address = Address(opened.dataset, opened.name, chunk.index, "bench_truth", key)
    artifact = kept.find(address)
    if artifact is None:
        images = [opened.truth.image(v.frame, chunk.world_SE3_chunk @ v.chunk_SE3_camera, v.lens) for v in views]
        color = torch.from_numpy(np.stack(images).astype(np.float32) / np.float32(255))
        artifact = kept.commit(address, "fixed_views", FixedViews(views, color))
    return of_fixed(kept.read(artifact))
