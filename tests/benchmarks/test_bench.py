"""``genre bench``: resumed after an interruption, honest about what fails."""

from __future__ import annotations

import importlib
import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from benchmarks.common import runner
from benchmarks.common.bench import NotMeasuredError
from flows.cli import bench as command
from flows.cli.main import app
from genre_tasks.errors import ArtifactCorruptError, ConfigError
from tests.benchmarks.small_cells import Tiny


def _bench(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["bench", *arguments])


def _stop(name: str) -> None:
    if name == "second":
        raise KeyboardInterrupt


def test_a_failing_claim_is_written_as_failing_and_the_command_succeeds(bench: Tiny) -> None:
    done = _bench("tiny", "--json", "out/result.json")
    assert done.exit_code == 0, done.output
    result = json.loads(Path("out/result.json").read_text())
    assert [(c["id"], c["measured"], c["holds"]) for c in result["claims"]] == [
        ("tiny.first", 3.0, True),
        ("tiny.second", 5.0, False),
    ]
    assert result["rows"] == [{"cell": "first", "number": 3.0}, {"cell": "second", "number": 5.0}]
    lines = done.stderr.splitlines()
    assert [line.split()[:2] for line in lines if "tiny." in line] == [
        ["holds", "tiny.first"],
        ["FAILS", "tiny.second"],
    ]
    assert "| 3.0 | 5.0 |" in done.stdout


def test_a_broken_off_run_goes_on_where_it_stopped(bench: Tiny) -> None:
    bench.meet = _stop
    done = _bench("tiny", "--json", "result.json")
    assert done.exit_code == 130 and "run the same command again" in done.stderr
    assert not Path("result.json").exists()
    bench.meet = lambda name: None
    assert _bench("tiny", "--json", "result.json").exit_code == 0
    assert bench.measured == ["first", "second"]
    assert len(json.loads(Path("result.json").read_text())["rows"]) == 2


def test_what_is_measured_again(bench: Tiny, monkeypatch: pytest.MonkeyPatch) -> None:
    def measured(*arguments: str) -> int:
        before = len(bench.measured)
        assert _bench("tiny", "--json", "result.json", *arguments).exit_code == 0
        return len(bench.measured) - before

    assert [measured(), measured(), measured("--fresh"), measured()] == [2, 0, 2, 0]
    assert [measured("--set", "size=2"), measured("--quick"), measured()] == [2, 2, 0]
    monkeypatch.setattr(runner, "describe_machine", lambda: "another machine")
    assert measured() == 2
    monkeypatch.setattr(runner, "code_digest", lambda module, also: "changed code")
    assert measured() == 2


def test_a_cached_row_says_at_which_commit_it_was_measured(bench: Tiny, monkeypatch: pytest.MonkeyPatch) -> None:
    def rows(commit: str, *arguments: str) -> list[dict[str, object]]:
        monkeypatch.setattr(runner, "git_commit", lambda: commit * 40)
        assert _bench("tiny", "--json", "result.json", *arguments).exit_code == 0
        result = json.loads(Path("result.json").read_text())
        assert result["commit"] == commit * 40
        return [{name: value for name, value in row.items() if name == "commit"} for row in result["rows"]]

    assert rows("a", "--only", "first") == [{}, {}]
    assert rows("b") == [{"commit": "a" * 40}, {}]
    assert rows("c") == [{"commit": "a" * 40}, {"commit": "b" * 40}]
    assert rows("a", "--fresh") == [{}, {}]
    # A file of a version that did not note the commit: nobody knows it.
    cell = next(Path(".genre/bench/tiny").glob("first-*.json"))
    cell.write_text(json.dumps({name: v for name, v in json.loads(cell.read_text()).items() if name != "commit"}))
    assert rows("a") == [{"commit": "unknown"}, {}]


def test_what_cannot_be_measured_says_why_and_is_tried_again(bench: Tiny) -> None:
    def meet(name: str) -> None:
        if name == "second":
            raise NotMeasuredError("needs a second machine")

    bench.meet = meet
    done = _bench("tiny", "--json", "result.json")
    assert done.exit_code == 0 and "needs a second machine" in done.stderr
    result = json.loads(Path("result.json").read_text())
    assert result["rows"][1] == {"cell": "second", "not_measured": "needs a second machine"}
    assert (result["claims"][1]["measured"], result["claims"][1]["holds"]) == (None, False)
    bench.meet = lambda name: None
    _bench("tiny", "--json", "result.json")
    assert bench.measured == ["first", "second"]


def test_a_quick_run_leaves_out_what_would_not_end_in_time(bench: Tiny) -> None:
    plans = runner.find_cached_rows(bench, bench.options, quick=True, fresh=False)
    rows = runner.measure_cells(plans, lambda text: None, limit_s=59.0)
    assert bench.measured == [] and rows
    assert all("would not end" in row["not_measured"] for row in rows.values())


def test_a_dry_run_measures_nothing(bench: Tiny) -> None:
    first = _bench("tiny", "--dry-run")
    assert first.exit_code == 0 and bench.measured == []
    assert "second" in first.stdout and "about 120 s" in first.stdout
    bench.meet = _stop
    _bench("tiny", "--json", "result.json")
    assert "about 60 s" in _bench("tiny", "--dry-run").stdout


def test_a_damaged_cell_is_an_error_that_names_it(bench: Tiny) -> None:
    _bench("tiny", "--json", "result.json")
    cell = next(Path(".genre/bench/tiny").glob("first-*.json"))
    cell.write_text("{")
    error = _bench("tiny", "--json", "result.json").exception
    assert isinstance(error, ArtifactCorruptError) and error.file is not None and "first-" in error.file


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("rastr", "--dry-run"), "Did you mean 'raster'"),
        (("tiny",), "Add --json FILE"),
        (("tiny", "--dry-run", "--set", "sise=3"), "Known: size=1"),
    ],
)
def test_mistakes_are_answered_with_a_remedy(bench: Tiny, arguments: tuple[str, ...], expected: str) -> None:
    error = _bench(*arguments).exception
    assert isinstance(error, ConfigError) and expected in str(error)


def test_a_benchmark_that_cannot_be_imported_says_how(bench: Tiny) -> None:
    command.register_bench("absent", "tests.benchmarks.nowhere:BENCH")
    with pytest.raises(ConfigError, match="pip install"):
        command.load_bench("absent")
    with pytest.raises(ValueError, match="exists already"):
        command.register_bench("absent", "another:BENCH")


@pytest.mark.parametrize("name", ["pipeline", "raster"])
def test_quick_runs_are_predicted_to_end_in_time(name: str) -> None:
    known = command.load_bench(name)
    quick, full = (known.cells(known.options, quick=q) for q in (True, False))
    assert 0 < sum(cell.seconds for cell in quick) <= runner.QUICK_S
    assert sum(cell.seconds for cell in quick) < sum(cell.seconds for cell in full)
    assert len({cell.name for cell in full}) == len(full)
    for module in known.code:
        importlib.import_module(module)


def test_cells_without_the_text_in_their_names_are_left_out_and_not_cached(bench: Tiny) -> None:
    done = _bench("tiny", "--json", "result.json", "--only", "second")
    assert done.exit_code == 0 and bench.measured == ["second"]
    rows = json.loads(Path("result.json").read_text())["rows"]
    assert "left out" in rows[0]["not_measured"] and rows[1] == {"cell": "second", "number": 5.0}
    assert "about 60 s" in _bench("tiny", "--dry-run", "--only", "first").stdout
    _bench("tiny", "--json", "result.json")
    assert bench.measured == ["second", "first"]


def test_the_file_notes_options_that_are_not_the_defaults(bench: Tiny) -> None:
    _bench("tiny", "--json", "result.json", "--set", "size=1")
    assert json.loads(Path("result.json").read_text())["options"] == {}
    _bench("tiny", "--json", "result.json", "--set", "size=2")
    assert json.loads(Path("result.json").read_text())["options"] == {"size": "2"}
