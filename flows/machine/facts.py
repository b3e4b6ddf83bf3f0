"""What a number was measured on: the machine, the commit of the code, the versions of the packages."""

from __future__ import annotations

import functools
import math
import os
import platform
import subprocess
from importlib.metadata import version
from pathlib import Path

from flows.machine.cgroups import read_cgroup_files

CHECKOUT = Path(__file__).resolve().parents[2]
"""The folder that holds the packages: the checkout, where they run from one."""


def describe_machine() -> str:
    """Names the machine in one line, for the results that are measured on it.

    Returns:
        CPU model, cores that this process may use, instruction set of the kernels, version of torch, and the GPU if
        there is one, separated by commas.
    """
    import torch

    from genre_tasks.compiled.loader import supported_instruction_sets

    parts = [_cpu_model(), f"{count_cores()} cores", supported_instruction_sets()[0], f"torch {torch.__version__}"]
    if torch.cuda.is_available():
        parts.append(torch.cuda.get_device_name())
    return ", ".join(parts)


def count_cores() -> int:
    """Counts the cores that this process may use, of which a container may have fewer than the machine.

    Returns:
        At least 1: the smallest of the machine's cores, those that it is bound to, and the quotas of its cgroups.

    >>> count_cores() >= 1
    True
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    # A quota is of microseconds of all cores in a period; a part of a core is still worth a thread.
    quotas = [text.split() for text in read_cgroup_files("", "cpu.max")]
    v1 = [read_cgroup_files("cpu", name) for name in ("cpu.cfs_quota_us", "cpu.cfs_period_us")]
    quotas += [[quota, period] for quota, period in zip(*v1, strict=False)]
    # The word "max", or -1, says that there is no quota.
    granted = [math.ceil(int(quota) / int(period)) for quota, period in quotas if quota.isdigit()]
    return max(min([cores, *granted]), 1)


def describe_environment() -> dict[str, str]:
    """Lists what can change a measured number, for the manifest of an artifact.

    Returns:
        Versions of Python, torch, numpy and GenRe, the platform, the processor, and the number of torch's threads.
    """
    import torch

    # A sweep over numbers of threads changes theirs within a process; nothing else changes.
    return {**_describe_installation(), "threads": str(torch.get_num_threads())}


def git_commit(folder: Path = CHECKOUT) -> str:
    """Finds the commit that the code of a folder is at.

    Args:
        folder: the root of a checkout, as a resolved path.

    Returns:
        40 hex digits, followed by ``+changes`` where tracked files differ from the commit; ``unknown`` outside of a
        checkout.
    """
    try:
        # Installed below another project's repository, git would answer with that project's commit.
        if Path(_git(folder, "rev-parse", "--show-toplevel")).resolve() != folder:
            return "unknown"
        head = _git(folder, "rev-parse", "HEAD")
        # Stores, results and notes lie untracked in many checkouts; they change no measurement.
        changed = _git(folder, "status", "--porcelain", "--untracked-files=no")
        return f"{head}+changes" if changed else head
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


@functools.lru_cache(maxsize=1)
def _describe_installation() -> dict[str, str]:
    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "processor": platform.machine(),
        **{name: version(name) for name in ("torch", "numpy", "genre")},
    }


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    fields = dict(line.split(":", 1) for line in lines if ":" in line)
    values = {name.strip(): value.strip() for name, value in fields.items()}
    if "model name" not in values:
        return platform.processor() or platform.machine()
    # Virtual machines hide the model's name; family and model still tell the generation.
    return f"{values['model name']} (family {values.get('cpu family', '?')} model {values.get('model', '?')})"


def _git(folder: Path, *arguments: str) -> str:
    done = subprocess.run(["git", *arguments], cwd=folder, capture_output=True, text=True, check=True)
    return done.stdout.strip()
