"""A run in browsers, as long as the command runs."""

from __future__ import annotations

import threading
import time

import viser

from flows.viewer.client_session import ClientSession
from flows.viewer.local_server import aim_first_view, start_server, stop_server
from flows.viewer.viewed_chunks import ViewedChunk, ViewedRun

_TICK_S = 0.05


class LiveViewer:
    """A server that shows a run; to be used in a ``with`` statement, which stops it.

    Args:
        run: to show.
        viewed: the chunk that new clients see.
        host: address to bind.
        port: number of the port; a taken one leads to the next, 0 to any free one.
        with_range: whether the reliable range is drawn.

    Attributes:
        sessions: those of the clients that are connected, by viser's number of the client.
    """

    def __init__(
        self, run: ViewedRun, viewed: ViewedChunk, host: str = "127.0.0.1", port: int = 8080, with_range: bool = True
    ) -> None:
        self.sessions: dict[int, ClientSession] = {}
        self._sessions_lock = threading.Lock()
        self._server = start_server(host, port, f"GenRe {run.name}")
        aim_first_view(self._server, viewed)

        @self._server.on_client_connect
        def _(client: viser.ClientHandle) -> None:
            session = ClientSession(client, run, viewed, with_range)
            with self._sessions_lock:
                # A client that is gone by now has no session to keep.
                if client.client_id in self._server.get_clients():
                    self.sessions[client.client_id] = session
            session.draw_range()

        @self._server.on_client_disconnect
        def _(client: viser.ClientHandle) -> None:
            with self._sessions_lock:
                self.sessions.pop(client.client_id, None)

    def __enter__(self) -> LiveViewer:
        return self

    def __exit__(self, *error: object) -> None:
        stop_server(self._server)

    @property
    def address(self) -> str:
        """What a browser on this machine opens."""
        host = self._server.get_host()
        shown = "127.0.0.1" if host in ("0.0.0.0", "::") else host
        shown = f"[{shown}]" if ":" in shown else shown
        return f"http://{shown}:{self._server.get_port()}"

    def run_forever(self) -> None:
        """Lets time run for clients that play, until an exception such as Ctrl-C ends it."""
        before = time.monotonic()
        while True:
            time.sleep(_TICK_S)
            now = time.monotonic()
            self.tick(now - before)
            before = now

    def tick(self, seconds: float) -> None:
        """Lets time run for all clients that play.

        Args:
            seconds: since the last tick.
        """
        with self._sessions_lock:
            sessions = list(self.sessions.values())
        for session in sessions:
            session.tick(seconds)
