"""Night: marked, not modelled."""

from __future__ import annotations

import numpy as np

from genre_tasks.effects.measurements import Seen
from genre_tasks.effects.types import Effect, Measured

DARK = 0.15
"""Mean of the luma, of 1, below which an image is dark."""

_LUMA = np.array([0.299, 0.587, 0.114])


def measure(seen: Seen) -> Measured:
    """The share of source images that are dark."""
    lumas = [float((image.reshape(-1, 3).mean(0) @ _LUMA) / 255) for image in seen.pixels.values()]
    if not lumas:
        return Measured(None, "there is no image")
    dark = 100 * float(np.mean([luma < DARK for luma in lumas]))
    return Measured(dark, f"luma {min(lumas):.2f} to {max(lumas):.2f} of 1")


EFFECT = Effect("darkness", "images darker than 0.15 of 1", "%", 50.0, "nothing: it is marked", measure, marks=True)
