"""The process whose instructions are counted, see :func:`benchmarks.effects.whole_plans.count_plain_cost`.

python -m benchmarks.effects.instruction_count KIND LOG CHUNK STORE [SETTING …]
"""

from __future__ import annotations

import sys

import torch

from benchmarks.common.run_stages import reconstruct
from benchmarks.effects.cells import STAGES, ChunkLocation
from benchmarks.effects.whole_plans import COUNTED_SETTINGS
from flows.pipeline.log_cache import cached_log
from flows.pipeline.stage_runner import read_artifact
from genre_tasks.config import PipelineConfig
from genre_tasks.effects.types import EffectsPlan
from genre_tasks.scene.chunk import Chunk
from genre_tasks.stages.effects import effects
from genre_tasks.stages.gnet import gnet
from genre_tasks.stages.initial import initial


def main(kind: str, location: ChunkLocation) -> None:
    """Runs what is counted.

    Args:
        kind: ``start`` ends before the plan; ``none`` runs with what the street needs set on, and all else off;
            ``planned`` reads the plan from the store; ``planning`` makes it.
        location: the chunk, whose stages up to the plan are in the store.
    """
    # Waiting threads spin, and their instructions would differ from run to run.
    torch.set_num_threads(1)
    job = location.job(*COUNTED_SETTINGS)
    config = PipelineConfig.model_validate(job.config)
    refs = reconstruct(job, STAGES[:2])
    chunk: Chunk = read_artifact(job, refs["ingest"])
    plan: EffectsPlan = read_artifact(job, refs["effects"])
    # Imports and reading are the same in every kind; this process measures them, to be subtracted.
    if kind == "start":
        return
    # The store would hand over the finished plan, so it is made here once more.
    if kind == "planning":
        plan = effects(config.effects, chunk, cached_log(location.log))
    if kind == "none":
        plan = EffectsPlan()
    gnet(config.gnet, chunk, initial(config.initial, chunk, plan), plan)


if __name__ == "__main__":
    _, kind, log, chunk, store, *settings = sys.argv
    main(kind, ChunkLocation(log, int(chunk), store, tuple(settings)))
