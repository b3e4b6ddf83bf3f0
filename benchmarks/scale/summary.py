"""The numbers of a simulated cluster, made from what its processes and servers have recorded."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks.scale.request_meter import Request, RequestMeter
from benchmarks.scale.server_load import LoadSample, find_quantiles, measure_usage
from benchmarks.scale.simulated_stages import count_artifacts

POLL_S = 10.0
"""Seconds between two polls of a worker, as Prefect's default has it."""
# Latencies over time: enough parts to see them grow, and enough requests in each.
_PARTS = 6
# A process of Python runs on one core; well before it is full, requests wait.
_BUSY_CORE = 0.85
_FREE_CORE = 0.15
Row = dict[str, Any]


@dataclass(frozen=True)
class ClusterRun:
    """What was recorded of a simulated cluster.

    Attributes:
        logs: of the dataset.
        workers: of the cluster.
        scale: by what the seconds of stages were multiplied.
        seconds: of the stages as they were measured, by name.
        outcomes: rows of the dataset's table.
        processes: what each process of workers did.
        parent: requests of the dataset's supervisor.
        samples: of the load, from the dataset's start to its end.
        base: two samples before there were workers.
        idle: two samples while all workers were polling and there was no log.
        database: what PostgreSQL counted during the dataset.
        drain_s: seconds from the dataset's end until its task runs were recorded.
        event_delays: how far the server was behind with events, in seconds, every ten seconds.
        is_given_up: whether the dataset was ended by its time limit, before all logs were done.
    """

    logs: int
    workers: int
    scale: float
    seconds: Mapping[str, float]
    outcomes: Sequence[Mapping[str, Any]]
    processes: Sequence[Mapping[str, Any]]
    parent: RequestMeter
    samples: Sequence[LoadSample]
    base: tuple[LoadSample, LoadSample]
    idle: tuple[LoadSample, LoadSample]
    database: Mapping[str, Any]
    drain_s: float
    event_delays: Sequence[float] = ()
    is_given_up: bool = False

    @property
    def wall_s(self) -> float:
        """Seconds of the dataset."""
        return self.samples[-1].time_s - self.samples[0].time_s


def summarise_cluster(run: ClusterRun) -> Row:
    """Makes the numbers of a simulated cluster.

    Args:
        run: what was recorded.

    Returns:
        JSON values. Numbers in ``per_log`` are divided by the number of logs; ``cores`` are processors that a service
        kept busy; ``parts`` are six equal parts of the time.
    """
    api = [Request(*request) for process in run.processes for request in process["api"]] + list(run.parent.api)
    store = [Request(*request) for process in run.processes for request in process["store"]]
    first = run.samples[0].time_s
    last = run.samples[-1].time_s
    busy_api = [request for request in api if first <= request.time_s <= last]
    statuses = Counter(str(row["status"]) for row in run.outcomes)
    cores = measure_usage(run.samples[0], run.samples[-1])
    parts = _split_in_parts(run, busy_api, store)
    return {
        "logs": run.logs,
        "workers": run.workers,
        "seconds_scale": run.scale,
        "log_seconds": round(sum(run.seconds.values()), 1),
        "wall_s": round(run.wall_s, 1),
        "logs_per_minute": round(60 * statuses["done"] / run.wall_s, 2),
        "offered_logs_per_minute": round(60 * run.workers / (sum(run.seconds.values()) * run.scale + POLL_S / 2), 2),
        "logs_done": statuses["done"],
        "statuses": dict(statuses),
        "is_given_up": run.is_given_up,
        "attempts": sum(int(row["attempts"]) for row in run.outcomes),
        "stages": _count_stages(run),
        "cores": cores,
        # Of the busiest part: at the start and the end there is less to do.
        "first_limit": find_limit(max([cores, *(p["cores"] for p in parts if p["cores"])], key=_busy_prefect)),
        "per_log": _divide(run, busy_api, store),
        "idle": _measure_idle(run, api),
        "capacity": _predict_capacity(run),
        "latencies": _measure_latencies(busy_api, store, first, last),
        "parts": parts,
        "client": _describe_client(run),
        "server_peak_mib": round(max(sample.rss_mib["prefect"] for sample in run.samples), 1),
        "server_rss_growth_mib": round(run.samples[-1].rss_mib["prefect"] - run.samples[0].rss_mib["prefect"], 1),
        "postgres_connections": run.database["connections"],
        "task_runs_recorded": run.database["task_runs"],
        "drain_s": round(run.drain_s, 1),
        "event_delay_s": [round(delay, 1) for delay in run.event_delays],
        "api_errors": sum(request.is_error for request in busy_api),
    }


def _busy_prefect(cores: Mapping[str, float]) -> float:
    return cores["prefect"]


def find_limit(cores: Mapping[str, float]) -> str:
    """Says which part of the cluster has no more room.

    Args:
        cores: processors that the services kept busy, with ``machine_idle``.

    Returns:
        A sentence.

    >>> find_limit({"prefect": 0.95, "workers-0": 0.2, "machine_idle": 0.5})
    "Prefect's server keeps one processor busy."
    """
    if any(used > _BUSY_CORE for name, used in cores.items() if name.startswith("workers") or name == "parent"):
        return "The simulated workers keep one processor busy: the servers may carry more."
    if cores["prefect"] > _BUSY_CORE:
        return "Prefect's server keeps one processor busy."
    if cores["machine_idle"] < _FREE_CORE:
        return "The machine, which the servers share with the simulated workers, has no idle processor."
    return "No limit is reached."


def _count_stages(run: ClusterRun) -> Row:
    commits = Counter(name for process in run.processes for name in process["commits"])
    computed = Counter(stage for process in run.processes for stage in process["computed"])
    logs = run.logs
    if run.is_given_up:
        # Only the logs that were done must be complete: the others were still on their way.
        done = {row["log"] for row in run.outcomes if row["status"] == "done"}
        commits = Counter({name: n for name, n in commits.items() if name.split("/")[1] in done})
        logs = len(done)
    counts = count_artifacts(commits, logs)
    twice = sum(count - 1 for count in computed.values())
    refused = sum(len(process["refused"]) for process in run.processes)
    return {
        **counts,
        # The store refuses a second manifest, so that a stage of two workers is never put twice: it is refused to the
        # slower one, or was computed twice.
        "doubled": counts["doubled"] + refused + twice,
        "computed": computed.total(),
        "computed_twice": twice,
        "refused_commits": refused,
        "run_errors": [error for process in run.processes for error in process["errors"]][:10],
    }


def _divide(run: ClusterRun, api: Sequence[Request], store: Sequence[Request]) -> Row:
    logs = _count_done(run)
    used = {name: run.samples[-1].cpu_s[name] - run.samples[0].cpu_s[name] for name in run.samples[0].cpu_s}
    groups = Counter(request.group for request in api)
    parent = Counter(request.group for request in run.parent.api)
    events: Counter[str] = Counter()
    for process in run.processes:
        events.update(process["events"])
    database = {k: round(v / logs, 1) for k, v in run.database.items() if not isinstance(v, Mapping)}
    del database["connections"]
    return {
        "cpu_s": {name: round(seconds / logs, 4) for name, seconds in used.items()},
        "api_requests": round(len(api) / logs, 2),
        "api_by_group": {name: round(count / logs, 3) for name, count in groups.most_common()},
        "supervisor_requests": round(parent.total() / logs, 2),
        "supervisor_by_group": {name: round(count / logs, 3) for name, count in parent.most_common()},
        "supervisor_sent_kb": round(sum(request.sent_bytes for request in run.parent.api) / logs / 1000, 2),
        "events": round(events.total() / logs, 2),
        "database": database,
        "inserted_rows": {name: round(count / logs, 2) for name, count in run.database["inserted"].items()},
        "store_requests": round(len(store) / logs, 2),
        "store_by_call": {k: round(n / logs, 2) for k, n in Counter(r.group for r in store).most_common()},
        "store_sent_kb": round(sum(request.sent_bytes for request in store) / logs / 1000, 2),
    }


def _measure_idle(run: ClusterRun, api: Sequence[Request]) -> Row:
    start, end = run.idle
    seconds = end.time_s - start.time_s
    asked = [request for request in api if start.time_s <= request.time_s <= end.time_s]
    cores = measure_usage(start, end)
    per_second = len(asked) / seconds / run.workers
    return {
        "seconds": round(seconds, 1),
        "requests_per_worker_second": round(per_second, 4),
        "prefect_cores": cores["prefect"],
        "postgres_cores": cores["postgres"],
    }


def _count_done(run: ClusterRun) -> int:
    return max(1, sum(row["status"] == "done" for row in run.outcomes))


def _predict_capacity(run: ClusterRun) -> Row:
    """How many workers keep one processor of Prefect's server busy, at the stages' measured seconds."""
    base = measure_usage(*run.base)["prefect"]
    idle = measure_usage(*run.idle)["prefect"]
    busy = measure_usage(run.samples[0], run.samples[-1])["prefect"]
    polling = max(idle - base, 0.0) / run.workers
    per_log = max(busy - idle, 0.0) * run.wall_s / _count_done(run)
    # A worker that ends a log waits for half of its pause between two polls.
    log_s = sum(run.seconds.values()) + POLL_S / 2
    workers = (1.0 - base) / (polling + per_log / log_s)
    return {
        "prefect_base_cores": base,
        "prefect_cpu_s_per_log": round(per_log, 3),
        "prefect_cpu_ms_per_worker_second": round(1000 * polling, 3),
        "workers_per_server_core": round(workers),
        "logs_per_minute_per_server_core": round(60 * workers / log_s, 1),
    }


def _measure_latencies(api: Sequence[Request], store: Sequence[Request], first: float, last: float) -> Row:
    groups: dict[str, list[float]] = defaultdict(list)
    for request in api:
        groups[request.group].append(request.seconds)
    calls: dict[str, list[float]] = defaultdict(list)
    for request in store:
        if first <= request.time_s <= last:
            calls[request.group].append(request.seconds)
    return {
        "api": find_quantiles([request.seconds for request in api]),
        "api_by_group": {name: find_quantiles(values) for name, values in sorted(groups.items())},
        "store": find_quantiles([value for values in calls.values() for value in values]),
        "store_by_call": {name: find_quantiles(values) for name, values in sorted(calls.items())},
    }


def _split_in_parts(run: ClusterRun, api: Sequence[Request], store: Sequence[Request]) -> list[Row]:
    """Load and latencies of equal parts of the time: a server that slows down with its database shows here."""
    first = run.samples[0].time_s
    parts = []
    for number in range(_PARTS):
        start = first + run.wall_s * number / _PARTS
        end = first + run.wall_s * (number + 1) / _PARTS
        inside = [sample for sample in run.samples if start <= sample.time_s <= end]
        parts.append(
            {
                "cores": measure_usage(inside[0], inside[-1]) if len(inside) > 1 else {},
                "api": find_quantiles([r.seconds for r in api if start <= r.time_s < end]),
                "store": find_quantiles([r.seconds for r in store if start <= r.time_s < end]),
                "server_mib": round(inside[-1].rss_mib["prefect"], 1) if inside else None,
            }
        )
    return parts


def _describe_client(run: ClusterRun) -> Row:
    lags = [lag for process in run.processes for lag in process["lags"]]
    return {
        "processes": len(run.processes),
        "event_loop_lag": find_quantiles(lags),
        "failed_workers": [error for process in run.processes for error in process["failed_workers"]],
    }
