"""A dataset on a simulated cluster: real servers, real supervisor and store, workers whose stages sleep.

Run as ``python -m benchmarks.scale.cluster --logs 20 --workers 5 --scale 0.1 --json FILE``.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any
from uuid import uuid4

from benchmarks.scale.cluster_services import POOL, ClusterServices, start_services
from benchmarks.scale.request_meter import RequestMeter, metered_clients
from benchmarks.scale.server_load import (
    LoadSample,
    LoadSampler,
    read_database,
    read_event_delay,
    subtract_counters,
)
from benchmarks.scale.simulated_stages import read_stage_seconds
from benchmarks.scale.summary import ClusterRun, summarise_cluster
from flows.dataset.live_table import LiveTable
from flows.dataset.prefect_runs import ChildRequest, PrefectRuns
from flows.dataset.supervisor import SupervisionLimits, Supervisor
from flows.dataset.work_units import WorkUnit

# The servers without workers, whose load every later number includes.
_BASE_S = 10.0
_DELAY_EVERY_S = 10.0
# Two polls of every worker.
_IDLE_S = 20.0
# The server records task runs after the dataset has ended, as far as it is behind.
_DRAIN_S = 120.0
# More than the workers: a worker that ends a log finds the next one waiting.
_IN_FLIGHT_PER_WORKER = 1.25
Row = dict[str, Any]


def measure_cluster(
    logs: int,
    workers: int,
    seed: int,
    seconds_scale: float,
    keep_logs: Path | None = None,
    limit_s: float = float("inf"),
) -> Row:
    """Runs a dataset of simulated logs on simulated workers, and measures what it costs the servers.

    PostgreSQL, Prefect's server, the S3 server, the supervisor of the dataset and the store are real. So is the part
    of Prefect's worker that polls and proposes states. Only the process of a flow run is simulated: it sends the
    requests and events of a real one, and sleeps where a stage computes.

    Args:
        logs: of the dataset.
        workers: that run one log at a time each.
        seed: of the artifacts' keys, and of when the workers start.
        seconds_scale: by what the stages' measured seconds and the time between two heartbeats of a run are multiplied.
            Workers poll as often as real ones do.
        keep_logs: folder for the servers' logs.
        limit_s: seconds after which the dataset is given up; the numbers are then those of a part of it.

    Returns:
        JSON values: ``wall_s``, ``logs_per_minute``, ``per_log``, ``idle``, ``cores``, ``latencies``, ``stages`` and
        more, as :func:`benchmarks.scale.summary.summarise_cluster` says.

    Raises:
        ConfigError: PostgreSQL or the S3 server is not installed.
        ResourceError: a server did not start.
    """
    run = _run_cluster(logs, workers, seed, seconds_scale, keep_logs, limit_s)
    return summarise_cluster(run) | {"seed": seed}


def _run_cluster(
    logs: int, workers: int, seed: int, seconds_scale: float, keep_logs: Path | None, limit_s: float
) -> ClusterRun:
    seconds = read_stage_seconds()
    meter = RequestMeter()
    with start_services(keep_logs) as services, metered_clients(meter):
        base = _sample_during(services, _BASE_S)
        services.start_workers(workers, seed, seconds_scale, seconds)
        idle = _sample_during(services, _IDLE_S)
        sampler = LoadSampler(services.pids())
        before = read_database(services.postgres.url)
        # The requests of the start belong to no log.
        meter.api.clear()
        sampler.start()
        start = sampler.sample()
        watch = _DatasetWatch(services.postgres.url, start.time_s + limit_s)
        rows = _run_dataset(logs, workers, watch)
        end = sampler.sample()
        connections = read_database(services.postgres.url)["connections"]
        done = sum(row["status"] == "done" for row in rows)
        drain_s = _wait_for_records(services, before["task_runs"] + done * len(seconds))
        after = read_database(services.postgres.url)
        sampler.stop()
        found = services.stop_workers()
    return ClusterRun(
        logs=logs,
        workers=workers,
        scale=seconds_scale,
        seconds=seconds,
        outcomes=rows,
        processes=found,
        parent=meter,
        samples=[start, *(sample for sample in sampler.samples if start.time_s < sample.time_s < end.time_s), end],
        base=base,
        idle=idle,
        database=subtract_counters(after, before) | {"connections": connections},
        drain_s=drain_s,
        event_delays=watch.delays,
        is_given_up=watch.is_over,
    )


def _sample_during(services: ClusterServices, seconds: float) -> tuple[LoadSample, LoadSample]:
    sampler = LoadSampler(services.pids())
    start = sampler.sample()
    time.sleep(seconds)
    return start, sampler.sample()


class _TimeOverError(Exception):
    """The dataset takes longer than it may."""


class _DatasetWatch:
    """Shows the live table as the dataset's flow does, and measures how far the server is behind with events."""

    def __init__(self, database: str, end_s: float) -> None:
        self.delays: list[float] = []
        self.is_over = False
        self._database = database
        self._end_s = end_s
        self._table = LiveTable()
        self._next_s = time.monotonic()

    def on_change(self, rows: list[Row]) -> None:
        now_s = time.monotonic()
        if now_s > self._end_s:
            self.is_over = True
            raise _TimeOverError
        self._table.show(rows)
        if now_s >= self._next_s:
            self._next_s = now_s + _DELAY_EVERY_S
            self.delays.append(read_event_delay(self._database))


def _run_dataset(logs: int, workers: int, watch: _DatasetWatch) -> list[Row]:
    """The dataset's flow without its process: its supervisor, child runs and table are the real ones."""
    units = [WorkUnit(f"log-{number:04d}") for number in range(logs)]
    request = ChildRequest(f"simulated-{uuid4().hex[:8]}", str(uuid4()), POOL, {"preset": "small"})
    limits = SupervisionLimits(in_flight=max(2, round(_IN_FLIGHT_PER_WORKER * workers)), attempts=3)
    supervisor = Supervisor(units, PrefectRuns(request), limits, watch.on_change)
    with suppress(_TimeOverError):
        supervisor.run()
    return supervisor.rows


def _wait_for_records(services: ClusterServices, wanted: int) -> float:
    """Seconds until the server has recorded the task runs, whose events it may still work through."""
    start_s = time.monotonic()
    while time.monotonic() - start_s < _DRAIN_S:
        if read_database(services.postgres.url)["task_runs"] >= wanted:
            break
        time.sleep(1.0)
    return time.monotonic() - start_s


def main() -> None:
    """Measures one or several clusters, and adds each to a file of JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--logs", type=int, nargs="+", required=True, help="logs of each cluster")
    parser.add_argument("--workers", type=int, nargs="+", required=True, help="workers of each cluster")
    parser.add_argument("--scale", type=float, default=1.0, help="by what the seconds of stages are multiplied")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, required=True, help="file that a row is added to for each cluster")
    parser.add_argument("--limit-s", type=float, default=float("inf"), help="seconds after which a dataset is given up")
    parser.add_argument("--keep-logs", type=Path, default=None, help="folder for the servers' logs")
    args = parser.parse_args()
    for logs, workers in zip(args.logs, args.workers, strict=True):
        row = measure_cluster(logs, workers, args.seed, args.scale, args.keep_logs, args.limit_s)
        rows = json.loads(args.json.read_text()) if args.json.exists() else []
        args.json.write_text(json.dumps([*rows, row], indent=1))
        sys.stdout.write(json.dumps(row, indent=1) + "\n")


if __name__ == "__main__":
    main()
