"""What a run would take before it runs: hits, seconds and gigabytes per stage."""

from __future__ import annotations

import statistics
from typing import Any

from flows.pipeline.definition import PIPELINE, RECONSTRUCTING, StageSpec, reconstructing_until
from flows.pipeline.log_cache import chosen_chunks, opened_log
from flows.pipeline.stage_runner import ArtifactRef, Job, look_up
from genre_tasks.config import PipelineConfig
from storage.local import open_store

# Measured on two cores at 320×180 with six cameras and 44k Gaussians (preset small), per chunk: seconds, GB.
# Used where the store holds no finished stage to learn from; scaled with the pixels.
_TYPICAL = {
    "ingest": (10.0, 2.5),
    "initial": (4.0, 2.0),
    "gnet": (4.0, 2.5),
    "effects": (7.0, 2.0),
    "novel_views": (10.0, 2.5),
    "fnet": (24.0, 3.0),
    "enet": (16.0, 2.5),
    "evaluate": (40.0, 3.0),
}
_TYPICAL_PIXELS = 320 * 180


def plan_run(
    log: str, store: str, chunks: list[int] | None, config: PipelineConfig, end: str = RECONSTRUCTING[-1]
) -> dict[str, Any]:
    """The plan of ``genre run --dry-run``: a row per chunk and stage with key, hit or miss, seconds and gigabytes.

    ``end``: the last stage before evaluation, where a budget chose an earlier one than the pipeline's.
    A key depends on the payloads of the inputs: below a miss it is not known yet (``follows``).
    """
    known = _measured(store, opened_log(log).dataset)
    rows: list[dict[str, Any]] = []
    made = reconstructing_until(end)
    for chunk in chosen_chunks(log, config, chunks):
        job = Job(log, chunk, store, config.model_dump(mode="json"))
        refs: dict[str, ArtifactRef] = {}
        for spec in (s for s in PIPELINE if s.name.removeprefix("evaluate/") in made):
            rows.append(_row(spec, job, refs, known, config))
    misses = [row for row in rows if row["cache"] != "hit"]
    return {
        "log": log,
        "store": store,
        "stages": rows,
        "seconds": sum(row["seconds"] for row in misses),
        "gigabytes": max((row["gigabytes"] for row in misses), default=0.0),
        "basis": "stages in this store" if known else "a table of typical values",
    }


def _row(
    spec: StageSpec,
    job: Job,
    refs: dict[str, ArtifactRef],
    known: dict[str, tuple[float, float]],
    config: PipelineConfig,
) -> dict[str, Any]:
    key, cache = None, "follows"
    if all(name in refs for name in spec.inputs):
        address, ref, note = look_up(spec, job, refs, repair=False)
        key, cache = address.key, "hit" if ref else ("corrupt" if note else "miss")
        if ref:
            refs[spec.name] = ref
    seconds, gigabytes = known.get(spec.name) or _typical(spec, config)
    return {
        "chunk": job.chunk,
        "stage": spec.name,
        "key": key,
        "cache": cache,
        "seconds": 0.0 if cache == "hit" else seconds,
        "gigabytes": gigabytes,
    }


def _measured(store: str, dataset: str) -> dict[str, tuple[float, float]]:
    seconds: dict[str, list[float]] = {}
    memory: dict[str, list[float]] = {}
    for artifact in open_store(store).artifacts():
        manifest = artifact.manifest
        if manifest.dataset == dataset:
            seconds.setdefault(manifest.stage, []).append(manifest.seconds)
            memory.setdefault(manifest.stage, []).append(manifest.peak_mib / 1024)
    return {stage: (statistics.median(seconds[stage]), max(memory[stage])) for stage in seconds}


def stage_seconds(store: str) -> dict[str, float]:
    """By stage (``evaluate`` for all of them): the median of those in the store, or a typical value."""
    seconds = {stage: s for stage, (s, _) in _TYPICAL.items()}
    found: dict[str, list[float]] = {}
    for artifact in open_store(store).artifacts():
        found.setdefault(artifact.manifest.stage.partition("/")[0], []).append(artifact.manifest.seconds)
    return seconds | {stage: statistics.median(values) for stage, values in found.items()}


def _typical(spec: StageSpec, config: PipelineConfig) -> tuple[float, float]:
    scale = config.ingest.width_px * config.ingest.height_px / _TYPICAL_PIXELS
    seconds, gigabytes = _TYPICAL[spec.name.partition("/")[0]]
    return seconds * scale, gigabytes * max(1.0, scale / 4)
