"""What a table would take before it is measured."""

from __future__ import annotations

import json
from typing import Any

from flows.paper_tables.measure import stages_of
from flows.paper_tables.methods import PER_SCENE, Method
from flows.paper_tables.request import Planned
from flows.pipeline.definition import BY_NAME
from flows.pipeline.prediction import stage_seconds
from flows.pipeline.stage_runner import ArtifactRef, Job, look_up
from genre_tasks.config import GnetConfig, PipelineConfig

PER_SCENE_S = 0.012
"""Of one iteration of per-scene 3DGS at 320×180 on two cores; it grows with the pixels."""
_TYPICAL_PIXELS = 320 * 180
_PLAIN = Method("the preset", ())


def predicted(plan: Planned) -> list[dict[str, Any]]:
    """A row a cell: predicted seconds, and how many of its stages are in the store.

    A stage that an earlier cell will have made costs nothing; per-scene training costs by the iteration, GNet and ENet
    in proportion to their renders, the others what such stages took in the store (or a table of typical values).
    """
    known = stage_seconds(plan.basis.store)
    seen: set[str] = set()
    out: list[dict[str, Any]] = []
    for place in plan.places:
        for row in plan.layout.rows:
            if row.label in plan.missing:
                out.append({"cell": row.label, "seconds": 0.0, "cached": f"not measured: {plan.missing[row.label]}"})
                continue
            job = plan.basis.job(plan.layout, row.method, place)
            base = PipelineConfig.model_validate(plan.basis.job(plan.layout, _PLAIN, place).config)
            config = PipelineConfig.model_validate(job.config)
            refs: dict[str, ArtifactRef] = {}
            seconds, names = 0.0, stages_of(plan.layout, row.method)
            for name in names:
                spec = BY_NAME[name]
                same = json.dumps([place.log, place.chunk, *_recipe(name, job)])
                ref = look_up(spec, job, refs, repair=False)[1] if all(i in refs for i in spec.inputs) else None
                if ref is not None:
                    refs[name] = ref
                elif same not in seen:
                    seconds += _seconds(name, config, base, known)
                seen.add(same)
            cached = f"{len(refs)} of {len(names)} stages"
            out.append({"cell": f"{row.label} · {place}", "seconds": seconds, "cached": cached})
    return out


def not_stored(plan: Planned) -> dict[str, str]:
    """A method's name → which of its stages the store has not, for those that lack any on any chunk."""
    out: dict[str, str] = {}
    for place in plan.places:
        for row in plan.layout.rows:
            job = plan.basis.job(plan.layout, row.method, place)
            refs: dict[str, ArtifactRef] = {}
            for name in stages_of(plan.layout, row.method):
                spec = BY_NAME[name]
                ref = look_up(spec, job, refs, repair=False)[1] if all(i in refs for i in spec.inputs) else None
                if ref is None:
                    out.setdefault(row.label, f"the store has no {name} of {place} yet.")
                    break
                refs[name] = ref
    return out


def _recipe(stage: str, job: Job) -> list[Any]:
    """The configuration of the stage and of all before it."""
    spec = BY_NAME[stage]
    return [*(part for name in spec.inputs for part in _recipe(name, job)), stage, job.config[spec.section]]


def _seconds(stage: str, config: PipelineConfig, base: PipelineConfig, known: dict[str, float]) -> float:
    spec = BY_NAME[stage]
    section, plain = getattr(config, spec.section), getattr(base, spec.section)
    if isinstance(section, GnetConfig) and section.method in PER_SCENE:
        pixels = config.ingest.width_px * config.ingest.height_px / _TYPICAL_PIXELS
        return section.per_scene.iterations * PER_SCENE_S * pixels
    seconds = known[stage.partition("/")[0]]
    if spec.section in ("gnet", "enet"):
        renders = [x.iterations * (x.views_per_iteration + x.novel_views_per_iteration) for x in (section, plain)]
        seconds *= renders[0] / renders[1]
    return seconds
