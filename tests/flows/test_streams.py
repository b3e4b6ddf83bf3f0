"""Encodings, pipes, closed and full streams, narrow terminals: none of them ends a command in an odd way."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import termios
from pathlib import Path

import pytest

from flows.cli.streams import FALLBACK_WIDTH, terminal_width
from tests.flows.command_line import GENRE, environment, genre, shell

LIVE_LINES = """
import time
from flows.cli.terminal import TerminalReporter
with TerminalReporter("chunk 0  a stage of a long name") as reporter:
    for k in range(3):
        time.sleep(0.25)
        reporter.progress(k, 10, "a note that goes on and on and on")
"""


def run_in_terminal(command: list[str], columns: int, folder: Path, **more: str) -> str:
    """What a command writes to a terminal of so many columns."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    env = environment(**more)
    process = subprocess.Popen(command, cwd=folder, env=env, stdin=theirs, stdout=theirs, stderr=theirs)
    os.close(theirs)
    written = b""
    try:
        while block := os.read(ours, 65536):
            written += block
    except OSError:
        # So the kernel says that the other side is closed.
        pass
    os.close(ours)
    assert process.wait(60) == 0
    return written.decode()


@pytest.mark.parametrize("encoding", ["ascii", "ascii:strict", "latin-1", "cp1252"])
def test_characters_that_the_encoding_lacks_are_replaced(tmp_path: Path, encoding: str) -> None:
    """Reports: Textualize/rich#68, Textualize/rich#826."""
    done = genre(tmp_path, "show", "config", PYTHONIOENCODING=encoding)
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.isascii() and b"gnet" in done.stdout
    refused = genre(tmp_path, "check", "pandaset:löss→", PYTHONIOENCODING=encoding)
    assert refused.returncode == 2 and refused.stderr.count(b"\n") == 1
    assert b"ss?" in refused.stderr and b"Traceback" not in refused.stderr
    assert "ö→" not in refused.stderr.decode(encoding.partition(":")[0])


def test_json_needs_no_encoding(tmp_path: Path) -> None:
    """Report: VikParuchuri/tabled#11."""
    import json

    done = genre(tmp_path, "check", "pandaset:löss→", "--json", PYTHONIOENCODING="ascii")
    assert json.loads(done.stdout)["uri"] == "pandaset:löss→"


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_reader_that_leaves_is_no_error(tmp_path: Path, unbuffered: str) -> None:
    """Reports: Backblaze/B2_Command_Line_Tool#1071, getslash/slash#967."""
    # Much more than a pipe holds, so that the reader is gone before the last of it.
    more = {"PYTHONUNBUFFERED": unbuffered, "COLUMNS": "4000"}
    done = shell(tmp_path, "for k in 1 2 3 4; do $GENRE show config --preset small || exit; done | head -1", **more)
    assert (done.returncode, done.stderr) == (0, "") and done.stdout.startswith("preset small")


def test_work_goes_on_when_nobody_reads_its_progress(tmp_path: Path) -> None:
    """Report: python/cpython#90650."""
    script = f"""
import sys
from flows.cli.streams import prepare_streams
prepare_streams()
for k in range(20000):
    sys.stderr.write("a line of progress\\n")
open("{tmp_path}/work", "w").write("done")
"""
    command = [sys.executable, "-c", script]
    process = subprocess.Popen(command, cwd=tmp_path, env=environment(), stderr=subprocess.PIPE)
    assert process.stderr is not None
    process.stderr.close()
    assert process.wait(60) == 0 and (tmp_path / "work").read_text() == "done"


def test_a_full_disk_behind_stdout_is_one_line(tmp_path: Path) -> None:
    """Report: notatallshaw/nab#990."""
    done = shell(tmp_path, "$GENRE show config > /dev/full")
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1 and "stdout (ENOSPC" in done.stderr
    silent = shell(tmp_path, "$GENRE show config 2> /dev/full")
    assert silent.returncode == 0 and "gnet" in silent.stdout


def test_closed_streams_take_everything(tmp_path: Path) -> None:
    """Reports: pixelb/crudini#82, streamlink/streamlink#6197."""
    assert shell(tmp_path, "$GENRE show config <&- >&- 2>&-").returncode == 0
    assert shell(tmp_path, "$GENRE check nothing <&- >&- 2>&-").returncode == 2
    done = shell(tmp_path, "$GENRE check nothing >&-")
    assert done.returncode == 2 and done.stderr.startswith("error: ")


@pytest.mark.parametrize("columns", [20, 40])
def test_a_narrow_terminal_shows_everything(tmp_path: Path, columns: int) -> None:
    """Report: ibis-project/ibis#4554."""
    text = run_in_terminal([*GENRE, "show", "config", "--preset", "small"], columns, tmp_path)
    plain = re.sub(r"\x1b\[[0-9;]*m", "", text)
    assert max(len(line) for line in plain.splitlines()) <= columns
    assert "…" not in plain
    assert "lr_before_refine" in re.sub(r"[\s│]", "", plain)


def test_the_live_line_fits_the_terminal(tmp_path: Path) -> None:
    """Report: none found; case 26 of the list of odd logs."""
    text = run_in_terminal([sys.executable, "-c", LIVE_LINES], 40, tmp_path, TERM="xterm")
    lines = re.split(r"\r\x1b\[2K", text)
    assert len(lines) > 3 and max(len(line.rstrip("\r\n")) for line in lines) < 40
    assert any(line.endswith("...") for line in lines)
    # A terminal that obeys no escape sequences gets lines of their own.
    assert "\x1b" not in run_in_terminal([sys.executable, "-c", LIVE_LINES], 40, tmp_path, TERM="dumb")


def test_the_stated_width_counts_without_a_terminal(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Report: none found; case 26 of the list of odd logs."""
    with (tmp_path / "file").open("w") as file:
        for stated, width in (("40", 40), ("7", 20), ("0", FALLBACK_WIDTH), ("wide", FALLBACK_WIDTH)):
            monkeypatch.setenv("COLUMNS", stated)
            assert terminal_width(file) == width
