"""Motion blur: what moves over a pixel while the shutter is open."""

from __future__ import annotations

from genre_tasks.effects.motion import displaced
from genre_tasks.effects.seen import Seen
from genre_tasks.effects.types import Effect, Measured


def measure(seen: Seen) -> Measured:
    """Displacement in the image during the exposure, of the fastest camera."""
    return displaced(seen, {n: c.exposure_s for n, c in seen.cameras.items() if c.exposure_s > 0}, "exposed")


def needs(seen: Seen) -> str | None:
    """An exposure time."""
    return None if any(c.exposure_s > 0 for c in seen.cameras.values()) else "the log states no exposure time"


EFFECT = Effect(
    "motion_blur",
    "displacement during the exposure",
    "px",
    1.0,
    "some five virtual views an image",
    measure,
    needs,
    marks=True,
)
