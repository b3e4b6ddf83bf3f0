"""The folder of what this machine can make or fetch again."""

from __future__ import annotations

import os
import tempfile
from contextlib import suppress
from pathlib import Path

from genre_tasks.errors import ConfigError
from genre_tasks.user_paths import expand_user_path

FOLDER_VARIABLE = "GENRE_CACHE_DIR"
"""The environment variable for the folder."""


def find_cache_folder() -> Path:
    """Finds the folder of all caches of this user.

    Returns:
        ``$GENRE_CACHE_DIR``, or ``genre`` in the user's folder of caches, or among the temporary files where this
        user has none.

    Raises:
        ConfigError: the folder among the temporary files belongs to another user.
        InputError: ``$GENRE_CACHE_DIR`` begins with a ``~`` that stands for no home folder.
    """
    stated = os.environ.get(FOLDER_VARIABLE)
    if stated:
        return expand_user_path(stated).absolute()
    base = os.environ.get("XDG_CACHE_HOME", "")
    with suppress(RuntimeError):
        folder = (Path(base) if os.path.isabs(base) else Path.home() / ".cache") / "genre"  # noqa: PTH117
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK | os.X_OK):
            return folder
    folder = Path(tempfile.gettempdir()).absolute() / f"genre-cache-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    # Everybody may write there: another user could have put files into it that would be read as artifacts.
    if folder.is_symlink() or folder.stat().st_uid != os.getuid():
        raise ConfigError(f"{folder} belongs to another user", remedy=f"Set {FOLDER_VARIABLE} to a folder of yours.")
    return folder
