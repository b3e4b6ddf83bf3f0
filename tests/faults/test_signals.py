"""Signals at random moments of a run: no process stays, no temporary file, and the store is sound."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import time
from pathlib import Path

import psutil
import pytest

from storage.local import LocalStore
from tests.faults import small_run

pytestmark = pytest.mark.fault
MOMENTS = 20
# From the first import to the report: a tiny run takes about so long on two cores.
LATEST_S = 14.0
MAX_SECONDS_TO_END = 10


def start(folder: Path, store: Path) -> subprocess.Popen[str]:
    """The tiny run in a session of its own, so that every process of it can be found."""
    return subprocess.Popen(
        [small_run.GENRE, *small_run.arguments(store)],
        env=small_run.environment(folder),
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # A shell that starts the tests in the background lets them ignore signals, which children would inherit.
        preexec_fn=lambda: [signal.signal(n, signal.SIG_DFL) for n in (signal.SIGINT, signal.SIGHUP)],
        start_new_session=True,
    )


def processes_of_session(session: int) -> list[int]:
    found = []
    for process in psutil.process_iter():
        try:
            if os.getsid(process.pid) == session and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process.pid)
        except (ProcessLookupError, psutil.Error):
            continue
    return found


def temporary_files(folder: Path) -> list[Path]:
    names = (".tmp-", ".trash-")
    return [p for p in folder.rglob("*") if p.name.startswith(names) or ".part" in p.name or ".partial" in p.name]


def handles_signals(process: int) -> bool:
    """Whether the command has its handlers already; Python by itself handles Ctrl-C alone."""
    try:
        status = Path(f"/proc/{process}/status").read_text()
    except OSError:
        return False
    (mask,) = [line.split()[1] for line in status.splitlines() if line.startswith("SigCgt:")]
    return bool(int(mask, 16) >> (signal.SIGTERM - 1) & 1)


@pytest.mark.timeout(1800)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL], ids=lambda n: n.name)
def test_a_run_leaves_nothing_behind(number: signal.Signals, tmp_path: Path) -> None:
    """Reports: HarperFast/harper#2388, imbue-ai/mngr#1280 (servers that outlive a killed parent)."""
    moments = random.Random(number)
    ended_early = 0
    statuses: list[int] = []
    for k in range(MOMENTS):
        # Every second run goes on with what the one before it left.
        store = tmp_path / f"store{k // 2}"
        process = start(tmp_path, store)
        time.sleep(moments.uniform(0.05, LATEST_S))
        ended_early += process.poll() is None
        is_handled = handles_signals(process.pid)
        process.send_signal(number)
        _, error = process.communicate(timeout=MAX_SECONDS_TO_END)
        assert not processes_of_session(process.pid)
        statuses.append(process.returncode)
        assert "Traceback" not in error or "site-packages" not in error, error
        if number == signal.SIGKILL or not is_handled:
            assert process.returncode in (0, -number, 128 + number), error
        else:
            assert "Traceback" not in error, error
            assert process.returncode in (0, 128 + number), error
        assert all(damage is None for _, damage in LocalStore(store).verify_all())
    assert ended_early >= MOMENTS // 2
    if number != signal.SIGKILL:
        assert statuses.count(128 + number) >= MOMENTS // 4, statuses
    for k in range(0, MOMENTS // 2, 4):
        store = tmp_path / f"store{k}"
        small_run.run_to_the_end(tmp_path, store)
        assert not temporary_files(store)
        assert all(damage is None for _, damage in LocalStore(store).verify_all())


def test_no_hangup_lets_a_run_go_on(tmp_path: Path) -> None:
    """What ``nohup genre run …`` asks for."""
    command = ["nohup", small_run.GENRE, *small_run.arguments(tmp_path / "store")]
    process = subprocess.Popen(command, env=small_run.environment(tmp_path), cwd=tmp_path, stdout=subprocess.DEVNULL)
    time.sleep(4)
    process.send_signal(signal.SIGHUP)
    assert process.wait(300) == 0
