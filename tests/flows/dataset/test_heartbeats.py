"""Heartbeats are noticed and judged by the server's clock: a worker's clock may be wrong, and may jump."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from types import SimpleNamespace
from typing import Any

from flows.dataset.prefect_runs import ChildRequest, PrefectRuns, has_heartbeat

NOW = datetime.now(UTC)


class FakeClient:
    """Answers with the newest events by their own times, as the server does."""

    def __init__(self) -> None:
        self.events: list[SimpleNamespace] = []

    def read_deployment_by_name(self, name: str) -> SimpleNamespace:
        return SimpleNamespace(name=name)

    def read_events(self, wanted: Any, limit: int) -> SimpleNamespace:
        newest = sorted(self.events, key=lambda event: event.occurred, reverse=True)
        return SimpleNamespace(events=newest[:limit], total=len(newest))

    def send(self, age_s: float, shift_s: float = 0.0) -> None:
        received = NOW - timedelta(seconds=age_s)
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


def test_a_run_is_alive_by_the_time_of_receipt() -> None:
    client = FakeClient()
    assert not has_heartbeat(client, "a", since_s=90.0)  # type: ignore[arg-type]
    # The worker's clock is ahead, and its process has died.
    client.send(600.0, shift_s=3600.0)
    assert not has_heartbeat(client, "a", since_s=90.0)  # type: ignore[arg-type]
    # A clock that is behind.
    client.send(10.0, shift_s=-3600.0)
    assert has_heartbeat(client, "a", since_s=90.0)  # type: ignore[arg-type]
