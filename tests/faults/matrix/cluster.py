"""A deployment for the fault matrix: PostgreSQL, Prefect, a coordinator, two workers, and an S3 server if needed."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil
from prefect.client.orchestration import SyncPrefectClient, get_client
from prefect.client.schemas.actions import GlobalConcurrencyLimitCreate, GlobalConcurrencyLimitUpdate
from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterState, FlowRunFilterStateType
from prefect.client.schemas.objects import FlowRun, StateType
from prefect.settings import PREFECT_API_AUTH_STRING, PREFECT_API_URL, temporary_settings

from flows.dataset.supervisor import PENDING_VARIABLE, SILENT_VARIABLE
from flows.operations import ObjectServer, PostgresServer, PrefectServer, Worker
from flows.operations.deployments import COORDINATOR_QUEUE, RUN_QUEUE, deploy_flows
from tests.faults import small_run
from tests.faults.matrix import fault_hooks
from tests.faults.matrix.compute_log import Note, read_notes

POOL = "genre"
GPU_LIMIT = "gpu"
# Of two workers: runs that are killed do not hold up the others until their slots are taken back.
GPU_SLOTS = 8
WORKERS = 2
ATTEMPTS = 12
PENDING_S = 45
SILENT_S = 75
_ACTIVE = [StateType.SCHEDULED, StateType.PENDING, StateType.RUNNING, StateType.PAUSED, StateType.CANCELLING]


@dataclass
class Cluster:
    """The running services, and what the faults need of them.

    Attributes:
        folder: of everything; a user that runs PostgreSQL can enter it.
        postgres: the database.
        server: Prefect's server.
        coordinator: the worker of datasets.
        workers: those of logs, one log at a time each.
        faults: folder of the hooks.
        objects: the S3 server, once it was needed.
        commands: of all datasets.
        orphans: runs whose worker was killed alone.
        store_env: what processes need to reach the store.
    """

    folder: Path
    postgres: PostgresServer
    server: PrefectServer
    faults: Path
    coordinator: Worker
    workers: list[Worker]
    objects: ObjectServer | None = None
    commands: list[subprocess.Popen[bytes]] = field(default_factory=list)
    orphans: list[psutil.Process] = field(default_factory=list)
    store_env: dict[str, str] = field(default_factory=dict)

    @contextmanager
    def client(self) -> Iterator[SyncPrefectClient]:
        """Prefect's client of this server."""
        env = self.server.env()
        settings = {PREFECT_API_URL: env["PREFECT_API_URL"], PREFECT_API_AUTH_STRING: env["PREFECT_API_AUTH_STRING"]}
        with temporary_settings(settings), get_client(sync_client=True) as client:
            yield client

    def client_env(self, **more: str) -> dict[str, str]:
        """The environment of a command that talks to this server."""
        return small_run.environment(self.folder, **{**self.server.env(), **self.store_env, **more})

    def start_dataset(self, logs: Sequence[str], store: str, *more: str, **env: str) -> subprocess.Popen[bytes]:
        """Starts ``genre dataset LOGS --pool … --follow``; its output goes to files by the number of the command."""
        sets = [part for setting in small_run.SETTINGS for part in ("--set", setting)]
        words = [sys.executable, "-m", "flows.cli.main", "dataset", *logs, "--preset", "demo", *sets]
        words += ["--store", store, "--pool", POOL, "--follow", "--json"]
        words += ["--attempts", str(ATTEMPTS), "--gpu-limit", GPU_LIMIT, *more]
        number = len(self.commands)
        out = (self.folder / f"dataset-{number}.out").open("wb")
        err = (self.folder / f"dataset-{number}.err").open("wb")
        with out, err:
            command = subprocess.Popen(words, env=self.client_env(**env), cwd=self.folder, stdout=out, stderr=err)
        self.commands.append(command)
        return command

    def read_rows(self, command: subprocess.Popen[bytes]) -> list[dict[str, Any]]:
        """The rows of the table that a finished command has printed; none if it printed none."""
        out = self.folder / f"dataset-{self.commands.index(command)}.out"
        with suppress(ValueError):
            rows: list[dict[str, Any]] = json.loads(out.read_text())["logs"]
            return rows
        return []

    def read_error(self, command: subprocess.Popen[bytes]) -> str:
        """The end of what a command has printed as its errors."""
        return (self.folder / f"dataset-{self.commands.index(command)}.err").read_text(errors="replace")[-3000:]

    def is_dataset_running(self) -> bool:
        """Whether a command has not ended."""
        return any(command.poll() is None for command in self.commands)

    def read_fault(self, name: str) -> Note:
        """What the process that suffered an armed fault has noted."""
        while True:
            for note in read_notes(self.faults):
                if note.fault == name:
                    return note
            # Its file is renamed just before it is noted.
            time.sleep(0.01)

    def kill_worker(self, worker: Worker, children: bool) -> None:
        """Kills a worker; a child that lives on is ended with the cluster at the latest."""
        if not children:
            self.orphans += self.find_children(worker)
        worker.kill(children=children)

    def find_children(self, worker: Worker) -> list[psutil.Process]:
        """The processes of a worker's flow runs."""
        if worker.pid is None:
            return []
        with suppress(psutil.NoSuchProcess):
            return psutil.Process(worker.pid).children()
        return []

    def read_active_runs(self) -> list[FlowRun]:
        """Flow runs that have not ended."""
        wanted = FlowRunFilter(state=FlowRunFilterState(type=FlowRunFilterStateType(any_=_ACTIVE)))
        with self.client() as client:
            return client.read_flow_runs(flow_run_filter=wanted)

    def set_slots(self, slots: int) -> None:
        """Changes how many stages may use a GPU at a time."""
        with self.client() as client:
            client.update_global_concurrency_limit(GPU_LIMIT, GlobalConcurrencyLimitUpdate(limit=slots))

    def count_slots(self) -> int:
        """Slots that are taken of all global concurrency limits."""
        with self.client() as client:
            return sum(round(limit.active_slots) for limit in client.read_global_concurrency_limits())

    def start_objects(self) -> ObjectServer:
        """Starts the S3 server, once."""
        if self.objects is None:
            self.objects = ObjectServer(self.folder / "objects").start()
        return self.objects

    def restart_workers(self, **env: str) -> None:
        """Starts all workers again, with further variables of their environment."""
        services = [self.coordinator, *self.workers]
        for service in services:
            service.kill()
        more = {**self.store_env, **env}
        self.coordinator = make_coordinator(self.folder, self.server, more)
        self.workers = [make_worker(self.folder, self.server, self.faults, n, more) for n in range(WORKERS)]
        for service in [self.coordinator, *self.workers]:
            service.start()

    def kill_orphans(self) -> None:
        """Ends runs whose worker was killed alone, if there are any left."""
        for process in self.orphans:
            with suppress(psutil.Error):
                process.kill()
        self.orphans.clear()

    def stop_runs(self) -> None:
        """Ends what a failed fault has left, so that the next one starts from nothing."""
        for command in self.commands:
            if command.poll() is None:
                command.kill()
                command.wait()
        left = self.read_active_runs()
        self.kill_orphans()
        for armed in (self.faults / fault_hooks.ARMED).iterdir():
            armed.unlink()
        if not left:
            return
        with self.client() as client:
            for run in left:
                client.delete_flow_run(run.id)
        self.restart_workers()


def _worker_env(folder: Path, server: PrefectServer, more: Mapping[str, str]) -> dict[str, str]:
    return {
        **server.env(),
        "PYTHONPATH": f"{folder / 'site'}{os.pathsep}{small_run.ROOT}",
        "OMP_NUM_THREADS": "1",
        "PREFECT_WORKER_QUERY_SECONDS": "1",
        **more,
    }


def make_coordinator(folder: Path, server: PrefectServer, env: Mapping[str, str]) -> Worker:
    """The worker of datasets, with shorter times until a run counts as dead."""
    times = {PENDING_VARIABLE: str(PENDING_S), SILENT_VARIABLE: str(SILENT_S)}
    values = _worker_env(folder, server, {**times, **env})
    return Worker(folder / "workers", values, POOL, COORDINATOR_QUEUE, limit=None, name="coordinator")


def make_worker(folder: Path, server: PrefectServer, faults: Path, number: int, env: Mapping[str, str]) -> Worker:
    """A worker of logs, whose processes have the hooks."""
    values = _worker_env(folder, server, {fault_hooks.FOLDER_VARIABLE: str(faults), **env})
    return Worker(folder / "workers", values, POOL, RUN_QUEUE, limit=1, name=f"worker-{number}")


@contextmanager
def start_cluster(keep_folder: bool = False) -> Iterator[Cluster]:
    """Starts all services, and stops them at the end; their folder goes, too, unless it is to be read."""
    with ExitStack() as stack:
        # Not below pytest's folder, whose parents PostgreSQL's user may not enter.
        folder = Path(tempfile.mkdtemp(prefix="genre-faults-"))
        if not keep_folder:
            stack.callback(shutil.rmtree, folder, ignore_errors=True)
        folder.chmod(0o711)
        faults = folder / "faults"
        for name in (fault_hooks.ARMED, fault_hooks.TAKEN):
            (faults / name).mkdir(parents=True)
        (folder / "site").mkdir()
        (folder / "site/sitecustomize.py").write_text("import tests.faults.matrix.fault_hooks\n")
        postgres = stack.enter_context(PostgresServer(folder / "postgres"))
        server = PrefectServer(folder / "server", postgres.url)
        stack.enter_context(server)
        store = str(folder / "store")
        auth = server.env()["PREFECT_API_AUTH_STRING"]
        deploy_flows(server.url, auth, POOL, store, training_folder=folder / "training")
        coordinator = make_coordinator(folder, server, {})
        workers = [make_worker(folder, server, faults, number, {}) for number in range(WORKERS)]
        cluster = Cluster(folder, postgres, server, faults, coordinator, workers)
        with cluster.client() as client:
            limit = GlobalConcurrencyLimitCreate(name=GPU_LIMIT, limit=GPU_SLOTS)
            client.create_global_concurrency_limit(limit)
        stack.callback(_stop, cluster)
        for worker in (coordinator, *workers):
            worker.start()
        _wait_for_workers(cluster)
        yield cluster


def _wait_for_workers(cluster: Cluster) -> None:
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        with cluster.client() as client:
            found = client.read_workers_for_work_pool(POOL)
        if sum(str(worker.status.value) == "ONLINE" for worker in found if worker.status) == 1 + WORKERS:
            return
        time.sleep(0.5)
    raise AssertionError("not all workers are online")


def _stop(cluster: Cluster) -> None:
    for command in cluster.commands:
        if command.poll() is None:
            command.kill()
    for worker in (cluster.coordinator, *cluster.workers):
        worker.kill()
    cluster.kill_orphans()
    if cluster.objects is not None:
        cluster.objects.stop()
