"""Workers that are killed, alone or with their children, at any moment of a run."""

from __future__ import annotations

import random
import signal
import time
from contextlib import suppress

import psutil
from prefect.client.orchestration import SyncPrefectClient
from prefect.client.schemas.objects import StateType

from flows.dataset.prefect_runs import has_heartbeat
from flows.operations import Worker
from tests.faults.matrix.cluster import Cluster
from tests.faults.matrix.compute_log import read_notes
from tests.faults.matrix.fault_hooks import ARMED, TAKEN
from tests.faults.matrix.scenario import Fault, Injection

_RUN_VARIABLE = "PREFECT__FLOW_RUN_ID"
_WAIT_S = 60.0
_STAGE_FRACTION = 2 / 3
_STAGE_S = 15.0


def find_runs(cluster: Cluster, worker: Worker) -> dict[str, psutil.Process]:
    """The flow runs whose processes a worker has, by their ids."""
    found = {}
    for child in cluster.find_children(worker):
        with suppress(psutil.Error):
            run_id = child.environ().get(_RUN_VARIABLE)
            if run_id:
                found[run_id] = child
    return found


def find_logs(cluster: Cluster, run_ids: list[str]) -> set[str]:
    """The logs of flow runs."""
    with cluster.client() as client:
        return {str(client.read_flow_run(run_id).parameters["log"]) for run_id in run_ids}  # type: ignore[arg-type]


def choose_worker(cluster: Cluster, rng: random.Random) -> Worker:
    """A worker at a random moment: mostly inside a stage, as the start of a run takes longer than all its stages."""
    worker = rng.choice(cluster.workers)
    if rng.random() < _STAGE_FRACTION:
        deadline = time.monotonic() + _STAGE_S
        while time.monotonic() < deadline:
            pids = {process.pid for process in find_runs(cluster, worker).values()}
            last = next((note for note in reversed(read_notes(cluster.faults)) if note.pid in pids), None)
            if last is not None and last.event == "start":
                break
            time.sleep(0.05)
        time.sleep(rng.uniform(0.0, 0.3))
    return worker


class WorkerKilledAlone(Fault):
    """The worker dies; its children lose the pipes of their output."""

    name = "worker killed, its run lives"
    how = "kill −9 of the worker's process alone, then a new worker"

    def inject(self, cluster: Cluster, rng: random.Random) -> Injection | None:
        worker = choose_worker(cluster, rng)
        runs = find_runs(cluster, worker)
        if not runs:
            return None
        logs = find_logs(cluster, list(runs))
        moment = time.monotonic()
        cluster.kill_worker(worker, children=False)
        worker.start()
        return Injection(moment, logs)


class WorkerKilledWithChildren(Fault):
    """As when the machine of a worker fails."""

    name = "worker killed with its run"
    how = "kill −9 of all processes of the worker, then a new worker"
    pause_s = (1.0, 8.0)

    def inject(self, cluster: Cluster, rng: random.Random) -> Injection | None:
        worker = choose_worker(cluster, rng)
        runs = find_runs(cluster, worker)
        if not runs:
            return None
        logs = find_logs(cluster, list(runs))
        moment = time.monotonic()
        cluster.kill_worker(worker, children=True)
        worker.start()
        return Injection(moment, logs)


class RunKilled(Fault):
    """As the system does to the largest process when memory is exhausted."""

    name = "out of memory: the system kills the run"
    how = "kill −9 of the run's process alone"

    def inject(self, cluster: Cluster, rng: random.Random) -> Injection | None:
        runs = find_runs(cluster, choose_worker(cluster, rng))
        if not runs:
            return None
        logs = find_logs(cluster, list(runs))
        moment = time.monotonic()
        for process in runs.values():
            process.send_signal(signal.SIGKILL)
        return Injection(moment, logs)


class WorkerKilledWhilePending(Fault):
    """The run has been taken from the queue, and no process of it has reported yet."""

    name = "worker killed while its run is pending"
    how = "kill −9 of all processes of the worker while the server says PENDING, then a new worker"
    pause_s = (0.0, 1.0)
    first_stage = False

    def inject(self, cluster: Cluster, rng: random.Random) -> Injection | None:
        with cluster.client() as client:
            found = self._find_pending(cluster, client)
            if found is None:
                return None
            worker, run_id = found
            time.sleep(rng.uniform(0.0, 0.5))
            log = str(client.read_flow_run(run_id).parameters["log"])  # type: ignore[arg-type]
            moment = time.monotonic()
            cluster.kill_worker(worker, children=True)
            state = client.read_flow_run(run_id).state  # type: ignore[arg-type]
        worker.start()
        # It may have started at the last moment, which is another fault.
        is_pending = state is not None and state.type is StateType.PENDING
        return Injection(moment, {log}) if is_pending else None

    def _find_pending(self, cluster: Cluster, client: SyncPrefectClient) -> tuple[Worker, str] | None:
        deadline = time.monotonic() + 10.0
        while time.monotonic() < deadline:
            for worker in cluster.workers:
                for run_id in find_runs(cluster, worker):
                    state = client.read_flow_run(run_id).state  # type: ignore[arg-type]
                    if state is not None and state.type is StateType.PENDING:
                        return worker, run_id
            time.sleep(0.05)
        return None


class WorkerKilledBeforeHeartbeat(Fault):
    """The server says RUNNING, and no heartbeat has ever come."""

    name = "worker killed before its run's first heartbeat"
    how = "kill −9 of all processes of the worker at the call that sends the first heartbeat, then a new worker"
    pause_s = (0.0, 2.0)
    first_stage = False

    def inject(self, cluster: Cluster, rng: random.Random) -> Injection | None:
        name = f"heartbeat.{time.monotonic_ns()}"
        armed = cluster.faults / ARMED / name
        armed.touch()
        deadline = time.monotonic() + _WAIT_S
        while not (cluster.faults / TAKEN / name).exists():
            if time.monotonic() > deadline or not cluster.is_dataset_running():
                armed.unlink(missing_ok=True)
                return None
            time.sleep(0.02)
        pid = cluster.read_fault(name).pid
        for worker in cluster.workers:
            runs = find_runs(cluster, worker)
            hit = [run_id for run_id, process in runs.items() if process.pid == pid]
            if hit:
                logs = find_logs(cluster, hit)
                moment = time.monotonic()
                cluster.kill_worker(worker, children=True)
                with cluster.client() as client:
                    is_late = has_heartbeat(client, hit[0], since_s=3600.0)
                worker.start()
                return None if is_late else Injection(moment, logs)
        return None
