"""Motion blur: what moves over a pixel while the shutter is open. Rendered by ``render.blur``."""

from __future__ import annotations

from genre_tasks.effects.measurements import Seen
from genre_tasks.effects.pixel_motion import displaced, motions
from genre_tasks.effects.types import Effect, Fitted, Measured
from genre_tasks.logs.types import MotionBlur


def measure(seen: Seen) -> Measured:
    """Displacement in the image during the exposure, of the fastest camera."""
    return displaced(seen, {n: c.exposure_s for n, c in seen.cameras.items() if c.exposure_s > 0}, "exposed")


def needs(seen: Seen) -> str | None:
    """An exposure time."""
    return None if any(c.exposure_s > 0 for c in seen.cameras.values()) else "the log states no exposure time"


def fit(seen: Seen) -> Fitted:
    """How each camera that states an exposure time moves, see ``motion.motions``."""
    moving, frame_s = motions(seen, [n for n, c in seen.cameras.items() if c.exposure_s > 0])
    return Fitted(
        blurs={
            key: MotionBlur(seen.cameras[key[0]].exposure_s, velocity, turn, frame_s)
            for key, (velocity, turn) in moving.items()
        }
    )


EFFECT = Effect(
    "motion_blur",
    "displacement during the exposure",
    "px",
    10.0,
    "five virtual views an image",
    measure,
    needs,
    fit=fit,
)
