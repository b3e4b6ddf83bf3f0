"""``genre run --json`` where the run is partly done or stopped: one object that says what is done and what is not."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

from tests.faults import small_run

pytestmark = pytest.mark.fault

SHORT_LOG = small_run.LOG.replace("frames=8", "frames=7")
"""With chunks of six frames its last chunk has one frame, which is no source view and another."""
SHORT_CHUNKS = ("--set", "ingest.chunk_frames=6", "--set", "ingest.source_every=2")


def test_a_last_chunk_of_one_frame_is_left_out(tmp_path: Path) -> None:
    """Reports: paiml/aprender#3775, NuGet/Home#11983."""
    words = [SHORT_LOG if word == small_run.LOG else word for word in small_run.arguments(tmp_path / "store")]
    done = small_run.genre(tmp_path, *words, *SHORT_CHUNKS)
    assert done.returncode == 1
    found = json.loads(done.stdout)
    assert (found["status"], found["exit_code"]) == ("partly_done", 1)
    assert [chunk["chunk"] for chunk in found["chunks"]] == [0]
    (entry,) = found["left_out"]
    assert (entry["chunk"], entry["class"]) == (1, "InputError") and "source frames" in entry["message"]
    record = json.loads(Path(found["report"]).with_name("run.json").read_text())
    assert record["left_out"] == found["left_out"]
    # The same for a reader: the table of what is done, what is left out, and the same exit status.
    words.remove("--json")
    again = small_run.genre(tmp_path, *words, *SHORT_CHUNKS)
    assert again.returncode == 1 and "chunk 1 is left out" in again.stdout
    assert again.stderr.splitlines()[-1].startswith("error: 1 of 2 chunks left out")


def test_a_run_that_is_stopped_says_what_is_done(tmp_path: Path) -> None:
    """Report: agentclash/agentclash#425."""
    store = tmp_path / "store"
    process = subprocess.Popen(
        [small_run.GENRE, *small_run.arguments(store)],
        env=small_run.environment(tmp_path),
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        start_new_session=True,
    )
    while not list(store.glob("*/*/0000/effects/*/manifest.json")):
        assert process.poll() is None
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)
    output, _ = process.communicate(timeout=120)
    found = json.loads(output)
    assert process.returncode == found["exit_code"] == 130
    assert found["status"] == "interrupted" and found["run"] is None
    assert {"ingest"} <= {stage["stage"] for stage in found["chunks"][0]["stages"]}
