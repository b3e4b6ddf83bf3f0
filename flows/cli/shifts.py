"""Distances to the side of the path, as commands take them: ``0,1,2``, ``-3,3`` or ``±3m``."""

from __future__ import annotations

import re

from flows.cli.parsing import check_number
from genre_tasks.errors import ConfigError

# Farther to the side no log has recorded anything.
_MAX_SHIFT_M = 1000.0
_NUMBER = r"[0-9]{1,9}(?:\.[0-9]{1,9})?"
_SHIFT = re.compile(rf"(?P<sign>±|\+/?-|[+-])?\s*(?P<size>{_NUMBER})\s*m?")


def parse_shifts(text: str, option: str) -> list[float]:
    """Reads distances to the side.

    Args:
        text: what the user wrote: numbers with or without ``m``, separated by commas; ``±`` or ``+-`` is both sides.
        option: the option's name, for the error.

    Returns:
        Metres to the left, in the order of the text; of both sides left first.

    Raises:
        ConfigError: the text is no such list, has a distance twice, or one that is out of range.

    >>> parse_shifts("±3m", "--shift"), parse_shifts("-3,3", "--shift"), parse_shifts("1, 2.5", "--shift")
    ([3.0, -3.0], [-3.0, 3.0], [1.0, 2.5])
    """
    remedy = "Write metres with commas, such as 1,2 or -3,3, or ±3 for both sides."
    shifts: list[float] = []
    for part in text.split(","):
        found = _SHIFT.fullmatch(part.strip())
        if found is None:
            raise ConfigError(f"cannot read {option} {text!r}", remedy=remedy)
        size = check_number(float(found["size"]), option, 0, _MAX_SHIFT_M)
        sign = found["sign"] or "+"
        if sign in ("+", "-"):
            # Without a minus zero, which would be another path by its name.
            shifts.append(size if sign == "+" or not size else -size)
        else:
            shifts += [size, -size]
    if len(set(shifts)) != len(shifts):
        raise ConfigError(f"{option} {text!r} names a distance twice", remedy=remedy)
    return shifts
