"""One process of a deployment: started in its session, watched, and ended with its children."""

from __future__ import annotations

import os
import secrets
import signal
import socket
import subprocess
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

from flows.operations.file_lock import lock_file
from genre_tasks.atomic_path import atomic_path, write_atomically
from genre_tasks.errors import ConfigError, ResourceError

HOST = "127.0.0.1"
_LOG_LINES = 15
_POLL_SECONDS = 0.2
_MAX_PORT = 65_535


class Service:
    """Base of the services: a context manager around one process that leads a session.

    Args:
        folder: where the service keeps its log and its data; made where it is missing.
        name: the service's name, also of its log file.
        start_seconds: how long ``start`` waits until the service is healthy.
        stop_seconds: how long ``stop`` waits before it kills.
    """

    def __init__(self, folder: Path, name: str, start_seconds: float = 90.0, stop_seconds: float = 20.0) -> None:
        self.folder = Path(folder).absolute()
        self.name = name
        self.log = self.folder / f"{name}.log"
        self.start_seconds = start_seconds
        self.stop_seconds = stop_seconds
        self.process: subprocess.Popen[bytes] | None = None

    @property
    def pid(self) -> int | None:
        """The process's id, ``None`` where this object has started none."""
        return None if self.process is None else self.process.pid

    @property
    def url(self) -> str:
        """Where clients reach the service; empty where it listens nowhere."""
        return ""

    def command(self) -> list[str]:
        """Returns the command line, without credentials."""
        raise NotImplementedError

    def environment(self) -> dict[str, str]:
        """Returns the variables that the process gets in addition to this process's."""
        return {}

    def env(self) -> dict[str, str]:
        """Returns the variables that clients of the service need; they may hold credentials."""
        return {}

    def prepare(self) -> None:
        """Makes what must exist before the process starts."""

    def is_healthy(self) -> bool:
        """Whether the service answers."""
        return self.is_alive()

    def finish_start(self) -> None:
        """Does what needs the healthy service, such as making a bucket."""

    def spawn_options(self) -> dict[str, object]:
        """Returns further arguments of ``subprocess.Popen``, such as the user."""
        return {}

    def start(self) -> Self:
        """Starts the process and waits until it is healthy.

        Returns:
            The service itself.

        Raises:
            ConfigError: the folder cannot be written or a program is missing.
            ResourceError: the process ended or did not become healthy; the message has the log's last lines.
        """
        if self.is_alive():
            return self
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self.prepare()
            with self.log.open("ab") as log:
                self.process = subprocess.Popen(
                    self.command(),
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    env={**os.environ, **self.environment()},
                    # A session of its own: signals reach the children too, and a closed terminal does not.
                    start_new_session=True,
                    **self.spawn_options(),  # type: ignore[call-overload]
                )
        except PermissionError as error:
            raise ConfigError(
                f"the state folder cannot be written: {error}",
                remedy="Name another with --folder.",
                file=self.folder,
            ) from error
        try:
            self._wait_until_healthy()
            self.finish_start()
        except BaseException:
            self.kill()
            raise
        return self

    def _wait_until_healthy(self) -> None:
        deadline = time.monotonic() + self.start_seconds
        while time.monotonic() < deadline:
            if not self.is_alive():
                raise self._start_error("ended at its start")
            if self.is_healthy():
                return
            time.sleep(_POLL_SECONDS)
        raise self._start_error(f"is not healthy after {self.start_seconds:.0f} s")

    def _start_error(self, problem: str) -> ResourceError:
        lines = self.log.read_text(errors="replace").splitlines()[-_LOG_LINES:]
        return ResourceError(
            f"{self.name} {problem}; its log ends with:\n" + "\n".join(lines) + "\n",
            remedy="Read the log.",
            file=self.log,
        )

    def is_alive(self) -> bool:
        """Whether the process that this object started runs."""
        return self.process is not None and self.process.poll() is None

    def stop(self) -> None:
        """Ends the process gently; after ``stop_seconds`` it is killed with its children."""
        if self.process is not None and self.process.poll() is None:
            with suppress(ProcessLookupError):
                self.process.send_signal(self.stop_signal)
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(self.stop_seconds)
        self.kill()

    @property
    def stop_signal(self) -> signal.Signals:
        """The signal that asks the process to end."""
        return signal.SIGTERM

    def kill(self, children: bool = True) -> None:
        """Kills the process at once (SIGKILL).

        Args:
            children: whether its children are killed too, as when the machine fails.
        """
        if self.process is None:
            return
        is_alive = self.process.poll() is None
        if is_alive and children:
            kill_tree(self.process.pid)
        elif is_alive:
            self.process.kill()
        elif children:
            kill_group(self.process.pid)
        self.process.wait()

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()


def kill_tree(pid: int) -> None:
    """Kills a running process that leads a session, its group, and its descendants in sessions of their own (SIGKILL).

    Args:
        pid: the process. The caller makes sure that it runs, as its number may be another's later.
    """
    import psutil

    descendants: list[psutil.Process] = []
    with suppress(psutil.Error):
        leader = psutil.Process(pid)
        # Stopped first, so that it starts no more. A worker of Prefect starts every run in a session of its own.
        leader.suspend()
        descendants = leader.children(recursive=True)
    kill_group(pid)
    for process in descendants:
        with suppress(psutil.Error):
            process.kill()


def kill_group(pid: int) -> None:
    """Kills what is left of the group of a process that leads a session (SIGKILL).

    Args:
        pid: the process, which may have ended.
    """
    with suppress(ProcessLookupError, PermissionError):
        # The group outlives its leader while a child lives, and its number is not reused until then.
        os.killpg(pid, signal.SIGKILL)


def find_free_port() -> int:
    """Returns a TCP port of the loopback that nothing listens at now."""
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


def is_listening(port: int) -> bool:
    """Whether something accepts connections at a port of the loopback."""
    with socket.socket() as probe:
        probe.settimeout(1.0)
        return probe.connect_ex((HOST, port)) == 0


def keep_port(file: Path, wanted: int | None = None) -> int:
    """Returns the port that a file remembers, so that a service starts again where its clients expect it.

    Args:
        file: the file of the port; written where it is missing, or holds no port.
        wanted: the port to use and to remember instead.

    Returns:
        The port.

    Raises:
        ConfigError: another process listens at it.
    """
    known = _read_port(file)
    port = wanted if wanted is not None else known or find_free_port()
    if is_listening(port):
        raise ConfigError(f"port {port} is taken", remedy="End the process that listens there.", file=file)
    # Only where it changes: a full disk must not cost the port of before.
    if port != known:
        write_atomically(file, f"{port}\n".encode())
    return port


def _read_port(file: Path) -> int | None:
    """The port in a file; ``None`` where there is no file, or no port in it, as after a full disk."""
    try:
        port = int(file.read_text())
    except (FileNotFoundError, ValueError):
        return None
    return port if is_port(port) else None


def is_port(value: object) -> bool:
    """Whether a value of a file is the number of a TCP port.

    >>> is_port(4200), is_port(0), is_port(70_000), is_port("4200"), is_port(True)
    (True, False, False, False, False)
    """
    # A bool is an int of Python.
    return type(value) is int and 0 < value <= _MAX_PORT


def keep_secret(file: Path) -> str:
    """Returns the secret in a file of mode 600; a random one is made where the file is missing or empty.

    Args:
        file: the file; its folder is made where it is missing.

    Returns:
        The secret; the same in all processes that ask at once.

    Raises:
        ConfigError: the file is missing, and its folder has no locks.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    secret = ""
    while not secret:
        secret = _read_secret(file) or _make_secret(file)
    return secret


def _read_secret(file: Path) -> str:
    try:
        return file.read_text().strip()
    except FileNotFoundError:
        return ""


def _make_secret(file: Path) -> str:
    """Makes a secret, or waits for another process that makes it; empty where that one has replaced the file."""
    handle = os.open(file, os.O_RDWR | os.O_CREAT, 0o600)
    with os.fdopen(handle, "r+") as lock:
        # The empty file is the lock: the one who gets it first puts a complete file in its place.
        lock_file(lock, file)
        secret = lock.read().strip()
        if secret or not _is_still_there(file, handle):
            return secret
        secret = secrets.token_hex(24)
        with atomic_path(file) as part:
            part_handle = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            with os.fdopen(part_handle, "w") as stream:
                stream.write(secret)
                stream.flush()
                # A rename can reach the disk before the secret does.
                os.fsync(part_handle)
        return secret


def _is_still_there(file: Path, handle: int) -> bool:
    """Whether a path leads to an open file, and not to one that has taken its place."""
    try:
        return os.path.samestat(file.stat(), os.fstat(handle))
    except FileNotFoundError:
        return False


def merge_environments(*services: Service) -> Mapping[str, str]:
    """Returns what clients of several services need."""
    merged: dict[str, str] = {}
    for service in services:
        merged.update(service.env())
    return merged
