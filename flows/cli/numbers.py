"""Lists of numbers on the command line."""

from __future__ import annotations


def numbers(text: str | None, option: str) -> list[int] | None:
    """``0,1`` as whole numbers; ``None`` stays. Raises ``ConfigError`` that names the option."""
    if text is None:
        return None
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        from genre_tasks.errors import ConfigError

        raise ConfigError(f"cannot read {option} {text!r}", remedy="Write numbers with commas: 0,1.") from None
