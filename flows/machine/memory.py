"""How much memory this process may use: the smaller of the machine's and its cgroup's."""

from __future__ import annotations

from pathlib import Path

_CGROUP_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))


def memory_limit_gib() -> float:
    """Finds how much memory this process may use, in GiB.

    On Linux the kernel kills a process that uses more, so work is planned against this limit beforehand.

    Returns:
        The smaller of the machine's memory and the limit of the process's cgroup (a container's limit).

    >>> memory_limit_gib() > 0
    True
    """
    import psutil

    limits = [float(psutil.virtual_memory().total)]
    for path in _CGROUP_LIMITS:
        try:
            limits.append(float(path.read_text()))
        except (OSError, ValueError):
            # There is no cgroup here, or its file says "max": no limit.
            continue
    return min(limits) / 2**30
