"""``prefect deployment run`` from prefect.yaml, with a server and a worker, as docker-compose.yml starts them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.faults import tiny

pytestmark = pytest.mark.slow
PREFECT = str(Path(sys.executable).parent / "prefect")


def test_a_deployment_runs_on_a_worker(tmp_path: Path) -> None:
    store = tmp_path / "store"
    with tiny.prefect_server(tmp_path) as url:
        env = tiny.environment(tmp_path, PREFECT_API_URL=url, DO_NOT_TRACK="1")

        def prefect(*args: str) -> str:
            done = subprocess.run([PREFECT, *args], env=env, cwd=tiny.ROOT, capture_output=True, text=True, check=False)
            assert done.returncode == 0, done.stdout + done.stderr
            return done.stdout

        prefect("work-pool", "create", "genre", "--type", "process")
        prefect("--no-prompt", "deploy", "--all")
        log = (tmp_path / "worker.log").open("w")
        worker = subprocess.Popen(
            [PREFECT, "worker", "start", "--pool", "genre"], env=env, cwd=tiny.ROOT, stdout=log, stderr=log
        )
        try:
            values = {"logs": [tiny.LOG], "preset": "demo", "store": str(store), "settings": list(tiny.SETTINGS)}
            params = [part for k, v in values.items() for part in ("--param", f"{k}={json.dumps(v)}")]
            # Watched to its end: a worker that is told to stop as a run ends may wait for ever.
            done = prefect(
                "deployment", "run", "reconstruct-dataset/dataset", *params, "--watch", "--watch-timeout", "400"
            )
            assert "Completed" in done, done + (tmp_path / "worker.log").read_text()[-3000:]
        finally:
            worker.terminate()
            try:
                worker.wait(60)
            except subprocess.TimeoutExpired:
                worker.kill()
                raise
            log.close()
    (record,) = store.glob("runs/*/run.json")
    stages = json.loads(record.read_text())["chunks"][0]["stages"]
    assert {s["stage"] for s in stages} >= {"ingest", "gnet", "fnet", "enet", "evaluate/enet"}
