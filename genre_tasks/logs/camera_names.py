"""Which names of cameras may stand in paths: the log of someone else may call a camera ``../../x``."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from genre_tasks.errors import InputError

_PLAIN_NAME = re.compile(r"[\w.=,+-]+", re.ASCII)
_OUT_OF_FOLDERS = frozenset("/\\\0")


def is_folder_name(name: str) -> bool:
    """Tells whether the name of a camera can be the name of a folder, which stays inside the folder above it.

    Args:
        name: of a camera.

    Returns:
        Whether it can.

    >>> is_folder_name("front camera"), is_folder_name("../x"), is_folder_name("..")
    (True, False, False)
    """
    # Dots alone are the folder itself or the one above it.
    return name.strip(".") != "" and not _OUT_OF_FOLDERS & set(name)


def is_plain_name(name: str) -> bool:
    """Tells whether the name of a camera has letters, digits and ``. = , + - _`` only, and more than dots.

    Args:
        name: of a camera.

    Returns:
        Whether it has.

    >>> is_plain_name("front_camera"), is_plain_name("front camera"), is_plain_name("..")
    (True, False, False)
    """
    return is_folder_name(name) and _PLAIN_NAME.fullmatch(name) is not None


def require_camera_names(
    names: Iterable[str], *, plain: bool = False, log: str | None = None, file: Path | None = None
) -> None:
    """Refuses names of cameras that would lead out of a folder.

    Args:
        names: of the cameras.
        plain: whether letters, digits and ``. = , + - _`` alone are allowed.
        log: URI of the log, for the error.
        file: that the names are from or that would be written, for the error.

    Raises:
        InputError: a name is none of a folder, or not plain where it must be.
    """
    is_fit = is_plain_name if plain else is_folder_name
    for name in names:
        if not is_fit(name):
            rule = r"only letters, digits and . = , + - _ are allowed" if plain else r"/ and \ are not allowed"
            remedy = f"Rename the camera in the log: {rule}, nor are dots alone."
            raise InputError(f"the camera's name {name!r} cannot be a folder's name", remedy=remedy, log=log, file=file)
