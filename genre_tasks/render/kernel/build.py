"""What the renderer's CPU kernel is compiled from. Imports no torch: ``setup.py`` runs this file by its path."""

from __future__ import annotations

from pathlib import Path

from genre_tasks.compiled.build import Kernel

CONSTANTS = (
    "NEAR_M",
    "BLUR_PX2",
    "ALPHA_MIN",
    "ALPHA_MAX",
    "TRANSMITTANCE_STOP",
    "JACOBIAN_MARGIN",
    "QUAT_MIN_NORM2",
    "MAX_VARIANCE_PX2",
    "MAX_CENTER_PX",
    "SHUTTER_MIN_RATE",
    "COMPENSATION_MIN",
)
ABLATIONS = ("GENRE_ABLATE_GUARDS", "GENRE_ABLATE_DETERMINISM")
"""Compile-time switches of the sources, off by default: each leaves out what makes the kernel safe or deterministic, so
that a benchmark can time what it costs."""

SOURCES = (
    "kernel.cpp",
    "view.h",
    "blend.h",
    "project.h",
    "camera.h",
    "simd.h",
    "memory_pool.h",
    "spherical_harmonics.h",
    "../constants.py",
    "build.py",
)

KERNEL = Kernel(
    title="the renderer's CPU kernel",
    stem="kernel",
    folder=Path(__file__).resolve().parent,
    sources=SOURCES,
    constants_file="../constants.py",
    constants=CONSTANTS,
    flags=("-fno-signed-zeros", "-freciprocal-math"),
)
