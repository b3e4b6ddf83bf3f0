"""How much memory this process may use: the smaller of the machine's and its cgroup's."""

from __future__ import annotations

from pathlib import Path

_CGROUP_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))


def memory_limit_gib() -> float:
    """GiB. On Linux the kernel kills a process that goes over, so work is planned against this beforehand."""
    import psutil

    limits = [float(psutil.virtual_memory().total)]
    for path in _CGROUP_LIMITS:
        try:
            limits.append(float(path.read_text()))
        except (OSError, ValueError):  # no cgroup, or the word "max"
            continue
    return min(limits) / 2**30
