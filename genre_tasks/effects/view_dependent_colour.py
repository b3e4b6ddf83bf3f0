"""View-dependent colour: a point's colour changes with the direction that it is seen from, after gains are removed."""

from __future__ import annotations

import numpy as np

from genre_tasks.effects.measurements import ChunkMeasurements
from genre_tasks.effects.types import Effect, Measurement

MIN_VIEWS = 3

# The threshold is where 0.1 dB of held-out images are won: at 0.62 (a street with a third of the gloss) 0.07, at 0.71
# (PandaSet 028, chunk 0) 0.10 to 0.15, at 0.81 (the street's full gloss) 0.5. To the side of the path it may lose.
THRESHOLD = 0.7


def measure(measurements: ChunkMeasurements) -> Measurement:
    """Measures how much the colour of points varies between views, relative to their texture.

    Texture and noise alone explain 0.4 to 0.5 of the variation; only more than that counts as view dependence.

    Args:
        measurements: the chunk's colours of points; gains and haze are removed.

    Returns:
        Median over points of the standard deviation of log colour over views, per that within 3 × 3 pixels. No value
        where no point is seen by ``MIN_VIEWS`` images.
    """
    residuals = measurements.color_residuals
    in_enough_views = np.isfinite(residuals).all(2).sum(0) >= MIN_VIEWS
    if not in_enough_views.any():
        return Measurement(None, f"no point is seen by {MIN_VIEWS} images")
    # Both are medians over points: at edges of objects a few points vary far more than all others.
    spread = np.nanstd(residuals[:, in_enough_views], 0).mean(1)
    texture = np.nanmean(measurements.point_colors.texture[:, in_enough_views], 0)
    ratio = float(np.median(spread) / max(float(np.median(texture)), 1e-6))
    return Measurement(ratio, f"{int(in_enough_views.sum())} points in {MIN_VIEWS} or more images")


EFFECT = Effect(
    name="view_dependent_colour",
    property="spread of a point's colour per its texture's",
    unit="ratio",
    threshold=THRESHOLD,
    cost="eight harmonics a colour: 24 more numbers a Gaussian beside 14",
    measure=measure,
)
