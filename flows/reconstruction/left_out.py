"""Errors of runs that are not complete: each knows what is done, what was left out, and why."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from flows.error_record import describe_record, record_error
from genre_tasks.errors import (
    ArtifactCorruptError,
    ConfigError,
    GenreError,
    InputError,
    ResourceError,
    TransientIOError,
)
from storage.manifest import NewerSchemaError


class ChunksLeftOutError(GenreError):
    """Some chunks of a log could not be reconstructed.

    Args:
        log: the log's URI.
        count: how many chunks were asked for.
        failures: by chunk, its error.
        record: the record of the run of the other chunks; ``None`` where there is none.

    Attributes:
        record: the record.
        left_out: of each chunk that could not be reconstructed, its error as plain values with ``chunk``.
        status: ``partly_done`` where other chunks are done; otherwise ``refused`` if every chunk's input or
            configuration is at fault, and ``failed`` if not.
        is_passing: whether any chunk failed by its surroundings, so that another try may succeed.

    >>> errors = {1: InputError("no source view", remedy="Take more frames.")}
    >>> error = ChunksLeftOutError("synthetic:street", 2, errors, record={"run": "5f41"})
    >>> print(error)
    1 of 2 chunks left out: chunk 1: no source view (log synthetic:street). Take more frames.
    >>> error.status
    'partly_done'
    """

    def __init__(
        self, log: str, count: int, failures: Mapping[int, GenreError], record: dict[str, Any] | None = None
    ) -> None:
        problems = "; ".join(f"chunk {chunk}: {error.problem}" for chunk, error in failures.items())
        # The same remedy is said once, as chunks of one log often lack the same thing.
        remedies = " ".join(dict.fromkeys(error.remedy for error in failures.values()))
        super().__init__(f"{len(failures)} of {count} chunks left out: {problems}", remedy=remedies, log=log)
        self.record = record
        self.left_out = record_failures(log, failures)
        self.is_passing = any(may_pass(error) for error in failures.values())
        is_refused = all(isinstance(error, InputError | ConfigError) for error in failures.values())
        self.status: Literal["partly_done", "refused", "failed"] = "refused" if is_refused else "failed"
        if record is not None:
            self.status = "partly_done"


def may_pass(error: BaseException) -> bool:
    """Says whether another try may succeed, of an error that is not of several chunks.

    Args:
        error: what ended a stage or a run.

    Returns:
        Whether its surroundings are at fault, or an artifact that is computed again.

    >>> may_pass(ArtifactCorruptError("an altered file", remedy="Run again.")), may_pass(InputError("", remedy=""))
    (True, False)
    """
    # A stage that meets a damaged input removes it. What a newer version wrote stays as it is.
    if isinstance(error, NewerSchemaError):
        return False
    return isinstance(error, TransientIOError | ResourceError | ArtifactCorruptError)


class LogsFailedError(GenreError):
    """Some logs of a dataset could not be reconstructed completely.

    Args:
        outcomes: of each log, as :func:`describe_log` gives it.

    Attributes:
        outcomes: the same.
        status: ``partly_done`` where any log is done, wholly or in part.
    """

    def __init__(self, outcomes: Sequence[Mapping[str, Any]]) -> None:
        problems = [
            f"{outcome['log']} {outcome['status'].replace('_', ' ')}: {outcome['why'].rstrip('.')}"
            for outcome in outcomes
            if outcome["status"] != "done"
        ]
        super().__init__(
            f"{len(problems)} of {len(outcomes)} logs are not complete: {'; '.join(problems)}",
            remedy="Mend what the errors name and run again: what is done comes from the store.",
        )
        self.outcomes = [dict(outcome) for outcome in outcomes]
        is_any_done = any(outcome["status"] in ("done", "partly_done") for outcome in outcomes)
        self.status: Literal["partly_done", "failed"] = "partly_done" if is_any_done else "failed"


def record_failures(log: str, failures: Mapping[int, GenreError]) -> list[dict[str, Any]]:
    """Writes the errors of a log's chunks as plain values.

    Args:
        log: the log's URI.
        failures: by chunk, its error.

    Returns:
        Of each, what :func:`flows.error_record.record_error` gives, with ``log`` and ``chunk``.
    """
    return [record_error(error) | {"log": log, "chunk": chunk} for chunk, error in failures.items()]


def describe_log(log: str, record: Mapping[str, Any] | None, error: Exception | None) -> dict[str, Any]:
    """Says how the run of a log ended, as a row of the table of all logs.

    Args:
        log: the log's URI.
        record: the record of its run; ``None`` where there is none.
        error: what is wrong, if anything is.

    Returns:
        ``log``, ``status`` (done, partly_done or failed), ``chunks`` (how many are done), ``left_out`` (how many are
        not), ``run``, ``report`` and ``why``.

    >>> describe_log("synthetic:nothing", None, InputError("no such street", remedy="Check it."))["status"]
    'failed'
    """
    left_out = getattr(error, "left_out", ())
    why = "" if error is None else describe_record(record_error(error))
    if error is not None and not isinstance(error, GenreError):
        why = f"a fault of ours: {type(error).__name__}: {why}"
    return {
        "log": log,
        "status": "failed" if record is None else record["status"],
        "chunks": 0 if record is None else len(record["chunks"]),
        "left_out": len(left_out),
        "run": "" if record is None else record["run"],
        "report": "" if record is None else record["report"],
        "why": why,
    }
