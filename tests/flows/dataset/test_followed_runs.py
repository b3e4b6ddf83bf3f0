"""Who follows a dataset is told why its logs do not start, and is not kept by a run whose worker is dead."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any
from uuid import UUID, uuid4

import pytest
from prefect.client.schemas.objects import FlowRun, State, WorkQueue, WorkQueueStatus
from prefect.exceptions import ObjectNotFound
from prefect.states import Cancelling, Completed, Running, Scheduled

from flows.dataset import prefect_runs, server_calls, submission
from flows.dataset.child_start_watch import ChildStartWatch
from flows.dataset.event_probe import PROBE_EVENT
from flows.dataset.prefect_runs import ChildRequest, PrefectRuns
from flows.dataset.submission import PARENT_TAG, HeartbeatWatch, follow_dataset

TAG = "genre-dataset:d"
WORKER_COMMAND = "prefect worker start --pool genre --work-queue default"


def make_child(log: str, state: State[Any]) -> FlowRun:
    return FlowRun(flow_id=uuid4(), state=state, work_queue_id=uuid4(), tags=[TAG, f"genre-log:{log}"])


class FakeServer:
    """A dataset with its parent, whose child runs are in a queue that no worker serves.

    Attributes:
        parent: as it is now.
        children: oldest first.
        has_heartbeats: whether another one has come whenever they are counted.
        has_queue: whether the queue is still there.
        now_s: of the clock that the watches have.
    """

    def __init__(self, state: State[Any]) -> None:
        self.parent = FlowRun(flow_id=uuid4(), state=state, tags=[TAG, PARENT_TAG])
        self.children: list[FlowRun] = []
        self.has_heartbeats = False
        self.has_queue = True
        self.now_s = 0.0
        self._heartbeats = 0

    def read_deployment_by_name(self, name: str) -> SimpleNamespace:
        return SimpleNamespace(name=name)

    def read_flow_run(self, run_id: UUID) -> FlowRun:
        return self.parent

    def read_flow_runs(self, **wanted: Any) -> list[FlowRun]:
        # As the server finds them by the dataset's tag.
        runs = [self.parent, *self.children]
        ids = wanted["flow_run_filter"].id
        return [run for run in runs if ids is None or run.id in ids.any_]

    def read_work_queue(self, queue_id: UUID) -> WorkQueue:
        if not self.has_queue:
            raise ObjectNotFound(ValueError("404"))
        values = {"name": "default", "work_pool_id": uuid4(), "work_pool_name": "genre"}
        return WorkQueue(id=queue_id, status=WorkQueueStatus.NOT_READY, **values)

    def set_flow_run_state(self, run_id: UUID, state: State[Any], force: bool) -> None:
        assert run_id == self.parent.id and force
        self.parent.state = state

    def read_artifacts(self, **wanted: Any) -> list[Any]:
        return []

    def read_events(self, wanted: Any, limit: int) -> SimpleNamespace:
        if wanted.event.name == [PROBE_EVENT]:
            return SimpleNamespace(total=1)
        self._heartbeats += self.has_heartbeats
        return SimpleNamespace(total=self._heartbeats)

    def request(self, method: str, path: str, json: Any) -> None:
        assert (method, path) == ("POST", "/events")


def follow(server: FakeServer, monkeypatch: pytest.MonkeyPatch, polls: int) -> str:
    """Follows the parent, which completes after some polls of twenty seconds; how it ended."""

    @contextmanager
    def get_client(sync_client: bool) -> Iterator[FakeServer]:
        yield server

    def clock() -> float:
        return server.now_s

    shown: list[object] = []

    def show(rows: object) -> None:
        shown.append(rows)
        if len(shown) == polls:
            server.parent.state = Completed()

    def sleep(seconds: float) -> None:
        server.now_s += 20.0

    monkeypatch.setattr(submission, "get_client", get_client)
    monkeypatch.setattr(submission, "time", SimpleNamespace(sleep=sleep))
    monkeypatch.setattr(submission, "ChildStartWatch", lambda client: ChildStartWatch(client, clock))
    monkeypatch.setattr(submission, "HeartbeatWatch", lambda client, run_id: HeartbeatWatch(client, run_id, clock))
    monkeypatch.setattr(server_calls, "_last_outage_s", float("-inf"))
    return follow_dataset(server.parent.id, show)[0]


def read_warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]


def test_a_run_that_is_being_cancelled_and_whose_worker_is_dead_ends(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    server = FakeServer(Cancelling())
    state = follow(server, monkeypatch, polls=30)
    assert state == f"CANCELLED: the flow run {server.parent.id} sends no heartbeat while it is being cancelled"
    assert 90.0 < server.now_s < 150.0
    (warning,) = read_warnings(caplog)
    assert str(server.parent.id) in warning
    # One that runs is Crashed, as nobody has asked for its end.
    assert follow(FakeServer(Running()), monkeypatch, polls=30).startswith("CRASHED")


def test_a_run_that_is_being_cancelled_and_sends_heartbeats_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    server = FakeServer(Cancelling())
    server.has_heartbeats = True
    assert follow(server, monkeypatch, polls=30).startswith("COMPLETED")


@pytest.mark.parametrize("is_one_running", [False, True])
def test_who_follows_a_dataset_whose_logs_have_no_worker_is_told_which_to_start(
    is_one_running: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    server = FakeServer(Running())
    server.has_heartbeats = True
    server.children = [make_child("kitti:a", Scheduled()), make_child("kitti:b", Scheduled())]
    if is_one_running:
        # The others wait for its slot.
        server.children.append(make_child("kitti:c", Running()))
    assert follow(server, monkeypatch, polls=30).startswith("COMPLETED")
    warnings = read_warnings(caplog)
    # Once, not at every poll.
    assert len(warnings) == (0 if is_one_running else 1)
    assert all("the oldest run of a log has not started" in text and WORKER_COMMAND in text for text in warnings)


def test_the_log_of_the_parent_names_the_worker_too(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    server = FakeServer(Running())
    server.children = [make_child("kitti:a", Scheduled())]
    monkeypatch.setattr(prefect_runs, "ChildStartWatch", lambda client: ChildStartWatch(client, lambda: server.now_s))
    runs = PrefectRuns(ChildRequest("d", "p", "genre", {}), server)  # type: ignore[arg-type]
    ids = [str(run.id) for run in server.children]
    for server.now_s in (0.0, 60.0, 120.0):
        assert list(runs.read(ids)) == ids
    (warning,) = read_warnings(caplog)
    assert WORKER_COMMAND in warning


def make_check(server: FakeServer, caplog: pytest.LogCaptureFixture) -> Callable[[float, Sequence[FlowRun]], list[str]]:
    """Makes a check of child runs at a time; it gives all warnings until then."""
    watch = ChildStartWatch(server, lambda: server.now_s)  # type: ignore[arg-type]

    def check(now_s: float, runs: Sequence[FlowRun]) -> list[str]:
        server.now_s = now_s
        watch.check(runs)
        return read_warnings(caplog)

    return check


def test_a_wait_counts_from_when_the_last_log_has_ended(caplog: pytest.LogCaptureFixture) -> None:
    server = FakeServer(Running())
    check = make_check(server, caplog)
    waiting = make_child("kitti:a", Scheduled())
    assert check(0.0, [waiting]) == []
    assert check(60.0, [waiting, make_child("kitti:b", Running())]) == []
    # Its slot is free, and the worker takes a moment.
    assert check(3600.0, [waiting]) == check(3660.0, [waiting]) == []
    assert len(check(3700.0, [waiting])) == 1
    # The same reason once more, after runs that did start.
    assert len(check(4000.0, [])) == len(check(4010.0, [waiting])) == 1
    assert len(check(4110.0, [waiting])) == 2


def test_a_queue_that_is_deleted_meanwhile_ends_nobody(caplog: pytest.LogCaptureFixture) -> None:
    server = FakeServer(Running())
    server.has_queue = False
    check = make_check(server, caplog)
    waiting = make_child("kitti:a", Scheduled())
    check(0.0, [waiting])
    (warning,) = check(100.0, [waiting])
    # A child that was cancelled would be given up.
    assert "its work queue was deleted" in warning and f"prefect flow-run delete {waiting.id}" in warning
