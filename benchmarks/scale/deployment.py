"""A deployment on this machine: PostgreSQL, a Prefect server, workers with one thread each, and an S3 server."""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.common.bench import NotMeasuredError
from benchmarks.common.command import COMMAND
from flows.machine.facts import CHECKOUT
from flows.operations import ObjectServer, PostgresServer, PrefectServer, Worker
from flows.operations.deployments import COORDINATOR_QUEUE, RUN_QUEUE, deploy_flows
from genre_tasks.errors import ConfigError, ResourceError

if TYPE_CHECKING:
    from prefect.client.orchestration import SyncPrefectClient
    from prefect.client.schemas.objects import FlowRun

POOL = "genre"
# Every process has one thread, so that two workers have a core each.
_ONE_THREAD = {"OMP_NUM_THREADS": "1"}


@dataclass
class Deployment:
    """Running services.

    Attributes:
        folder: of everything.
        server: Prefect's server.
        env: what clients and workers need to reach it.
        coordinator: the worker of datasets.
        workers: those of logs, one log at a time each.
    """

    folder: Path
    server: PrefectServer
    env: dict[str, str]
    coordinator: Worker
    workers: list[Worker] = field(default_factory=list)

    @contextmanager
    def client(self) -> Iterator[SyncPrefectClient]:
        """Opens Prefect's client of this server.

        Yields:
            SyncPrefectClient: the client.
        """
        from prefect.client.orchestration import get_client
        from prefect.settings import PREFECT_API_AUTH_STRING, PREFECT_API_URL, temporary_settings

        env = self.server.env()
        settings = {PREFECT_API_URL: env["PREFECT_API_URL"], PREFECT_API_AUTH_STRING: env["PREFECT_API_AUTH_STRING"]}
        with temporary_settings(settings), get_client(sync_client=True) as client:
            yield client

    def set_workers(self, count: int) -> None:
        """Starts or stops workers of logs, until there are so many.

        Args:
            count: how many there are to be.
        """
        while len(self.workers) > count:
            self.workers.pop().stop()
        while len(self.workers) < count:
            name = f"worker-{len(self.workers)}"
            worker = Worker(self.folder / "workers", self.env, POOL, RUN_QUEUE, limit=1, name=name)
            worker.start()
            self.workers.append(worker)

    def run_dataset(self, logs: Sequence[str], store: str, options: Sequence[str]) -> dict[str, Any]:
        """Runs ``genre dataset LOGS --pool … --follow`` to its end.

        Args:
            logs: URIs.
            store: folder or URI.
            options: further ones of the command.

        Returns:
            What the command prints as JSON, with ``wall_s``, the seconds of the command.

        Raises:
            NotMeasuredError: the command fails.
        """
        words = [*COMMAND, "dataset", *logs, "--store", store, "--pool", POOL, "--follow", "--json", *options]
        start_s = time.perf_counter()
        done = subprocess.run(words, env=self.env, cwd=self.folder, capture_output=True, text=True, check=False)
        wall_s = time.perf_counter() - start_s
        if done.returncode:
            raise NotMeasuredError(f"genre dataset ended with {done.returncode}: {done.stderr[-500:]}")
        printed: dict[str, Any] = json.loads(done.stdout)
        return {**printed, "wall_s": wall_s}

    def read_child_runs(self, dataset: str) -> list[FlowRun]:
        """Reads the flow runs of a dataset's logs.

        Args:
            dataset: its name.

        Returns:
            The runs, by the time of their start.
        """
        from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterTags

        from flows.dataset.prefect_runs import dataset_tag
        from flows.dataset.submission import PARENT_TAG

        wanted = FlowRunFilter(tags=FlowRunFilterTags(all_=[dataset_tag(dataset)]))
        with self.client() as client:
            runs = client.read_flow_runs(flow_run_filter=wanted)
        children = [run for run in runs if PARENT_TAG not in run.tags and run.start_time is not None]
        return sorted(children, key=lambda run: str(run.start_time))


@contextmanager
def start_deployment(workers: int, objects: bool = False) -> Iterator[Deployment]:
    """Starts all services, and stops them at the end.

    Args:
        workers: how many take logs.
        objects: whether an S3 server runs, too.

    Yields:
        Deployment: the services; its folder is gone afterwards.

    Raises:
        NotMeasuredError: a program is missing, or a service does not start.
    """
    with ExitStack() as stack:
        # PostgreSQL's user has to enter the folder.
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="genre-scale-")))
        folder.chmod(0o711)
        try:
            postgres = stack.enter_context(PostgresServer(folder / "postgres"))
            server = stack.enter_context(PrefectServer(folder / "server", postgres.url))
            env = _environment(folder) | server.env()
            if objects:
                env |= stack.enter_context(ObjectServer(folder / "objects")).env()
        except (ConfigError, ResourceError) as error:
            raise NotMeasuredError(str(error)) from error
        auth = server.env()["PREFECT_API_AUTH_STRING"]
        # Not the folder itself: a training keeps files of its own there, and a store.
        deploy_flows(server.url, auth, POOL, str(folder / "store"), training_folder=folder / "training")
        coordinator = Worker(folder / "workers", env, POOL, COORDINATOR_QUEUE, limit=None, name="coordinator")
        deployment = Deployment(folder, server, env, stack.enter_context(coordinator))
        # Workers first: they ask the server for runs until they end.
        stack.callback(deployment.set_workers, 0)
        deployment.set_workers(workers)
        yield deployment


def _environment(folder: Path) -> dict[str, str]:
    # The caller's server and settings play no part.
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    return {**kept, **_ONE_THREAD, "PREFECT_HOME": str(folder / "prefect"), "PYTHONPATH": str(CHECKOUT)}


def options_from_settings(preset: str, settings: Sequence[str]) -> list[str]:
    """Writes a preset and settings as a command's options.

    Args:
        preset: of the configuration.
        settings: over it, as ``section.key=value``.

    Returns:
        The options.

    >>> options_from_settings("demo", ["gnet.iterations=3"])
    ['--preset', 'demo', '--set', 'gnet.iterations=3']
    """
    options = ["--preset", preset]
    for setting in settings:
        options += ["--set", setting]
    return options


def read_compute_seconds(store: Path) -> dict[str, float]:
    """Reads how long the stages in a store of this machine computed.

    Args:
        store: its folder.

    Returns:
        Wall seconds of each stage's function, from the manifests, summed over logs and chunks; those of evaluation,
        whose names begin with ``evaluate/``, are among them.
    """
    seconds: dict[str, float] = {}
    for path in sorted(store.glob("*/*/*/**/manifest.json")):
        with suppress(FileNotFoundError):
            manifest = json.loads(path.read_text(encoding="utf-8"))
            seconds[manifest["stage"]] = seconds.get(manifest["stage"], 0.0) + float(manifest["seconds"])
    return seconds
