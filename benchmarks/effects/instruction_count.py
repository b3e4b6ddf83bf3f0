"""The process whose instructions are counted, see :func:`benchmarks.effects.whole_plans.plain_cost`.

python -m benchmarks.effects.instruction_count WORD LOG CHUNK STORE
"""

from __future__ import annotations

import sys

import torch

from benchmarks.common.run_stages import reconstruct
from benchmarks.common.task import value_of
from benchmarks.effects.cells import STAGES, Place
from benchmarks.effects.whole_plans import SHORT
from flows.pipeline.log_cache import opened_log
from genre_tasks.config import PipelineConfig
from genre_tasks.effects.types import EffectsPlan
from genre_tasks.scene.chunk import Chunk
from genre_tasks.stages.effects import effects
from genre_tasks.stages.gnet import gnet
from genre_tasks.stages.initial import initial


def main(word: str, at: Place) -> None:
    """``start`` ends before the plan; ``none`` has what the street needs set on, and all else off."""
    torch.set_num_threads(1)
    job = at.job(*SHORT)
    config = PipelineConfig.model_validate(job.config)
    refs = reconstruct(job, STAGES[:2])
    chunk: Chunk = value_of(job, refs["ingest"])
    plan: EffectsPlan = value_of(job, refs["effects"])
    if word == "start":
        return
    if word == "planning":
        plan = effects(config.effects, chunk, opened_log(at.log))
    if word == "none":
        plan = EffectsPlan()
    gnet(config.gnet, chunk, initial(config.initial, chunk, plan), plan)


if __name__ == "__main__":
    main(sys.argv[1], Place(sys.argv[2], int(sys.argv[3]), sys.argv[4]))
