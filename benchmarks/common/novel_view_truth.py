"""Views away from the path whose true images are known, kept in the store: one ray cast serves every method."""

from __future__ import annotations

import numpy as np
import torch

from flows.pipeline.log_cache import cached_log
from flows.training.training_scenes import evenly_spaced, get_or_make
from genre_tasks.losses.targets import Target, novel_targets
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.novel_poses import place_novel_views
from genre_tasks.scene.novel_views import FixedViews, NovelView
from storage.address import Address
from storage.code_digest import code_digest
from storage.keys import digest_value
from storage.opening import open_store

TRUE_VIEWS = 12
"""Number of views at a shift that are ray-cast, half a second each; spread evenly over sides, frames and cameras."""


def views_at_shift(chunk: Chunk, shift_m: float, count: int | None = None) -> tuple[NovelView, ...]:
    """Places views to both sides of the path.

    Args:
        chunk: the frames and cameras.
        shift_m: metres to the left and to the right.
        count: take so many of the views, spread evenly; all of them if ``None``.

    Returns:
        Views at every frame of every camera, or ``count`` of them.
    """
    views = place_novel_views(chunk, (shift_m, -shift_m), chunk.frames)
    # Ray casting takes half a second a view, so a spread sample stands for all.
    return views if count is None else evenly_spaced(views, count)


def load_true_targets(
    log: str, store: str, chunk: Chunk, shift_m: float, count: int = TRUE_VIEWS
) -> tuple[Target, ...]:
    """Gives what the cameras would have seen at a shift, from the store or ray-cast now.

    Args:
        log: URI of the log.
        store: folder of the store.
        chunk: of this log.
        shift_m: see :func:`views_at_shift`.
        count: number of views.

    Returns:
        A target for each view; none where the log has no truth away from the path.
    """
    opened = cached_log(log)
    truth = opened.truth
    if truth is None:
        # An empty tuple and not an error: real logs have no truth, and their cells are measured without it.
        return ()
    views = views_at_shift(chunk, shift_m, count)
    # Views are in the key by name and size: their poses follow from the log.
    poses = [[v.frame, v.camera, v.shift_m, v.lens.width_px, v.lens.height_px] for v in views]
    # The reader's code is in the key: another street would have other true images.
    key = digest_value({"log": opened.digest(), "code": code_digest(type(opened).__module__), "views": poses})
    address = Address(opened.dataset, opened.name, chunk.index, "bench_truth", key)

    def cast() -> FixedViews:
        images = [truth.image(v.frame, chunk.world_SE3_chunk @ v.chunk_SE3_camera, v.lens) for v in views]
        return FixedViews(views, torch.from_numpy(np.stack(images).astype(np.float32) / np.float32(255)))

    return novel_targets(get_or_make(open_store(store), address, "fixed_views", cast))
