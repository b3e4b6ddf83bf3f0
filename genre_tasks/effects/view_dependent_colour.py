"""View-dependent colour: the same point differs in colour from place to place, gain apart."""

from __future__ import annotations

import numpy as np

from genre_tasks.effects.measurements import Seen
from genre_tasks.effects.types import Effect, Measured

MIN_VIEWS = 3


def measure(seen: Seen) -> Measured:
    """The median spread of a point's log colour over its views, after the exposure fit, per its spread within pixels.

    A point's neighbourhood tells what noise and a wrong pixel would make of it: without gloss that is 0.4 to 0.5 of it.

    The threshold is where 0.1 dB of held-out images are won: at 0.62 (a street with a third of the gloss) 0.07, at 0.71
    (PandaSet 028, chunk 0) 0.10 to 0.15, at 0.81 (the street's gloss) 0.5. Beside the path it may lose.
    """
    left = seen.unexplained
    often = np.isfinite(left).all(2).sum(0) >= MIN_VIEWS
    if not often.any():
        return Measured(None, f"no point is seen by {MIN_VIEWS} images")
    spread = np.nanstd(left[:, often], 0).mean(1)
    noise = np.nanmean(seen.colours.texture[:, often], 0)
    ratio = float(np.median(spread) / max(float(np.median(noise)), 1e-6))
    return Measured(ratio, f"{int(often.sum())} points in {MIN_VIEWS} or more images")


EFFECT = Effect(
    "view_dependent_colour",
    "spread of a point's colour per its texture's",
    "ratio",
    0.7,
    "eight harmonics a colour: 24 more numbers a Gaussian beside 14",
    measure,
)
