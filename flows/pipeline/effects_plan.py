"""The plan of a chunk's effects, without the rest of a run."""

from __future__ import annotations

from flows.pipeline.stage_runner import Job, read_artifact, run_stage
from genre_tasks.effects.types import EffectsPlan
from genre_tasks.progress import Progress, silent


def plan_effects(job: Job, progress: Progress = silent) -> EffectsPlan:
    """Ingests a chunk and decides which effects are modelled in it, or finds both results in the store.

    A run of the same job takes the same plan from the store.

    Args:
        job: log, chunk, store and configuration.
        progress: called with how far the computation is.

    Returns:
        The plan with a decision for every effect.

    Raises:
        GenreError: as the stages ``ingest`` and ``effects`` raise it.
    """
    ingested = run_stage("ingest", job, {}, progress=progress)
    planned = run_stage("effects", job, {"ingest": ingested}, progress=progress)
    # Read back from the store, where a run will read it, instead of kept from the computation.
    plan: EffectsPlan = read_artifact(job, planned)
    return plan
