"""What the optimiser's CPU kernel is compiled from.

It imports no torch, because ``setup.py`` runs this file by its path in an environment that may lack it.
"""

from __future__ import annotations

from pathlib import Path

from genre_tasks.compiled.build import Kernel

SOURCES = (
    "network.cpp",
    "features.h",
    "rows.h",
    "thread_team.h",
    "../../render/kernel/simd.h",
    "constants.py",
    "build_network.py",
)

KERNEL = Kernel(
    title="the optimiser's CPU kernel",
    stem="network",
    folder=Path(__file__).resolve().parent,
    sources=SOURCES,
    constants_file="constants.py",
    constants=("BLOCK_GAUSSIANS", "RMS_FLOOR", "WEIGHT_FLOOR_PX", "VARYING_FEATURES", "IMAGE_RESIDUALS"),
    # No -freciprocal-math: tuned Adam's step and that of an untrained network must be the same bits.
    flags=("-fno-signed-zeros",),
)
"""The recipe of the kernel's libraries."""
