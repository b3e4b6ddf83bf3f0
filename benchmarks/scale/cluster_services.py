"""The real servers of the simulated cluster, and the processes of its workers."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.scale.simulated_worker import WorkersPlan
from benchmarks.scale.summary import POLL_S
from flows.operations import ObjectServer, PostgresServer, PrefectServer
from flows.operations.deployments import RUN_QUEUE, deploy_flows
from genre_tasks.errors import ResourceError

POOL = "genre"
_WORKERS_PER_PROCESS = 50
_ONLINE_S = 120.0
_STOP_S = 60.0


@dataclass
class ClusterServices:
    """The running servers.

    Attributes:
        folder: of everything.
        postgres: the database.
        server: Prefect's server with its services.
        objects: the S3 server.
        processes: of the workers.
        results: files that those processes write at their end.
    """

    folder: Path
    postgres: PostgresServer
    server: PrefectServer
    objects: ObjectServer
    processes: list[subprocess.Popen[bytes]] = field(default_factory=list)
    results: list[Path] = field(default_factory=list)

    def env(self) -> dict[str, str]:
        """Returns what clients need to reach the servers.

        Returns:
            Variables of the environment.
        """
        quiet = {"DO_NOT_TRACK": "1", "PREFECT_LOGGING_LEVEL": "INFO", "PREFECT_LOGGING_TO_API_ENABLED": "true"}
        places = {"PREFECT_HOME": str(self.folder / "client-home"), "GENRE_CACHE_DIR": str(self.folder / "cache")}
        return {**quiet, **places, **self.server.env(), **self.objects.env()}

    def pids(self) -> dict[str, list[int]]:
        """Returns the first processes of what is measured.

        Returns:
            Process ids by the service's name; ``workers-N`` are those of workers, ``parent`` is this process.
        """
        servers = {"prefect": self.server.pid, "postgres": self.postgres.pid, "objects": self.objects.pid}
        found = {name: [] if pid is None else [pid] for name, pid in servers.items()}
        workers = {f"workers-{number}": [process.pid] for number, process in enumerate(self.processes)}
        return {**found, **workers, "parent": [os.getpid()]}

    def start_workers(self, workers: int, seed: int, scale: float, seconds: Mapping[str, float]) -> None:
        """Starts the processes of workers and waits until all workers are online.

        Args:
            workers: how many.
            seed: of the artifacts' keys.
            scale: by what the seconds of stages are multiplied.
            seconds: of the stages.

        Raises:
            ResourceError: a process ended, or not all workers are online in time.
        """
        names = [f"worker-{number}" for number in range(workers)]
        env = {**os.environ, **self.env(), "PREFECT_WORKER_QUERY_SECONDS": str(POLL_S)}
        for number, start in enumerate(range(0, workers, _WORKERS_PER_PROCESS)):
            result = self.folder / f"workers-{number}.result.json"
            some = names[start : start + _WORKERS_PER_PROCESS]
            plan = WorkersPlan(
                names=some,
                pool=POOL,
                queue=RUN_QUEUE,
                store=self.objects.store,
                seed=seed,
                scale=scale,
                seconds=dict(seconds),
                poll_s=POLL_S,
                stop_file=str(self.folder / "stop"),
                result_file=str(result),
            )
            plan_file = self.folder / f"workers-{number}.json"
            plan_file.write_text(json.dumps(asdict(plan)))
            with (self.folder / f"workers-{number}.log").open("wb") as log:
                words = [sys.executable, "-m", "benchmarks.scale.simulated_worker", str(plan_file)]
                self.processes.append(subprocess.Popen(words, env=env, stdout=log, stderr=subprocess.STDOUT))
            self.results.append(result)
        self._wait_until_online(workers)

    def _wait_until_online(self, workers: int) -> None:
        from prefect.client.orchestration import get_client

        deadline = time.monotonic() + _ONLINE_S
        while time.monotonic() < deadline:
            with get_client(sync_client=True) as client:
                found = client.read_workers_for_work_pool(POOL, limit=200)
            if sum(worker.status is not None and worker.status.value == "ONLINE" for worker in found) >= workers:
                return
            self._check_processes()
            time.sleep(1.0)
        raise ResourceError(f"not all {workers} workers are online", remedy="Read the log.", file=self.folder)

    def _check_processes(self) -> None:
        for number, process in enumerate(self.processes):
            if process.poll() is not None:
                log = self.folder / f"workers-{number}.log"
                end = log.read_text(errors="replace")[-2000:]
                raise ResourceError(f"a process of workers ended: {end}", remedy="Read the log.", file=log)

    def stop_workers(self) -> list[dict[str, Any]]:
        """Ends the workers.

        Returns:
            What each process of workers did.
        """
        (self.folder / "stop").touch()
        found = []
        for process, result in zip(self.processes, self.results, strict=True):
            process.wait(_STOP_S)
            found.append(json.loads(result.read_text(encoding="utf-8")))
        return found

    def kill_workers(self) -> None:
        """Ends what an error has left."""
        for process in self.processes:
            if process.poll() is None:
                process.kill()
                process.wait()


@contextmanager
def start_services(keep_folder: Path | None = None) -> Iterator[ClusterServices]:
    """Starts PostgreSQL, Prefect's server, and an S3 server, with GenRe's deployments; all of them stop at the end.

    Args:
        keep_folder: where the servers' logs are copied to.

    Yields:
        The servers.
    """
    from prefect.settings import PREFECT_API_AUTH_STRING, PREFECT_API_URL, temporary_settings

    with ExitStack() as stack:
        # PostgreSQL's user must be able to enter it.
        folder = Path(tempfile.mkdtemp(prefix="genre-cluster-"))
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        folder.chmod(0o711)
        postgres = stack.enter_context(PostgresServer(folder / "postgres"))
        objects = stack.enter_context(ObjectServer(folder / "objects"))
        server = PrefectServer(folder / "server", postgres.url)
        stack.enter_context(server)
        services = ClusterServices(folder, postgres, server, objects)
        if keep_folder is not None:
            stack.callback(_copy_logs, folder, keep_folder)
        stack.callback(services.kill_workers)
        auth = server.env()["PREFECT_API_AUTH_STRING"]
        deploy_flows(server.url, auth, POOL, objects.store, training_folder=folder / "training")
        stack.enter_context(temporary_settings({PREFECT_API_URL: server.url, PREFECT_API_AUTH_STRING: auth}))
        yield services


def _copy_logs(folder: Path, target: Path) -> None:
    target.mkdir(parents=True, exist_ok=True)
    for log in [*folder.glob("*.log"), *folder.glob("*/*.log")]:
        shutil.copy(log, target / log.name)
