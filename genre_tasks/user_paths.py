"""Paths as users write them."""

from __future__ import annotations

from pathlib import Path

from genre_tasks.errors import InputError


def expand_user_path(text: str | Path) -> Path:
    """Replaces ``~`` and ``~NAME`` at the start of a path by a home folder, as a shell does where it sees them.

    A shell does not see them within a word, such as in ``pandaset:~/logs/002`` or ``--out=~/film.mp4``.

    Args:
        text: the path.

    Returns:
        The path, as it is where no ``~`` stands at its start.

    Raises:
        InputError: there is no user of that name, or nothing says where the home folder is.

    >>> expand_user_path("data/002")
    PosixPath('data/002')
    >>> print(expand_user_path("~nobody-of-this-name/002"))
    Traceback (most recent call last):
    genre_tasks.errors.InputError: there is no home folder of this user ...
    """
    try:
        return Path(text).expanduser()
    except RuntimeError as error:
        raise InputError(
            "there is no home folder of this user", remedy="Write the path without `~`.", file=str(text)
        ) from error
