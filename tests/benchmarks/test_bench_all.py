"""All benchmarks in one go: what they would take, and that one which fails does not end the others."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from flows.cli import bench as command
from flows.cli import bench_all
from flows.cli.main import app
from tests.benchmarks.small_cells import Tiny


@pytest.fixture
def two(bench: Tiny, monkeypatch: pytest.MonkeyPatch) -> Tiny:
    """Two names of one benchmark are all that there are."""
    entry = command._BENCHES[bench.name]
    monkeypatch.setattr(command, "_BENCHES", {"first": entry, "second": entry})
    return bench


def test_a_dry_run_adds_up_what_is_missing(two: Tiny) -> None:
    lines = bench_all.list_benches(["first", "second"], command.load_bench, quick=False, fresh=False)
    assert [line["benchmark"] for line in lines] == ["first", "second"]
    assert all(line["measure"] > 0 and line["cached"] == 0 for line in lines)
    result = CliRunner().invoke(app, ["bench", "all", "--dry-run"])
    assert result.exit_code == 0 and "hours to measure" in result.output


def test_one_that_fails_does_not_end_the_others(two: Tiny, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commands: list[list[str]] = []

    def run(words: list[str], check: bool) -> SimpleNamespace:
        commands.append(words)
        return SimpleNamespace(returncode=3 if "first" in words else 0)

    monkeypatch.setattr(subprocess, "run", run)
    result = CliRunner().invoke(app, ["bench", "all", "--json", str(tmp_path), "--quick"])
    assert result.exit_code == 1 and "ended with an error: first" in result.output
    files = [str(tmp_path / f"{name}.json") for name in ("first", "second")]
    assert [words[3:] for words in commands] == [
        ["bench", name, "--json", file, "--quick"] for name, file in zip(("first", "second"), files, strict=True)
    ]
    assert all(words[0] == sys.executable for words in commands)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("--dry-run", "--only", "x"), "belong to one benchmark"),
        ((), "Add --json FOLDER"),
        (("--json", "no-folder"), "no-folder"),
    ],
)
def test_mistakes_of_all_are_answered_with_a_remedy(two: Tiny, arguments: tuple[str, ...], expected: str) -> None:
    result = CliRunner().invoke(app, ["bench", "all", *arguments])
    assert result.exit_code != 0
    assert expected in result.output + str(result.exception)


def test_a_process_of_its_own_runs_the_command(two: Tiny, tmp_path: Path) -> None:
    # The real thing, with a benchmark that does not exist: the child says so and its status comes back.
    assert bench_all.run_benches(["nothing"], tmp_path, []) == ["nothing"]
