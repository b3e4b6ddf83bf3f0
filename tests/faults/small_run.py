"""The smallest run that goes through every stage, and the environment to start it in."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from flows.pipeline.stage_runner import ArtifactRef, Job, run_stage

ROOT = Path(__file__).resolve().parents[2]
GENRE = str(Path(sys.executable).parent / "genre")
LOG = "synthetic:street?seed=900&frames=8&cameras=1&width=64&height=36&lidar_beams=32&lidar_azimuths=300"
SETTINGS = (
    "ingest.width_px=64",
    "ingest.height_px=36",
    "initial.max_points=600",
    "initial.distant_count=100",
    "gnet.iterations=2",
    "gnet.snapshots=1",
    "enet.iterations=2",
    "enet.snapshots=0",
    "novel_views.lidar_max_points=600",
    "evaluate.shifts_m=[3]",
    "evaluate.bootstrap=5",
)


def arguments(store: Path, *more: str) -> list[str]:
    """``run LOG --preset demo --set … --store … --json``."""
    sets = [part for setting in SETTINGS for part in ("--set", setting)]
    return ["run", LOG, "--preset", "demo", *sets, "--store", str(store), "--json", *more]


def environment(folder: Path, **more: str) -> dict[str, str]:
    """A Prefect home of its own, one thread, nothing of the caller's Prefect settings."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith("PREFECT_")}
    return kept | {"PREFECT_HOME": str(folder / "prefect"), "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)} | more


def genre(folder: Path, *args: str, **env: str) -> subprocess.CompletedProcess[str]:
    """``genre …`` to its end."""
    return subprocess.run(
        [GENRE, *args],
        env=environment(folder, **env),
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )


def run_to_the_end(folder: Path, store: Path, *more: str, **env: str) -> dict[str, Any]:
    """The tiny run; the object that ``--json`` prints."""
    done = genre(folder, *arguments(store, *more), **env)
    assert done.returncode == 0, done.stderr[-3000:]
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def payloads(store: Path) -> dict[str, str]:
    """``log/chunk/stage`` → payload digest, from the manifests."""
    found = {}
    for path in store.glob("*/*/*/**/manifest.json"):
        if any(part.startswith(".") for part in path.relative_to(store).parts):
            continue
        manifest = json.loads(path.read_text())
        found[f"{manifest['log']}/{manifest['chunk']}/{manifest['stage']}"] = manifest["payload_digest"]
    return found


@contextlib.contextmanager
def prefect_server(folder: Path) -> Iterator[str]:
    """A Prefect server on a free port; its API's URL."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    log = (folder / "server.log").open("w")
    env = environment(folder, PREFECT_SERVER_ANALYTICS_ENABLED="false", DO_NOT_TRACK="1")
    command = [str(Path(sys.executable).parent / "prefect"), "server", "start", "--port", str(port)]
    process = subprocess.Popen(command, env=env, stdout=log, stderr=log)
    url = f"http://127.0.0.1:{port}/api"
    try:
        for _ in range(240):
            with contextlib.suppress(OSError), urllib.request.urlopen(url + "/health", timeout=2):
                break
            time.sleep(0.25)
        else:
            raise AssertionError((folder / "server.log").read_text()[-2000:])
        yield url
    finally:
        process.terminate()
        process.wait(20)
        log.close()


class Stopped(Exception):
    """As by a kill."""


def stopping(after: int) -> tuple[list[str], Callable[[str, Job, dict[str, ArtifactRef]], ArtifactRef]]:
    """A ``run_stage`` that lists what it computes and raises ``Stopped`` while exactly ``after`` are listed."""
    computed: list[str] = []

    def counted(stage: str, job: Job, inputs: dict[str, ArtifactRef]) -> ArtifactRef:
        if len(computed) == after:
            raise Stopped
        ref = run_stage(stage, job, inputs)
        computed.extend([] if ref.cached else [stage])
        return ref

    return computed, counted
