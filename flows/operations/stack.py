"""All services of a deployment on one machine, started detached and found again by the state folder."""

from __future__ import annotations

import logging
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
from flows.operations.orphaned_runs import kill_runs
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
from genre_tasks.atomic_path import atomic_path, holds_files
from genre_tasks.errors import ConfigError, ResourceError
from genre_tasks.process_start import read_start_ticks

_log = logging.getLogger("genre")
_STOP_SECONDS = 40.0
_DATA_FOLDERS = ("postgres", "server", "store-server", "workers", "store")
_TRAINING_FOLDER = "training"


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
                server.url,
                env["PREFECT_API_AUTH_STRING"],
                self.pool,
                store,
                training_folder=self.folder / _TRAINING_FOLDER,
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
            if hasattr(service, "port"):
                # As it runs: the file that ``start`` would have read may be lost.
                service.port = found.port
            return
        service.start()
        try:
            write_records(self.folder, {**records, service.name: _make_record(service)})
        except BaseException:
            # Without a record it would run on: `down` would not find it, and the next start would find its port taken.
            service.stop()
            raise

    def _write_env(self, env: dict[str, str]) -> None:
        # Quoted for a shell: a state folder may have an apostrophe in its name.
        lines = [f"export {name}={shlex.quote(value)}\n" for name, value in env.items()]
        with atomic_path(self.folder / "env") as part:
            part.touch(mode=0o600)
            part.write_text("".join(lines))


def _make_record(service: Service) -> ServiceRecord:
    pid = service.pid
    ticks = None if pid is None else read_start_ticks(pid)
    if pid is None or ticks is None:
        raise service._start_error("ended after its start")
    # PostgreSQL's address holds its password, which belongs into its file of mode 600 alone.
    url = service.url if service.name != "postgres" else f"postgresql://127.0.0.1:{getattr(service, 'port', 0)}"
    since = datetime.now(UTC).isoformat(timespec="seconds")
    return ServiceRecord(service.name, pid, ticks, since, url, str(service.log))


def stop_stack(folder: Path, delete: bool = False) -> list[str]:
    """Stops all services of a state folder, workers first and databases last.

    Args:
        folder: the state folder.
        delete: whether data, logs and secrets are removed too. Trainings are hours of work, and stay.

    Returns:
        The names of those that ran, and whose runs went on without their worker.

    Raises:
        ResourceError: the services have ended, but not all data could be removed.
    """
    if not folder.is_dir():
        return []
    with locked(folder):
        records = read_records(folder)
        stopped = []
        for record in reversed(records.values()):
            was_alive = record.alive
            if was_alive:
                _stop(record)
                stopped.append(record.name)
            if kill_runs(Worker(folder / "workers", {}, name=record.name).home) and not was_alive:
                stopped.append(f"runs of {record.name}")
        (folder / "services.json").unlink(missing_ok=True)
        (folder / OPTIONS_FILE).unlink(missing_ok=True)
        (folder / "env").unlink(missing_ok=True)
        if delete:
            _remove_data(folder)
        return stopped


def _remove_data(folder: Path) -> None:
    trainings = folder / _TRAINING_FOLDER
    if holds_files(trainings):
        _log.warning("trainings are kept in %s: remove that folder if you do not need them", trainings)
    problems = []
    for path in (folder / name for name in _DATA_FOLDERS):
        # As much as can be removed. What stays says why, at the second time.
        shutil.rmtree(path, ignore_errors=True)
        try:
            shutil.rmtree(path)
        except FileNotFoundError:
            continue
        except OSError as error:
            problems.append(f"{path.name} ({error.strerror or error})")
    if problems:
        raise ResourceError(
            f"the services have ended, but data could not be removed: {', '.join(problems)}",
            remedy="Remove these folders by hand.",
            file=folder,
        )


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

    Raises:
        ConfigError: the file is cut or damaged, as after a full disk.
    """
    values = _parse_exports(file.read_text(errors="replace"))
    if values is None:
        remedy = "Run `genre ops up` again with the same options, which writes them again."
        raise ConfigError("the variables for clients are incomplete", remedy=remedy, file=file)
    return values


def _parse_exports(text: str) -> dict[str, str] | None:
    """The values by name; ``None`` where the text is cut."""
    try:
        # As a shell reads them: a value may be quoted, and have spaces.
        words = [word for word in shlex.split(text) if word != "export"]
        values = dict(word.split("=", 1) for word in words)
    except ValueError:
        return None
    # Half of a value would be taken for another one.
    return values if text.endswith("\n") else None
