"""What the image loss's CPU kernel is compiled from. No torch is imported: ``setup.py`` runs this file by its path."""

from __future__ import annotations

from pathlib import Path

from genre_tasks.compiled.build import Kernel

KERNEL = Kernel(
    title="the image loss's CPU kernel",
    stem="image_loss",
    folder=Path(__file__).resolve().parent,
    # A change of any of these makes another digest, and the loader then asks for a new build.
    sources=("image_loss.cpp", "constants.py", "build_image_loss.py"),
    constants_file="constants.py",
    constants=("RADIUS", "SIGMA", "C1", "C2", "DEPTH_MIN_M", "DEPTH_LOSS_MAX"),
)
