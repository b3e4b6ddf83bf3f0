"""Prefect's API in a thread of this process: it needs no port of its own, and is gone whenever the process is.

Prefect itself would start a second process. That one is reached through the proxy that the environment names, stays
behind after a kill, and takes three times as long to start.
"""

from __future__ import annotations

import asyncio
import errno
import fcntl
import os
import resource
import socket
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from genre_tasks.errors import GenreError, ResourceError

if TYPE_CHECKING:
    import uvicorn

_START_TIMEOUT_S = 120.0
_STOP_TIMEOUT_S = 5.0
# The server, its client and the event streams have about 30 open; a server that cannot accept waits forever.
_MIN_OPEN_FILES = 64
# What the file is to blame for; others, such as a full disk, are not cured by its removal.
_DAMAGED_CODES = (sqlite3.SQLITE_ERROR, sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
# NFS without a lock daemon, and some file systems of containers.
_WITHOUT_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP)
_DATABASE = "prefect.db"
DATABASE_VARIABLES = ("PREFECT_API_DATABASE_CONNECTION_URL", "PREFECT_SERVER_DATABASE_CONNECTION_URL")
"""Either names the database of a server, also of the one in this process."""


def find_stated_database() -> str | None:
    """Finds the variable by which the user names a database for Prefect.

    Returns:
        Its name; ``None`` where the database is the usual one.
    """
    return next((name for name in DATABASE_VARIABLES if os.environ.get(name)), None)


def database_url(folder: Path) -> str:
    """Writes the address of Prefect's SQLite database in a folder.

    Args:
        folder: an absolute path; any name is fine, also with ``?``, ``#`` or ``%2F`` in it.

    Returns:
        A URL for SQLAlchemy.

    >>> database_url(Path("/data/logs"))
    'sqlite+aiosqlite:///file%3A/data/logs/prefect.db?uri=true'
    """
    from sqlalchemy import URL

    # As a file URI, which SQLite decodes itself: a bare path would lose what follows a question mark.
    database = f"file:{quote(str(folder / _DATABASE))}"
    # SQLAlchemy writes what it will read: its versions differ in what they decode.
    url = URL.create("sqlite+aiosqlite", database=database, query={"uri": "true"})
    return url.render_as_string(hide_password=False)


class ServerThread:
    """Prefect's API server in a daemon thread.

    Args:
        folder: where its database is; it exists. Several processes may share it.

    Attributes:
        url: address of the API; requests wait until the server has started.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._stated_database = find_stated_database()
        # The system chooses a free port, so that two runs never meet. Requests queue from now on.
        self._socket = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._socket.getsockname()[1]}/api"
        self._ended_start = threading.Event()
        self._error: BaseException | None = None
        self._server: uvicorn.Server | None = None
        self._thread = threading.Thread(target=self._serve, name="prefect-api", daemon=True)

    def start(self) -> None:
        """Starts the server and waits until it answers.

        Raises:
            ResourceError: it cannot start; the message has its reason.
        """
        _ensure_open_files()
        self._thread.start()
        if not self._ended_start.wait(_START_TIMEOUT_S):
            raise self._start_error(f"it has not started within {_START_TIMEOUT_S:.0f} s")
        if self._error is not None:
            raise self._start_error(_last_line(self._error)) from self._error

    def stop(self) -> None:
        """Ends the server, once it has answered what it was asked; it never waits for long."""
        if self._server is not None:
            self._server.should_exit = True
        if self._thread.ident is not None:
            self._thread.join(_STOP_TIMEOUT_S)
        self._socket.close()

    def _serve(self) -> None:
        # Whatever ends the thread is for the one who waits in ``start``: a thread's own traceback helps nobody.
        try:
            asyncio.run(self._run())
        except BaseException as error:
            self._error = error
        finally:
            self._ended_start.set()

    async def _run(self) -> None:
        # Imported here, as it takes seconds, and only commands that compute something need it.
        import uvicorn
        from prefect.server.api.server import create_app

        app = create_app(ephemeral=True, final=True, ignore_cache=True)
        config = uvicorn.Config(app, log_config=None, log_level="critical", access_log=False, lifespan="off")
        server = uvicorn.Server(config)
        # Run here and not by uvicorn, which would log an error of the start and go on without it.
        lifespan = app.router.lifespan_context(app)
        with _alone_in(self._folder):
            await lifespan.__aenter__()
        self._server = server
        self._ended_start.set()
        try:
            await server.serve(sockets=[self._socket])
        finally:
            await lifespan.__aexit__(None, None, None)

    def _start_error(self, reason: str) -> GenreError:
        cause = _root_cause(self._error)
        if isinstance(cause, OSError) and cause.errno in _WITHOUT_LOCKS:
            problem = f"Prefect's local API cannot start: files of its folder cannot be locked ({reason})"
            remedy = "Set PREFECT_HOME or XDG_STATE_HOME to a local disk."
            return ResourceError(problem, remedy=remedy, file=self._folder)
        if self._stated_database is not None:
            remedy = f"Correct or unset {self._stated_database}, which names its database."
            return ResourceError(f"Prefect's local API cannot start: {reason}", remedy=remedy)
        database = self._folder / _DATABASE
        remedy = "Free disk space and memory there."
        is_damaged = isinstance(cause, sqlite3.Error) and cause.sqlite_errorcode & 0xFF in _DAMAGED_CODES
        if is_damaged or "revision" in reason:
            remedy = "Delete that file if it is damaged or of another version: it holds records of runs, no results."
        return ResourceError(f"Prefect's local API cannot start: {reason}", remedy=remedy, file=database)


def _ensure_open_files() -> None:
    """Raises the number of files that this process may have open where it is very low."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY or soft >= _MIN_OPEN_FILES:
        return
    if hard != resource.RLIM_INFINITY and hard < _MIN_OPEN_FILES:
        raise ResourceError(
            f"Prefect's local API cannot start: this process may have only {hard} files open",
            remedy=f"Allow {_MIN_OPEN_FILES} or more: ulimit -n 1024.",
        )
    resource.setrlimit(resource.RLIMIT_NOFILE, (_MIN_OPEN_FILES, hard))


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Keeps other processes out of the folder: two that bring one database up to date at a time spoil each other."""
    with (folder / "start.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _root_cause(error: BaseException | None) -> Any:
    while error is not None and (error.__cause__ or getattr(error, "orig", None)):
        error = error.__cause__ or getattr(error, "orig", None)
    return error


def _last_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    # SQLAlchemy explains an error in many lines, of which the first is the error itself.
    return lines[0] if lines else type(error).__name__
