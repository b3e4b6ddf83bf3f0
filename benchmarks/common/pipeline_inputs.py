"""What lies before ENet, for one order of views: GNet's scene, its novel views, FNet's images of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from benchmarks.common.run_stages import reconstruct
from benchmarks.common.task import make_job
from flows.pipeline.stage_runner import read_artifact
from genre_tasks.config import PipelineConfig
from genre_tasks.losses.targets import Target, novel_targets, source_targets, view_targets
from genre_tasks.render.api import render_views
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.novel_views import NovelView

_BATCH_VIEWS = 16


@dataclass(frozen=True)
class PipelineInputs:
    """Scenes of a chunk and what supervises ENet.

    Attributes:
        config: of the whole pipeline.
        chunk: as ingested.
        gnet: GNet's scene.
        source: targets of the source views, with depth where ENet's loss has a term of it.
        fixed: targets of the novel views, as FNet fixed them.
        heldout: targets of all held-out views.
        enet: ENet's scene; ``None`` where it was not asked for.
    """

    config: PipelineConfig
    chunk: Chunk
    gnet: SceneGraph
    source: tuple[Target, ...]
    fixed: tuple[Target, ...]
    heldout: tuple[Target, ...]
    enet: SceneGraph | None


def load_pipeline_inputs(log: str, chunk: int, store: str, order: int, enet: bool, *settings: str) -> PipelineInputs:
    """Runs the preset ``small`` up to FNet, or to ENet.

    Args:
        log: URI of the log.
        chunk: index of the chunk.
        store: folder of the store that stages come from and go to.
        order: seed of GNet's and ENet's order of views.
        enet: whether ENet is run too.
        settings: ``section.key=value`` over the preset.

    Raises:
        NotMeasuredError: the log's folder is missing.
    """
    job = make_job(log, chunk, store, order, *settings)
    names = ("ingest", "effects", "initial", "gnet", "novel_views", "fnet")
    refs = reconstruct(job, (*names, "enet") if enet else names)
    ingested = read_artifact(job, refs["ingest"])
    config = PipelineConfig.model_validate(job.config)
    return PipelineInputs(
        config=config,
        chunk=ingested,
        gnet=read_artifact(job, refs["gnet"]).scene,
        # LiDAR depth maps cost memory, so they are left out where the loss ignores them.
        source=source_targets(ingested, depth=config.enet.loss.depth > 0),
        fixed=novel_targets(read_artifact(job, refs["fnet"])),
        heldout=view_targets(ingested, ingested.views_with_role("heldout")),
        enet=read_artifact(job, refs["enet"]).scene if enet else None,
    )


@torch.no_grad()
def render_images(scene: SceneGraph, views: Sequence[NovelView | Target]) -> Tensor:
    """Renders views in batches.

    Args:
        scene: what to render.
        views: V of one size.

    Returns:
        [V, H, W, 3] sRGB in [0, 1].
    """
    # In batches, because all views at once would hold every intermediate buffer.
    batches = (views[k : k + _BATCH_VIEWS] for k in range(0, len(views), _BATCH_VIEWS))
    return torch.cat([render_views(scene, batch).color.clamp(0, 1) for batch in batches])
