"""Heartbeats are noticed and judged by the server's clock: a worker's clock may be wrong, and may jump."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from email.utils import format_datetime
from types import SimpleNamespace
from typing import Any
from uuid import uuid4

import pytest

from flows.dataset import submission
from flows.dataset.dataset_record import name_dataset
from flows.dataset.event_probe import PROBE_EVENT
from flows.dataset.prefect_runs import ChildRequest, PrefectRuns, has_heartbeat
from flows.dataset.submission import HeartbeatWatch


class FakeClient:
    """Answers with the newest events by their own times, as the server does."""

    def __init__(self) -> None:
        self.events: list[SimpleNamespace] = []
        self.probes: set[str] = set()
        self.count_requests = 0
        self.is_behind = False
        self.clock_error_s = 0.0

    def read_deployment_by_name(self, name: str) -> SimpleNamespace:
        return SimpleNamespace(name=name)

    def read_events(self, wanted: Any, limit: int) -> SimpleNamespace:
        if wanted.event.name == [PROBE_EVENT]:
            return SimpleNamespace(total=0 if self.is_behind else len(self.probes & set(wanted.resource.id)))
        self.asked_since = wanted.occurred.since
        newest = sorted(self.events, key=lambda event: event.occurred, reverse=True)
        return SimpleNamespace(events=newest[:limit], total=len(newest))

    def request(self, method: str, path: str, json: Any, path_params: dict[str, str] | None = None) -> SimpleNamespace:
        if path == "/events":
            self.probes |= {event["resource"]["prefect.resource.id"] for event in json}
            return SimpleNamespace()
        if path == "/events/filter":
            newest = sorted(self.events, key=lambda event: event.occurred, reverse=True)[: json["limit"]]
            events = [{"received": event.received.isoformat()} for event in newest]
            now = datetime.now(UTC) + timedelta(seconds=self.clock_error_s)
            return SimpleNamespace(
                headers={"date": format_datetime(now, usegmt=True)},
                json=lambda: {"events": events},
            )
        assert path.format(**path_params or {}) == "/events/count-by/resource"
        self.count_requests += 1
        counts = [{"value": id_, "count": len(self.events)} for id_ in json["filter"]["resource"]["id"]]
        return SimpleNamespace(json=lambda: counts if self.events else [])

    def send(self, age_s: float, shift_s: float = 0.0) -> None:
        received = datetime.now(UTC) + timedelta(seconds=self.clock_error_s - age_s)
        self.events.append(SimpleNamespace(occurred=received + timedelta(seconds=shift_s), received=received))


def test_every_heartbeat_is_noticed_also_when_the_clock_jumps_back() -> None:
    client = FakeClient()
    runs = PrefectRuns(ChildRequest("d", "p", "pool", {}), client)  # type: ignore[arg-type]
    assert runs.read_heartbeats(["a"]) == {}
    found = []
    for shift_s in (0.0, 3600.0, 0.0, -3600.0, -3600.0):
        client.send(60.0, shift_s)
        found.append(runs.read_heartbeats(["a"])["a"])
    assert len(set(found)) == len(found)


def test_heartbeats_of_many_runs_are_read_by_one_request() -> None:
    client = FakeClient()
    client.send(60.0)
    runs = PrefectRuns(ChildRequest("d", "p", "pool", {}), client)  # type: ignore[arg-type]
    ids = [str(uuid4()) for _ in range(150)]
    assert runs.read_heartbeats(ids) == dict.fromkeys(ids, "1")
    assert client.count_requests == 1


def test_the_delay_of_events_is_by_the_servers_clock() -> None:
    client = FakeClient()
    runs = PrefectRuns(ChildRequest("d", "p", "pool", {}), client)  # type: ignore[arg-type]
    events = [{"received": "2020-01-01T00:00:10Z"}, {"received": "2020-01-01T00:00:00Z"}]
    answer = SimpleNamespace(
        headers={"date": "Wed, 01 Jan 2020 00:01:40 GMT"},
        json=lambda: {"events": events},
    )
    client.request = lambda *args, **kwargs: answer  # type: ignore[method-assign]
    assert runs.read_event_delay() == 90.0
    events.clear()
    assert runs.read_event_delay() == 0.0


def test_a_run_is_alive_by_the_time_of_receipt() -> None:
    client = FakeClient()
    assert not has_heartbeat(client, "a", since_s=90.0)  # type: ignore[arg-type]
    # The worker's clock is ahead, and its process has died.
    client.send(600.0, shift_s=3600.0)
    assert not has_heartbeat(client, "a", since_s=90.0)  # type: ignore[arg-type]
    # A clock that is behind.
    client.send(10.0, shift_s=-3600.0)
    assert has_heartbeat(client, "a", since_s=90.0)  # type: ignore[arg-type]


@pytest.mark.parametrize("clock_error_s", [-600.0, 600.0])
def test_a_run_is_alive_whatever_the_clock_of_this_machine(clock_error_s: float) -> None:
    client = FakeClient()
    client.clock_error_s = clock_error_s
    client.send(300.0)
    assert not has_heartbeat(client, "a", since_s=90.0)  # type: ignore[arg-type]
    client.send(10.0)
    assert has_heartbeat(client, "a", since_s=90.0)  # type: ignore[arg-type]


def _silent_after(
    heartbeats_s: list[float],
    outages_s: list[float],
    monkeypatch: pytest.MonkeyPatch,
    behind_until_s: float = 0.0,
    watched_s: float = 300.0,
) -> float | None:
    """When a watch calls a parent silent, which sends heartbeats at some times, while the server is away at others."""
    client = FakeClient()
    now_s = 0.0
    watch = HeartbeatWatch(client, uuid4(), clock=lambda: now_s)  # type: ignore[arg-type]
    while now_s < watched_s:
        now_s += 2.0
        known = [outage_s for outage_s in outages_s if outage_s <= now_s]
        monkeypatch.setattr(submission, "read_last_outage", lambda known=known: max(known, default=float("-inf")))
        client.events = []
        client.is_behind = now_s < behind_until_s
        for heartbeat_s in heartbeats_s:
            if heartbeat_s <= now_s and not client.is_behind:
                client.send(0.0)
        if watch.is_silent():
            return now_s
    return None


def test_a_dead_parent_is_noticed_and_one_whose_heartbeats_were_lost_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    dead_s = _silent_after([10.0], [], monkeypatch)
    assert dead_s is not None and 100.0 < dead_s < 115.0
    assert _silent_after([10.0, 40.0, 70.0, 100.0, 130.0, 160.0, 190.0, 220.0, 250.0, 280.0], [], monkeypatch) is None
    # The server was killed again and again, and with it four heartbeats were lost.
    assert _silent_after([10.0, 160.0, 190.0, 220.0, 250.0, 280.0], [38.0, 68.0, 99.0, 128.0], monkeypatch) is None
    late_s = _silent_after([10.0], [60.0], monkeypatch)
    assert late_s is not None and late_s > 150.0


def test_a_living_parent_outlives_a_server_that_is_behind_with_events(monkeypatch: pytest.MonkeyPatch) -> None:
    alive = [10.0 + 30.0 * i for i in range(10)]
    assert _silent_after(alive, [], monkeypatch, behind_until_s=240.0) is None
    # A dead one is noticed as soon as the server has caught up.
    dead_s = _silent_after([], [], monkeypatch, behind_until_s=240.0)
    assert dead_s is not None and 240.0 <= dead_s < 250.0
    # And at last also where it never does.
    stuck_s = _silent_after(alive, [], monkeypatch, behind_until_s=2000.0, watched_s=2000.0)
    assert stuck_s is not None and 900.0 < stuck_s < 1010.0


def test_heartbeats_of_long_runs_are_counted_from_a_fixed_time() -> None:
    client = FakeClient()
    clock_s = [0.0]
    watch = HeartbeatWatch(client, uuid4(), clock=lambda: clock_s[0])  # type: ignore[arg-type]
    since = []
    for clock_s[0] in (0.0, 60.0):
        watch.is_silent()
        since.append(client.asked_since)
    # Of a window that moves on, one heartbeat would leave for each that comes.
    assert since[0] == since[1]


def test_a_parent_that_waits_for_its_worker_is_not_silent() -> None:
    clock_s = [0.0]
    watch = HeartbeatWatch(FakeClient(), uuid4(), clock=lambda: clock_s[0])  # type: ignore[arg-type]
    assert not watch.is_silent()
    for clock_s[0] in (60.0, 120.0, 180.0):
        watch.restart()
        assert not watch.is_silent()
    # It runs now, and its first heartbeat is still on its way.
    clock_s[0] = 190.0
    assert not watch.is_silent()


def test_another_store_is_another_dataset() -> None:
    names = {name_dataset(["kitti:a"], "demo", store, None) for store in ("s3://a", "s3://b")}
    assert len(names) == 2
