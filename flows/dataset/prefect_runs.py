"""Child runs on a Prefect server: flow runs of the deployment ``reconstruct-log/log``, found again by their tags."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from email.utils import parsedate_to_datetime
from typing import Any
from uuid import UUID

from prefect.client.orchestration import SyncPrefectClient, get_client
from prefect.client.schemas.filters import (
    ArtifactFilter,
    ArtifactFilterFlowRunId,
    ArtifactFilterKey,
    FlowRunFilter,
    FlowRunFilterId,
    FlowRunFilterTags,
    TaskRunFilter,
    TaskRunFilterFlowRunId,
    TaskRunFilterState,
    TaskRunFilterStateType,
)
from prefect.client.schemas.objects import Artifact, FlowRun, StateType
from prefect.client.schemas.sorting import FlowRunSort
from prefect.events.filters import EventFilter, EventNameFilter, EventOccurredFilter, EventOrder, EventResourceFilter
from prefect.states import Crashed

from flows.dataset.child_runs import ACTIVE_STATES, DATASET_TAG, SILENT, ChildRun
from flows.dataset.child_start_watch import ChildStartWatch
from flows.dataset.server_calls import call_server
from flows.dataset.supervisor import HEARTBEAT_S
from flows.dataset.work_units import WorkUnit, read_unit
from flows.operations.heartbeat_automation import SILENT_STATE_NAME
from flows.pipeline.gpu_slot import GPU_LIMIT_VARIABLE
from flows.reconstruction.outcome_artifact import DATASET_VARIABLE, OUTCOME_KEY

DEPLOYMENT = "reconstruct-log/log"
"""What a child run is a run of."""
HEARTBEAT_EVENT = "prefect.flow-run.heartbeat"
# The server gives no more runs in one answer, and no more than fifty events.
_RUNS_PER_REQUEST = 200
_EVENTS_PER_REQUEST = 50
_DAYS = 7
# A run that was tried again within itself has left several.
_OUTCOMES_PER_REQUEST = 50
_SUBMITTED_AT_ONCE = 8
_RUN_RESOURCE = "prefect.flow-run."
_WORKER_LABEL = "prefect.worker.name"


@dataclass(frozen=True)
class ChildRequest:
    """What all child runs of a dataset have in common.

    Attributes:
        dataset: the dataset's name.
        parent: id of the parent's flow run.
        pool: the work pool that runs them.
        parameters: of ``reconstruct-log``, apart from log and chunks.
        gpu_limit: name of the concurrency limit that a stage on a GPU waits for; ``None`` for none.
    """

    dataset: str
    parent: str
    pool: str
    parameters: Mapping[str, Any]
    gpu_limit: str | None = None


class PrefectRuns:
    """Implements :class:`flows.dataset.child_runs.ChildRuns` by Prefect's API.

    Args:
        request: what the child runs have in common.
        client: of the server; the one of the settings if not given.
        before_submission: called before runs are submitted; what it raises ends the dataset.
    """

    def __init__(
        self,
        request: ChildRequest,
        client: SyncPrefectClient | None = None,
        before_submission: Callable[[], None] = lambda: None,
    ) -> None:
        self._request = request
        self._client = client or get_client(sync_client=True)
        self._before_submission = before_submission
        self._deployment = call_server(self._client.read_deployment_by_name, DEPLOYMENT)
        self._start_watch = ChildStartWatch(self._client)

    def find(self) -> list[ChildRun]:
        """Finds runs of an earlier life of this parent, and active ones of any parent of the same dataset."""
        tags = FlowRunFilter(tags=FlowRunFilterTags(all_=[dataset_tag(self._request.dataset)]))
        runs = [self._read(run) for run in self._page(tags) if read_unit(run.tags) is not None]
        return [run for run in runs if run.is_ours or run.state in ACTIVE_STATES]

    def submit(self, requests: Sequence[tuple[WorkUnit, int]]) -> Sequence[ChildRun]:
        """Submits runs, several at a time; the same unit and attempt give the same run."""
        self._before_submission()
        # One after another, a busy server that takes a second for a request would leave a hundred workers idle.
        with ThreadPoolExecutor(_SUBMITTED_AT_ONCE) as threads:
            return list(threads.map(self._submit, *zip(*requests, strict=True)))

    def _submit(self, unit: WorkUnit, attempt: int) -> ChildRun:
        chunks = None if unit.chunk is None else [unit.chunk]
        environment = {DATASET_VARIABLE: self._request.dataset, "PREFECT_FLOWS_HEARTBEAT_FREQUENCY": str(HEARTBEAT_S)}
        if self._request.gpu_limit is not None:
            environment[GPU_LIMIT_VARIABLE] = self._request.gpu_limit
        key = [self._request.dataset, *unit, self._request.parent, attempt]
        body = {
            "name": unit.log if unit.chunk is None else f"{unit.log} · chunk {unit.chunk}",
            "flow_id": str(self._deployment.flow_id),
            "deployment_id": str(self._deployment.id),
            "parameters": {**self._request.parameters, "log": unit.log, "chunks": chunks},
            "tags": [dataset_tag(self._request.dataset), self._parent_tag, *unit.tags()],
            "idempotency_key": hashlib.sha256(json.dumps(key).encode()).hexdigest(),
            # The deployment may be of another pool: Prefect's client could only choose the queue.
            "work_pool_name": self._request.pool,
            "job_variables": {**(self._deployment.job_variables or {}), "env": environment},
            "state": {"type": "SCHEDULED", "name": "Scheduled"},
        }
        response = call_server(self._client.request, "POST", "/flow_runs/", json=body)
        return self._read(FlowRun.model_validate(response.json()))

    def read(self, ids: Sequence[str]) -> Mapping[str, ChildRun]:
        """Reads the state of runs."""
        runs: list[FlowRun] = []
        for some in _split(ids, _RUNS_PER_REQUEST):
            runs += self._page(FlowRunFilter(id=FlowRunFilterId(any_=[UUID(id_) for id_ in some])))
        self._start_watch.check(runs)
        return {str(run.id): self._read(run) for run in runs}

    def read_heartbeats(self, ids: Sequence[str]) -> Mapping[str, str]:
        """Reads when runs have last shown that they are alive."""
        # By their number and not by their times, which jump with the worker's clock.
        found: dict[str, str] = {}
        for some in _split(ids, _RUNS_PER_REQUEST):
            body = {"filter": _heartbeats_of(some).model_dump(mode="json", exclude_unset=True)}
            # Prefect's client has no function for it.
            response = call_server(
                self._client.request,
                "POST",
                "/events/count-by/{countable}",
                path_params={"countable": "resource"},
                json=body,
            )
            for entry in response.json():
                found[entry["value"].removeprefix(_RUN_RESOURCE)] = str(entry["count"])
        return found

    def read_event_delay(self) -> float:
        """Measures how far the server is behind with the events that it has received."""
        return min(_read_ages(self._client, _any_event()), default=0.0)

    def read_stages(self, ids: Sequence[str]) -> Mapping[str, str]:
        """Reads which stage runs are in."""
        found: dict[str, str] = {}
        running = TaskRunFilterState(type=TaskRunFilterStateType(any_=[StateType.RUNNING]))
        for some in _split(ids, _RUNS_PER_REQUEST):
            wanted = TaskRunFilter(
                flow_run_id=TaskRunFilterFlowRunId(any_=[UUID(id_) for id_ in some]),
                state=running,
            )
            for task in call_server(self._client.read_task_runs, task_run_filter=wanted, limit=_RUNS_PER_REQUEST):
                found[str(task.flow_run_id)] = task.name
        return found

    def crash(self, run: ChildRun, reason: str) -> None:
        """Sets a run to Crashed, so that its slots are free; a run that has ended meanwhile is left as it is."""
        newest = call_server(self._client.read_flow_run, UUID(run.id))
        if newest.state is not None and _name_state(newest) == run.state:
            # Forced: the rules of states would let a run that is being cancelled stay as it is.
            call_server(self._client.set_flow_run_state, UUID(run.id), Crashed(message=reason), force=True)

    def read_outcomes(self, ids: Sequence[str]) -> Mapping[str, dict[str, Any]]:
        """Reads how runs ended, as the runs themselves have left it."""
        newest: dict[str, Artifact] = {}
        for some in _split(ids, _OUTCOMES_PER_REQUEST):
            wanted = ArtifactFilter(
                flow_run_id=ArtifactFilterFlowRunId(any_=[UUID(id_) for id_ in some]),
                key=ArtifactFilterKey(any_=[OUTCOME_KEY]),
            )
            artifacts = call_server(self._client.read_artifacts, artifact_filter=wanted, limit=_RUNS_PER_REQUEST)
            for artifact in sorted(artifacts, key=lambda artifact: str(artifact.created)):
                newest[str(artifact.flow_run_id)] = artifact
        return {id_: json.loads(str(artifact.data))[0] for id_, artifact in newest.items()}

    @property
    def _parent_tag(self) -> str:
        return f"genre-parent:{self._request.parent}"

    def _page(self, wanted: FlowRunFilter) -> Iterator[FlowRun]:
        offset = 0
        while True:
            runs = call_server(
                self._client.read_flow_runs,
                flow_run_filter=wanted,
                sort=FlowRunSort.EXPECTED_START_TIME_ASC,
                limit=_RUNS_PER_REQUEST,
                offset=offset,
            )
            yield from runs
            if len(runs) < _RUNS_PER_REQUEST:
                return
            offset += len(runs)

    def _read(self, run: FlowRun) -> ChildRun:
        unit = read_unit(run.tags)
        # Only runs that were found by their tags come here.
        assert unit is not None
        seconds = run.total_run_time if run.state is not None and run.state.is_final() else run.estimated_run_time
        return ChildRun(
            id=str(run.id),
            unit=unit,
            state=_name_state(run),
            message="" if run.state is None else run.state.message or "",
            # A number of a process says nothing on many machines.
            where=str(run.labels.get(_WORKER_LABEL) or run.infrastructure_pid or ""),
            seconds=seconds.total_seconds(),
            is_ours=self._parent_tag in run.tags,
        )


def is_called_silent(run: FlowRun) -> bool:
    """Says whether a run is Crashed only because the server missed its heartbeats.

    Args:
        run: as the server has it.

    Returns:
        Whether its state is the one of the heartbeat automation.
    """
    return run.state is not None and run.state.type is StateType.CRASHED and run.state.name == SILENT_STATE_NAME


def _name_state(run: FlowRun) -> str:
    if is_called_silent(run):
        return SILENT
    return "SCHEDULED" if run.state is None else run.state.type.value


def dataset_tag(dataset: str) -> str:
    """Writes the tag of the flow runs of a dataset.

    Args:
        dataset: the dataset's name.

    Returns:
        The tag.

    >>> dataset_tag("0b2a")
    'genre-dataset:0b2a'
    """
    return f"{DATASET_TAG}{dataset}"


def has_heartbeat(client: SyncPrefectClient, run_id: str, since_s: float) -> bool:
    """Says whether the server has received a heartbeat of a flow run lately.

    Args:
        client: of the server.
        run_id: of the run.
        since_s: how many seconds ago the heartbeat may have been received, by the server's clock.

    Returns:
        Whether there is one.
    """
    return any(age_s <= since_s for age_s in _read_ages(client, _heartbeats_of([run_id])))


def count_heartbeats(client: SyncPrefectClient, run_id: str, since: datetime) -> int:
    """Counts the heartbeats of a flow run that the server has received.

    Args:
        client: of the server.
        run_id: of the run.
        since: when the watch began. The count has to begin at a fixed time: of a window that moves on, one heartbeat
            leaves for each that comes.

    Returns:
        Their number.
    """
    return int(call_server(client.read_events, _heartbeats_of([run_id], since), limit=1).total)


def _read_ages(client: SyncPrefectClient, wanted: EventFilter) -> list[float]:
    """How many seconds ago the server has received events: the clocks of this machine and of workers may be wrong."""
    body = {"filter": wanted.model_dump(mode="json", exclude_unset=True), "limit": _EVENTS_PER_REQUEST}
    # Prefect's client keeps the answer's header, which names the server's time, to itself.
    response = call_server(client.request, "POST", "/events/filter", json=body)
    now = parsedate_to_datetime(response.headers["date"])
    received = [datetime.fromisoformat(event["received"]) for event in response.json()["events"]]
    return [(now - moment).total_seconds() for moment in received]


def _heartbeats_of(run_ids: Sequence[str], watched_since: datetime | None = None) -> EventFilter:
    now = datetime.now(UTC)
    began = watched_since or now
    return EventFilter(
        event=EventNameFilter(name=[HEARTBEAT_EVENT]),
        resource=EventResourceFilter(id=[f"{_RUN_RESOURCE}{run_id}" for run_id in run_ids]),
        # Far enough for any worker's clock.
        occurred=EventOccurredFilter(since=began - timedelta(days=_DAYS), until=now + timedelta(days=_DAYS)),
        order=EventOrder.DESC,
    )


def _any_event() -> EventFilter:
    now = datetime.now(UTC)
    occurred = EventOccurredFilter(since=now - timedelta(days=_DAYS), until=now + timedelta(days=_DAYS))
    return EventFilter(occurred=occurred, order=EventOrder.DESC)


def _split(ids: Sequence[str], size: int) -> Iterator[Sequence[str]]:
    for start in range(0, len(ids), size):
        yield ids[start : start + size]
