"""Starts a dataset on a Prefect server, finds one that is running, and follows it to its end."""

from __future__ import annotations

import hashlib
import json
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any
from uuid import UUID

from prefect.client.orchestration import SyncPrefectClient, get_client
from prefect.client.schemas.filters import (
    ArtifactFilter,
    ArtifactFilterFlowRunId,
    ArtifactFilterKey,
    FlowRunFilter,
    FlowRunFilterTags,
)
from prefect.client.schemas.objects import FlowRun, StateType
from prefect.client.schemas.responses import DeploymentResponse
from prefect.client.schemas.sorting import FlowRunSort
from prefect.exceptions import ObjectNotFound
from prefect.states import Cancelled, Crashed

from flows.dataset.child_start_watch import ChildStartWatch
from flows.dataset.event_probe import EventProbe
from flows.dataset.live_table import TABLE_KEY
from flows.dataset.prefect_runs import DEPLOYMENT, count_heartbeats, dataset_tag, has_heartbeat, is_called_silent
from flows.dataset.server_calls import call_server, read_last_outage
from flows.dataset.start_watch import StartWatch
from flows.dataset.supervisor import HEARTBEAT_S
from genre_tasks.errors import ConfigError, ResourceError

_log = logging.getLogger("genre")
PARENT_DEPLOYMENT = "reconstruct-dataset/dataset"
"""What the parent of a dataset is a run of."""
PARENT_TAG = "genre-dataset-parent"
"""Tag of the flow runs of parents; their child runs do not have it."""
_SILENT_S = 3.0 * HEARTBEAT_S
_HEARTBEAT_POLL_S = 5.0
# A server that stores no events at all would keep a dead parent for ever.
_MOST_DELAY_S = 900.0
_ACTIVE = frozenset({StateType.SCHEDULED, StateType.PENDING, StateType.RUNNING, StateType.PAUSED})


@dataclass(frozen=True)
class Submission:
    """A dataset's flow run on the server.

    Attributes:
        id: of the flow run.
        is_new: whether it was started now; otherwise it was running already.
    """

    id: UUID
    is_new: bool


def submit_dataset(name: str, parameters: Mapping[str, Any]) -> Submission:
    """Starts a dataset's flow, unless it is running already.

    Args:
        name: the dataset's name.
        parameters: of :func:`flows.dataset.flow.reconstruct_dataset`, with ``pool``.

    Returns:
        The flow run.

    Raises:
        ConfigError: a deployment, the pool or a worker is missing.
    """
    with get_client(sync_client=True) as client:
        parent = _find_deployment(client, PARENT_DEPLOYMENT)
        _find_deployment(client, DEPLOYMENT)
        _check_pool(client, str(parameters["pool"]))
        _check_pool(client, parent.work_pool_name or "")
        parents = _read_parents(client, name)
        running = _find_running(client, parents)
        if running is not None:
            return Submission(running.id, is_new=False)
        run = call_server(
            client.create_flow_run_from_deployment,
            parent.id,
            parameters=dict(parameters),
            idempotency_key=_make_key(name, parents),
            name=f"dataset {name}",
            tags=[dataset_tag(name), PARENT_TAG],
            job_variables={"env": {"PREFECT_FLOWS_HEARTBEAT_FREQUENCY": str(HEARTBEAT_S)}},
        )
        return Submission(run.id, is_new=True)


def mark_as_parent(run_id: str, name: str) -> None:
    """Gives a running parent the tags by which it is found, as one that Prefect's own command started has none.

    Args:
        run_id: of the parent's flow run.
        name: the dataset's name.
    """
    with get_client(sync_client=True) as client:
        run = call_server(client.read_flow_run, UUID(run_id))
        tags = {*run.tags, dataset_tag(name), PARENT_TAG}
        if tags != set(run.tags):
            call_server(client.update_flow_run, UUID(run_id), tags=sorted(tags))


def require_parent(run_id: str) -> None:
    """Ends a parent whose flow run was deleted: it would go on to submit runs, next to those of a new parent.

    Prefect stops a process whose flow run is cancelled, and leaves one alone whose flow run is deleted.

    Args:
        run_id: of the parent's flow run.

    Raises:
        ResourceError: the flow run was deleted.
    """
    with get_client(sync_client=True) as client:
        try:
            call_server(client.read_flow_run, UUID(run_id))
        except ObjectNotFound as error:
            raise _describe_deleted(run_id, "while it ran") from error


def follow_dataset(
    run_id: UUID, show: Callable[[Sequence[Mapping[str, Any]]], None], poll_s: float = 2.0
) -> tuple[str, list[dict[str, Any]]]:
    """Shows the table of a dataset until its flow run ends.

    Args:
        run_id: of the flow run.
        show: called with the rows of the table whenever they are read.
        poll_s: seconds between two reads.

    Returns:
        The type of the run's last state with its message, and the final rows.

    Raises:
        ResourceError: the flow run was deleted.
    """
    with get_client(sync_client=True) as client:
        try:
            return _follow(client, run_id, show, poll_s)
        except ObjectNotFound as error:
            raise _describe_deleted(str(run_id), "while it was followed") from error


def _describe_deleted(run_id: str, moment: str) -> ResourceError:
    problem = f"the dataset's flow run {run_id} was deleted {moment}"
    return ResourceError(problem, remedy="Run the same command again: it takes over the runs of logs that go on.")


def _follow(
    client: SyncPrefectClient, run_id: UUID, show: Callable[[Sequence[Mapping[str, Any]]], None], poll_s: float
) -> tuple[str, list[dict[str, Any]]]:
    watch = HeartbeatWatch(client, run_id)
    start_watch = StartWatch(client)
    child_watch = ChildStartWatch(client)
    while True:
        run = call_server(client.read_flow_run, run_id)
        start_watch.check(run)
        child_watch.follow(run)
        if run.state is not None and run.state.type in (StateType.SCHEDULED, StateType.PENDING):
            # A run that waits for its worker sends no heartbeats yet.
            watch.restart()
        is_silent = watch.is_silent()
        if is_silent and _end_silent(client, run):
            continue
        rows = _read_table(client, run_id)
        show(rows)
        lives = is_called_silent(run) and not is_silent
        if run.state is not None and run.state.is_final() and not lives:
            return f"{run.state.type.value}: {run.state.message or ''}", _read_table(client, run_id)
        time.sleep(poll_s)


def _end_silent(client: SyncPrefectClient, run: FlowRun) -> bool:
    """Ends a parent that should send heartbeats; nobody else notices that its worker died with all its processes."""
    state = None if run.state is None else run.state.type
    if state is StateType.RUNNING:
        crash_run(client, run.id)
    elif state is StateType.CANCELLING:
        message = f"the flow run {run.id} sends no heartbeat while it is being cancelled"
        _log.warning("%s: it is set to Cancelled", message)
        call_server(client.set_flow_run_state, run.id, Cancelled(message=message), force=True)
    return state in (StateType.RUNNING, StateType.CANCELLING)


def _find_deployment(client: SyncPrefectClient, name: str) -> DeploymentResponse:
    try:
        return client.read_deployment_by_name(name)
    except ObjectNotFound as error:
        remedy = "Deploy the flows: genre ops deploy --store STORE."
        raise ConfigError(f"the Prefect server has no deployment '{name}'", remedy=remedy) from error


def _check_pool(client: SyncPrefectClient, pool: str) -> None:
    try:
        client.read_work_pool(pool)
    except ObjectNotFound as error:
        remedy = f"Create it: prefect work-pool create {pool} --type process."
        raise ConfigError(f"the Prefect server has no work pool '{pool}'", remedy=remedy) from error
    workers = client.read_workers_for_work_pool(pool)
    if not any(worker.status is not None and str(worker.status.value) == "ONLINE" for worker in workers):
        remedy = f"Start one: prefect worker start --pool {pool}."
        raise ConfigError(f"no worker of the work pool '{pool}' is online", remedy=remedy)


def _read_parents(client: SyncPrefectClient, name: str) -> list[FlowRun]:
    """All parents that this dataset has had, the newest first."""
    wanted = FlowRunFilter(tags=FlowRunFilterTags(all_=[dataset_tag(name), PARENT_TAG]))
    # Of more than the server gives at once, the oldest are left out.
    return client.read_flow_runs(flow_run_filter=wanted, sort=FlowRunSort.EXPECTED_START_TIME_DESC)


def _make_key(name: str, parents: Sequence[FlowRun]) -> str:
    """The idempotency key of the parent that follows those that the dataset has had.

    Two commands at one moment know of the same parents, so that the server gives both the same run. A later command
    knows of that run, too.
    """
    known = sorted(str(run.id) for run in parents)
    return hashlib.sha256(json.dumps([name, *known]).encode()).hexdigest()


def _find_running(client: SyncPrefectClient, parents: Sequence[FlowRun]) -> FlowRun | None:
    """The parent that is running this dataset; one without a sign of life is set to Crashed."""
    for run in parents:
        # Without waiting for one more heartbeat: it may have ended long ago.
        if is_called_silent(run) and has_heartbeat(client, str(run.id), since_s=_SILENT_S):
            return run
    for run in parents:
        if run.state is None or run.state.type not in _ACTIVE:
            continue
        if run.state.type is not StateType.RUNNING or _shows_life(client, run):
            return run
        crash_run(client, run.id)
    return None


def crash_run(client: SyncPrefectClient, run_id: UUID) -> None:
    """Sets a parent without a sign of life to Crashed, so that the dataset can be started again.

    Args:
        client: of the server.
        run_id: of the flow run.
    """
    call_server(client.set_flow_run_state, run_id, Crashed(message="no heartbeat"), force=True)


class HeartbeatWatch:
    """Watches by this process's clock whether a running parent sends heartbeats.

    Heartbeats are lost while the server is away, so that time does not count. Nor does the time in which the server has
    received heartbeats and not stored them yet.

    Args:
        client: of the server.
        run_id: of the parent's flow run.
        clock: seconds of a clock that never jumps.
    """

    def __init__(self, client: SyncPrefectClient, run_id: UUID, clock: Callable[[], float] = time.monotonic) -> None:
        self._client = client
        self._run_id = str(run_id)
        self._clock = clock
        self._count = -1
        self._began = datetime.now(UTC)
        self._since_s = clock()
        self._next_s = self._since_s
        self._probe: EventProbe | None = None
        self._probe_s = 0.0

    def restart(self) -> None:
        """Counts the time without a heartbeat from now on."""
        self._since_s = self._clock()

    def is_silent(self) -> bool:
        """Says whether no heartbeat has come for three periods in which the server was there; asks now and then."""
        now_s = self._clock()
        self._since_s = max(self._since_s, read_last_outage())
        if now_s < self._next_s:
            return False
        self._next_s = now_s + _HEARTBEAT_POLL_S
        # Asked before the heartbeats are counted: of those that came before the probe none is missed.
        is_caught_up = self._is_caught_up(now_s)
        count = count_heartbeats(self._client, self._run_id, self._began)
        if count != self._count:
            self._count = count
            self._since_s = now_s
        return is_caught_up and now_s - self._since_s > _SILENT_S

    def _is_caught_up(self, now_s: float) -> bool:
        """Says whether the server has stored what it had received when the parent was first found silent."""
        if now_s - self._since_s <= _SILENT_S:
            self._probe = None
            return False
        if self._probe is None:
            self._probe = EventProbe(self._client)
            self._probe_s = now_s
        return self._probe.is_stored() or now_s - self._probe_s > _MOST_DELAY_S

    def waits_for_life(self, sleep: Callable[[float], None] = time.sleep) -> bool:
        """Waits for a heartbeat; returns False if none comes for three periods."""
        self.is_silent()
        first = self._count
        while self._count == first:
            if self.is_silent():
                return False
            sleep(1.0)
        return True


def _shows_life(client: SyncPrefectClient, run: FlowRun) -> bool:
    if run.estimated_run_time.total_seconds() < _SILENT_S or has_heartbeat(client, str(run.id), since_s=_SILENT_S):
        return True
    # Its heartbeats may have been lost with the server: one that lives sends another.
    _log.warning("the dataset's flow run sends no heartbeat: waiting for one before it is given up")
    return HeartbeatWatch(client, run.id).waits_for_life()


def _read_table(client: SyncPrefectClient, run_id: UUID) -> list[dict[str, Any]]:
    wanted = ArtifactFilter(
        flow_run_id=ArtifactFilterFlowRunId(any_=[run_id]),
        key=ArtifactFilterKey(any_=[TABLE_KEY]),
    )
    artifacts = call_server(client.read_artifacts, artifact_filter=wanted)
    # A parent that was started again has a table of each of its lives.
    newest = max(artifacts, key=lambda artifact: str(artifact.created), default=None)
    rows: list[dict[str, Any]] = [] if newest is None else json.loads(str(newest.data))
    return rows
