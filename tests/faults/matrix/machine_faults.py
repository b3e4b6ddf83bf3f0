"""Faults of a worker's machine: disk, memory, clock; errors that pass; two workers on one artifact."""

from __future__ import annotations

import errno
import os
import random
import struct
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from flows.pipeline.gpu_slot import GPU_STAGES
from tests.faults.matrix.cluster import GPU_SLOTS, Cluster
from tests.faults.matrix.fault_hooks import ARMED, TAKEN
from tests.faults.matrix.scenario import LOGS, Fault, Injection
from tests.faults.matrix.worker_faults import find_logs, find_runs

CLOCK_SOURCE = Path(__file__).with_name("clock_shift.c")
_DISK_BYTES = 256 << 20
_BLOCK_BYTES = 64 << 10
_JUMP_S = 3600
_WAIT_S = 60.0


def arm(cluster: Cluster, point: str) -> Injection | None:
    """Arms a fault and waits until a process suffers it; ``None`` where no process comes to its point."""
    name = f"{point}.{time.monotonic_ns()}"
    armed = cluster.faults / ARMED / name
    armed.touch()
    deadline = time.monotonic() + _WAIT_S
    while not (cluster.faults / TAKEN / name).exists():
        if time.monotonic() > deadline or not cluster.is_dataset_running():
            armed.unlink(missing_ok=True)
            return None
        time.sleep(0.05)
    fault = cluster.read_fault(name)
    return Injection(fault.time, {fault.log})


class DiskFull(Fault):
    """The store's disk has no byte left for some seconds."""

    name = "disk full"
    how = "the store's disk (a small tmpfs) is filled by another file for 2 to 10 s"
    pause_s = (1.0, 4.0)

    @contextmanager
    def surround(self, cluster: Cluster) -> Iterator[None]:
        disk = self._disk(cluster)
        disk.mkdir(exist_ok=True)
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={_DISK_BYTES}", "tmpfs", str(disk)], check=True)
        try:
            yield
        finally:
            subprocess.run(["umount", "-l", str(disk)], check=True)

    def make_store(self, cluster: Cluster, number: int) -> str:
        return str(self._disk(cluster) / f"store-{number}")

    def inject(self, cluster: Cluster, rng: random.Random) -> Injection | None:
        filler = self._disk(cluster) / "filler"
        moment = time.monotonic()
        try:
            _fill(filler)
            time.sleep(rng.uniform(2.0, 10.0))
        finally:
            filler.unlink(missing_ok=True)
        return Injection(moment)

    def _disk(self, cluster: Cluster) -> Path:
        return cluster.folder / "disk"


def _fill(path: Path) -> None:
    handle = os.open(path, os.O_WRONLY | os.O_CREAT)
    try:
        for size in (_BLOCK_BYTES, 1):
            try:
                while True:
                    os.write(handle, bytes(size))
            except OSError as error:
                if error.errno != errno.ENOSPC:
                    raise
    finally:
        os.close(handle)


class AllocationFails(Fault):
    """A stage asks for more memory than the system gives."""

    name = "out of memory: an allocation fails"
    how = "an allocation above RLIMIT_AS at the start of a stage's computation"
    pause_s = (0.0, 4.0)

    def inject(self, cluster: Cluster, rng: random.Random) -> Injection | None:
        return arm(cluster, "memory")


class RetryUnderLimit(Fault):
    """A stage with a slot of a concurrency limit fails once."""

    name = "retry under a concurrency limit"
    how = "TransientIOError in a stage that has the only slot of the limit, for which two workers wait"
    pause_s = (0.0, 2.0)

    @contextmanager
    def surround(self, cluster: Cluster) -> Iterator[None]:
        cluster.set_slots(1)
        try:
            yield
        finally:
            cluster.set_slots(GPU_SLOTS)

    def inject(self, cluster: Cluster, rng: random.Random) -> Injection | None:
        return arm(cluster, f"transient@{rng.choice(sorted(GPU_STAGES))}")


class ClockJumps(Fault):
    """The clocks of all workers jump by an hour, forth or back, and are set right again."""

    name = "clock jump"
    how = "a preloaded library shifts the wall clock of all workers by +1 h or −1 h for 3 to 12 s"
    pause_s = (1.0, 4.0)

    @contextmanager
    def surround(self, cluster: Cluster) -> Iterator[None]:
        shift = self._shift(cluster)
        write_shift(shift, 0)
        library = build_clock_shift(cluster.folder)
        cluster.restart_workers(LD_PRELOAD=str(library), GENRE_CLOCK_SHIFT=str(shift))
        try:
            yield
        finally:
            cluster.restart_workers()

    def inject(self, cluster: Cluster, rng: random.Random) -> Injection | None:
        shift = self._shift(cluster)
        moment = time.monotonic()
        write_shift(shift, rng.choice((-_JUMP_S, _JUMP_S)))
        time.sleep(rng.uniform(3.0, 12.0))
        write_shift(shift, 0)
        return Injection(moment)

    def _shift(self, cluster: Cluster) -> Path:
        return cluster.folder / "clock"


def build_clock_shift(folder: Path) -> Path:
    """Compiles the library that shifts wall clocks; libfaketime would break waits by the monotonic clock, too."""
    library = folder / "clock_shift.so"
    compiler = os.environ.get("CC", "cc")
    subprocess.run([compiler, "-O2", "-shared", "-fPIC", "-o", str(library), str(CLOCK_SOURCE)], check=True)
    return library


def write_shift(path: Path, seconds: int) -> None:
    """Changes the shift of all processes that have the file; in place, as they have mapped it."""
    handle = os.open(path, os.O_WRONLY | os.O_CREAT)
    try:
        os.pwrite(handle, struct.pack("=q", seconds), 0)
    finally:
        os.close(handle)


class TwoWorkersOneArtifact(Fault):
    """Two datasets of the same logs at a time: every artifact is wanted by two workers."""

    name = "two workers on one artifact"
    how = "two datasets of the same logs at a time, counted when both workers run the same log"
    pause_s = (0.0, 0.2)

    def __init__(self) -> None:
        self._met: set[frozenset[str]] = set()

    def start(self, cluster: Cluster, store: str) -> list[subprocess.Popen[bytes]]:
        # The same setting once more makes another dataset of the same artifacts.
        more = ("--set", "evaluate.bootstrap=5")
        one = ("--in-flight", "1")
        return [cluster.start_dataset(LOGS, store, *one), cluster.start_dataset(LOGS, store, *one, *more)]

    def inject(self, cluster: Cluster, rng: random.Random) -> Injection | None:
        runs = [run_id for worker in cluster.workers for run_id in find_runs(cluster, worker)]
        pair = frozenset(runs)
        logs = find_logs(cluster, runs)
        if len(pair) != 2 or len(logs) != 1 or pair in self._met:
            return None
        self._met.add(pair)
        return Injection(time.monotonic(), logs)
