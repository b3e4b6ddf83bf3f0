"""An HTTP server in a thread of its own, so that the main thread is free for signals."""

from __future__ import annotations

import threading
import time
from typing import Any

import uvicorn

from flows.simulators.service import bind_socket
from genre_tasks.errors import ResourceError

# A command has to end within seconds of a signal.
_SECONDS_TO_END = 3
_SECONDS_TO_START = 30.0
# Beside those that wait: clients that are refused with a sentence, and connections that are open without a request. A
# request of the largest size may be read at each.
_FURTHER_CONNECTIONS = 48


class HttpThread:
    """Serves an ASGI application until it is closed; a ``RunningService``.

    Args:
        app: the application.
        host: address to listen at.
        port: 0: any free one.
        max_waiting: requests that the application lets wait. Far more connections are refused before it hears of them.

    Raises:
        ConfigError: the address cannot be listened at.
        ResourceError: the server does not start.
    """

    def __init__(self, app: Any, host: str, port: int, max_waiting: int) -> None:
        self._socket = bind_socket(host, port)
        name, bound_port = self._socket.getsockname()[:2]
        self._address = f"http://[{name}]:{bound_port}" if ":" in name else f"http://{name}:{bound_port}"
        config = uvicorn.Config(
            app,
            log_config=None,
            access_log=False,
            lifespan="off",
            limit_concurrency=max_waiting + _FURTHER_CONNECTIONS,
            timeout_graceful_shutdown=_SECONDS_TO_END,
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._run, name="http-service", daemon=True)
        self._thread.start()
        deadline = time.monotonic() + _SECONDS_TO_START
        while not self._server.started:
            if not self._thread.is_alive() or time.monotonic() > deadline:
                raise ResourceError("the HTTP server does not start", remedy="Run with --debug to see why.")
            time.sleep(0.01)

    @property
    def address(self) -> str:
        """Where it listens."""
        return self._address

    def wait(self) -> None:
        """Waits until the server ends."""
        self._thread.join()

    def close(self) -> None:
        """Ends the server; requests under way have a few seconds."""
        self._server.should_exit = True
        self._thread.join(2 * _SECONDS_TO_END)

    def _run(self) -> None:
        # In a thread that is not the main one, the server leaves the handlers of signals alone.
        self._server.run(sockets=[self._socket])
