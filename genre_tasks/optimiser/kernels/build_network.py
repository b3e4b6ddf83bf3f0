"""What the optimiser's CPU kernel is compiled from. Imports no torch: ``setup.py`` runs this file by its path."""

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
    constants=("BLOCK", "DEVIATION_FLOOR", "SHARE_FLOOR_PX", "VARYING", "RESIDUALS"),
    flags=("-fno-signed-zeros",),
)
"""No -freciprocal-math: tuned Adam's step and that of an untrained network are the same bits."""
