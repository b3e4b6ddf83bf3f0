"""Tables of datasets on many machines, from the JSON file that ``genre bench scale`` writes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from benchmarks.scale.report import sum_evaluation
from docs.result_tables import number, result, table

NAME = "scale"


def workers() -> str:
    """What workers, orchestration and the store on S3 cost."""
    throughput = _row("throughput")
    run = _row("orchestration")
    cached = _row("cached")["seconds"]
    objects = _row("object_store")
    lines = [
        [f"{throughput['logs']} logs, one worker", number(throughput["one_worker_s"])],
        [f"{throughput['logs']} logs, two workers", number(throughput["two_workers_s"])],
        ["one log on a worker, from its start to the end of its process", number(run["worker_s"])],
        ["the computation in it", number(run["compute_s"])],
        ["the computation in it without evaluation", number(run["compute_s"] - sum_evaluation(run["stages_s"]))],
        ["the rest of it: orchestration", number(run["worker_s"] - run["compute_s"])],
        ["a log whose stages are all in the store, on a worker", _spread(cached)],
        ["one log into a store of this machine", _spread(objects["local_s"])],
        ["one log into a store on an S3 server of this machine", _spread(objects["s3_s"])],
    ]
    return table(["what", "seconds"], lines)


def cluster() -> str:
    """What a log costs the servers, and what an idle worker does."""
    row = _row("cluster")
    a_log = row["per_log"]
    idle = row["capacity"]["prefect_cpu_ms_per_worker_second"]
    polls = row["idle"]["requests_per_worker_second"]
    cpu = a_log["cpu_s"]
    lines = [
        ["CPU time of Prefect's server", f"{number(cpu['prefect'])} s", f"{number(idle)} ms a second"],
        ["CPU time of PostgreSQL", f"{number(cpu['postgres'])} s", "–"],
        ["CPU time of the S3 server", f"{number(cpu['objects'])} s", "–"],
        ["requests to Prefect's API", number(a_log["api_requests"]), f"{number(polls)} a second"],
        ["events", number(a_log["events"]), "–"],
        ["rows written to the database", f"{sum(a_log['inserted_rows'].values()):,.0f}", "–"],
        ["growth of the database", f"{number(a_log['database']['bytes'] / 1e6)} MB", "–"],
        ["requests to the store", f"{a_log['store_requests']:,.0f}", "–"],
    ]
    return table(["load", "of a log", "of an idle worker"], lines)


def cluster_runs() -> str:
    """How the simulated dataset went."""
    row = _row("cluster")
    stages = row["stages"]
    latencies = row["latencies"]
    lines = [
        ["logs, workers", f"{row['logs']:,}, {row['workers']}"],
        ["seconds of a log's stages, multiplied by", f"{number(row['log_seconds'])}, {row['seconds_scale']:g}"],
        ["logs that ended complete", f"{row['logs_done']:,}"],
        ["stages in the store", f"{stages['stages']:,}"],
        ["stages lost, doubled, computed twice", f"{stages['lost']}, {stages['doubled']}, {stages['computed_twice']}"],
        ["wall seconds", number(row["wall_s"])],
        ["logs a minute, of which the workers could do", _pair(row, "logs_per_minute", "offered_logs_per_minute")],
        ["an API request, median and 95th percentile, ms", _pair(latencies["api"], "p50_ms", "p95_ms")],
        ["a store request, median and 95th percentile, ms", _pair(latencies["store"], "p50_ms", "p95_ms")],
        ["longest delay of events, s", number(max(row["event_delay_s"], default=0.0))],
        ["memory of Prefect's server at most, MiB", number(row["server_peak_mib"])],
        ["processors kept busy on average: Prefect, PostgreSQL, S3", _cores(row["cores"])],
        ["first limit, in the busiest sixth of the time", row["first_limit"].rstrip(".")],
        ["workers that keep one processor of Prefect's server busy", str(row["capacity"]["workers_per_server_core"])],
    ]
    return table(["what", "measured"], lines)


def fuzz() -> str:
    """What became of damaged and harmful files, by format."""
    row = _row("fuzz")
    formats: Mapping[str, Mapping[str, Any]] = row["formats"]
    lines = [
        [
            name,
            str(counts["read"]),
            str(counts["refused"]),
            str(sum(value for key, value in counts.items() if key not in ("read", "refused", "seconds", "memory_mib"))),
            number(counts["seconds"]),
            number(counts["memory_mib"]),
        ]
        for name, counts in sorted(formats.items())
    ]
    read, refused, findings = (sum(int(line[k]) for line in lines) for k in (1, 2, 3))
    lines.append(["all", f"{read:,}", f"{refused:,}", str(findings), "", ""])
    head = ["format", "read", "refused", "findings", "longest, s", "memory at most, MiB"]
    return table(head, lines)


def _row(cell: str) -> dict[str, Any]:
    (row,) = [row for row in result(NAME)["rows"] if row["cell"] == cell]
    return row


def _spread(quartiles: Mapping[str, float]) -> str:
    return f"{number(quartiles['median'])} ({number(quartiles['low'])} to {number(quartiles['high'])})"


def _pair(row: Mapping[str, float], first: str, second: str) -> str:
    return f"{number(row[first])}, {number(row[second])}"


def _cores(cores: Mapping[str, float]) -> str:
    return ", ".join(number(cores[name]) for name in ("prefect", "postgres", "objects"))
