"""Rolling shutter: rows are read one after the other while the camera moves."""

from __future__ import annotations

from genre_tasks.effects.motion import displaced
from genre_tasks.effects.seen import Seen
from genre_tasks.effects.types import Effect, Measured


def measure(seen: Seen) -> Measured:
    """Displacement in the image between the first and the last row, of the fastest camera."""
    return displaced(seen, {n: c.readout_s for n, c in seen.cameras.items() if c.readout_s > 0}, "read out")


def needs(seen: Seen) -> str | None:
    """A readout time."""
    return None if any(c.readout_s > 0 for c in seen.cameras.values()) else "the log states no readout time"


EFFECT = Effect("rolling_shutter", "displacement during the readout", "px", 0.5, "a pose for each row", measure, needs)
