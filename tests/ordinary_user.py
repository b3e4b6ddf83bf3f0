"""A folder of a user whom permissions bind, for tests that may run as root."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

NOBODY = 65534


@contextmanager
def as_ordinary_user(source: Path | None = None) -> Iterator[Path]:
    """Runs a block as a user whom permissions bind: as who runs the tests, or as nobody where that is root.

    What the block calls should have run before: nobody may not import modules from the home folder of root.

    Args:
        source: a folder that the user gets a copy of.

    Yields:
        A new folder of the user, or the copy.
    """
    # Not among pytest's folders, which another user may not enter.
    home = Path(tempfile.mkdtemp(prefix="genre-user-"))
    is_root = os.geteuid() == 0
    folder = home
    try:
        if source is not None:
            folder = Path(shutil.copytree(source, home / source.name))
        if is_root:
            _become_nobody(home)
        yield folder
    finally:
        if is_root:
            os.setresuid(0, 0, 0)
        # Tests close folders and leave them so.
        subprocess.run(["chmod", "-R", "u+rwX", home], check=True)
        shutil.rmtree(home)


def _become_nobody(home: Path) -> None:
    try:
        for path in (home, *home.rglob("*")):
            os.chown(path, NOBODY, NOBODY)
        # The real user counts for os.access; the saved one is the way back.
        os.setresuid(NOBODY, NOBODY, 0)
    except OSError as error:
        pytest.skip(f"root may not become another user here: {error}")
    if not os.access(home, os.W_OK | os.X_OK):
        pytest.skip("another user may not enter the folder of temporary files")
