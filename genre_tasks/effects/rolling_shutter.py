"""Rolling shutter: rows are read one after the other while the camera moves."""

from __future__ import annotations

from genre_tasks.effects.motion import pixel_speeds
from genre_tasks.effects.seen import Seen
from genre_tasks.effects.types import Effect, Measured


def measure(seen: Seen) -> Measured:
    """Displacement in the image between the first and the last row, of the fastest camera."""
    moved = {name: speed * seen.cameras[name].readout_s for name, speed in pixel_speeds(seen).items()}
    if not moved:
        return Measured(None, "no camera has two images and LiDAR returns")
    name = max(moved, key=lambda n: moved[n])
    return Measured(moved[name], f"{name} is read in {1e3 * seen.cameras[name].readout_s:g} ms")


def needs(seen: Seen) -> str | None:
    """A readout time."""
    return None if any(c.readout_s > 0 for c in seen.cameras.values()) else "the log states no readout time"


EFFECT = Effect("rolling_shutter", "displacement during the readout", "px", 0.5, "a pose for each row", measure, needs)
