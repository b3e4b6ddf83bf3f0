"""Ctrl-C in a training at a terminal: the signal reaches the whole process group, Prefect's own server too."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

from tests.faults import tiny

pytestmark = pytest.mark.fault


def test_ctrl_c_ends_at_once_and_keeps_what_is_made(tmp_path: Path) -> None:
    command = [tiny.GENRE, "train", "scenes", "--folder", "training"]
    store = tmp_path / "training" / "store"

    def start() -> subprocess.Popen[str]:
        return subprocess.Popen(
            command, env=tiny.environment(tmp_path), cwd=tmp_path, stderr=subprocess.PIPE, text=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL), start_new_session=True,
        )  # fmt: skip

    made: list[set[Path]] = []
    for stage in ("ingest", "truth"):
        process = start()
        while not list(store.rglob(f"{stage}/*/manifest.json")):
            assert process.poll() is None
            time.sleep(0.05)
        os.killpg(process.pid, signal.SIGINT)
        began = time.monotonic()
        _, error = process.communicate(timeout=120)
        assert process.returncode == 130 and time.monotonic() - began < 60
        assert "Traceback" not in error and "run the same command again" in error
        made.append(set(store.rglob("manifest.json")))
    assert made[0] < made[1]
