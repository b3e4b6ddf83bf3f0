"""Pose refinement: recorded camera poses err by satellites, calibration or clocks, and images tell by how much."""

from __future__ import annotations

from genre_tasks.effects.measurements import ChunkMeasurements
from genre_tasks.effects.types import Effect, EffectParameters, Measurement
from genre_tasks.scene.pose_alignment import align_poses

MIN_PIXELS = 57_000
"""Images of fewer are too coarse: on exact streets refined poses then move by as much as the gate's threshold.

320×180 has 57 600 pixels, and images of another shape get as many within rounding: on exact streets at 278×208 and
302×190 poses move by less than the threshold, too."""

MIN_IMAGES = 8
"""Fewer source images do not hold a motion that all of them share: on exact streets it then exceeds the threshold."""


def measure(measurements: ChunkMeasurements) -> Measurement:
    """Measures by how far LiDAR points miss their place in the images.

    Args:
        measurements: the chunk's images and LiDAR points.

    Returns:
        Pixels at the working resolution, by which refined poses move LiDAR returns; no value where no two images see
        the same points, source images are fewer than ``MIN_IMAGES``, or they have less than ``MIN_PIXELS``.
    """
    chunk = measurements.chunk
    if chunk.width_px * chunk.height_px < MIN_PIXELS:
        return Measurement(None, f"images of {chunk.width_px}×{chunk.height_px} pixels are too coarse to tell")
    count = len(measurements.source_views)
    if count < MIN_IMAGES:
        return Measurement(None, f"{count} source images are too few to tell")
    # Coarse, since most logs err by nothing and should not pay for it.
    alignment = measurements.coarse_alignment
    if alignment is None:
        return Measurement(None, "no two source images see the same LiDAR points")
    return Measurement(alignment.displacement_px, f"of LiDAR returns in {count} images, where points keep their colour")


def fit(measurements: ChunkMeasurements) -> EffectParameters:
    """Refines the poses.

    Args:
        measurements: the chunk's images and LiDAR points.

    Returns:
        Poses of all views; those that are held out take theirs from their neighbours in time.
    """
    alignment = align_poses(measurements.chunk, start=measurements.coarse_alignment)
    return EffectParameters() if alignment is None else EffectParameters(poses=alignment.poses)


EFFECT = Effect(
    name="pose_refinement",
    property="misalignment of LiDAR and images",
    unit="px",
    threshold=0.6,
    cost="ten seconds for fifteen source images",
    measure=measure,
    fit=fit,
)
