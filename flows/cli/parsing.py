"""Numbers, times and paths on the command line."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Sequence
from pathlib import Path

# A bare number counts as seconds.
_SECONDS_PER_UNIT = {"": 1.0, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}
_BYTES_PER_UNIT = {"mb": 1e6, "gb": 1e9, "mib": 2.0**20, "gib": 2.0**30}


def parse_numbers(text: str | None, option: str) -> list[int] | None:
    """Reads whole numbers from 0 on that are separated by commas.

    Args:
        text: what the user wrote; ``None`` if the option was not given.
        option: the option's name, for the error.

    Returns:
        The numbers, or ``None`` for ``None``.

    Raises:
        ConfigError: the text is no such list, or has a number twice.

    >>> parse_numbers("0,2", "--chunks")
    [0, 2]
    """
    if text is None:
        return None
    from genre_tasks.errors import ConfigError

    remedy = "Write numbers from 0 on with commas: 0,1."
    # Not int() alone, which takes 1_0 and digits of other scripts too. Nine digits are more than anything has.
    if not re.fullmatch(r"\s*[0-9]{1,9}\s*(,\s*[0-9]{1,9}\s*)*", text):
        raise ConfigError(f"cannot read {option} {text!r}", remedy=remedy)
    numbers = [int(part) for part in text.split(",")]
    if len(set(numbers)) != len(numbers):
        raise ConfigError(f"{option} {text!r} names a number twice", remedy=remedy)
    return numbers


def check_number(value: float, option: str, low: float, high: float) -> float:
    """Checks a number that was read already: command lines take ``nan`` and ``inf`` for numbers.

    Args:
        value: the number.
        option: the option's name, for the error.
        low: the least that makes sense.
        high: the most that makes sense.

    Returns:
        The number.

    Raises:
        ConfigError: it is NaN or out of range.

    >>> check_number(3.0, "--shift", -100, 100)
    3.0
    """
    if not low <= value <= high or math.isnan(value):
        from genre_tasks.errors import ConfigError

        raise ConfigError(f"{option} {value:g} is out of range", remedy=f"Give a number from {low:g} to {high:g}.")
    return value


def check_words(words: Sequence[str]) -> None:
    r"""Checks that the words of a command line are text: Prefect and the records could not hold them otherwise.

    Args:
        words: the command line without the program's name.

    Raises:
        InputError: a word holds bytes that are no text in the encoding of this system's file names.

    >>> check_words(["check", "pandaset:/data/caf\udce9"])
    Traceback (most recent call last):
    genre_tasks.errors.InputError: 'pandaset:/data/caf\udce9' is no text in utf-8 ...
    """
    for word in words:
        # Python keeps such bytes as half characters, which only the system's own functions take.
        if any("\ud800" <= character <= "\udfff" for character in word):
            from genre_tasks.errors import InputError

            raise InputError(
                f"{word!r} is no text in {sys.getfilesystemencoding()}",
                remedy="Rename the folder or link to it by another name, or set PYTHONUTF8=1.",
            )


def parse_path(text: str | Path) -> Path:
    """Reads a path; ``~`` at its start is the home folder, also where the shell does not replace it.

    Args:
        text: what the user wrote, or an option's default.

    Returns:
        The path.

    Raises:
        ConfigError: the text is empty.
        InputError: there is no such user as in ``~NAME``.

    >>> parse_path("data/002")
    PosixPath('data/002')
    """
    from genre_tasks.errors import ConfigError
    from genre_tasks.user_paths import expand_user_path

    # An empty text would be the working folder, as an unset variable of a script's does not mean.
    if not str(text):
        raise ConfigError("a path is empty", remedy="Give a path, or leave the option out.")
    return expand_user_path(text)


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
    match = re.fullmatch(r"\s*([0-9]{1,9}(?:\.[0-9]+)?)\s*([a-z]*)\s*", text)
    # Zero is refused: a run without any time would choose the shortest setting, as a mistyped 0 would not mean.
    if match is None or match[2] not in _SECONDS_PER_UNIT or float(match[1]) == 0:
        from genre_tasks.errors import ConfigError

        raise ConfigError(f"cannot read {option} {text!r}", remedy="Write a time above 0: 90s, 2m or 1h.")
    return float(match[1]) * _SECONDS_PER_UNIT[match[2]]


def parse_memory(text: str | None, option: str) -> float | None:
    """Reads an amount of memory such as ``4GB``, ``3.5GiB`` or ``800MiB``.

    Args:
        text: what the user wrote; ``None`` if the option was not given.
        option: the option's name, for the error.

    Returns:
        GiB, or ``None`` for ``None``.

    Raises:
        ConfigError: the text is no amount above 0, or has no unit.

    >>> parse_memory("4GB", "--memory")
    3.725...
    """
    if text is None:
        return None
    match = re.fullmatch(r"\s*([0-9]{1,9}(?:\.[0-9]+)?)\s*([a-z]+)\s*", text.lower())
    # Without a unit 4096 could be meant for megabytes as well as 4 for gigabytes.
    if match is None or match[2] not in _BYTES_PER_UNIT or float(match[1]) == 0:
        from genre_tasks.errors import ConfigError

        raise ConfigError(f"cannot read {option} {text!r}", remedy="Write an amount with its unit: 4GB or 800MiB.")
    return float(match[1]) * _BYTES_PER_UNIT[match[2]] / 2**30
