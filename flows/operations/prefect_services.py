"""Prefect's server, its background services and its workers as processes."""

from __future__ import annotations

import json
import os
import sys
import urllib.error
import urllib.request
from collections.abc import Mapping
from pathlib import Path

from flows.operations.service import HOST, Service, keep_port, keep_secret
from flows.prefect_api.server_thread import DATABASE_VARIABLES, database_url

HEARTBEAT_SECONDS = 30
_QUIET = {"DO_NOT_TRACK": "1", "PREFECT_SERVER_ANALYTICS_ENABLED": "false"}
LEASE_STORAGE = "prefect.server.concurrency.lease_storage.filesystem"
"""Where a server remembers who has slots of concurrency limits: files, as memory is lost with the process."""
EVENT_SETTINGS = {
    "PREFECT_SERVER_SERVICES_TASK_RUN_RECORDER_BATCH_SIZE": "100",
    "PREFECT_SERVER_SERVICES_TASK_RUN_RECORDER_FLUSH_INTERVAL": "1",
    "PREFECT_SERVER_SERVICES_EVENT_PERSISTER_BATCH_SIZE": "200",
    "PREFECT_SERVER_SERVICES_EVENT_PERSISTER_FLUSH_INTERVAL": "1",
}
"""How many events a server writes at once. By default it writes each state of a task in a transaction of its own, and
falls minutes behind with fifty workers."""
_LEVEL_VARIABLE = "PREFECT_SERVER_LOGGING_LEVEL"
_PREFECT = [sys.executable, "-m", "prefect"]


class PrefectServer(Service):
    """Prefect's API server on the loopback, with basic authentication.

    Args:
        folder: where log, port, secret and ``PREFECT_HOME`` are kept; a later server goes on with them.
        database_url: ``postgresql+asyncpg://…``; ``None``: SQLite in the folder.
        services: whether the background services run in this process. Without them a message broker is needed that
            both processes reach, since Prefect's default broker lives in the memory of one process.
        port: the TCP port; ``None``: the one of before, else a free one.
        authentication: whether clients must send a password.
        settings: further variables of the process.
    """

    def __init__(
        self,
        folder: Path,
        database_url: str | None = None,
        services: bool = True,
        port: int | None = None,
        authentication: bool = True,
        settings: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(folder, "server")
        self.database_url = database_url
        self.services = services
        self.wanted_port = port
        self.port = 0
        self.authentication = authentication
        self.settings = dict(settings or {})

    @property
    def url(self) -> str:
        """The address of the API."""
        return f"http://{HOST}:{self.port}/api"

    def prepare(self) -> None:
        """Chooses the port."""
        self.port = keep_port(self.folder / "port", self.wanted_port)

    def command(self) -> list[str]:
        """Returns the server's command line."""
        words = [*_PREFECT, "server", "start", "--host", HOST, "--port", str(self.port)]
        return words if self.services else [*words, "--no-services"]

    def environment(self) -> dict[str, str]:
        """Returns database, secret and home of the server."""
        variables = {**_QUIET, **EVENT_SETTINGS, "PREFECT_HOME": str(self.folder / "home"), "PREFECT_API_URL": self.url}
        # The database counts the slots: without their leases, a server that was killed would never take them back.
        variables["PREFECT_SERVER_CONCURRENCY_LEASE_STORAGE"] = LEASE_STORAGE
        if os.environ.get(_LEVEL_VARIABLE) == "CRITICAL":
            # The command silences the server of its own process; the log of a service must say why it ended.
            variables[_LEVEL_VARIABLE] = "WARNING"
        # By both names: the database that the user has named for another server would win by the other one.
        variables |= dict.fromkeys(DATABASE_VARIABLES, self.database_url or database_url(self.folder / "home"))
        if self.authentication:
            variables["PREFECT_SERVER_API_AUTH_STRING"] = self._auth_string()
        return {**variables, **self.env(), **self.settings}

    def env(self) -> dict[str, str]:
        """Returns address and password of the API."""
        variables = {"PREFECT_API_URL": self.url}
        if self.authentication:
            variables["PREFECT_API_AUTH_STRING"] = self._auth_string()
        return variables

    def _auth_string(self) -> str:
        return f"genre:{keep_secret(self.folder / 'password')}"

    def is_healthy(self) -> bool:
        """Whether the API answers that it is healthy."""
        return answers_health(self.url)


class PrefectServices(Service):
    """Prefect's background services as a process of their own, for a server started with ``services=False``.

    Args:
        folder: where the log is kept.
        server: the server, which must be started; its settings must name a message broker that both reach.
    """

    def __init__(self, folder: Path, server: PrefectServer) -> None:
        super().__init__(folder, "services")
        self.server = server

    def command(self) -> list[str]:
        """Returns the services' command line."""
        return [*_PREFECT, "server", "services", "start"]

    def environment(self) -> dict[str, str]:
        """Returns the same variables as the server's."""
        return self.server.environment()


class Worker(Service):
    """A process worker on a queue of a work pool.

    Args:
        folder: where log and ``PREFECT_HOME`` are kept.
        env: what the worker's runs need: the server's ``env()``, the store's credentials.
        pool: the work pool, of type process.
        queue: the work queue; ``None``: all of the pool's.
        limit: flow runs at once; ``None``: no bound.
        name: the worker's name and its log's.
        heartbeat_seconds: how often its runs say that they live, at least 30.
    """

    def __init__(
        self,
        folder: Path,
        env: Mapping[str, str],
        pool: str = "genre",
        queue: str | None = "default",
        limit: int | None = 1,
        name: str = "worker",
        heartbeat_seconds: int = HEARTBEAT_SECONDS,
    ) -> None:
        # A worker forwards SIGTERM to its runs and waits for them.
        super().__init__(folder, name, stop_seconds=30.0)
        self.client_env = dict(env)
        self.pool = pool
        self.queue = queue
        self.limit = limit
        self.heartbeat_seconds = heartbeat_seconds

    def command(self) -> list[str]:
        """Returns the worker's command line."""
        words = [*_PREFECT, "worker", "start", "--pool", self.pool, "--type", "process", "--name", self.name]
        if self.queue is not None:
            words += ["--work-queue", self.queue]
        if self.limit is not None:
            words += ["--limit", str(self.limit)]
        return words

    @property
    def home(self) -> Path:
        """The worker's ``PREFECT_HOME``, which its runs have as well."""
        return self.folder / f"{self.name}-home"

    def environment(self) -> dict[str, str]:
        """Returns the clients' variables, the heartbeat and quiet OpenMP threads."""
        return {
            **_QUIET,
            "PREFECT_HOME": str(self.home),
            "PREFECT_FLOWS_HEARTBEAT_FREQUENCY": str(self.heartbeat_seconds),
            "PREFECT_LOGGING_EXTRA_LOGGERS": "genre",
            "PREFECT_LOGGING_TO_API_ENABLED": "true",
            "PREFECT_LOGGING_LEVEL": "INFO",
            "OMP_WAIT_POLICY": "PASSIVE",
            # A worker of one run at a time asks for the next one only so often.
            "PREFECT_WORKER_QUERY_SECONDS": "2",
            **self.client_env,
            # Runs are started by the name python, which must be this interpreter.
            "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)]),
        }

    def env(self) -> dict[str, str]:
        """Returns what the worker itself was started with."""
        return dict(self.client_env)

    def prepare(self) -> None:
        """Notes where the log ends, since an earlier worker may have written it."""
        self._log_start = self.log.stat().st_size if self.log.exists() else 0

    def is_healthy(self) -> bool:
        """Whether the worker says in its log that it has started."""
        with self.log.open("rb") as log:
            log.seek(self._log_start)
            return b"started!" in log.read()


def answers_health(api_url: str) -> bool:
    """Whether a Prefect API answers its health check, which needs no password."""
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        with opener.open(f"{api_url}/health", timeout=3) as answer:
            return bool(json.load(answer))
    except urllib.error.HTTPError as error:
        # A server that asks for the password answers.
        return error.code == 401
    except (OSError, ValueError):
        return False
