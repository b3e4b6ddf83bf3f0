"""Numbers and times on the command line."""

from __future__ import annotations

import re

_UNITS = {"": 1.0, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}


def numbers(text: str | None, option: str) -> list[int] | None:
    """``0,1`` as whole numbers; ``None`` stays. Raises ``ConfigError`` that names the option."""
    if text is None:
        return None
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        from genre_tasks.errors import ConfigError

        raise ConfigError(f"cannot read {option} {text!r}", remedy="Write numbers with commas: 0,1.") from None


def seconds(text: str | None, option: str) -> float | None:
    """``90``, ``90s``, ``1.5m``, ``2h`` in seconds; ``None`` stays. Raises ``ConfigError`` that names the option."""
    if text is None:
        return None
    found = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([a-z]*)\s*", text)
    if found is None or found[2] not in _UNITS or float(found[1]) == 0:
        from genre_tasks.errors import ConfigError

        raise ConfigError(f"cannot read {option} {text!r}", remedy="Write a time above 0: 90s, 2m or 1h.")
    return float(found[1]) * _UNITS[found[2]]
