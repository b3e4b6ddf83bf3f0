"""A dataset on a real server with process workers: a failing log, a killed worker, a killed parent."""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from uuid import UUID

import psutil
import pytest
from prefect.client.orchestration import get_client
from prefect.settings import PREFECT_API_URL, temporary_settings

from flows.dataset.submission import crash_run
from tests.faults import small_run

pytestmark = [pytest.mark.slow, pytest.mark.fault]
PREFECT = str(Path(sys.executable).parent / "prefect")
GOOD = [small_run.LOG, small_run.LOG.replace("seed=900", "seed=902")]


class Cluster:
    """A server's address, and workers that tests may kill with all their processes."""

    def __init__(self, folder: Path, url: str) -> None:
        self.folder = folder
        self.env = small_run.environment(
            folder,
            PREFECT_API_URL=url,
            DO_NOT_TRACK="1",
            PREFECT_WORKER_QUERY_SECONDS="1",
        )
        self.workers: list[subprocess.Popen[bytes]] = []

    def prefect(self, *args: str) -> None:
        done = subprocess.run(
            [PREFECT, *args], env=self.env, cwd=small_run.ROOT, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr

    def start_worker(self, pool: str) -> subprocess.Popen[bytes]:
        log = (self.folder / f"worker-{pool}-{len(self.workers)}.log").open("wb")
        command = [PREFECT, "worker", "start", "--pool", pool]
        worker = subprocess.Popen(command, env=self.env, cwd=small_run.ROOT, stdout=log, stderr=log)
        self.workers.append(worker)
        return worker

    def kill(self, worker: subprocess.Popen[bytes]) -> None:
        with suppress(psutil.NoSuchProcess):
            for child in psutil.Process(worker.pid).children(recursive=True):
                with suppress(psutil.NoSuchProcess):
                    os.kill(child.pid, signal.SIGKILL)
        worker.kill()
        worker.wait()

    def dataset(self, *args: str) -> list[str]:
        sets = [part for setting in small_run.SETTINGS for part in ("--set", setting)]
        common = ["--preset", "demo", *sets, "--store", str(self.folder / "store"), "--json"]
        return [small_run.GENRE, "dataset", *args, *common, "--pool", "logs"]


@contextmanager
def _cluster(folder: Path) -> Iterator[Cluster]:
    with small_run.prefect_server(folder) as url:
        cluster = Cluster(folder, url)
        for pool in ("genre", "logs"):
            cluster.prefect("work-pool", "create", pool, "--type", "process")
        cluster.prefect("--no-prompt", "deploy", "--all")
        try:
            yield cluster
        finally:
            for worker in cluster.workers:
                cluster.kill(worker)


def _wait_for(path: Path, pattern: str, seconds: float) -> None:
    start_s = time.monotonic()
    while not list(path.glob(pattern)):
        assert time.monotonic() - start_s < seconds, f"no {pattern} within {seconds} s"
        time.sleep(0.2)


def _worker_online(cluster: Cluster) -> None:
    """Waits until the command takes the pools for ready."""
    wanted = {"genre", "logs"}
    for _ in range(120):
        online = set()
        for pool in wanted:
            url = f"{cluster.env['PREFECT_API_URL']}/work_pools/{pool}/workers/filter"
            request = urllib.request.Request(url, b"{}", {"Content-Type": "application/json"})
            with urllib.request.urlopen(request, timeout=10) as answer:
                online |= {pool for worker in json.load(answer) if worker["status"] == "ONLINE"}
        if online == wanted:
            return
        time.sleep(0.5)
    raise AssertionError(f"online: {online}")


def test_a_failing_log_does_not_stop_the_others(tmp_path: Path) -> None:
    with _cluster(tmp_path) as cluster:
        refused = subprocess.run(
            cluster.dataset(*GOOD), env=cluster.env, cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert refused.returncode == 2 and "no worker of the work pool 'logs'" in refused.stderr, refused.stderr
        cluster.start_worker("genre")
        cluster.start_worker("logs")
        _worker_online(cluster)
        for _ in range(2):
            done = subprocess.run(
                cluster.dataset("synthetic:nothing", *GOOD, "--follow"),
                env=cluster.env,
                cwd=tmp_path,
                capture_output=True,
                text=True,
                timeout=400,
                check=False,
            )
            assert done.returncode == 1, done.stderr[-3000:]
            rows = json.loads(done.stdout)["logs"]
            assert [row["status"] for row in rows] == ["failed", "done", "done"], rows
            assert "no synthetic log 'nothing'" in rows[0]["why"] and rows[0]["attempts"] == 1
            assert all(row["where"] for row in rows)
        (record,) = (tmp_path / "store").glob("datasets/*/dataset.json")
        assert json.loads(record.read_text())["logs"] == rows


def test_a_worker_killed_with_its_children_costs_no_log(tmp_path: Path) -> None:
    with _cluster(tmp_path) as cluster:
        cluster.start_worker("genre")
        victim = cluster.start_worker("logs")
        _worker_online(cluster)
        log = (tmp_path / "command.log").open("wb")
        command = subprocess.Popen(
            cluster.dataset(*GOOD, "--follow"), env=cluster.env, cwd=tmp_path, stdout=subprocess.PIPE, stderr=log
        )
        _wait_for(tmp_path / "store", "synthetic/*/0000/ingest/*/manifest.json", 120)
        cluster.kill(victim)
        cluster.start_worker("logs")
        printed, _ = command.communicate(timeout=500)
        assert command.returncode == 0, (tmp_path / "command.log").read_text()[-3000:]
        rows = json.loads(printed)["logs"]
    assert [row["status"] for row in rows] == ["done", "done"]
    assert max(row["attempts"] for row in rows) == 2


def test_a_killed_parent_is_resumed_by_the_same_command(tmp_path: Path) -> None:
    """The second parent takes over active child runs; Crashed is what the automation of heartbeats would set."""
    with _cluster(tmp_path) as cluster:
        coordinator = cluster.start_worker("genre")
        cluster.start_worker("logs")
        _worker_online(cluster)
        started = subprocess.run(
            cluster.dataset(*GOOD), env=cluster.env, cwd=tmp_path, capture_output=True, text=True, check=True
        )
        first = json.loads(started.stdout)["flow_run"]
        _wait_for(tmp_path / "store", "synthetic/*/0000/ingest/*/manifest.json", 120)
        cluster.kill(coordinator)
        with temporary_settings({PREFECT_API_URL: cluster.env["PREFECT_API_URL"]}):
            with get_client(sync_client=True) as client:
                crash_run(client, UUID(first))
            cluster.start_worker("genre")
            done = subprocess.run(
                cluster.dataset(*GOOD, "--follow"),
                env=cluster.env,
                cwd=tmp_path,
                capture_output=True,
                text=True,
                timeout=400,
                check=False,
            )
            assert done.returncode == 0, done.stderr[-3000:]
            result = json.loads(done.stdout)
            assert [row["status"] for row in result["logs"]] == ["done", "done"]
            with get_client(sync_client=True) as client:
                runs = client.read_flow_runs(limit=50)
    children = [run for run in runs if any(tag.startswith("genre-log:") for tag in run.tags)]
    # None crashed, and no two runs of one log at a time.
    assert {run.state.type.value for run in children if run.state} == {"COMPLETED"}
    for log in GOOD:
        times = sorted(
            (run.start_time.timestamp(), run.end_time.timestamp())
            for run in children
            if f"genre-log:{log}" in run.tags and run.start_time and run.end_time
        )
        assert times and all(before[1] <= after[0] for before, after in itertools.pairwise(times))
