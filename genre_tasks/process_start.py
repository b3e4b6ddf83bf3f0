"""When a process started, which tells it from a later process of the same number."""

from __future__ import annotations

from pathlib import Path


def read_start_ticks(process: int) -> int | None:
    """Reads when a process started, by a clock that nobody sets.

    Args:
        process: its number.

    Returns:
        Hundredths of a second since the machine's start on Linux, elsewhere since the epoch; ``None`` where the process
        does not run, or has ended and waits for its parent.

    >>> import os
    >>> read_start_ticks(os.getpid()) == read_start_ticks(os.getpid())
    True
    """
    if not Path("/proc/self/stat").exists():
        return _read_start_elsewhere(process)
    try:
        text = Path(f"/proc/{process}/stat").read_text()
    except OSError:
        return None
    # The name in parentheses may hold spaces and parentheses.
    fields = text.rpartition(")")[2].split()
    return None if fields[0] in "ZX" else int(fields[19])


def _read_start_elsewhere(process: int) -> int | None:
    import psutil

    try:
        found = psutil.Process(process)
        return None if found.status() == psutil.STATUS_ZOMBIE else round(found.create_time() * 100)
    except psutil.Error:
        return None
