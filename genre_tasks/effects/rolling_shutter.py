"""Rolling shutter: rows are read one after the other while the camera moves; the renderer gives each its own pose."""

from __future__ import annotations

from genre_tasks.effects.measurements import ChunkMeasurements
from genre_tasks.effects.pixel_motion import MotionDuringImage
from genre_tasks.effects.types import Effect, EffectParameters
from genre_tasks.logs.types import RollingShutter

# A tenth of a decibel is gained at 3 m (validation streets 900–902, medians: −0.02 dB at 4 px, 0.21 at 8, 0.45 at 16,
# 0.99 at 27 to 32).
THRESHOLD_PX = 6.0

READOUT = MotionDuringImage(lambda camera: camera.readout_s, activity="read out", quantity="readout time")
"""Displacement in the image between the first and the last row."""


def fit(measurements: ChunkMeasurements) -> EffectParameters:
    """Estimates how each camera that states a readout time moves while its images are read out.

    Args:
        measurements: the chunk's poses.

    Returns:
        A shutter for each image of those cameras.
    """
    return EffectParameters(shutters=READOUT.fit(measurements, RollingShutter))


EFFECT = Effect(
    name="rolling_shutter",
    property="displacement during the readout",
    unit="px",
    threshold=THRESHOLD_PX,
    cost="a pose for each row",
    measure=READOUT.measure,
    find_missing=READOUT.find_missing,
    fit=fit,
)
