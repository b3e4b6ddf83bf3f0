"""Calls of Prefect's API that outlive a restart of the server or of its database."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import httpx
from prefect.exceptions import PrefectHTTPStatusError

_log = logging.getLogger("genre")
P = ParamSpec("P")
R = TypeVar("R")
_PATIENCE_S = 900.0
_MAX_PAUSE_S = 10.0
_FIRST_SERVER_ERROR = 500
_last_outage_s = float("-inf")


def call_server(
    function: Callable[P, R],
    *args: P.args,
    **kwargs: P.kwargs,
) -> R:
    """Calls a function of Prefect's client; where the server is away, again after pauses, for a quarter of an hour.

    Args:
        function: a call that may be made twice without harm.
        args: of the call.
        kwargs: of the call.

    Returns:
        What the function returns.

    Raises:
        Exception: what the last call raised, once the time is over; any error of the request at once.
    """
    pause_s = 0.5
    start_s = time.monotonic()
    while True:
        try:
            return function(*args, **kwargs)
        except Exception as error:
            if not is_server_away(error):
                raise
            _note_outage()
            if time.monotonic() - start_s > _PATIENCE_S:
                raise
            _log.warning("Prefect's server does not answer (%s): trying again in %.1f s", error, pause_s)
        time.sleep(pause_s)
        pause_s = min(2 * pause_s, _MAX_PAUSE_S)


def read_last_outage() -> float:
    """Reads when a call of this process last found the server away, as heartbeats are lost at such times.

    Returns:
        Seconds of ``time.monotonic``; minus infinity if it never did.
    """
    return _last_outage_s


def _note_outage() -> None:
    global _last_outage_s
    _last_outage_s = time.monotonic()


def is_server_away(error: Exception) -> bool:
    """Says whether an error of Prefect's client may pass by itself.

    Args:
        error: what a call raised.

    Returns:
        Whether the server could not be reached, or failed; not where it refused the request.
    """
    if isinstance(error, PrefectHTTPStatusError | httpx.HTTPStatusError):
        return error.response.status_code >= _FIRST_SERVER_ERROR
    # Prefect reports a connection that was never made as a RuntimeError of its own.
    is_unreachable = isinstance(error, RuntimeError) and "reach" in str(error).lower()
    return is_unreachable or isinstance(error, httpx.TransportError)
