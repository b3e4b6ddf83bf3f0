"""Exposure and white balance: the same point is brighter in one image than in another."""

from __future__ import annotations

from genre_tasks.effects.seen import Seen
from genre_tasks.effects.types import Effect, Measured


def measure(seen: Seen) -> Measured:
    """The spread of log gain over images that share points, of the channel where it is widest."""
    linked = seen.linked
    if linked.sum() < 2:
        return Measured(None, "no two images share enough points of LiDAR sweeps")
    spread = seen.gains[linked].std(0)
    channel = int(spread.argmax())
    return Measured(100 * float(spread[channel]), f"of {int(linked.sum())} images, widest in {'RGB'[channel]}")


HAZE_PERCENT = 8.0
"""What haze alone may read as: streets without any change of exposure read 5 to 6 %."""

EFFECT = Effect(
    "exposure", "spread of gain between images", "%", HAZE_PERCENT, "an affine colour map an image", measure
)
