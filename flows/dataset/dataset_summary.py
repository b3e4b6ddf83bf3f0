"""What a dataset's report and record show: every log or chunk with metrics, what failed and why, the worst views."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import Any

from flows.dataset.setting_differences import LogDifference, SettingDifference, count_differences, list_differences
from flows.dataset.worst_views import WorstView, find_worst_views
from flows.observability.redaction import redact
from flows.reconstruction.range_record import FOLDER as RANGES
from flows.reconstruction.range_record import read_range_record
from flows.reconstruction.run_records import find_run_record, name_run_folder
from genre_tasks.errors import GenreError
from storage.opening import open_store

SCENE_STAGES = ("initial", "gnet", "enet")
"""Stages that make scenes; a run's result is that of the last one it has."""


@dataclass(frozen=True)
class LogFailure:
    """What is not done of a log.

    Attributes:
        log: the log's URI.
        chunk: number of the chunk; ``None`` for the log as such.
        status: of the log.
        reason: what is wrong.
        remedy: what can be done; empty where the reason says it.
        where: the worker or host that it happened on; empty where it is not known.
        attempts: how many tries there were.
    """

    log: str
    chunk: int | None
    status: str
    reason: str
    remedy: str = ""
    where: str = ""
    attempts: int = 1


@dataclass(frozen=True)
class LogSummary:
    """One log of the dataset, or one chunk of a log where every chunk has a run of its own.

    Attributes:
        log: the log's URI.
        status: done, partly_done, failed, running or waiting.
        chunk: number of the chunk that the run was about; ``None`` for all chunks of the log.
        run: the run's name; empty where it has none.
        seconds: wall time of the log's run.
        chunks: how many are done.
        left_out: how many could not be reconstructed.
        cached_stages: stages that the store had already.
        stages: all stages.
        stage_seconds: seconds of computing, by stage; those of an earlier run for what came from the store.
        metrics: means over the chunks of the last scene's metrics, such as ``interpolation/psnr``.
        range_m: smallest reliable range of all chunks and both sides, metres; ``None`` where none was measured.
    """

    log: str
    status: str
    chunk: int | None = None
    run: str = ""
    seconds: float = 0.0
    chunks: int = 0
    left_out: int = 0
    cached_stages: int = 0
    stages: int = 0
    stage_seconds: Mapping[str, float] = field(default_factory=dict)
    metrics: Mapping[str, float] = field(default_factory=dict)
    range_m: float | None = None


@dataclass(frozen=True)
class DatasetSummary:
    """A dataset's run, complete or under way.

    Attributes:
        preset: the preset that all logs started from.
        store: path or URI of the store, without credentials.
        logs: one entry for each log, or for each chunk that has a run of its own, in the order of the outcomes.
        failures: what is not done.
        differs: settings that differ from the preset.
        worst_views: pictures of the chunks with the lowest accuracy, the worst first.
    """

    preset: str
    store: str
    logs: tuple[LogSummary, ...]
    failures: tuple[LogFailure, ...] = ()
    differs: tuple[SettingDifference, ...] = ()
    worst_views: tuple[WorstView, ...] = ()

    @property
    def is_by_chunk(self) -> bool:
        """Whether chunks have runs of their own, so that a log may have several entries."""
        return any(log.chunk is not None for log in self.logs)

    @property
    def log_count(self) -> int:
        """How many logs there are.

        >>> DatasetSummary("demo", "store", (LogSummary("a", "done", 0), LogSummary("a", "done", 1))).log_count
        1
        """
        return len({log.log for log in self.logs}) if self.is_by_chunk else len(self.logs)

    def count(self, status: str) -> int:
        """Counts the entries that ended so.

        Args:
            status: such as ``done``.

        Returns:
            How many there are.

        >>> DatasetSummary("demo", "store", (LogSummary("a", "done"), LogSummary("b", "failed"))).count("done")
        1
        """
        return sum(log.status == status for log in self.logs)

    def as_values(self) -> dict[str, Any]:
        """Gives the summary as JSON values, for ``dataset.json``.

        Returns:
            Everything but the pictures.
        """
        values = asdict(self)
        for view in values["worst_views"]:
            del view["picture"], view["truth"]
        cleaned: dict[str, Any] = _without_infinities(values)
        return cleaned


def summarise_dataset(store: str, preset: str, outcomes: Sequence[Mapping[str, Any]]) -> DatasetSummary:
    """Gathers what the report of a dataset shows from the records of its runs.

    A record that is missing or damaged becomes a failure with the reason, and so does a damaged part of one. All else
    is shown nevertheless.

    Args:
        store: folder (or URI) of the store.
        preset: the preset that all logs started from.
        outcomes: of each log, ``log`` and ``status``; ``run``, ``seconds``, ``chunk``, ``where``, ``attempts`` and
            ``why`` where they are known.

    Returns:
        The summary.

    Raises:
        ConfigError: the store is of no known kind.

    Example::

        summary = summarise_dataset("genre-store", "small", outcomes)
        write_dataset_report(folder / "report.html", summary)
    """
    opened = open_store(store)
    logs = []
    failures: list[LogFailure] = []
    records = []
    differences: list[LogDifference] = []
    for outcome in outcomes:
        record: dict[str, Any] = {}
        if outcome.get("run"):
            with _noted(failures, outcome):
                record = find_run_record(store, str(outcome["run"]))
        failures += _find_failures(outcome, record)
        log = _summarise_log(outcome, record)
        if record:
            records.append(record)
            with _noted(failures, outcome):
                log = _add_range(log, store, record)
            with _noted(failures, outcome):
                differences += list_differences(record)
        logs.append(log)
    return DatasetSummary(
        preset=preset,
        store=redact(opened.uri),
        logs=tuple(logs),
        failures=tuple(failures),
        differs=count_differences(differences),
        worst_views=find_worst_views(opened, records),
    )


@contextmanager
def _noted(failures: list[LogFailure], outcome: Mapping[str, Any]) -> Iterator[None]:
    """Makes an error a failure of this one log."""
    try:
        yield
    except GenreError as error:
        failures.append(_describe_failure(outcome, _find_chunk(outcome), error.problem, error.remedy))


def _summarise_log(outcome: Mapping[str, Any], record: Mapping[str, Any]) -> LogSummary:
    chunks = record.get("chunks", ())
    stages = [stage for chunk in chunks for stage in chunk["stages"]]
    stage_seconds: dict[str, float] = {}
    for stage in stages:
        # Evaluations are one kind of work for a reader, whichever scene they are of.
        name = stage["stage"].partition("/")[0]
        stage_seconds[name] = stage_seconds.get(name, 0.0) + stage["seconds"]
    return LogSummary(
        log=redact(str(outcome["log"])),
        status=str(outcome["status"]),
        chunk=_find_chunk(outcome),
        run=str(record.get("run", "")),
        seconds=float(outcome.get("seconds") or 0.0),
        chunks=len(chunks) or int(outcome.get("chunks") or 0),
        left_out=int(outcome.get("left_out") or len(record.get("left_out", ()))),
        cached_stages=sum(stage["cached"] for stage in stages),
        stages=len(stages),
        stage_seconds=stage_seconds,
        metrics=_mean_metrics(chunks),
    )


def _mean_metrics(chunks: Iterable[Mapping[str, Any]]) -> dict[str, float]:
    """Means over the chunks of what the last scene of each has; values that are no finite numbers are left out."""
    values: dict[str, list[float]] = {}
    for chunk in chunks:
        for name, value in find_last_metrics(chunk).items():
            if isinstance(value, int | float) and math.isfinite(value):
                values.setdefault(name, []).append(float(value))
    return {name: sum(found) / len(found) for name, found in values.items()}


def find_last_metrics(chunk: Mapping[str, Any]) -> Mapping[str, Any]:
    """Finds the metrics of the last scene of a recorded chunk.

    Args:
        chunk: of a run's record.

    Returns:
        Values by name; empty where no scene was evaluated.
    """
    by_stage = {stage["stage"]: stage["metrics"] for stage in chunk["stages"]}
    return next((by_stage[name] for name in reversed(SCENE_STAGES) if by_stage.get(name)), {})


def _add_range(log: LogSummary, store: str, record: Mapping[str, Any]) -> LogSummary:
    from dataclasses import replace

    records = open_store(store).records
    # Only this one file: a run's folder may be large, and the store far away.
    parent = name_run_folder(record["run"])
    sides: list[float] = []
    for chunk in record["chunks"]:
        number = chunk["chunk"]
        for path in records.find(parent, f"chunk-{number}-curve.json", RANGES):
            found = read_range_record(path.parent.parent, number)
            sides += [] if found is None else [found.left_m, found.right_m]
    return replace(log, range_m=min(sides)) if sides else log


def _find_failures(outcome: Mapping[str, Any], record: Mapping[str, Any]) -> list[LogFailure]:
    left_out = [
        _describe_failure(
            outcome, entry["chunk"], str(entry.get("message", "no reason is recorded")), str(entry.get("remedy", ""))
        )
        for entry in record.get("left_out", ())
    ]
    # The reason of a log that is partly done is that of its chunks.
    if left_out or not outcome.get("why"):
        return left_out
    return [_describe_failure(outcome, _find_chunk(outcome), str(outcome["why"]), "")]


def _find_chunk(outcome: Mapping[str, Any]) -> int | None:
    # The table of logs has an empty text for a run of all chunks.
    chunk = outcome.get("chunk")
    return chunk if isinstance(chunk, int) else None


def _describe_failure(outcome: Mapping[str, Any], chunk: int | None, reason: str, remedy: str) -> LogFailure:
    return LogFailure(
        log=redact(str(outcome["log"])),
        chunk=chunk,
        status=str(outcome["status"]),
        reason=redact(reason),
        remedy=redact(remedy),
        where=redact(str(outcome.get("where") or "")),
        attempts=int(outcome.get("attempts") or 1),
    )


def _without_infinities(value: Any) -> Any:
    """The value without what JSON does not have."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(name): _without_infinities(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_without_infinities(entry) for entry in value]
    return value
