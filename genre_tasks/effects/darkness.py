"""Darkness: images of the night are reported, and not modelled."""

from __future__ import annotations

import numpy as np

from genre_tasks.effects.measurements import ChunkMeasurements
from genre_tasks.effects.types import Effect, Measurement
from genre_tasks.srgb import LUMA_WEIGHTS

DARK_LUMA = 0.15
"""An image is dark where the mean of its luma, from 0 to 1, is below."""


def measure(measurements: ChunkMeasurements) -> Measurement:
    """Measures which part of the source images is dark.

    Args:
        measurements: the chunk's images.

    Returns:
        Percentage of the source images; no value where there is no image.
    """
    weights = np.array(LUMA_WEIGHTS)
    lumas = [float((image.reshape(-1, 3).mean(0) @ weights) / 255) for image in measurements.source_images.values()]
    if not lumas:
        return Measurement(None, "there is no image")
    percent = 100 * float(np.mean([luma < DARK_LUMA for luma in lumas]))
    return Measurement(percent, f"luma {min(lumas):.2f} to {max(lumas):.2f} of 1")


EFFECT = Effect(
    name="darkness",
    property="images darker than 0.15 of 1",
    unit="%",
    threshold=50.0,
    cost="nothing: it is marked",
    measure=measure,
    report_only=True,
)
