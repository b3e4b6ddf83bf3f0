"""PostgreSQL from the system's packages, with its data in the state folder."""

from __future__ import annotations

import os
import pwd
import shutil
import signal
import subprocess
from pathlib import Path

from flows.operations.service import HOST, Service, keep_port, keep_secret
from genre_tasks.errors import ConfigError, ResourceError

_USER = "prefect"
_UNFINISHED_DATA = "data.part"
# Linux bounds the path of a socket; PostgreSQL adds `/.s.PGSQL.12345.lock`.
_SOCKET_PATH_MAX = 85


class PostgresServer(Service):
    """A PostgreSQL server on the loopback with password authentication (scram-sha-256).

    Args:
        folder: where data, log, port and password are kept; a later server goes on with them.
        port: the TCP port; ``None``: the one of before, else a free one.
        system_user: who runs it where this process is root, which PostgreSQL refuses.
    """

    def __init__(self, folder: Path, port: int | None = None, system_user: str = "postgres") -> None:
        super().__init__(folder, "postgres")
        self.data = self.folder / "data"
        self.sockets = self.folder / "socket"
        self.wanted_port = port
        self.port = 0
        self.system_user = system_user

    @property
    def password_file(self) -> Path:
        """The file of mode 600 with the password."""
        return self.folder / "password"

    @property
    def url(self) -> str:
        """The connection URL for Prefect; it holds the password."""
        password = keep_secret(self.password_file)
        return f"postgresql+asyncpg://{_USER}:{password}@{HOST}:{self.port}/postgres"

    @property
    def stop_signal(self) -> signal.Signals:
        """Fast shutdown: clients are disconnected, and nothing is lost."""
        return signal.SIGINT

    def env(self) -> dict[str, str]:
        """Returns the variable by which a Prefect server finds its database."""
        return {"PREFECT_API_DATABASE_CONNECTION_URL": self.url}

    def spawn_options(self) -> dict[str, object]:
        """Returns the user, where this process is root."""
        if os.geteuid() != 0:
            return {}
        account = self._account()
        return {"user": account.pw_uid, "group": account.pw_gid, "extra_groups": [], "cwd": "/"}

    def _account(self) -> pwd.struct_passwd:
        try:
            return pwd.getpwnam(self.system_user)
        except KeyError as error:
            raise ConfigError(
                f"PostgreSQL cannot run as root, and there is no user {self.system_user}",
                remedy="Install the package postgresql, or use --database sqlite.",
            ) from error

    def prepare(self) -> None:
        """Makes the database cluster where there is none."""
        initdb = find_postgres_program("initdb")
        options = self.spawn_options()
        self.port = keep_port(self.folder / "port", self.wanted_port)
        keep_secret(self.password_file)
        self.sockets.mkdir(mode=0o700, exist_ok=True)
        is_new = not (self.data / "PG_VERSION").exists()
        # Made elsewhere and renamed: an interrupted initdb leaves a folder that a later start would take for whole.
        data = self.folder / _UNFINISHED_DATA if is_new else self.data
        if is_new:
            shutil.rmtree(data, ignore_errors=True)
            data.mkdir(mode=0o700)
        if os.geteuid() == 0:
            account = self._account()
            for path in (self.folder, data, self.sockets, self.password_file):
                os.chown(path, account.pw_uid, account.pw_gid)
            self._check_reachable(data, options)
        if is_new:
            self._make_cluster(initdb, data, options)

    def _make_cluster(self, initdb: str, unfinished: Path, options: dict[str, object]) -> None:
        """Fills an empty folder with a database cluster, and gives it its name."""
        words = [initdb, "-D", str(unfinished), "-U", _USER, "--pwfile", str(self.password_file)]
        words += ["--auth=scram-sha-256", "--encoding=UTF8", "--locale=C"]
        made = subprocess.run(words, capture_output=True, text=True, check=False, **options)  # type: ignore[call-overload]
        if made.returncode:
            remedy = "Read the message, and run it again."
            raise ResourceError(f"initdb failed: {made.stderr.strip()}", remedy=remedy, file=unfinished)
        try:
            # Takes the place of an empty folder, and of no other.
            unfinished.rename(self.data)
        except OSError as error:
            problem = f"the new database cannot take its place ({error})"
            raise ResourceError(
                problem, remedy="Remove this folder, which holds no database.", file=self.data
            ) from error

    def _check_reachable(self, data: Path, options: dict[str, object]) -> None:
        found = subprocess.run(["test", "-r", str(data)], check=False, **options)  # type: ignore[call-overload]
        if found.returncode:
            raise ConfigError(
                f"the user {self.system_user}, who runs PostgreSQL where you are root, cannot enter the folder",
                remedy="Name another with --folder, or make its parents enterable with chmod o+x.",
                file=data,
            )

    def command(self) -> list[str]:
        """Returns the server's command line."""
        sockets = str(self.sockets) if len(str(self.sockets)) < _SOCKET_PATH_MAX else ""
        settings = {
            "listen_addresses": HOST,
            "port": str(self.port),
            "unix_socket_directories": sockets,
            "max_connections": "200",
        }
        words = [find_postgres_program("postgres"), "-D", str(self.data)]
        for name, value in settings.items():
            words += ["-c", f"{name}={value}"]
        return words

    def is_healthy(self) -> bool:
        """Whether the server accepts connections."""
        words = [find_postgres_program("pg_isready"), "-q", "-h", HOST, "-p", str(self.port)]
        return subprocess.run(words, check=False).returncode == 0


def find_postgres_program(name: str) -> str:
    """Returns the path of a program of PostgreSQL, from PATH or Debian's folders, the newest version first.

    Raises:
        ConfigError: PostgreSQL is not installed.
    """
    found = shutil.which(name)
    if found:
        return found
    folders = sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=_read_version, reverse=True)
    for folder in folders:
        if (folder / name).exists():
            return str(folder / name)
    raise ConfigError(
        f"PostgreSQL is not installed: no {name}",
        remedy="Install the package postgresql, or use --database sqlite.",
    )


def _read_version(programs: Path) -> tuple[int, ...]:
    """The numbers of a version that names the folder above, as 17 or 9.6; none where it is named otherwise."""
    parts = programs.parent.name.split(".")
    return tuple(int(part) for part in parts) if all(part.isdecimal() for part in parts) else ()
