"""Numbers and times on the command line."""

from __future__ import annotations

import re

# A bare number counts as seconds.
_SECONDS_PER_UNIT = {"": 1.0, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}


def parse_numbers(text: str | None, option: str) -> list[int] | None:
    """Reads whole numbers that are separated by commas.

    Args:
        text: what the user wrote; ``None`` if the option was not given.
        option: the option's name, for the error.

    Returns:
        The numbers, or ``None`` for ``None``.

    Raises:
        ConfigError: the text is no such list.

    >>> parse_numbers("0,2", "--chunks")
    [0, 2]
    """
    if text is None:
        return None
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        from genre_tasks.errors import ConfigError

        raise ConfigError(f"cannot read {option} {text!r}", remedy="Write numbers with commas: 0,1.") from None


def parse_duration(text: str | None, option: str) -> float | None:
    """Reads a time such as ``90``, ``90s``, ``1.5m`` or ``2h``.

    Args:
        text: what the user wrote; ``None`` if the option was not given.
        option: the option's name, for the error.

    Returns:
        The time in seconds, or ``None`` for ``None``.

    Raises:
        ConfigError: the text is no time above 0.

    >>> parse_duration("1.5m", "--budget")
    90.0
    """
    if text is None:
        return None
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([a-z]*)\s*", text)
    # Zero is refused: a run without any time would choose the shortest setting, as a mistyped 0 would not mean.
    if match is None or match[2] not in _SECONDS_PER_UNIT or float(match[1]) == 0:
        from genre_tasks.errors import ConfigError

        raise ConfigError(f"cannot read {option} {text!r}", remedy="Write a time above 0: 90s, 2m or 1h.")
    return float(match[1]) * _SECONDS_PER_UNIT[match[2]]
