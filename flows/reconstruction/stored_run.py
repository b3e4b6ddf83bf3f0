"""Runs whose every stage is in the store already: nothing is computed, so nothing has to start."""

from __future__ import annotations

from flows.configuration import diff_from_preset
from flows.pipeline.definition import PIPELINE
from flows.pipeline.log_cache import select_chunks
from flows.pipeline.stage_runner import ArtifactRef, Job, find_artifact
from flows.reconstruction.run_records import FinishedRun
from genre_tasks.config import PipelineConfig
from storage.opening import open_store


def find_stored_run(
    log: str, preset: str, store: str, chunks: list[int] | None, config: PipelineConfig
) -> FinishedRun | None:
    """Looks up a run in the store, and verifies each of its artifacts.

    Args:
        log: the log's URI.
        preset: the preset that the configuration started from.
        store: folder (or URI) of the store.
        chunks: numbers of the chunks; ``None`` for all.
        config: the effective configuration.

    Returns:
        The run, or ``None`` where any stage of any chunk has to be computed.

    Raises:
        InputError: the log cannot be opened, or does not have one of the chunks.
    """
    values = config.model_dump(mode="json")
    found: dict[int, dict[str, ArtifactRef]] = {}
    for chunk in select_chunks(log, config, chunks):
        refs = _find_stored_chunk(Job(log, chunk, store, values))
        if refs is None:
            return None
        found[chunk] = refs
    # A killed run may have left half-written folders behind. A run that computes removes them itself.
    open_store(store).clean_temporaries()
    return FinishedRun(
        log=log,
        preset=preset,
        store=store,
        config=values,
        differs=diff_from_preset(config, preset),
        chunks=found,
    )


def _find_stored_chunk(job: Job) -> dict[str, ArtifactRef] | None:
    """The references of every stage; ``None`` at the first one that is missing or damaged."""
    refs: dict[str, ArtifactRef] = {}
    for spec in PIPELINE:
        # A damaged artifact is left for the run that computes it again.
        ref = find_artifact(spec, job, refs, repair=False).ref
        if ref is None:
            return None
        refs[spec.name] = ref
    return refs
