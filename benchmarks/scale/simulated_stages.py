"""The stages of a log as sleeps, with everything that they do with the store."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Mapping
from functools import cache
from importlib import resources
from typing import Any

import numpy as np

from flows.pipeline.definition import PIPELINE
from genre_tasks.metrics.results import Evaluation, Metric
from storage.address import Address
from storage.store import Provenance, Store

DATASET = "simulated"
"""Dataset of the artifacts."""
_METRICS = 12
_TABLES = 3


def read_stage_seconds() -> dict[str, float]:
    """Reads how long the stages of a log of the preset ``small`` were measured to take.

    Returns:
        Seconds by the stage's name, in the order of the pipeline.
    """
    seconds = _read_measured()["seconds"]
    return {spec.name: float(seconds[spec.name]) for spec in PIPELINE}


@cache
def _read_measured() -> dict[str, Any]:
    text = (resources.files(__package__) / "stage_seconds.json").read_text(encoding="utf-8")
    measured: dict[str, Any] = json.loads(text)
    return measured


def locate(log: str, stage: str, seed: int) -> Address:
    """Builds the address of a stage's artifact.

    Args:
        log: the log's name.
        stage: the stage's name.
        seed: another seed gives other keys.

    Returns:
        The address.

    >>> locate("log-0001", "gnet", 0).stage
    'gnet'
    """
    key = hashlib.sha256(f"{seed} {log} {stage}".encode()).hexdigest()[:32]
    return Address(DATASET, log, 0, stage, key)


def run_simulated_stage(store: Store, log: str, stage: str, seed: int, seconds: float) -> bool:
    """Does what :func:`flows.pipeline.stage_runner.run_stage` does with the store, and sleeps where that computes.

    Args:
        store: the store.
        log: the log's name.
        stage: the stage's name.
        seed: of the keys.
        seconds: how long the stage sleeps.

    Returns:
        Whether the stage was computed here, and not found.
    """
    address = locate(log, stage, seed)
    if _is_sound(store, address):
        return False
    with store.lease(address):
        if _is_sound(store, address):
            return False
        inputs = next(spec.inputs for spec in PIPELINE if spec.name == stage)
        for name in inputs:
            artifact = store.find(locate(log, name, seed))
            # A stage is only started after those that it reads.
            assert artifact is not None
            store.read(artifact)
        time.sleep(seconds)
        keys = {name: locate(log, name, seed).key for name in inputs}
        store.commit(address, "evaluation", _make_value(log, stage), Provenance(inputs=keys, seconds=seconds))
    return True


def _is_sound(store: Store, address: Address) -> bool:
    artifact = store.find(address)
    if artifact is None:
        return False
    store.verify(artifact)
    return True


def _make_value(log: str, stage: str) -> Evaluation:
    # Numbers that depend on the log: no two payloads are the same bytes.
    digest = hashlib.sha256(f"{log} {stage}".encode()).digest()
    metrics = tuple(Metric(f"interpolation/{k}", digest[k] / 255, 10) for k in range(_METRICS))
    # As many files as the stage's artifact has, but small ones: the store's requests are the same, its bytes are not.
    count = max(0, int(_read_measured()["files"][stage]) - _TABLES)
    pictures = {f"view-{k:02d}": np.full((4, 4, 3), digest[k % 32], np.uint8) for k in range(count)}
    return Evaluation(stage, metrics, pictures=pictures)


def write_simulated_record(store: Store, log: str) -> None:
    """Writes a run's record into the store, as the end of a run does.

    Args:
        store: the store.
        log: the log's name.
    """
    name = f"runs/{hashlib.sha256(log.encode()).hexdigest()[:12]}"
    folder = store.records.pull(name)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "run.json").write_text(json.dumps({"log": log, "status": "done"}), encoding="utf-8")
    (folder / "report.html").write_text(f"<title>{log}</title>", encoding="utf-8")
    store.records.push(name)


def count_artifacts(commits: Mapping[str, int], logs: int) -> dict[str, int]:
    """Compares the artifacts that were committed with those that a dataset must have.

    Args:
        commits: how often each manifest was put where there was none; the store refuses a second one.
        logs: whose artifacts have to be there.

    Returns:
        ``stages``; ``lost``, those that were never put; ``doubled``, those that were put more than once.

    >>> count_artifacts({"a": 2, "b": 1}, 1)["doubled"]
    1
    """
    expected = logs * len(PIPELINE)
    doubled = sum(count - 1 for count in commits.values())
    return {"stages": len(commits), "lost": expected - len(commits), "doubled": doubled}
