"""How much memory stages are planned for: the smaller of the user's limit and most of what the machine has."""

from __future__ import annotations

from flows.machine.memory import memory_limit_gib
from genre_tasks.config import PipelineConfig

_SHARE_OF_MACHINE = 0.85
"""Of the machine's memory: predictions are that exact, and other programs need some."""


def usable_memory_gib(config: PipelineConfig) -> float:
    """Finds how much memory a stage may take.

    Args:
        config: with the limit that the user sets, if any.

    Returns:
        GiB.

    >>> usable_memory_gib(PipelineConfig()) > 0
    True
    """
    machine_gib = _SHARE_OF_MACHINE * memory_limit_gib()
    limit_gib = config.limits.memory_gib
    # A larger number than the machine's would switch its guard off, and the kernel kills a process without a word.
    return machine_gib if limit_gib is None else min(limit_gib, machine_gib)
