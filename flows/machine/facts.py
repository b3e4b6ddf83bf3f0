"""What a number was measured on."""

from __future__ import annotations

import os
import platform
import subprocess
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[2]


def machine() -> str:
    """CPU model, cores that this process may use, instruction set of the kernel, torch version, GPU if there is one."""
    import torch

    from genre_tasks.compiled.loader import supported_isas

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    parts = [_cpu_model(), f"{cores} cores", supported_isas()[0], f"torch {torch.__version__}"]
    if torch.cuda.is_available():
        parts.append(torch.cuda.get_device_name())
    return ", ".join(parts)


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    fields = dict(line.split(":", 1) for line in lines if ":" in line)
    names = {k.strip(): v.strip() for k, v in fields.items()}
    if "model name" not in names:
        return platform.processor() or platform.machine()
    # Virtual machines hide the name; family and model still tell the generation.
    return f"{names['model name']} (family {names.get('cpu family', '?')} model {names.get('model', '?')})"


def commit(folder: Path = CHECKOUT) -> str:
    """The checkout's commit, ``+changes`` added where tracked files differ from it; ``unknown`` outside of one."""
    try:
        if Path(_git(folder, "rev-parse", "--show-toplevel")).resolve() != folder:
            return "unknown"  # installed below somebody else's repository
        head = _git(folder, "rev-parse", "HEAD")
        return head + ("+changes" if _git(folder, "status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _git(where: Path, *arguments: str) -> str:
    done = subprocess.run(["git", *arguments], cwd=where, capture_output=True, text=True, check=True)
    return done.stdout.strip()
