"""Every command ends with a documented exit status, one line for an error and, with ``--json``, one object."""

from __future__ import annotations

import json
import os
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from flows.cli import outcome
from flows.cli.main import app
from flows.error_record import record_error
from flows.paper_tables import flow as paper_flow
from genre_tasks.errors import InputError
from tests.flows.command_line import ROOT, faulty, genre

STREET = "synthetic:street?seed=900&frames=8&cameras=1&width=64&height=36&lidar_beams=16&lidar_azimuths=100"


def parse(text: str | bytes) -> dict[str, Any]:
    """The one object on stdout."""
    (line,) = text.splitlines()
    found: dict[str, Any] = json.loads(line, parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))
    return found


@pytest.mark.parametrize(
    ("words", "kind"),
    [
        (("run",), "UsageError"),
        (("run", "synthetic:street", "--bogus"), "UsageError"),
        (("run", "nothing"), "InputError"),
        (("check", "pandaset:/nothing/here"), "InputError"),
        (("check", "synthetic:nothing"), "ConfigError"),
        (("run", "synthetic:street", "--set", "gnet.nothing=1"), "ConfigError"),
        (("run", "synthetic:street", "--budget", "nan"), "ConfigError"),
    ],
)
def test_what_is_refused_is_one_line_and_one_object(tmp_path: Path, words: tuple[str, ...], kind: str) -> None:
    """Reports: microsoft/winappCli#719, RakuenSoftware/aimee#2061."""
    done = genre(tmp_path, *words, "--json")
    assert done.returncode == 2
    assert done.stderr.startswith(b"error: ") and done.stderr.count(b"\n") == 1
    found = parse(done.stdout)
    assert (found["status"], found["exit_code"], found["error"]["class"]) == ("refused", 2, kind)
    assert found["error"]["message"] and found["error"]["remedy"]
    if words == ("run", "nothing"):
        # The same fields as after a run that has come to its end.
        assert {"log", "preset", "store", "run", "report", "chunks", "left_out"} < set(found)
    plain = genre(tmp_path, *words)
    assert (plain.returncode, plain.stdout, plain.stderr) == (2, b"", done.stderr)


def test_a_fault_is_one_line_and_its_traceback_a_file(tmp_path: Path) -> None:
    """Reports: certbot/certbot#544, canonical/ubuntu-pro-client#643."""
    done = faulty(tmp_path, "[][3]", "--json")
    assert done.returncode == 70
    assert done.stderr.startswith("error: a fault of ours: IndexError: list index out of range")
    assert done.stderr.count("\n") == 1 and "please report it" in done.stderr
    found = parse(done.stdout)
    assert (found["status"], found["exit_code"]) == ("failed", 70)
    log = Path(found["error"]["log_file"])
    assert log.parent == tmp_path / "state" / "genre" / "faults" and str(log) in done.stderr
    assert "Traceback" in log.read_text() and "IndexError" in log.read_text()
    shown = faulty(tmp_path, "[][3]", "--debug")
    assert shown.returncode == 70 and "Traceback" in shown.stderr


def test_the_log_of_a_fault_goes_where_the_user_may_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Report: none found; case 12 of the list of odd logs."""
    # A file in the folder's place cannot be written into by anybody, not even by the superuser.
    (tmp_path / "state").touch()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    done = faulty(tmp_path, "[][3]")
    (log,) = (tmp_path / "home" / ".local" / "state" / "genre" / "faults").iterdir()
    assert done.returncode == 70 and str(log) in done.stderr


@pytest.mark.parametrize(
    ("statement", "code", "text"),
    [
        ("raise OSError(28, 'No space left on device', '/data/x')", 1, "disk is full"),
        ("raise PermissionError(13, 'Permission denied', '/data/x')", 2, "Not permitted (EACCES) (file /data/x)"),
        ("raise NotADirectoryError(20, 'Not a directory', '/data/x')", 2, "ENOTDIR"),
        ("raise MemoryError", 1, "not enough memory"),
        ('raise RuntimeError("DefaultCPUAllocator: can\'t allocate memory: 9 bytes")', 1, "not enough memory"),
        ('raise ImportError("libtorch.so: failed to map segment from shared object")', 1, "not enough memory"),
        ("raise KeyboardInterrupt", 130, "stopped"),
        ("raise EOFError('Ran out of input')", 70, "a fault of ours: EOFError"),
        ("raise BaseExceptionGroup('tasks', [ValueError('odd')])", 70, "a fault of ours: ValueError: odd"),
        ("faulty()", 70, "a fault of ours: RecursionError"),
        ("raise ValueError('two\\nlines\\x1b[2K')", 70, r"two lines\x1b[2K"),
        ("sys.exit(143)", 143, ""),
        ("raise typer.Exit(1)", 1, ""),
    ],
)
def test_every_error_is_translated(tmp_path: Path, statement: str, code: int, text: str) -> None:
    """Report: bradmw in certbot/certbot#562: every other error is suppressed, and the log named."""
    done = faulty(tmp_path, statement, "--json")
    assert done.returncode == code and text in done.stderr, done.stderr
    assert done.stderr.count("\n") == bool(text) and "Traceback" not in done.stderr
    found = parse(done.stdout)
    assert found["exit_code"] == code
    status = {1: "failed", 2: "refused", 70: "failed", 130: "interrupted", 143: "interrupted"}[code]
    assert found["status"] == status


def test_an_error_in_a_thread_is_no_traceback(tmp_path: Path) -> None:
    """Report: none found; case 11 of the list of odd logs."""
    statement = "import threading; thread = threading.Thread(target=lambda: 1 / 0); thread.start(); thread.join()"
    done = faulty(tmp_path, statement)
    assert (done.returncode, done.stderr) == (0, "")
    (log,) = (tmp_path / "state" / "genre" / "faults").iterdir()
    assert "ZeroDivisionError" in log.read_text()


def test_what_is_done_is_in_the_object_of_a_command_that_was_stopped(capsys: pytest.CaptureFixture[str]) -> None:
    """Report: paiml/aprender#3775."""
    outcome.start_outcome(as_json=True)
    outcome.add_facts(log="a log", chunks=[], left_out=[])
    outcome.add_stage(0, "ingest", "5f41", cached=True)
    outcome.print_unfinished("interrupted", 130)
    # A signal may come more than once.
    outcome.print_unfinished("interrupted", 130)
    found = parse(capsys.readouterr().out)
    assert found["chunks"] == [{"chunk": 0, "stages": [{"stage": "ingest", "key": "5f41", "cached": True}]}]
    assert (found["status"], found["error"], found["log"]) == ("interrupted", None, "a log")


@pytest.mark.parametrize("words", [["store", "copy", "a", "b"], ["ops", "status"], ["run", "a log"]])
def test_json_is_wanted_of_commands_in_groups_too(words: list[str]) -> None:
    command = get_command(app)
    assert outcome.wants_json(command, [*words, "--json"])
    assert not outcome.wants_json(command, words) and not outcome.wants_json(command, [*words, "--", "--json"])


def test_numbers_that_json_lacks_are_null(capsys: pytest.CaptureFixture[str]) -> None:
    """Report: none found; case 20 of the list of odd logs."""
    outcome.print_outcome("done", {"psnr": float("inf"), "list": [float("nan"), 1.5]})
    found = parse(capsys.readouterr().out)
    assert (found["psnr"], found["list"]) == (None, [None, 1.5])


def test_commands_that_end_well_have_the_same_fields() -> None:
    """Report: bids-standard/legacy-validator#472."""
    checked = CliRunner().invoke(app, ["check", STREET, "--json"])
    found = parse(checked.stdout)
    assert (found["status"], found["error"], found["exit_code"]) == ("done", None, checked.exit_code)
    assert found["verdict"] in ("good", "usable", "unusable")


def test_an_error_is_recorded_with_its_place() -> None:
    """Report: max-sixty/worktrunk#3697."""
    error = InputError("no\nimage", remedy="Copy it.", camera="front", frame=3)
    expected = {"class": "InputError", "message": "no image", "remedy": "Copy it.", "camera": "front", "frame": 3}
    assert record_error(error) == expected


def test_the_command_fails_where_a_method_is_left_out(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for failed, status in (([], 0), (["3DGS on a: memory ran out"], 1)):
        done = {"cells": 2, "failed": failed, "files": ["table4.md"]}
        monkeypatch.setattr(paper_flow, "paper_table", lambda *args, _done=done, **options: _done)
        # Nothing runs, so no server is needed.
        monkeypatch.setattr("flows.cli.terminal.report_on_terminal", nullcontext)
        told = ["table", "4", STREET, "--preset", "demo", "--store", str(tmp_path), "--out", str(tmp_path / "out")]
        ended = CliRunner().invoke(app, told)
        assert ended.exit_code == status and f"{len(failed)} left out" in ended.output, ended.output


def test_a_table_without_any_row_replaces_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paper_flow, "_run_cells", lambda checked: ([], {}))
    monkeypatch.setattr(paper_flow, "write_results", lambda *args: pytest.fail("written"))
    request: Any = SimpleNamespace(number=1, store="store")
    checked: Any = SimpleNamespace(missing={"3DGS": "it is not in the store"})
    with pytest.raises(InputError, match=r"no method of table 1 is left \(3DGS: it is not in the store\)"):
        paper_flow._measure(request, checked)


def test_the_exit_statuses_are_documented() -> None:
    """Report: NuGet/Home#11983."""
    page = (ROOT / "docs" / "reference" / "errors.md").read_text()
    help_text = CliRunner().invoke(app, ["--help"]).output
    for code in (0, 1, 2, 70, 130):
        assert f"| {code} |" in page
        assert f" {code} " in " ".join(help_text.split())
    for status in outcome.EXIT_CODES:
        assert f"`{status}`" in page
    assert os.EX_SOFTWARE == 70
