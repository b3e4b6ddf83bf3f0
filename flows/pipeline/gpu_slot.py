"""A slot of a GPU that many workers share: heavy stages wait for one, if the worker's environment says so."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from genre_tasks.errors import ConfigError, TransientIOError

GPU_LIMIT_VARIABLE = "GENRE_GPU_LIMIT"
"""The environment variable that names Prefect's global concurrency limit; unset, nothing is waited for."""
# Renewed while the stage runs; what a dead worker had is free again after this time.
_LEASE_S = 120.0
_PATIENCE_S = 300.0
_FIRST_PAUSE_S = 0.5
_MAX_PAUSE_S = 10.0
_FIRST_SERVER_ERROR = 500
_log = logging.getLogger("genre")
GPU_STAGES = frozenset({"gnet", "fnet", "enet"})
"""Stages that wait for a slot, apart from those of evaluation: networks and rendering. They run on the CPU so far."""


def takes_gpu_slot(stage: str) -> bool:
    """Says whether a stage waits for a slot.

    Args:
        stage: the stage's name.

    Returns:
        Whether it does.

    >>> takes_gpu_slot("gnet"), takes_gpu_slot("evaluate/enet"), takes_gpu_slot("ingest")
    (True, True, False)
    """
    return stage in GPU_STAGES or stage.startswith("evaluate/")


@contextmanager
def gpu_slot(stage: str) -> Iterator[None]:
    """Holds a slot of the limit that ``GENRE_GPU_LIMIT`` names, while a heavy stage computes, on any device.

    Heavy are GNet, FNet, ENet and evaluations. The server takes the slot back some minutes after a worker died that had
    it.

    Args:
        stage: the stage's name.

    Yields:
        Nothing, once a slot is free.

    Raises:
        ConfigError: the server has no limit of this name, or refuses the request.
        TransientIOError: the server has been away for minutes.
    """
    limit = os.environ.get(GPU_LIMIT_VARIABLE)
    if not limit or not takes_gpu_slot(stage):
        yield
        return
    with ExitStack() as stack:
        _take_slot(stack, limit)
        yield


def _take_slot(stack: ExitStack, limit: str) -> None:
    from prefect.concurrency.asyncio import ConcurrencySlotAcquisitionError
    from prefect.concurrency.sync import concurrency

    start_s = time.monotonic()
    pause_s = _FIRST_PAUSE_S
    while True:
        try:
            # Strict: a limit that does not exist would let every stage in.
            stack.enter_context(concurrency(limit, strict=True, lease_duration=_LEASE_S))
            return
        except ConcurrencySlotAcquisitionError as error:
            if not _is_server_away(error.__cause__):
                remedy = f"Create it: prefect gcl create {limit} --limit 1. Or unset {GPU_LIMIT_VARIABLE}."
                raise ConfigError(f"the Prefect server has no concurrency limit '{limit}'", remedy=remedy) from error
            if time.monotonic() - start_s > _PATIENCE_S:
                remedy = "It is tried again; if it stays, start the server."
                raise TransientIOError("the Prefect server does not answer", remedy=remedy) from error
            # Prefect uses the same error for a server that is just started again, which must not end the log.
            _log.warning("the Prefect server does not answer: trying again in %.1f s", pause_s)
        time.sleep(pause_s)
        pause_s = min(2 * pause_s, _MAX_PAUSE_S)


def _is_server_away(cause: BaseException | None) -> bool:
    """Whether the cause of Prefect's error may pass; it has none where the limit does not exist."""
    import httpx

    if isinstance(cause, httpx.HTTPStatusError):
        return cause.response.status_code >= _FIRST_SERVER_ERROR
    return cause is not None
