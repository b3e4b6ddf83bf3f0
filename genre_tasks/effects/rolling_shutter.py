"""Rolling shutter: rows are read one after the other while the camera moves."""

from __future__ import annotations

from genre_tasks.effects.measurements import Seen
from genre_tasks.effects.pixel_motion import displaced, motions
from genre_tasks.effects.types import Effect, Fitted, Measured
from genre_tasks.logs.types import RollingShutter

THRESHOLD_PX = 6.0
"""A tenth of a decibel is gained at 3 m (validation streets 900–902, medians: −0.02 dB at 4 px, 0.21 at 8, 0.45 at 16,
0.99 at 27 to 32)."""


def measure(seen: Seen) -> Measured:
    """Displacement in the image between the first and the last row, of the fastest camera."""
    return displaced(seen, {n: c.readout_s for n, c in seen.cameras.items() if c.readout_s > 0}, "read out")


def needs(seen: Seen) -> str | None:
    """A readout time."""
    return None if any(c.readout_s > 0 for c in seen.cameras.values()) else "the log states no readout time"


def fit(seen: Seen) -> Fitted:
    """How each camera that states a readout time moves, see ``motion.motions``."""
    moving, frame_s = motions(seen, [n for n, c in seen.cameras.items() if c.readout_s > 0])
    return Fitted(
        shutters={
            key: RollingShutter(seen.cameras[key[0]].readout_s, velocity, turn, frame_s)
            for key, (velocity, turn) in moving.items()
        }
    )


EFFECT = Effect(
    "rolling_shutter",
    "displacement during the readout",
    "px",
    THRESHOLD_PX,
    "a pose for each row",
    measure,
    needs,
    fit=fit,
)
