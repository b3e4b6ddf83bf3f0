"""A dataset is submitted once, and who follows it is told why it does not start, or that it is gone."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any
from uuid import UUID, uuid4

import httpx
import pytest
from prefect.client.schemas.objects import FlowRun, WorkQueue, WorkQueueStatus
from prefect.exceptions import ObjectNotFound
from prefect.states import Completed, Pending, Running, Scheduled

from flows.dataset import prefect_runs, server_calls, submission
from flows.dataset.flow import _reconstruct_on_pool
from flows.dataset.prefect_runs import DEPLOYMENT, ChildRequest
from flows.dataset.start_watch import StartWatch
from flows.dataset.submission import PARENT_DEPLOYMENT, Submission, follow_dataset, submit_dataset
from flows.dataset.supervisor import SupervisionLimits
from flows.dataset.work_units import WorkUnit
from genre_tasks.errors import ResourceError

PARAMETERS = {"pool": "genre", "logs": ["kitti:a"]}


class FakeServer:
    """Flow runs of one dataset, of which two never have the same idempotency key, as on a real server.

    Attributes:
        runs: all flow runs.
        before_creation: called once, before a run is created.
        lost_answers: how many requests for a run are lost after the server has done what they ask.
        queue_status: of every work queue.
    """

    def __init__(self) -> None:
        self.runs: list[FlowRun] = []
        self.before_creation: Callable[[], object] | None = None
        self.lost_answers = 0
        self.queue_status = WorkQueueStatus.READY

    def read_deployment_by_name(self, name: str) -> SimpleNamespace:
        assert name in (PARENT_DEPLOYMENT, DEPLOYMENT)
        return SimpleNamespace(id=uuid4(), flow_id=uuid4(), work_pool_name="genre", job_variables={})

    def read_work_pool(self, name: str) -> SimpleNamespace:
        return SimpleNamespace(name=name)

    def read_workers_for_work_pool(self, name: str) -> list[SimpleNamespace]:
        return [SimpleNamespace(status=SimpleNamespace(value="ONLINE"))]

    def read_flow_runs(self, **wanted: Any) -> list[FlowRun]:
        return list(reversed(self.runs))

    def create_flow_run_from_deployment(self, deployment: UUID, idempotency_key: str | None, **values: Any) -> FlowRun:
        if self.before_creation is not None:
            meanwhile, self.before_creation = self.before_creation, None
            meanwhile()
        found = [run for run in self.runs if idempotency_key and run.idempotency_key == idempotency_key]
        if not found:
            found = [FlowRun(flow_id=uuid4(), state=Scheduled(), idempotency_key=idempotency_key)]
            self.runs += found
        if self.lost_answers > 0:
            self.lost_answers -= 1
            raise httpx.ReadError("the connection was reset")
        return found[0]

    def read_flow_run(self, run_id: UUID) -> FlowRun:
        for run in self.runs:
            if run.id == run_id:
                return run
        raise ObjectNotFound(ValueError("404"))

    def read_work_queue(self, queue_id: UUID) -> WorkQueue:
        values = {"name": "datasets", "work_pool_id": uuid4(), "work_pool_name": "genre"}
        return WorkQueue(id=queue_id, status=self.queue_status, **values)

    def read_artifacts(self, **wanted: Any) -> list[Any]:
        return []

    def read_events(self, wanted: Any, limit: int) -> SimpleNamespace:
        return SimpleNamespace(total=0)


@pytest.fixture()
def server(monkeypatch: pytest.MonkeyPatch) -> FakeServer:
    """The server that all commands reach; pauses between calls take no time."""
    fake = FakeServer()

    @contextmanager
    def get_client(sync_client: bool) -> Iterator[FakeServer]:
        yield fake

    monkeypatch.setattr(submission, "get_client", get_client)
    monkeypatch.setattr(server_calls, "_last_outage_s", float("-inf"))
    monkeypatch.setattr(server_calls, "time", SimpleNamespace(monotonic=lambda: 0.0, sleep=lambda seconds: None))
    return fake


def test_two_commands_at_one_moment_start_one_run(server: FakeServer) -> None:
    second: list[Submission] = []
    # It has read what the server knows before the first one starts its run.
    server.before_creation = lambda: second.append(submit_dataset("d", PARAMETERS))
    first = submit_dataset("d", PARAMETERS)
    assert [first.id] == [second[0].id] == [run.id for run in server.runs]


def test_a_request_that_is_sent_again_starts_one_run(server: FakeServer) -> None:
    server.lost_answers = 1
    submitted = submit_dataset("d", PARAMETERS)
    assert [run.id for run in server.runs] == [submitted.id]


def test_a_dataset_that_has_ended_starts_anew_and_one_that_runs_does_not(server: FakeServer) -> None:
    ids = []
    for count in range(3):
        submitted = submit_dataset("d", PARAMETERS)
        assert submitted.is_new and len(server.runs) == count + 1
        assert submit_dataset("d", PARAMETERS) == Submission(submitted.id, is_new=False)
        server.runs[-1].state = Completed()
        ids.append(submitted.id)
    assert len(set(ids)) == 3
    # One fewer than before, and the newest run's key is not made a second time.
    del server.runs[0]
    assert submit_dataset("d", PARAMETERS).id not in ids


def test_a_flow_run_that_is_deleted_while_it_is_followed_is_a_clear_error(server: FakeServer) -> None:
    run = FlowRun(flow_id=uuid4(), state=Running())
    server.runs.append(run)
    with pytest.raises(ResourceError, match=f"flow run {run.id} was deleted") as caught:
        follow_dataset(run.id, lambda rows: server.runs.clear(), poll_s=0.0)
    assert "Run the same command again" in caught.value.remedy


def test_a_parent_that_is_deleted_submits_nothing_more(server: FakeServer, monkeypatch: pytest.MonkeyPatch) -> None:
    run = FlowRun(flow_id=uuid4(), state=Running())
    server.runs.append(run)
    submitted: list[str] = []

    def submit(method: str, path: str, json: dict[str, Any]) -> SimpleNamespace:
        submitted.append(json["parameters"]["log"])
        # Somebody deletes the parent, and the run that it has just submitted.
        server.runs.clear()
        values = {"id": str(uuid4()), "flow_id": json["flow_id"], "name": json["name"], "tags": json["tags"]}
        return SimpleNamespace(json=lambda: values | {"state": json["state"]})

    monkeypatch.setattr(server, "request", submit, raising=False)
    monkeypatch.setattr(prefect_runs, "get_client", lambda sync_client: server)
    request = ChildRequest("d", str(run.id), "genre", {})
    limits = SupervisionLimits(in_flight=1, attempts=1, poll_s=0.0)
    table: Any = SimpleNamespace(show=lambda rows: None)
    with pytest.raises(ResourceError, match=f"flow run {run.id} was deleted while it ran") as caught:
        _reconstruct_on_pool(request, [WorkUnit("kitti:a"), WorkUnit("kitti:b")], limits, table)
    assert submitted == ["kitti:a"] and "Run the same command again" in caught.value.remedy


def test_who_follows_a_run_that_does_not_start_is_told_why(
    server: FakeServer, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    seconds = iter(range(0, 10_000, 60))
    monkeypatch.setattr(submission, "StartWatch", lambda client: StartWatch(client, clock=lambda: float(next(seconds))))
    server.queue_status = WorkQueueStatus.NOT_READY
    run = FlowRun(flow_id=uuid4(), state=Scheduled(), work_queue_id=uuid4())
    server.runs.append(run)
    polls: list[object] = []

    def show(rows: object) -> None:
        polls.append(rows)
        if len(polls) == 10:
            run.state = Completed()

    with caplog.at_level(logging.WARNING, logger="genre"):
        assert follow_dataset(run.id, show, poll_s=0.0)[0].startswith("COMPLETED")
    # Once, not at every poll.
    (record,) = caplog.records
    assert "no worker asks for runs of the work queue 'datasets' of the pool 'genre'" in record.getMessage()
    assert "prefect worker start --pool genre --work-queue datasets" in record.getMessage()


def _warn_after(seconds: list[float], run: FlowRun, server: FakeServer, caplog: pytest.LogCaptureFixture) -> list[str]:
    """What is said on a run that is looked at at some times."""
    clock_s = [0.0]
    caplog.clear()
    watch = StartWatch(server, clock=lambda: clock_s[0])  # type: ignore[arg-type]
    for clock_s[0] in seconds:
        watch.check(run)
    return [record.getMessage() for record in caplog.records]


def test_each_reason_of_a_wait_has_its_remedy(server: FakeServer, caplog: pytest.LogCaptureFixture) -> None:
    run = FlowRun(flow_id=uuid4(), state=Scheduled(), work_queue_id=uuid4())
    assert _warn_after([0.0, 60.0], run, server, caplog) == []
    assert "no free slot" in _warn_after([0.0, 100.0], run, server, caplog)[0]
    server.queue_status = WorkQueueStatus.PAUSED
    assert "prefect work-queue resume datasets --pool genre" in _warn_after([0.0, 100.0], run, server, caplog)[0]
    without_queue = FlowRun(flow_id=uuid4(), state=Scheduled())
    assert "genre ops deploy" in _warn_after([0.0, 100.0], without_queue, server, caplog)[0]
    run.state = Pending()
    assert f"prefect flow-run cancel {run.id}" in _warn_after([0.0, 100.0], run, server, caplog)[0]
    run.state = Running()
    assert _warn_after([0.0, 100.0, 1000.0], run, server, caplog) == []


def test_a_wait_counts_from_the_last_change_of_state(server: FakeServer, caplog: pytest.LogCaptureFixture) -> None:
    now_s = 0.0
    watch = StartWatch(server, clock=lambda: now_s)  # type: ignore[arg-type]
    run = FlowRun(flow_id=uuid4(), state=Scheduled(), work_queue_id=uuid4())
    watch.check(run)
    now_s = 89.0
    run.state = Pending()
    watch.check(run)
    now_s = 170.0
    watch.check(run)
    assert caplog.records == []
