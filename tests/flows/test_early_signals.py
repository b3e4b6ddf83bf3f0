"""Ctrl-C before the command has imported anything: no traceback, the usual status."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.flows.command_line import environment


@pytest.mark.parametrize("moment_s", [0.1, 0.2, 0.4])
def test_ctrl_c_while_python_imports(tmp_path: Path, moment_s: float) -> None:
    """Report: none found; case 9 of the list of odd logs."""
    # Ready once the handlers are there: before, Python itself starts.
    script = "from flows.cli.entry import *; end_on_signals(); sys.stderr.write('ready\\n'); main()"
    process = subprocess.Popen(
        [sys.executable, "-c", script, "doctor"],
        cwd=tmp_path,
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert process.stderr is not None and process.stderr.readline() == "ready\n"
    time.sleep(moment_s / 4)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=30)
    assert process.returncode == 130 and error == "stopped\n"
