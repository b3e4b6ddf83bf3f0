"""What the tests of the optimiser's benchmark share: a tiny task, its losses, and a goal out of reach."""

from __future__ import annotations

from benchmarks.optimiser.race import Point
from genre_tasks.config import (
    GnetConfig,
    LossConfig,
)

TINY_LOG = "synthetic:street?seed=903&width=96&height=54&samples=1&lidar_beams=32&lidar_azimuths=450&frames=9&cameras=2"
LOSS = LossConfig(perceptual=0.0)
ADAM = GnetConfig(method="adam", iterations=6, views_per_iteration=2, loss=LOSS)
NEVER = Point(0.05, 8, 99.0, 300)
"""A goal that nobody reaches."""


def learned(iterations: int) -> GnetConfig:
    return GnetConfig(iterations=iterations, views_per_iteration=4, loss=LOSS)
