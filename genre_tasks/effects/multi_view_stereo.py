"""Multi-view stereo: surfaces that images show and LiDAR does not reach get points of their own."""

from __future__ import annotations

import numpy as np

from genre_tasks.effects.measurements import ChunkMeasurements
from genre_tasks.effects.types import Effect, EffectParameters, Measurement
from genre_tasks.scene.chunk import View
from genre_tasks.scene.plane_sweep import SweepImage
from genre_tasks.scene.stereo_points import (
    choose_sweep_width,
    find_neighbours,
    find_stereo_points,
    find_unscanned_pixels,
)
from genre_tasks.threads import map_single_threaded

# Of brightness within a window, in [0, 1]: sky and plain walls stay below, foliage and windows are above.
_LEAST_CONTRAST = 0.02


def measure(measurements: ChunkMeasurements) -> Measurement:
    """Measures the area of the source images that has texture and shows no LiDAR point.

    Args:
        measurements: the chunk's images and LiDAR points.

    Returns:
        Percentage of the image area, mean over the source images that have others to be compared with; no value where
        there are none.
    """
    views = measurements.source_views
    compared = [view for view in views if find_neighbours(view, views)]

    def measure_area(view: View) -> float:
        image = SweepImage.from_view(view, choose_sweep_width(view))
        unscanned = find_unscanned_pixels(measurements.chunk, view, image.lens.width_px)
        return float((unscanned & (image.contrast.numpy() > _LEAST_CONTRAST)).mean())

    areas = map_single_threaded(measure_area, compared)
    if not areas:
        return Measurement(None, "no two source images see the same from different places")
    return Measurement(100 * float(np.mean(areas)), f"of {len(areas)} images, where they have texture")


def fit(measurements: ChunkMeasurements) -> EffectParameters:
    """Finds the points.

    Args:
        measurements: the chunk's images and LiDAR points.

    Returns:
        Points of the background; none where no depth is confirmed.
    """
    points = find_stereo_points(measurements.chunk, measurements.source_views)
    return EffectParameters(stereo_points=points if len(points) else None)


EFFECT = Effect(
    name="multi_view_stereo",
    property="image area with texture and without LiDAR",
    unit="%",
    threshold=4.0,
    cost="a depth map for each source image, which is checked against all the others",
    measure=measure,
    fit=fit,
)
