"""Waiting for what another thread or process does, with an end."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest

_POLL_S = 0.02


def wait_until(condition: Callable[[], bool], problem: str, seconds: float = 30.0) -> None:
    """Waits for a condition, and fails the test where it does not come.

    Args:
        condition: what must become true.
        problem: the sentence of the failure, such as ``"the worker does not start"``.
        seconds: how long to wait.
    """
    deadline_s = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline_s:
            pytest.fail(f"{problem} within {seconds:g} s")
        # A loop without a pause would take the core from what it waits for.
        time.sleep(_POLL_S)
