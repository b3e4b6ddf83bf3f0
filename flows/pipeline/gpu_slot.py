"""A slot of a GPU that many workers share: a stage on the GPU waits for one, if the worker's environment says so."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from genre_tasks.errors import ConfigError

GPU_LIMIT_VARIABLE = "GENRE_GPU_LIMIT"
"""The environment variable that names Prefect's global concurrency limit; unset, nothing is waited for."""
# Renewed while the stage runs; what a dead worker had is free again after this time.
_LEASE_S = 120.0
GPU_STAGES = frozenset({"gnet", "fnet", "enet"})
"""Stages that compute on a GPU where there is one, apart from those of evaluation."""


def uses_gpu(stage: str) -> bool:
    """Says whether a stage computes on a GPU where there is one.

    Args:
        stage: the stage's name.

    Returns:
        Whether it does.

    >>> uses_gpu("gnet"), uses_gpu("evaluate/enet"), uses_gpu("ingest")
    (True, True, False)
    """
    return stage in GPU_STAGES or stage.startswith("evaluate/")


@contextmanager
def gpu_slot(stage: str) -> Iterator[None]:
    """Holds a slot of the limit that ``GENRE_GPU_LIMIT`` names, while a stage that uses a GPU runs.

    The server takes the slot back some minutes after a worker died that had it.

    Args:
        stage: the stage's name.

    Yields:
        Nothing, once a slot is free.

    Raises:
        ConfigError: the server has no limit of this name.
    """
    limit = os.environ.get(GPU_LIMIT_VARIABLE)
    if not limit or not uses_gpu(stage):
        yield
        return
    from prefect.concurrency.asyncio import ConcurrencySlotAcquisitionError
    from prefect.concurrency.sync import concurrency

    with ExitStack() as stack:
        try:
            # Strict: a limit that does not exist would let every stage in.
            stack.enter_context(concurrency(limit, strict=True, lease_duration=_LEASE_S))
        except ConcurrencySlotAcquisitionError as error:
            remedy = f"Create it: prefect gcl create {limit} --limit 1. Or unset {GPU_LIMIT_VARIABLE}."
            raise ConfigError(f"the Prefect server has no concurrency limit '{limit}'", remedy=remedy) from error
        yield
