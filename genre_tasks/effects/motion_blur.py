"""Motion blur: a pixel mixes what moves over it while the shutter is open. ``render.motion_blur`` draws it."""

from __future__ import annotations

from genre_tasks.effects.measurements import ChunkMeasurements
from genre_tasks.effects.pixel_motion import MotionDuringImage
from genre_tasks.effects.types import Effect, EffectParameters
from genre_tasks.logs.types import MotionBlur

EXPOSURE = MotionDuringImage(lambda camera: camera.exposure_s, activity="exposed", quantity="exposure time")
"""Displacement in the image while the shutter is open."""


def fit(measurements: ChunkMeasurements) -> EffectParameters:
    """Estimates how each camera that states an exposure time moves while its images are exposed.

    Args:
        measurements: the chunk's poses.

    Returns:
        A blur for each image of those cameras.
    """
    return EffectParameters(blurs=EXPOSURE.fit(measurements, MotionBlur))


EFFECT = Effect(
    name="motion_blur",
    property="displacement during the exposure",
    unit="px",
    threshold=10.0,
    cost="five virtual views an image",
    measure=EXPOSURE.measure,
    find_missing=EXPOSURE.find_missing,
    fit=fit,
)
