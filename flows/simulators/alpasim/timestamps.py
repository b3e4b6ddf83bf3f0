"""Times on the wire and in bundles: whole microseconds."""

from __future__ import annotations


def to_microseconds(time_s: float) -> int:
    """Rounds absolute seconds to microseconds.

    Args:
        time_s: since 1970.

    >>> to_microseconds(1.5)
    1500000
    """
    return round(float(time_s) * 1e6)
