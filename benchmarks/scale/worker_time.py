"""How long workers are busy with runs: from the server's word that a run is taken to the end of its process."""

from __future__ import annotations

import threading
import time
from types import TracebackType
from typing import Self

import psutil

from benchmarks.scale.deployment import Deployment

_EVERY_S = 0.02


class WorkerClock:
    """Watches the processes of the workers' runs while it is open.

    A run's state is final before its process ends, and until then the worker takes no other run.

    Args:
        deployment: its workers are watched.
    """

    def __init__(self, deployment: Deployment) -> None:
        self._deployment = deployment
        self._last_seen: dict[int, float] = {}
        self._start = time.time()
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def _watch(self) -> None:
        workers = [psutil.Process(worker.pid) for worker in self._deployment.workers]
        while not self._stopped.wait(_EVERY_S):
            for worker in workers:
                for process in worker.children():
                    self._last_seen[process.pid] = time.time()

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._stopped.set()
        self._thread.join()

    def read_seconds(self, dataset: str) -> list[float]:
        """Reads how long each run of a dataset's logs kept its worker.

        Args:
            dataset: its name.

        Returns:
            Seconds by the time of the start, of the runs that began while the clock was open.
        """
        found = []
        with self._deployment.client() as client:
            for run in self._deployment.read_child_runs(dataset):
                if run.infrastructure_pid is None:
                    continue
                # The process's end by this machine's clock, which is the server's, too.
                _, _, pid = run.infrastructure_pid.rpartition(":")
                states = client.read_flow_run_states(run.id)
                # A worker's slot is taken from its proposal of Pending on.
                taken = min(state.timestamp for state in states if state.type.value == "PENDING")
                if int(pid) in self._last_seen and taken.timestamp() > self._start:
                    found.append(self._last_seen[int(pid)] - taken.timestamp())
        return found
