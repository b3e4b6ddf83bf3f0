"""The simulated cluster: stages against a real store in memory, the real supervisor, and the numbers made of them."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
from obstore.store import MemoryStore

from benchmarks.scale.cluster import measure_cluster
from benchmarks.scale.report import scale_claims
from benchmarks.scale.request_meter import Request, RequestMeter, metered_clients
from benchmarks.scale.server_load import LoadSample
from benchmarks.scale.simulated_run import RunCounts
from benchmarks.scale.simulated_stages import (
    count_artifacts,
    read_stage_seconds,
    run_simulated_stage,
    write_simulated_record,
)
from benchmarks.scale.summary import ClusterRun, find_limit, summarise_cluster
from flows.dataset.child_runs import ChildRun
from flows.dataset.supervisor import SupervisionLimits, Supervisor
from flows.dataset.work_units import WorkUnit
from flows.pipeline.definition import PIPELINE
from storage.objects import bucket
from storage.objects.object_store import ObjectStore

LOGS = 6
WORKERS = 3
SECONDS = 0.001


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ObjectStore:
    memory = MemoryStore()
    monkeypatch.setattr(bucket, "open_client", lambda uri: memory)
    monkeypatch.setenv("GENRE_CACHE_DIR", str(tmp_path))
    return ObjectStore("s3://bucket/store")


@pytest.fixture
def meter(store: ObjectStore) -> Iterator[RequestMeter]:
    found = RequestMeter()
    with metered_clients(found):
        yield found


class _Runs:
    """Child runs that workers of this process take from a queue."""

    def __init__(self) -> None:
        self.runs: dict[str, ChildRun] = {}
        self.queue: deque[str] = deque()

    def find(self) -> list[ChildRun]:
        return []

    def submit(self, requests: Sequence[tuple[WorkUnit, int]]) -> Sequence[ChildRun]:
        return [self._submit(unit, attempt) for unit, attempt in requests]

    def _submit(self, unit: WorkUnit, attempt: int) -> ChildRun:
        run = ChildRun(f"{unit.log}-{attempt}", unit, "SCHEDULED")
        self.runs[run.id] = run
        self.queue.append(run.id)
        return run

    def read(self, ids: Sequence[str]) -> Mapping[str, ChildRun]:
        return {id_: self.runs[id_] for id_ in ids}

    def read_heartbeats(self, ids: Sequence[str]) -> Mapping[str, str]:
        return {}

    def read_event_delay(self) -> float:
        return 0.0

    def read_stages(self, ids: Sequence[str]) -> Mapping[str, str]:
        return {}

    def crash(self, run: ChildRun, reason: str) -> None:
        self.runs[run.id] = replace(run, state="CRASHED")

    def read_outcomes(self, ids: Sequence[str]) -> Mapping[str, dict[str, Any]]:
        return {id_: {"status": "done", "is_passing": False, "why": ""} for id_ in ids}

    def work(self, store: ObjectStore, counts: RunCounts, stopped: threading.Event) -> None:
        while not stopped.is_set():
            try:
                run = self.runs[self.queue.popleft()]
            except IndexError:
                time.sleep(SECONDS)
                continue
            for spec in PIPELINE:
                if run_simulated_stage(store, run.unit.log, spec.name, 0, SECONDS):
                    counts.computed.append(f"{run.unit.log} {spec.name}")
            write_simulated_record(store, run.unit.log)
            self.runs[run.id] = replace(run, state="COMPLETED")


def _run(store: ObjectStore) -> tuple[list[dict[str, Any]], RunCounts]:
    runs = _Runs()
    counts = RunCounts()
    stopped = threading.Event()
    workers = [threading.Thread(target=runs.work, args=(store, counts, stopped)) for _ in range(WORKERS)]
    for worker in workers:
        worker.start()
    units = [WorkUnit(f"log-{number}") for number in range(LOGS)]
    rows = Supervisor(units, runs, SupervisionLimits(in_flight=4, poll_s=0.01)).run()
    stopped.set()
    for worker in workers:
        worker.join()
    return rows, counts


def _sample(time_s: float, prefect_cpu_s: float) -> LoadSample:
    cpu = {"prefect": prefect_cpu_s, "postgres": 0.1 * prefect_cpu_s, "workers-0": 0.0, "parent": 0.0}
    return LoadSample(time_s, cpu, dict.fromkeys(cpu, 100.0), idle_s=time_s)


def _cluster_run(rows: list[dict[str, Any]], counts: RunCounts, meter: RequestMeter, **changes: Any) -> ClusterRun:
    process = {**asdict(meter), **asdict(counts), "lags": [0.001], "cpu_s": 1.0, "failed_workers": []}
    run = ClusterRun(
        logs=LOGS,
        workers=WORKERS,
        scale=0.5,
        seconds=read_stage_seconds(),
        outcomes=rows,
        processes=[process],
        parent=RequestMeter(),
        samples=[_sample(100.0, 10.0), _sample(160.0, 40.0)],
        base=(_sample(0.0, 0.0), _sample(10.0, 1.0)),
        idle=(_sample(20.0, 1.0), _sample(30.0, 3.0)),
        database={"task_runs": LOGS * len(PIPELINE), "connections": 15, "inserted": {"log": 12}},
        drain_s=0.0,
    )
    return replace(run, **changes)


def test_a_dataset_loses_no_stage_and_doubles_none(store: ObjectStore, meter: RequestMeter) -> None:
    rows, counts = _run(store)
    row = summarise_cluster(_cluster_run(rows, counts, meter))
    stages = LOGS * len(PIPELINE)
    assert row["logs_done"] == LOGS
    assert row["stages"] == {
        "stages": stages,
        "lost": 0,
        "doubled": 0,
        "computed": stages,
        "computed_twice": 0,
        "refused_commits": 0,
        "run_errors": [],
    }
    assert sum(1 for _ in store.artifacts()) == stages
    # A lease and a manifest for every stage.
    assert row["per_log"]["store_by_call"]["create"] == 2 * len(PIPELINE)
    assert row["per_log"]["store_sent_kb"] > 0


def test_two_workers_on_one_stage_compute_it_once(store: ObjectStore, meter: RequestMeter) -> None:
    found: list[bool] = []
    threads = [
        threading.Thread(target=lambda: found.append(run_simulated_stage(store, "log", "ingest", 0, 0.05)))
        for _ in range(2)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(found) == [False, True]
    assert len(meter.commits) == 1
    assert meter.refused == []


def test_a_missing_and_a_doubled_stage_are_counted() -> None:
    commits = {f"log-0 {spec.name}": 1 for spec in PIPELINE[1:]} | {f"log-0 {PIPELINE[1].name}": 2}
    assert count_artifacts(commits, 1) == {"stages": len(PIPELINE) - 1, "lost": 1, "doubled": 1}


def test_lost_and_doubled_stages_can_be_claimed(store: ObjectStore, meter: RequestMeter) -> None:
    def counted(rows: list[dict[str, Any]], counts: RunCounts, **changes: Any) -> dict[str, float | None]:
        row = summarise_cluster(_cluster_run(rows, counts, meter, **changes))
        claims = {claim.id: claim for claim in scale_claims({"cluster": row})}
        return {name: claims[f"scale.cluster_{name}"].measured for name in ("lost", "doubled")}

    rows, counts = _run(store)
    assert counted(rows, counts) == {"lost": 0.0, "doubled": 0.0}
    # A stage that two workers computed, and whose second manifest the store refused.
    twice = replace(counts, computed=[*counts.computed, counts.computed[0]])
    assert counted(rows, twice)["doubled"] == 1.0
    meter.refused.append(meter.commits[0])
    assert counted(rows, twice)["doubled"] == 2.0
    meter.refused.clear()
    # The last log failed at its last stage: it is not done, and the stage is lost.
    failed = [*rows[:-1], rows[-1] | {"status": "failed"}]
    meter.commits.remove(next(name for name in meter.commits if f"/{rows[-1]['log']}/" in f"/{name}"))
    assert counted(failed, counts)["lost"] == 1.0
    # A dataset that was given up has logs that were still on their way.
    assert counted(failed, counts, is_given_up=True)["lost"] == 0.0


def test_the_numbers_are_those_of_the_samples(meter: RequestMeter) -> None:
    meter.api += [Request(110.0, "POST logs", 0.01), Request(150.0, "POST logs", 0.03), Request(25.0, "GET poll", 0.01)]
    rows = [{"log": f"log-{number}", "status": "done", "attempts": 1} for number in range(LOGS)]
    row = summarise_cluster(_cluster_run(rows, RunCounts(), meter))
    assert row["wall_s"] == 60.0
    assert row["cores"]["prefect"] == 0.5
    assert row["per_log"]["cpu_s"]["prefect"] == 5.0
    assert row["per_log"]["api_by_group"] == {"POST logs": round(2 / LOGS, 3)}
    # One request of three workers within ten seconds.
    assert row["idle"]["requests_per_worker_second"] == round(1 / 10 / WORKERS, 4)
    capacity = row["capacity"]
    # Idle workers use 0.2 - 0.1 of a processor; a log uses what is above that: (0.5 - 0.2) * 60 s / 6.
    assert capacity["prefect_cpu_ms_per_worker_second"] == round(1000 * 0.1 / WORKERS, 3)
    assert capacity["prefect_cpu_s_per_log"] == 3.0
    assert row["stages"]["lost"] == LOGS * len(PIPELINE)


@pytest.mark.parametrize(
    ("cores", "words"),
    [
        ({"prefect": 0.97, "workers-0": 0.3, "machine_idle": 0.5}, "Prefect's server"),
        ({"prefect": 0.97, "workers-0": 0.9, "machine_idle": 0.1}, "simulated workers keep"),
        ({"prefect": 0.6, "workers-0": 0.3, "machine_idle": 0.05}, "no idle processor"),
        ({"prefect": 0.6, "workers-0": 0.3, "machine_idle": 0.9}, "No limit"),
    ],
)
def test_the_first_limit_is_named(cores: dict[str, float], words: str) -> None:
    assert words in find_limit(cores)


@pytest.mark.slow
def test_a_cluster_of_real_servers() -> None:
    row = measure_cluster(LOGS, WORKERS, 0, 0.02)
    assert row["logs_done"] == LOGS
    assert row["stages"]["lost"] == row["stages"]["doubled"] == row["stages"]["computed_twice"] == 0
    assert row["task_runs_recorded"] == LOGS * len(PIPELINE)
    assert row["api_errors"] == 0
    assert row["per_log"]["database"]["xact_commit"] > 0
    assert row["idle"]["requests_per_worker_second"] > 0
