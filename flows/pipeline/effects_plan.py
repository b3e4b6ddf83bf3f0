"""The plan of a chunk's effects, without the rest of a run."""

from __future__ import annotations

from flows.pipeline.stage_runner import Job, produce
from genre_tasks.effects.types import EffectsPlan
from genre_tasks.progress import Progress, silent
from storage.local import open_store


def effects_of(job: Job, progress: Progress = silent) -> EffectsPlan:
    """Ingests the chunk and plans it, or finds both in the store: a run that follows takes the same plan."""
    ingested = produce("ingest", job, {}, progress=progress)
    planned = produce("effects", job, {"ingest": ingested}, progress=progress)
    store = open_store(job.store)
    (artifact,) = store.artifacts(key=planned.key, chunk=job.chunk)
    found: EffectsPlan = store.read(artifact)
    return found
