"""Finds out whether a Prefect server has stored the events that it received: a busy one is minutes behind with them."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from uuid import uuid4

from prefect.client.orchestration import SyncPrefectClient
from prefect.events.filters import EventFilter, EventNameFilter, EventOccurredFilter, EventResourceFilter

from flows.dataset.server_calls import call_server

PROBE_EVENT = "genre.probe"
# Far enough for the difference between this machine's clock and the server's.
_WINDOW = timedelta(days=1)


class EventProbe:
    """An event of this process: a server that has stored it has stored all events that it received before.

    Args:
        client: of the server, to which the event is sent at once.
    """

    def __init__(self, client: SyncPrefectClient) -> None:
        self._client = client
        self._resource = f"genre.probe.{uuid4()}"
        self._sent = datetime.now(UTC)
        event = {
            "id": str(uuid4()),
            "occurred": self._sent.isoformat(),
            "event": PROBE_EVENT,
            "resource": {"prefect.resource.id": self._resource},
        }
        # Prefect's client can only send events from a thread of its own, whose errors nobody sees.
        call_server(client.request, "POST", "/events", json=[event])

    def is_stored(self) -> bool:
        """Asks the server whether it has come to this event."""
        wanted = EventFilter(
            event=EventNameFilter(name=[PROBE_EVENT]),
            resource=EventResourceFilter(id=[self._resource]),
            occurred=EventOccurredFilter(since=self._sent - _WINDOW, until=self._sent + _WINDOW),
        )
        return bool(call_server(self._client.read_events, wanted, limit=1).total)
