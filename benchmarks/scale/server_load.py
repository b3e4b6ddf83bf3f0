"""What servers use while a measurement runs: processor, memory, and what PostgreSQL counts."""

from __future__ import annotations

import asyncio
import os
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import psutil

_SAMPLE_S = 2.0
_MIB = 1024.0**2
_COUNTERS = (
    "xact_commit",
    "xact_rollback",
    "tup_returned",
    "tup_fetched",
    "tup_inserted",
    "tup_updated",
    "tup_deleted",
    "blks_read",
    "blks_hit",
)


@dataclass(frozen=True)
class LoadSample:
    """What the processes had used at a moment.

    Attributes:
        time_s: by the system's monotonic clock.
        cpu_s: processor seconds so far, by the service's name.
        rss_mib: memory, by the service's name.
        idle_s: seconds that the machine's processors were idle so far, all together.
    """

    time_s: float
    cpu_s: Mapping[str, float]
    rss_mib: Mapping[str, float]
    idle_s: float


@dataclass
class LoadSampler:
    """Samples processes and their children in a thread, every two seconds.

    Attributes:
        pids: of the services' first processes, by name.
        samples: so far.
    """

    pids: Mapping[str, Sequence[int]]
    samples: list[LoadSample] = field(default_factory=list)
    _stopped: threading.Event = field(default_factory=threading.Event)
    _thread: threading.Thread | None = None

    def start(self) -> None:
        """Starts to sample."""
        # A daemon: a benchmark that fails must not wait for it.
        self._thread = threading.Thread(target=self._run, name="load", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Takes a last sample and ends."""
        self._stopped.set()
        if self._thread is not None:
            self._thread.join()

    def sample(self) -> LoadSample:
        """Samples now.

        Returns:
            The sample, which is not added to the list.
        """
        cpu_s = {name: sum(read_cpu_seconds(pid) for pid in pids) for name, pids in self.pids.items()}
        rss = {name: sum(_read_rss_mib(pid) for pid in pids) for name, pids in self.pids.items()}
        return LoadSample(time.monotonic(), cpu_s, rss, psutil.cpu_times().idle)

    def _run(self) -> None:
        while not self._stopped.wait(_SAMPLE_S):
            self.samples.append(self.sample())
        self.samples.append(self.sample())


def read_cpu_seconds(pid: int) -> float:
    """Reads the processor seconds of a process and of its children, also of those that have ended.

    Args:
        pid: of the process. This process is read without its children, which are the services.

    Returns:
        Seconds; 0 for a process that is gone.
    """
    with suppress(psutil.Error):
        process = psutil.Process(pid)
        times = process.cpu_times()
        total = float(times.user + times.system)
        if pid == os.getpid():
            return total
        ended = float(times.children_user + times.children_system)
        return total + ended + sum(read_cpu_seconds(child.pid) for child in process.children())
    return 0.0


def _read_rss_mib(pid: int) -> float:
    with suppress(psutil.Error):
        return float(psutil.Process(pid).memory_info().rss / _MIB)
    return 0.0


def measure_usage(start: LoadSample, end: LoadSample) -> dict[str, float]:
    """Computes how many processors each service kept busy between two samples.

    Args:
        start: the first sample.
        end: the last one.

    Returns:
        Busy processors by the service's name; ``machine_idle`` for those that were idle, ``others`` for the rest.
    """
    seconds = max(end.time_s - start.time_s, 1e-9)
    cores = {name: round((used - start.cpu_s[name]) / seconds, 3) for name, used in end.cpu_s.items()}
    idle = (end.idle_s - start.idle_s) / seconds
    others = max((psutil.cpu_count() or 1) - idle - sum(cores.values()), 0.0)
    return {**cores, "others": round(others, 3), "machine_idle": round(idle, 3)}


def find_quantiles(values: Sequence[float]) -> dict[str, float]:
    """Finds the median and the 95th percentile.

    Args:
        values: in seconds.

    Returns:
        ``p50_ms``, ``p95_ms`` and ``n``.

    >>> find_quantiles([0.001, 0.002, 0.003])
    {'p50_ms': 2.0, 'p95_ms': 3.0, 'n': 3}
    """
    if not values:
        return {"n": 0}
    ordered = sorted(values)
    last = len(ordered) - 1
    p50 = ordered[round(0.5 * last)]
    p95 = ordered[round(0.95 * last)]
    return {"p50_ms": round(1000 * p50, 2), "p95_ms": round(1000 * p95, 2), "n": len(ordered)}


def read_database(url: str) -> dict[str, Any]:
    """Reads what PostgreSQL has counted, and how large the database is.

    Args:
        url: as Prefect's server has it.

    Returns:
        Counters by name, ``bytes``, ``connections``, ``task_runs`` (records of the server), and ``inserted`` rows by
        table.
    """
    return asyncio.run(_read_database(url.replace("postgresql+asyncpg://", "postgresql://")))


async def _read_database(url: str) -> dict[str, Any]:
    import asyncpg

    connection = await asyncpg.connect(url)
    try:
        row = await connection.fetchrow("select * from pg_stat_database where datname = current_database()")
        found: dict[str, Any] = {name: int(row[name]) for name in _COUNTERS}
        found["bytes"] = int(await connection.fetchval("select pg_database_size(current_database())"))
        found["connections"] = int(
            await connection.fetchval("select count(*) from pg_stat_activity where backend_type = 'client backend'")
        )
        done = "select count(*) from task_run where state_type = 'COMPLETED'"
        found["task_runs"] = int(await connection.fetchval(done))
        tables = await connection.fetch("select relname, n_tup_ins from pg_stat_user_tables where n_tup_ins > 0")
        found["inserted"] = {table["relname"]: int(table["n_tup_ins"]) for table in tables}
    finally:
        await connection.close()
    return found


def read_event_delay(url: str) -> float:
    """Reads how long ago the newest event came that the server has worked through.

    Args:
        url: as Prefect's server has it.

    Returns:
        Seconds; 0 where there is no event.
    """
    return asyncio.run(_read_event_delay(url.replace("postgresql+asyncpg://", "postgresql://")))


async def _read_event_delay(url: str) -> float:
    import asyncpg

    connection = await asyncpg.connect(url)
    try:
        return float(await connection.fetchval("select extract(epoch from now() - max(received)) from events") or 0.0)
    finally:
        await connection.close()


def subtract_counters(end: Mapping[str, Any], start: Mapping[str, Any]) -> dict[str, Any]:
    """Subtracts two readings of the database.

    Args:
        end: the later one.
        start: the earlier one.

    Returns:
        The differences; tables without new rows are left out.

    >>> subtract_counters({"bytes": 5, "inserted": {"log": 3}}, {"bytes": 2, "inserted": {}})
    {'bytes': 3, 'inserted': {'log': 3}}
    """
    differences: dict[str, Any] = {}
    for name, value in end.items():
        if isinstance(value, Mapping):
            before = start[name]
            changed = {key: count - before.get(key, 0) for key, count in value.items()}
            differences[name] = {key: count for key, count in sorted(changed.items()) if count}
        else:
            differences[name] = value - start[name]
    return differences
