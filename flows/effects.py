"""The plan of a chunk's effects, without a run: ingest from the store, then what each effect measures."""

from __future__ import annotations

from flows.logs import opened_log
from flows.produce import Job, produce
from genre_tasks.config import PipelineConfig
from genre_tasks.effects.plan import plan
from genre_tasks.effects.types import EffectsPlan
from genre_tasks.progress import Progress, silent
from storage.local import open_store


def effects_of(job: Job, progress: Progress = silent) -> EffectsPlan:
    """Ingests the chunk, or finds it ingested, and asks each effect that is not set off."""
    ref = produce("ingest", job, {}, progress=progress)
    store = open_store(job.store)
    (artifact,) = store.artifacts(key=ref.key, chunk=job.chunk)
    config = PipelineConfig.model_validate(job.config).effects
    return plan(config, store.read(artifact), opened_log(job.log).cameras, progress)
