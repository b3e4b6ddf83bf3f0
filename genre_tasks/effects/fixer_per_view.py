"""The fixer, view by view: what is thin, or not borne out by images, is known once novel views are rendered."""

from __future__ import annotations

from genre_tasks.effects.measurements import Seen
from genre_tasks.effects.types import Effect, Measured


def measure(_: Seen) -> Measured:
    """Nothing yet."""
    return Measured(None, "decided view by view from the renders (fnet.gate)")


EFFECT = Effect("fixer_per_view", "what of a view is thin or unseen", "share", 0.0, "0.2 s a view at 320×180", measure)
