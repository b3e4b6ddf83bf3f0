"""Opens the store that a path or URI names."""

from __future__ import annotations

import re
from pathlib import Path
from urllib.parse import unquote, urlparse

from genre_tasks.errors import ConfigError
from genre_tasks.user_paths import expand_user_path
from storage.local import LocalStore
from storage.store import Store

_SCHEME = re.compile(r"[a-z][a-z0-9+.-]*://", re.IGNORECASE)


def is_remote(uri: str) -> bool:
    """Tells whether a store is reached over the network, without opening it.

    Args:
        uri: a path or URI.

    Returns:
        False for a path and for ``file://``.

    >>> is_remote("genre-store"), is_remote("s3://bucket/logs")
    (False, True)
    """
    return bool(_SCHEME.match(uri)) and not uri.lower().startswith("file://")


def make_address_absolute(uri: str) -> str:
    """Writes a store's path or URI so that it names the same store from every working folder.

    Args:
        uri: a path or URI.

    Returns:
        The path from the root, with ``~`` replaced; a URI as it is.

    Raises:
        InputError: ``~NAME`` names no user.

    >>> make_address_absolute("s3://bucket/logs"), make_address_absolute("/data/store")
    ('s3://bucket/logs', '/data/store')
    """
    return uri if _SCHEME.match(uri) else str(expand_user_path(uri).absolute())


def open_store(uri: str) -> Store:
    """Opens the store at a path or URI.

    Args:
        uri: a path, ``file:///…``, ``s3://bucket/path``, ``gs://bucket/path`` or ``az://container/path``. Credentials
            come from the environment.

    Returns:
        The store; it need not exist yet.

    Raises:
        ConfigError: the URI has another scheme, or holds credentials.

    >>> print(open_store("file:///data/a%20store").uri)
    /data/a store
    """
    if not is_remote(uri):
        return open_local_store(uri)
    # Only here: the package of its client is not needed for folders.
    from storage.objects.object_store import ObjectStore

    return ObjectStore(uri)


def open_local_store(uri: str) -> LocalStore:
    """Opens a store that must be a folder of this machine.

    Args:
        uri: a path, or ``file:///…``.

    Returns:
        The store; its folder need not exist yet.

    Raises:
        ConfigError: the URI has another scheme.

    >>> print(open_local_store("file:///data/a%20store").root)
    /data/a store
    """
    parsed = urlparse(uri)
    if parsed.scheme == "" and uri:
        return LocalStore(Path(uri))
    if parsed.scheme == "file" and parsed.netloc in ("", "localhost") and parsed.path:
        return LocalStore(Path(unquote(parsed.path)))
    raise ConfigError(f"The store {uri!r} is of no known kind", remedy="Give a folder: a path, or file:///path.")
