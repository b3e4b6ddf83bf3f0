"""What the kernel's control groups (cgroups) of this process say: limits of containers and of batch systems' jobs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

CGROUP_ROOT = Path("/sys/fs/cgroup")
CGROUPS_OF_PROCESS = Path("/proc/self/cgroup")


def read_cgroup_files(controller: str, name: str) -> Iterator[str]:
    """Reads one file of the process's cgroup and of every cgroup above it.

    A batch system sets limits in a cgroup below the root, while a container sees its cgroup as the root.

    Args:
        controller: of cgroup version 1, such as ``memory``; empty for version 2, which has all in one tree.
        name: of the file, such as ``memory.max``.

    Yields:
        The texts without space around them, from the root down; nothing where there are no cgroups.
    """
    root = CGROUP_ROOT / controller
    folder = root
    for part in ("", *_find_cgroup_path(controller).split("/")):
        folder = folder / part
        # The path may be of the machine's tree, of which a container sees its branch alone.
        with suppress(OSError):
            yield (folder / name).read_text().strip()


def _find_cgroup_path(controller: str) -> str:
    with suppress(OSError):
        for line in CGROUPS_OF_PROCESS.read_text().splitlines():
            _, controllers, path = line.split(":", 2)
            if controller in controllers.split(","):
                return path.strip("/")
    return ""
