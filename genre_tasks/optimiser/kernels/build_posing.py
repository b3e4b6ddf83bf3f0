"""What the kernel from offsets to splats is compiled from.

It imports no torch, because ``setup.py`` runs this file by its path in an environment that may lack it.
"""

from __future__ import annotations

from pathlib import Path

from genre_tasks.compiled.build import Kernel

KERNEL = Kernel(
    title="the posing of Gaussians on the CPU",
    stem="posing",
    folder=Path(__file__).resolve().parent,
    sources=("posing.cpp", "../../scene/constants.py", "build_posing.py"),
    constants_file="../../scene/constants.py",
    constants=("ABSENT_LOGIT", "LARGEST_LOG_SCALE", "LOWEST_LOGIT"),
)
"""The recipe of the kernel's libraries."""
