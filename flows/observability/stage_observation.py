"""What is noted of a running stage: the context of its log records, its outcome, seconds, bytes and waits."""

from __future__ import annotations

import functools
import inspect
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import ParamSpec, Protocol, TypeVar

from flows.observability import metric_definitions as metrics
from flows.observability.log_records import log_stage_end
from flows.observability.process_counters import ProcessCounters, get_counters
from flows.observability.stage_context import StageContext, enter_stage
from genre_tasks.progress import Progress


class _Reference(Protocol):
    """What is read of a stage's result."""

    @property
    def key(self) -> str: ...

    @property
    def cached(self) -> bool: ...


class _File(Protocol):
    """What is read of a file in a manifest."""

    @property
    def size(self) -> int: ...


_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result", bound=_Reference)


@dataclass
class StageObservation:
    """What the code of a running stage reports.

    Attributes:
        context: of its log records.
        is_cached: whether the artifact was in the store already.
        bytes_read: of the artifacts that it has read.
        bytes_written: of the artifact that it has committed.
        lease_wait_s: seconds that it waited for another process; 0 if it did not.
    """

    context: StageContext
    is_cached: bool = False
    bytes_read: int = 0
    bytes_written: int = 0
    lease_wait_s: float = 0.0


_observation: ContextVar[StageObservation | None] = ContextVar("genre_observation", default=None)


@contextmanager
def observe_stage(log: str, chunk: int, stage: str, attempt: int = 0) -> Iterator[StageObservation]:
    """Notes what a stage does while the block runs; it counts as failed if an error leaves the block.

    Args:
        log: the log's URI.
        chunk: number of the chunk.
        stage: the stage's name.
        attempt: how many tries there were before this one.

    Yields:
        What the stage fills in.

    Example::

        with observe_stage(job.log, job.chunk, "gnet") as observation:
            observation.context.key = key
    """
    counters = get_counters()
    start_s = time.perf_counter()
    outcome = "failed"
    if counters is not None:
        counters.add(metrics.RUNNING_STAGES, stage)
        if attempt > 0:
            counters.add(metrics.RETRIES, stage)
        counters.save()
    with enter_stage(log, chunk, stage) as context:
        observation = StageObservation(context)
        token = _observation.set(observation)
        try:
            yield observation
            outcome = "cached" if observation.is_cached else "computed"
        finally:
            _observation.reset(token)
            seconds = time.perf_counter() - start_s
            log_stage_end(stage, outcome, seconds)
            if counters is not None:
                _count_end(counters, stage, outcome, seconds, observation)


def observed(run: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
    """Makes a function that runs a stage an observed one.

    Args:
        run: takes ``stage``, ``job`` and ``attempt``, and returns a reference that says whether it is ``cached``.

    Returns:
        The same, with its log records and counts: see :func:`observe_stage`.
    """
    signature = inspect.signature(run)

    @functools.wraps(run)
    def run_observed(*args: _Parameters.args, **kwargs: _Parameters.kwargs) -> _Result:
        bound = signature.bind(*args, **kwargs)
        bound.apply_defaults()
        job = bound.arguments["job"]
        with observe_stage(job.log, job.chunk, bound.arguments["stage"], bound.arguments["attempt"]) as observation:
            ref = run(*args, **kwargs)
            observation.context.key = ref.key
            observation.is_cached = ref.cached
        return ref

    return run_observed


def note_key(key: str) -> None:
    """Notes the key of the running stage's artifact, for the log records that follow.

    Args:
        key: the artifact's key.
    """
    observation = _observation.get()
    if observation is not None:
        observation.context.key = key


def count_read(files: Iterable[_File]) -> None:
    """Adds files to what the running stage has read.

    Args:
        files: such as those that a manifest lists.
    """
    observation = _observation.get()
    if observation is not None:
        observation.bytes_read += sum(file.size for file in files)


def count_written(files: Iterable[_File]) -> None:
    """Adds files to what the running stage has written.

    Args:
        files: such as those that a manifest lists.
    """
    observation = _observation.get()
    if observation is not None:
        observation.bytes_written += sum(file.size for file in files)


def measure_lease_wait(progress: Progress) -> Progress:
    """Measures how long the running stage waits for a lease.

    Args:
        progress: what a lease would call while another process has it.

    Returns:
        What the lease shall call instead. The wait ends with its last call.
    """
    start_s = time.perf_counter()
    observation = _observation.get()

    def report(done: int, total: int, note: str = "") -> None:
        if observation is not None:
            observation.lease_wait_s = time.perf_counter() - start_s
        progress(done, total, note)

    return report


def _count_end(
    counters: ProcessCounters, stage: str, outcome: str, seconds: float, observation: StageObservation
) -> None:
    counters.add(metrics.RUNNING_STAGES, stage, amount=-1)
    counters.add(metrics.STAGES, stage, outcome)
    counters.observe(metrics.STAGE_SECONDS, stage, outcome, value=seconds)
    if outcome == "cached":
        counters.add(metrics.CACHE_HITS, stage)
    if observation.bytes_read:
        counters.add(metrics.BYTES_READ, stage, amount=observation.bytes_read)
    if observation.bytes_written:
        counters.add(metrics.BYTES_WRITTEN, stage, amount=observation.bytes_written)
    if observation.lease_wait_s:
        counters.add(metrics.LEASE_WAITS, stage)
        counters.add(metrics.LEASE_WAIT_SECONDS, stage, amount=observation.lease_wait_s)
    counters.save()
