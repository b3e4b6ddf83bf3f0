"""What lies before ENet, for one order of views: GNet's scene, its views beside the path, FNet's images of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from benchmarks.common.run_stages import reconstruct
from benchmarks.common.task import job_of, value_of
from genre_tasks.config import PipelineConfig
from genre_tasks.losses.targets import Target, of_fixed, of_source, of_views
from genre_tasks.render.api import render_views
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.novel_views import NovelView

_BATCH_VIEWS = 16


@dataclass(frozen=True)
class Steps:
    """Scenes of a chunk and what supervises ENet; ``enet`` is ``None`` where it was not asked for."""

    config: PipelineConfig
    chunk: Chunk
    gnet: SceneGraph
    source: tuple[Target, ...]
    fixed: tuple[Target, ...]
    heldout: tuple[Target, ...]
    enet: SceneGraph | None


def steps_of(log: str, chunk: int, store: str, order: int, enet: bool, *settings: str) -> Steps:
    """The preset ``small`` up to FNet, or to ENet, from and into a store. Raises ``NotMeasuredError`` without data."""
    job = job_of(log, chunk, store, order, *settings)
    names = ("ingest", "effects", "initial", "gnet", "novel_views", "fnet")
    refs = reconstruct(job, (*names, "enet") if enet else names)
    read, config = value_of(job, refs["ingest"]), PipelineConfig.model_validate(job.config)
    return Steps(
        config,
        read,
        value_of(job, refs["gnet"]).scene,
        of_source(read, depth=config.enet.loss.depth > 0),
        of_fixed(value_of(job, refs["fnet"])),
        of_views(read, read.of_role("heldout")),
        value_of(job, refs["enet"]).scene if enet else None,
    )


@torch.no_grad()
def images_of(scene: SceneGraph, views: Sequence[NovelView | Target]) -> Tensor:
    """[V, H, W, 3] in [0, 1]."""
    parts = (views[k : k + _BATCH_VIEWS] for k in range(0, len(views), _BATCH_VIEWS))
    return torch.cat([render_views(scene, part).color.clamp(0, 1) for part in parts])
