"""How much memory this process may use: the smaller of the machine's and its cgroups'."""

from __future__ import annotations

from flows.machine.cgroups import read_cgroup_files


def memory_limit_gib() -> float:
    """Finds how much memory this process may use, in GiB.

    On Linux the kernel kills a process that uses more, so work is planned against this limit beforehand.

    Returns:
        The smallest of the machine's memory and the limits of the process's cgroup and of all above it, as containers
        and batch systems set them.

    >>> memory_limit_gib() > 0
    True
    """
    import psutil

    limits = [float(psutil.virtual_memory().total)]
    texts = [*read_cgroup_files("", "memory.max"), *read_cgroup_files("memory", "memory.limit_in_bytes")]
    # The word "max" says that there is no limit.
    limits += [float(text) for text in texts if text.isdigit()]
    return min(limits) / 2**30
