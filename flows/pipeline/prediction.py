"""What a run would take before it runs: cache hits, seconds and gigabytes of each stage."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from typing import Any

from flows.machine.facts import count_cores
from flows.pipeline.definition import PIPELINE, RECONSTRUCTION_STAGES, StageSpec, stages_until
from flows.pipeline.log_cache import cached_log, select_chunks
from flows.pipeline.memory_plan import (
    ChunkSize,
    choose_threads,
    estimate_chunk_size,
    grow_until,
    needs_disk,
    predict_memory,
)
from flows.pipeline.stage_runner import ArtifactRef, Job, find_artifact
from genre_tasks.config import PipelineConfig
from genre_tasks.logs.log_selection import select_cameras
from storage.opening import open_store

# Seconds of one chunk, measured on two cores with six cameras. Used where the store holds no finished stage to learn
# from; in between and beyond they follow a line over the number of pixels, and never fall below the smaller size.
_SECONDS_SMALL = {
    "ingest": 10.0,
    "initial": 4.0,
    "gnet": 4.0,
    "effects": 7.0,
    "novel_views": 10.0,
    "fnet": 24.0,
    "enet": 16.0,
    "evaluate": 40.0,
}
"""With the preset ``small``: 320×180."""

_SECONDS_LARGE = {
    "ingest": 12.0,
    "initial": 8.0,
    "gnet": 38.0,
    "effects": 41.0,
    "novel_views": 26.0,
    "fnet": 86.0,
    "enet": 109.0,
    "evaluate": 180.0,
}
"""With the preset ``hd``: 1280×720. FNet takes far longer where ``fnet.max_network_px`` is not set."""

_SMALL_PIXELS = 320 * 180
_LARGE_PIXELS = 1280 * 720


def predict_run(
    log: str, store: str, chunks: list[int] | None, config: PipelineConfig, end: str = RECONSTRUCTION_STAGES[-1]
) -> dict[str, Any]:
    """Predicts what a run would compute and what that would take, for ``genre run --dry-run``.

    Args:
        log: the log's URI.
        store: folder (or URI) of the store.
        chunks: numbers of chunks; ``None`` for all.
        config: the effective configuration.
        end: the last stage before evaluation, where a budget ends the pipeline early.

    Returns:
        Plain values: ``stages``, a row for each chunk and stage with ``key``, ``cache`` (hit, miss, corrupt or
        follows), ``seconds`` and ``gigabytes``; and ``seconds``, ``gigabytes`` and ``basis`` of the whole run. A key
        depends on the payloads of the inputs: below a miss it is not known yet, and ``cache`` is ``follows``.

    Raises:
        InputError: the log cannot be opened, or does not have one of the chunks.
    """
    opened = cached_log(log)
    size = estimate_chunk_size(opened, select_cameras(config.ingest, opened), config)
    stored = _stored_seconds(store, config, opened.dataset)
    measured = {stage: statistics.median(values) for stage, values in stored.items()}
    included = stages_until(end)
    rows: list[dict[str, Any]] = []
    for chunk in select_chunks(log, config, chunks):
        job = Job(log, chunk, store, config.model_dump(mode="json"))
        refs: dict[str, ArtifactRef] = {}
        for spec in PIPELINE:
            if spec.name.removeprefix("evaluate/") in included:
                rows.append(_predict_stage(spec, job, refs, measured, size, config))
    # A damaged artifact is computed again, so it costs as much as one that is not there.
    misses = [row for row in rows if row["cache"] != "hit"]
    return {
        "log": log,
        "store": store,
        "stages": rows,
        "seconds": sum(row["seconds"] for row in misses),
        # Stages run one after the other, so their memory does not add up.
        "gigabytes": max((row["gigabytes"] for row in misses), default=0.0),
        "basis": "stages in this store" if measured else "a table of typical values",
    }


def median_stage_seconds(store: str, config: PipelineConfig) -> dict[str, float]:
    """Looks up how long stages usually take: the median of those in a store, or a typical value.

    Args:
        store: folder (or URI) of the store.
        config: the size of its images is the size of which stages count.

    Returns:
        Seconds by stage; all evaluation stages share the name ``evaluate``.
    """
    usual = {stage: _typical_seconds(stage, config) for stage in _SECONDS_SMALL}
    by_kind: dict[str, list[float]] = {}
    for stage, values in _stored_seconds(store, config).items():
        by_kind.setdefault(stage.partition("/")[0], []).extend(values)
    return usual | {stage: statistics.median(values) for stage, values in by_kind.items()}


def _predict_stage(
    spec: StageSpec,
    job: Job,
    refs: dict[str, ArtifactRef],
    measured: Mapping[str, float],
    size: ChunkSize,
    config: PipelineConfig,
) -> dict[str, Any]:
    """One row of the prediction; a hit is added to ``refs``, so that later stages can be looked up."""
    key = None
    cache = "follows"
    if all(name in refs for name in spec.inputs):
        # A prediction deletes nothing: a damaged artifact stays for the run to repair.
        address, ref, note = find_artifact(spec, job, refs, repair=False)
        key = address.key
        if ref is not None:
            refs[spec.name] = ref
            cache = "hit"
        else:
            cache = "corrupt" if note else "miss"
    seconds = measured[spec.name] if spec.name in measured else _typical_seconds(spec.name, config)
    grown = grow_until(spec.name, size, config)
    memory = predict_memory(spec.name, grown, config, choose_threads(spec.name, grown, config, count_cores()))
    on_disk = needs_disk(spec.name, memory, config)
    return {
        "chunk": job.chunk,
        "stage": spec.name,
        "key": key,
        "cache": cache,
        "seconds": 0.0 if cache == "hit" else seconds,
        "gigabytes": (memory.with_images_on_disk_mib if on_disk else memory.in_memory_mib) / 1024,
    }


def _stored_seconds(store: str, config: PipelineConfig, dataset: str = "") -> dict[str, list[float]]:
    """Seconds of the stages in a store that have images of this size, by stage; of all datasets if none is named."""
    manifests = [artifact.manifest for artifact in open_store(store).artifacts()]
    # Cameras and images differ between datasets, and with them the time of every stage.
    manifests = [m for m in manifests if not dataset or m.dataset == dataset]
    size = {"width_px": config.ingest.width_px, "height_px": config.ingest.height_px}
    of_size = {m.key for m in manifests if m.stage == "ingest" and size.items() <= m.configuration.items()}
    seconds: dict[str, list[float]] = {}
    for manifest in manifests:
        # Every later stage reads the ingested images, and its own section does not say how large they are.
        if (manifest.key if manifest.stage == "ingest" else manifest.inputs.get("ingest")) in of_size:
            seconds.setdefault(manifest.stage, []).append(manifest.seconds)
    return seconds


def _typical_seconds(stage: str, config: PipelineConfig) -> float:
    pixels = config.ingest.width_px * config.ingest.height_px
    share = max(0.0, (pixels - _SMALL_PIXELS) / (_LARGE_PIXELS - _SMALL_PIXELS))
    stage = stage.partition("/")[0]
    # Most at the smaller size is torch, points and Gaussians, which do not grow with the pixels.
    return _SECONDS_SMALL[stage] + share * (_SECONDS_LARGE[stage] - _SECONDS_SMALL[stage])
