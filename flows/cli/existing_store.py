"""The store of a command that only reads: a mistyped path must not look like an empty store."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from storage.store import Store


def open_existing_store(uri: str) -> Store:
    """Opens a store that must be there.

    Args:
        uri: a path, or ``file:///…``.

    Returns:
        The store.

    Raises:
        ConfigError: the URI has another scheme.
        InputError: there is no such folder.
    """
    from genre_tasks.errors import InputError
    from storage.opening import open_store

    opened = open_store(uri)
    if not opened.exists():
        remedy = "Give the folder of one by --store; `genre run` makes one."
        raise InputError("there is no store", remedy=remedy, file=opened.uri)
    return opened
