"""All services of a deployment on one machine, started detached and found again by the state folder."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from flows.operations.deployments import COORDINATOR_QUEUE, RUN_QUEUE, deploy_flows
from flows.operations.object_server import ObjectServer
from flows.operations.postgres_server import PostgresServer
from flows.operations.prefect_services import HEARTBEAT_SECONDS, PrefectServer, Worker
from flows.operations.service import Service, kill_group, kill_tree
from flows.operations.state_file import (
    OPTIONS_FILE,
    ServiceRecord,
    keep_options,
    locked,
    read_records,
    write_records,
)
from genre_tasks.errors import ConfigError
from genre_tasks.process_start import read_start_ticks

_STOP_SECONDS = 40.0
_DATA_FOLDERS = ("postgres", "server", "store-server", "workers", "store")


@dataclass(frozen=True)
class Stack:
    """The services that one state folder holds.

    Args:
        folder: the state folder.
        workers: how many workers take logs.
        pool: the work pool.
        store_server: whether an S3 server runs; otherwise the store is a folder of the state folder.
        database: ``postgres`` or ``sqlite``.
    """

    folder: Path
    workers: int = 2
    pool: str = "genre"
    store_server: bool = True
    database: str = "postgres"

    def start(self) -> list[ServiceRecord]:
        """Starts what does not run, then deploys the flows; a second call starts no more than further workers.

        Returns:
            The records of the services, in the order of their start.

        Raises:
            ConfigError: a program is missing, a port is taken, the folder cannot be written, or services run that
                were started with another pool, store or database.
            ResourceError: a service did not become healthy.
        """
        if self.database not in ("postgres", "sqlite"):
            raise ConfigError(f"unknown database {self.database}", remedy="Use postgres or sqlite.")
        with locked(self.folder):
            # Deployments would move to the new options, and the workers that live would stay with the old ones.
            store_option = "--store-server" if self.store_server else "--no-store-server"
            options = {"pool": f"--pool {self.pool}", "store": store_option, "database": f"--database {self.database}"}
            keep_options(self.folder, options)
            env: dict[str, str] = {}
            store = str(self.folder / "store")
            if self.store_server:
                objects = ObjectServer(self.folder / "store-server")
                self._ensure(objects)
                env.update(objects.env())
                store = objects.store
            database_url = None
            if self.database == "postgres":
                postgres = PostgresServer(self.folder / "postgres")
                self._ensure(postgres)
                database_url = postgres.url
            server = PrefectServer(self.folder / "server", database_url)
            self._ensure(server)
            env.update(server.env())
            deploy_flows(
                server.url, env["PREFECT_API_AUTH_STRING"], self.pool, store, training_folder=self.folder / "training"
            )
            # A run with slower heartbeats than the automation expects would be marked as crashed while it lives.
            heartbeat = {"PREFECT_FLOWS_HEARTBEAT_FREQUENCY": str(HEARTBEAT_SECONDS)}
            # Before the workers: where one of them does not start, the others and the server are there for clients.
            self._write_env({**env, **heartbeat, "GENRE_STORE": store})
            for worker in self._workers(env):
                self._ensure(worker)
            return list(read_records(self.folder).values())

    def _workers(self, env: dict[str, str]) -> Iterator[Worker]:
        folder = self.folder / "workers"
        yield Worker(folder, env, self.pool, COORDINATOR_QUEUE, limit=None, name="coordinator")
        for number in range(self.workers):
            yield Worker(folder, env, self.pool, RUN_QUEUE, limit=1, name=f"worker-{number}")

    def _ensure(self, service: Service) -> None:
        records = read_records(self.folder)
        found = records.get(service.name)
        if found is not None and found.alive:
            # The running service's port, which ``start`` would have read.
            if hasattr(service, "port"):
                service.port = int((service.folder / "port").read_text())
            return
        service.start()
        pid = service.pid
        ticks = None if pid is None else read_start_ticks(pid)
        if pid is None or ticks is None:
            raise service._start_error("ended after its start")
        # PostgreSQL's address holds its password, which belongs into its file of mode 600 alone.
        url = service.url if service.name != "postgres" else f"postgresql://127.0.0.1:{getattr(service, 'port', 0)}"
        since = datetime.now(UTC).isoformat(timespec="seconds")
        record = ServiceRecord(service.name, pid, ticks, since, url, str(service.log))
        write_records(self.folder, {**records, service.name: record})

    def _write_env(self, env: dict[str, str]) -> None:
        file = self.folder / "env"
        handle = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        with os.fdopen(handle, "w") as stream:
            # Quoted for a shell: a state folder may have an apostrophe in its name.
            stream.writelines(f"export {name}={shlex.quote(value)}\n" for name, value in env.items())


def stop_stack(folder: Path, delete: bool = False) -> list[str]:
    """Stops all services of a state folder, workers first and databases last.

    Args:
        folder: the state folder.
        delete: whether data, logs and secrets are removed too.

    Returns:
        The names of those that ran.
    """
    if not folder.is_dir():
        return []
    with locked(folder):
        records = read_records(folder)
        stopped = []
        for record in reversed(records.values()):
            if record.alive:
                _stop(record)
                stopped.append(record.name)
        (folder / "services.json").unlink(missing_ok=True)
        (folder / OPTIONS_FILE).unlink(missing_ok=True)
        (folder / "env").unlink(missing_ok=True)
        if delete:
            for name in _DATA_FOLDERS:
                shutil.rmtree(folder / name, ignore_errors=True)
        return stopped


def _stop(record: ServiceRecord) -> None:
    with suppress(ProcessLookupError):
        os.kill(record.pid, signal.SIGINT if record.name == "postgres" else signal.SIGTERM)
    deadline = time.monotonic() + _STOP_SECONDS
    while record.alive and time.monotonic() < deadline:
        time.sleep(0.1)
    if record.alive:
        kill_tree(record.pid)
    else:
        kill_group(record.pid)


def describe_services(folder: Path) -> list[dict[str, Any]]:
    """Returns a row for each recorded service: name, pid, state, url, since, log."""
    rows = []
    for record in read_records(folder).values():
        row = asdict(record)
        del row["start_ticks"]
        rows.append({"service": row.pop("name"), "state": "running" if record.alive else "dead", **row})
    return rows


def read_client_environment(file: Path) -> dict[str, str]:
    """Reads the variables that clients of the services need, passwords included.

    Args:
        file: ``env`` of the state folder, lines for a shell.

    Returns:
        The values by name.
    """
    # As a shell reads them: a value may be quoted, and have spaces.
    words = [word for word in shlex.split(file.read_text()) if word != "export"]
    return dict(word.split("=", 1) for word in words)
