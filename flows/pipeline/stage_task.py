"""The one task: a stage of a chunk under Prefect, with cache state, retries and progress.

The store's manifests are the one truth about what is cached: Prefect's own result cache is off, and a hit ends in a
state named ``Cached``.
"""

from __future__ import annotations

from typing import Any

from prefect import task
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State, TaskRun
from prefect.context import TaskRunContext
from prefect.states import Completed
from prefect.tasks import Task, exponential_backoff

from flows.pipeline.progress import current_reporter
from flows.pipeline.stage_runner import ArtifactRef, Job, produce
from genre_tasks.errors import ResourceError, TransientIOError

RETRIES = 3


async def _may_pass(task: Task[..., Any], run: TaskRun, state: State[Any]) -> bool:
    """Only what a retry can cure is retried: smaller after ``ResourceError``, later after ``TransientIOError``."""
    try:
        await state.aresult()
    except (ResourceError, TransientIOError):
        return True
    except BaseException:  # the result call raises whatever the task raised; any other kind is final
        return False
    return False


@task(
    name="stage",
    task_run_name="{stage} · chunk {chunk}",
    retries=RETRIES,
    retry_delay_seconds=exponential_backoff(backoff_factor=1),
    retry_condition_fn=_may_pass,
    persist_result=False,
    cache_policy=NO_CACHE,
)
def stage_task(stage: str, chunk: int, job: Job, inputs: dict[str, ArtifactRef]) -> Any:
    """Produces a stage's artifact and returns its reference, in a ``Cached`` state if it was there already.

    Args:
        stage: the stage's name in ``flows.pipeline.definition``. chunk: repeated for the task run's name.
        job: log, chunk, store, configuration. inputs: references of all earlier artifacts of the chunk.
    """
    context = TaskRunContext.get()
    attempt = context.task_run.run_count - 1 if context else 0
    reporter = current_reporter()
    reporter.stage_started(stage, chunk)
    ref = produce(stage, job, inputs, attempt=max(attempt, 0), progress=reporter.progress)
    reporter.stage_ended(stage, chunk, ref)
    if ref.cached:
        return Completed(name="Cached", message="served from the store", data=ref)
    return ref
