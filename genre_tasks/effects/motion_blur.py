"""Motion blur: what moves over a pixel while the shutter is open."""

from __future__ import annotations

from genre_tasks.effects.motion import pixel_speeds
from genre_tasks.effects.seen import Seen
from genre_tasks.effects.types import Effect, Measured


def measure(seen: Seen) -> Measured:
    """Displacement in the image during the exposure, of the fastest camera."""
    exposed = {n: c.exposure_s for n, c in seen.cameras.items() if c.exposure_s > 0}
    moved = {n: speed * exposed[n] for n, speed in pixel_speeds(seen).items() if n in exposed}
    if not moved:
        return Measured(None, "no camera with an exposure time has two images and LiDAR returns")
    name = max(moved, key=lambda n: moved[n])
    return Measured(moved[name], f"{name} is exposed for {1e3 * exposed[name]:g} ms")


def needs(seen: Seen) -> str | None:
    """An exposure time."""
    return None if any(c.exposure_s > 0 for c in seen.cameras.values()) else "the log states no exposure time"


EFFECT = Effect(
    "motion_blur", "displacement during the exposure", "px", 1.0, "some five virtual views an image", measure, needs
)
