"""``prefect deployment run`` from prefect.yaml, with a server and a worker, as docker-compose.yml starts them."""

from __future__ import annotations

import json
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from tests.faults import small_run

pytestmark = pytest.mark.slow
PREFECT = str(Path(sys.executable).parent / "prefect")


def test_a_deployment_runs_on_a_worker(tmp_path: Path) -> None:
    store = tmp_path / "store"
    with small_run.prefect_server(tmp_path) as url:
        env = small_run.environment(tmp_path, PREFECT_API_URL=url, DO_NOT_TRACK="1")

        log = tmp_path / "worker.log"

        def prefect(*args: str) -> str:
            done = subprocess.run(
                [PREFECT, *args], env=env, cwd=small_run.ROOT, capture_output=True, text=True, check=False
            )
            told = log.read_text()[-3000:] if log.exists() else ""
            assert done.returncode == 0, done.stdout + done.stderr + told
            return done.stdout

        prefect("work-pool", "create", "genre", "--type", "process")
        prefect("--no-prompt", "deploy", "--all")
        with log.open("w") as out:
            worker = subprocess.Popen(
                [PREFECT, "worker", "start", "--pool", "genre"], env=env, cwd=small_run.ROOT, stdout=out, stderr=out
            )
        try:
            values = {
                "logs": [small_run.LOG],
                "preset": "demo",
                "store": str(store),
                "settings": list(small_run.SETTINGS),
            }
            params = [part for k, v in values.items() for part in ("--param", f"{k}={json.dumps(v)}")]
            watch = ("--watch", "--watch-timeout", "400")
            done = prefect("deployment", "run", "reconstruct-dataset/dataset", *params, *watch)
            assert "Completed" in done, done
            worker.terminate()
            # One that is told to stop as a run's process ends may wait for ever: it is killed then.
            with suppress(subprocess.TimeoutExpired):
                worker.wait(20)
        finally:
            worker.kill()
            worker.wait()
    (record,) = store.glob("runs/*/run.json")
    stages = json.loads(record.read_text())["chunks"][0]["stages"]
    assert {s["stage"] for s in stages} >= {"ingest", "gnet", "fnet", "enet", "evaluate/enet"}
