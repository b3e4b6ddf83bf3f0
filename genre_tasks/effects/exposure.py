"""Exposure and white balance: the same point is brighter in one image than in another."""

from __future__ import annotations

import numpy as np

from genre_tasks.effects.seen import Seen
from genre_tasks.effects.types import Effect, Measured


def measure(seen: Seen) -> Measured:
    """The spread of the images' log gains, over images, of the channel where it is widest."""
    if len(seen.sources) < 2 or not np.isfinite(seen.colours.value).any():
        return Measured(None, "no two images share a point")
    spread = seen.gains.std(0)
    channel = int(spread.argmax())
    return Measured(100 * float(spread[channel]), f"of {len(seen.sources)} images, widest in {'RGB'[channel]}")


HAZE_PERCENT = 8.0
"""What haze alone may read as: a street without any change of exposure reads 4 to 7 %."""

EFFECT = Effect(
    "exposure", "spread of gain between images", "%", HAZE_PERCENT, "an affine colour map an image", measure
)
