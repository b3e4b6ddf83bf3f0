"""The one task: a stage of a chunk under Prefect, with cache state, retries and progress.

The store's manifests alone decide what is cached. Prefect's own result cache is off, and a hit ends in a state named
``Cached``.
"""

from __future__ import annotations

import functools
from typing import Any
from uuid import UUID

from prefect import task
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State, TaskRun
from prefect.context import TaskRunContext
from prefect.states import Completed
from prefect.tasks import Task, exponential_backoff

from flows.observability.stage_context import with_stage_context
from flows.pipeline.gpu_slot import gpu_slot
from flows.pipeline.progress import get_reporter
from flows.pipeline.stage_runner import ArtifactRef, Job, run_stage
from genre_tasks.errors import DiskFullError, ResourceError, TransientIOError, UnsupportedMachineError

# Each retry halves the batch of a stage that has one, so three retries divide it by eight.
RETRIES = 3

_memory_failures: dict[UUID, int] = {}
"""How many tries of a task run ended in ``ResourceError``; Prefect repeats a task in the process that began it."""


async def _can_retry(task: Task[..., Any], run: TaskRun, state: State[Any]) -> bool:
    """Whether a retry can cure the failure: with less memory after ``ResourceError``, later after an I/O error."""
    try:
        await state.aresult()
    except (DiskFullError, UnsupportedMachineError):
        # A full disk would let the stage be computed to its end once more, and a machine stays what it is.
        return False
    except (ResourceError, TransientIOError):
        return True
    except BaseException:
        # The result call raises whatever the task raised; any other kind is final.
        return False
    return False


@task(
    name="stage",
    task_run_name="{stage} · chunk {chunk}",
    retries=RETRIES,
    retry_delay_seconds=exponential_backoff(backoff_factor=1),
    retry_condition_fn=_can_retry,
    # Results are in the store. Prefect would pickle them once more, and answer from its copy without verification.
    persist_result=False,
    cache_policy=NO_CACHE,
)
@with_stage_context
def stage_task(stage: str, chunk: int, job: Job, inputs: dict[str, ArtifactRef]) -> Any:
    """Makes a stage's artifact, or finds it in the store.

    Args:
        stage: the stage's name in ``flows.pipeline.definition``.
        chunk: the job's chunk, repeated for the name of the task run.
        job: log, chunk, store and configuration.
        inputs: references of at least the stage's inputs, by stage name.

    Returns:
        The artifact's reference, in a state named ``Cached`` if the artifact was in the store already.

    Raises:
        GenreError: as the stage raises it, after the retries.
    """
    context = TaskRunContext.get()
    run_id = context.task_run.id if context else None
    # Not Prefect's count of tries: a store that was away for a moment must not change the batch, and so the payload.
    attempt = 0 if run_id is None else _memory_failures.get(run_id, 0)
    reporter = get_reporter()
    reporter.stage_started(stage, chunk)
    try:
        slot = functools.partial(gpu_slot, stage)
        ref = run_stage(stage, job, inputs, attempt=attempt, progress=reporter.progress, slot=slot)
    except ResourceError:
        if run_id is not None:
            _memory_failures[run_id] = attempt + 1
        raise
    if run_id is not None:
        _memory_failures.pop(run_id, None)
    reporter.stage_ended(stage, chunk, ref)
    # The name of the state is what Prefect's UI shows.
    if ref.cached:
        return Completed(name="Cached", message="served from the store", data=ref)
    return ref
