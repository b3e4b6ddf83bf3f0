"""What workers, orchestration and the store on S3 cost: whole datasets and runs on real services of this machine."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.common.bench import Row
from benchmarks.common.command import run_genre
from benchmarks.common.timing import Quartiles, ratio
from benchmarks.scale.deployment import (
    options_from_settings,
    read_compute_seconds,
    start_deployment,
)
from benchmarks.scale.worker_time import WorkerClock


def measure_throughput(logs: Sequence[str], preset: str, settings: Sequence[str]) -> Row:
    """Runs the same logs with one worker and with two, each into a store of its own.

    Args:
        logs: URIs.
        preset: of the configuration.
        settings: over it.

    Returns:
        ``one_worker_s`` and ``two_workers_s``, the seconds of the whole command, and their ``ratio``; the number of
        ``logs``, the first ``log`` and the ``preset``.
    """
    options = options_from_settings(preset, settings)
    seconds = {}
    with start_deployment(workers=2) as deployment:
        # The faster one first: what the first run warms up makes the ratio smaller, not larger.
        for workers in (2, 1):
            deployment.set_workers(workers)
            store = deployment.folder / f"store-{workers}"
            seconds[workers] = float(deployment.run_dataset(logs, str(store), options)["wall_s"])
            # Sixteen logs would fill a small disk twice.
            shutil.rmtree(store)
    return {
        "logs": len(logs),
        "log": logs[0],
        "preset": preset,
        "one_worker_s": seconds[1],
        "two_workers_s": seconds[2],
        "ratio": seconds[1] / seconds[2],
    }


def measure_orchestration(log: str, preset: str, settings: Sequence[str]) -> Row:
    """Finds what part of a worker's time no stage computes in.

    Args:
        log: URI.
        preset: of the configuration.
        settings: over it.

    Returns:
        ``worker_s``, from the worker's taking the run to the end of its process; ``compute_s``, of all stages, those
        of evaluation included, each of them in ``stages_s``; ``orchestration_s``, the difference; ``share``, what that
        is of the computation; ``log`` and ``preset``.
    """
    options = options_from_settings(preset, settings)
    with start_deployment(workers=1) as deployment:
        store = deployment.folder / "store"
        with WorkerClock(deployment) as clock:
            dataset = deployment.run_dataset([log], str(store), options)["dataset"]
        # A second run would mean that the first one died, and its time would be another one's.
        (worker_s,) = clock.read_seconds(dataset)
        stages_s = read_compute_seconds(store)
    compute_s = sum(stages_s.values())
    orchestration_s = worker_s - compute_s
    return {
        "log": log,
        "preset": preset,
        "worker_s": worker_s,
        "compute_s": compute_s,
        "orchestration_s": orchestration_s,
        "share": orchestration_s / compute_s,
        "stages_s": stages_s,
    }


def measure_cached_logs(logs: Sequence[str], preset: str, settings: Sequence[str], rounds: int) -> Row:
    """Runs logs again whose every stage is in the store.

    Args:
        logs: URIs.
        preset: of the configuration.
        settings: over it.
        rounds: how often.

    Returns:
        ``seconds`` of a worker's time for one log, quartiles over logs and rounds; the first ``log`` and the
        ``preset``.
    """
    options = options_from_settings(preset, settings)
    with start_deployment(workers=1) as deployment:
        store = str(deployment.folder / "store")
        dataset = deployment.run_dataset(logs, store, options)["dataset"]
        # The first runs computed; all later ones find every stage.
        with WorkerClock(deployment) as clock:
            for _ in range(rounds):
                deployment.run_dataset(logs, store, options)
        seconds = clock.read_seconds(dataset)
    return {"log": logs[0], "preset": preset, "seconds": Quartiles.from_values(seconds).as_row()}


def measure_object_store(log: str, preset: str, settings: Sequence[str], rounds: int) -> Row:
    """Runs a log into a store on this machine and into one on an S3 server, in turns.

    Args:
        log: URI.
        preset: of the configuration.
        settings: over it.
        rounds: how often.

    Returns:
        ``local_s`` and ``s3_s``, seconds of the command, and the quartiles of their ``ratio`` round by round; ``log``
        and ``preset``.
    """
    options = options_from_settings(preset, settings)
    seconds: dict[str, list[float]] = {"local": [], "s3": []}
    with start_deployment(workers=0, objects=True) as deployment, tempfile.TemporaryDirectory() as folder:
        env = deployment.env | {"GENRE_CACHE_DIR": f"{folder}/cache"}
        for number in range(rounds + 1):
            # Every second round the other way round, so that neither always runs second.
            for name in ("local", "s3") if number % 2 else ("s3", "local"):
                store = f"{folder}/store-{number}" if name == "local" else f"s3://genre/store-{number}"
                start_s = time.perf_counter()
                run_genre(log, Path(folder) / "prefect", *options, "--store", store, environment=env)
                seconds[name].append(time.perf_counter() - start_s)
    # The first round warms the caches of files, and makes Prefect's database.
    local, objects = seconds["local"][1:], seconds["s3"][1:]
    return {
        "log": log,
        "preset": preset,
        "local_s": Quartiles.from_values(local).as_row(),
        "s3_s": Quartiles.from_values(objects).as_row(),
        "ratio": ratio(objects, local).as_row(),
    }
