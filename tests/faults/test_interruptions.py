"""Two workers on one job, and Ctrl-C: nothing lost, nothing half-written, no traceback."""

from __future__ import annotations

import signal
import subprocess
import time
from pathlib import Path

import pytest

from flows.pipeline.definition import PIPELINE
from tests.faults import small_run

pytestmark = pytest.mark.fault


def test_two_workers_on_one_job_agree(tmp_path: Path) -> None:
    store = tmp_path / "store"
    with small_run.prefect_server(tmp_path) as url:
        env = small_run.environment(tmp_path, PREFECT_API_URL=url)
        workers = [
            subprocess.Popen(
                [small_run.GENRE, *small_run.arguments(store)], env=env, cwd=tmp_path, stderr=subprocess.PIPE
            )
            for _ in range(2)
        ]
        errors = [worker.communicate(timeout=600)[1] for worker in workers]
        assert [worker.returncode for worker in workers] == [0, 0], errors
        quiet = tmp_path / "quiet"
        small_run.run_to_the_end(tmp_path, quiet, PREFECT_API_URL=url)
    assert small_run.payloads(store) == small_run.payloads(quiet)
    assert len(list(store.rglob("manifest.json"))) == len(PIPELINE)
    assert not list(store.rglob(".tmp-*"))


def test_ctrl_c_ends_cleanly_and_the_run_goes_on(tmp_path: Path) -> None:
    store = tmp_path / "store"
    with small_run.prefect_server(tmp_path) as url:
        env = small_run.environment(tmp_path, PREFECT_API_URL=url)
        command = [small_run.GENRE, *small_run.arguments(store)]
        # a shell that starts the tests in the background lets them ignore SIGINT, which children would inherit
        process = subprocess.Popen(
            command,
            env=env,
            cwd=tmp_path,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )
        while not list(store.rglob("initial/*/manifest.json")):
            assert process.poll() is None
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=120)
        assert process.returncode == 130
        assert "Traceback" not in error and "run the same command again" in error
        assert not list(store.rglob(".tmp-*"))
        again = small_run.run_to_the_end(tmp_path, store, PREFECT_API_URL=url)
    served = {s["stage"]: s["cached"] for s in again["chunks"][0]["stages"]}
    assert served["ingest"] and served["initial"] and not all(served.values())
