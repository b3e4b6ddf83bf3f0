"""Ctrl-C in a training or a run at a terminal: the signal reaches the whole process group, Prefect's own server too."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

from tests.faults import small_run

pytestmark = pytest.mark.fault


def started(folder: Path, *command: str) -> subprocess.Popen[str]:
    """``genre COMMAND`` in a process group of its own, as a terminal starts it, with Prefect's own server."""
    return subprocess.Popen(
        [small_run.GENRE, *command],
        env=small_run.environment(folder),
        cwd=folder,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        start_new_session=True,
    )


def made_so_far(store: Path) -> set[str]:
    try:
        return set(small_run.payloads(store))
    except FileNotFoundError:  # a temporary folder took its place meanwhile
        return set()


def assert_it_stops(process: subprocess.Popen[str], store: Path, stage: str) -> None:
    """Sends what Ctrl-C sends, once the stage's artifact is in the store."""
    while not any(name.endswith(f"/{stage}") for name in made_so_far(store)):
        assert process.poll() is None
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)
    began = time.monotonic()
    _, error = process.communicate(timeout=120)
    assert process.returncode == 130 and time.monotonic() - began < 30
    assert "Traceback" not in error and "run the same command again" in error


def test_ctrl_c_ends_at_once_and_keeps_what_is_made(tmp_path: Path) -> None:
    store = tmp_path / "training" / "store"
    made: list[set[str]] = []
    for stage in ("ingest", "truth"):
        process = started(tmp_path, "train", "scenes", "--folder", "training")
        assert_it_stops(process, store, stage)
        made.append(made_so_far(store))
    assert made[0] < made[1]


def test_ctrl_c_in_a_run_ends_at_once_too(tmp_path: Path) -> None:
    store = tmp_path / "store"
    process = started(tmp_path, *small_run.arguments(store))
    assert_it_stops(process, store, "initial")
    again = small_run.run_to_the_end(tmp_path, store)
    served = {s["stage"]: s["cached"] for s in again["chunks"][0]["stages"]}
    assert served["ingest"] and served["initial"] and not all(served.values())
