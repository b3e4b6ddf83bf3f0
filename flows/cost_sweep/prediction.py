"""What a sweep would take before it runs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from flows.cost_sweep.cell import Cell, Sweep, stages_of
from flows.pipeline.definition import BY_NAME, PIPELINE
from flows.pipeline.prediction import stage_seconds
from flows.pipeline.stage_runner import ArtifactRef, Job, look_up
from genre_tasks.config import PipelineConfig


def predicted(sweep: Sweep, cells: Sequence[Cell]) -> list[dict[str, Any]]:
    """A row a cell: its name, predicted seconds, and how many of its stages are in the store.

    A stage that an earlier cell will have made costs nothing; the others take what such stages took in the store (or a
    table of typical values), in proportion to their iterations and views.
    """
    known = stage_seconds(sweep.store)
    seen: set[str] = set()
    return [_cell(sweep, cell, known, seen) for cell in cells]


def _cell(sweep: Sweep, cell: Cell, known: dict[str, float], seen: set[str]) -> dict[str, Any]:
    job, base = sweep.job(cell), PipelineConfig.model_validate(sweep.judge(cell).config)
    config = PipelineConfig.model_validate(job.config)
    refs: dict[str, ArtifactRef] = {}
    seconds, cached = 0.0, 0
    names = (*stages_of(cell.setting), f"evaluate/{cell.setting.end}")
    for spec in (s for s in PIPELINE if s.name in names):
        same = json.dumps([cell.log, cell.chunk, cell.setting.threads, *_recipe(spec.name, job)])
        ref = look_up(spec, job, refs, repair=False)[1] if all(n in refs for n in spec.inputs) else None
        if ref is not None:
            refs[spec.name] = ref
            cached += 1
        elif same not in seen:
            seconds += known[spec.name.partition("/")[0]] * _times(spec.section, config, base)
        seen.add(same)
    return {"cell": cell.name, "seconds": seconds, "cached": f"{cached} of {len(names)} stages"}


def _recipe(stage: str, job: Job) -> list[Any]:
    """The configuration of the stage and of all before it."""
    spec = BY_NAME[stage]
    before = [part for name in spec.inputs for part in _recipe(name, job)]
    return [*before, stage, job.config[spec.section]]


def _times(section: str, config: PipelineConfig, base: PipelineConfig) -> float:
    pixels = [c.ingest.width_px * c.ingest.height_px for c in (config, base)]
    work = pixels[0] / pixels[1]
    if section in ("gnet", "enet"):
        here, there = (getattr(c, section) for c in (config, base))
        views = [x.views_per_iteration + x.novel_views_per_iteration for x in (here, there)]
        work *= here.iterations * views[0] / (there.iterations * views[1])
    return work
