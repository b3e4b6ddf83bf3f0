"""Results measured part by part become one, and each row says where it is from."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks.common import merge
from benchmarks.common.claims import Result, write_json
from flows.cli import bench as command
from genre_tasks.errors import ArtifactCorruptError, ConfigError
from tests.benchmarks.small_cells import Tiny

A, B = "a" * 40, "b" * 40


def _result(machine: str, commit: str, **numbers: float | None) -> Result:
    rows: list[dict[str, Any]] = [
        {"cell": name, "not_measured": "no time"} if n is None else {"cell": name, "number": n}
        for name, n in numbers.items()
    ]
    return Result(machine=machine, commit=commit, rows=rows, claims=[])


def test_the_last_row_of_a_cell_counts_and_claims_are_of_all_rows() -> None:
    found = merge.merge_results(
        Tiny(), [_result("m", A, first=3.0, second=5.0), _result("m", A, second=2.0, third=9.0)]
    )
    assert [(row["cell"], row["number"]) for row in found.rows] == [("first", 3.0), ("second", 2.0), ("third", 9.0)]
    assert [(c.id, c.measured, c.holds) for c in found.claims] == [
        ("tiny.first", 3.0, True),
        ("tiny.second", 2.0, True),
        ("tiny.third", 9.0, False),
    ]


def test_a_row_from_elsewhere_says_its_machine_and_commit_through_two_merges() -> None:
    once = merge.merge_results(Tiny(), [_result("old", A, first=3.0), _result("new", B, second=5.0)])
    assert (once.machine, once.commit) == ("new", B)
    assert once.rows == [
        {"machine": "old", "commit": A, "cell": "first", "number": 3.0},
        {"cell": "second", "number": 5.0},
    ]
    twice = merge.merge_results(Tiny(), [once, _result("old", A, third=1.0)])
    assert twice.rows == [
        {"cell": "first", "number": 3.0},
        {"machine": "new", "commit": B, "cell": "second", "number": 5.0},
        {"cell": "third", "number": 1.0},
    ]


def test_a_cell_that_was_not_measured_leaves_the_one_that_was() -> None:
    found = merge.merge_results(Tiny(), [_result("m", A, first=3.0), _result("m", A, first=None, second=None)])
    assert found.rows == [{"cell": "first", "number": 3.0}, {"cell": "second", "not_measured": "no time"}]


def test_a_cell_that_is_measured_again_comes_behind_those_before_it() -> None:
    results = [_result("m", A, first=3.0, second=5.0), _result("m", A, first=1.0)]
    found = merge.merge_results(Tiny(), results)
    assert [(row["cell"], row["number"]) for row in found.rows] == [("second", 5.0), ("first", 1.0)]


def test_a_row_of_other_options_says_so() -> None:
    small = _result("m", A, first=3.0).model_copy(update={"options": {"size": "2"}})
    once = merge.merge_results(Tiny(), [small, _result("m", A, second=5.0)])
    assert once.options == {}
    assert once.rows == [{"options": {"size": "2"}, "cell": "first", "number": 3.0}, {"cell": "second", "number": 5.0}]
    twice = merge.merge_results(Tiny(), [once, small])
    assert twice.options == {"size": "2"}
    assert twice.rows == [{"options": {}, "cell": "second", "number": 5.0}, {"cell": "first", "number": 3.0}]


def test_options_of_a_file_that_notes_none_can_be_given() -> None:
    older = _result("m", A, first=3.0)
    assert merge.add_options(Tiny(), older, ["size=2"]).options == {"size": "2"}
    assert merge.add_options(Tiny(), older, ["size=1"]).options == {}
    noted = older.model_copy(update={"options": {"size": "3"}})
    assert merge.add_options(Tiny(), noted, ["size=2"]).options == {"size": "3"}
    with pytest.raises(ConfigError, match="no option"):
        merge.add_options(Tiny(), older, ["sise=2"])


def test_files_are_read_and_written_in_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(command._BENCHES, "tiny", command.BenchEntry("tests.benchmarks.small_cells:BENCH", "two cells"))
    files = tmp_path / "all.json", tmp_path / "part.json"
    for path, result in zip(files, (_result("m", A, first=3.0), _result("m", A, second=5.0)), strict=True):
        write_json(path, result.model_dump(mode="json"))
    merge.main(["tiny", str(files[0]), *map(str, files), "--set", "size=2"])
    written = json.loads(files[0].read_text())
    assert [row["cell"] for row in written["rows"]] == ["first", "second"]
    assert [c["holds"] for c in written["claims"]] == [True, False]
    assert written["options"] == {"size": "2"} and "options" not in written["rows"][0]


def test_what_is_no_result_is_said_with_its_file(tmp_path: Path) -> None:
    (tmp_path / "half.json").write_text('{"machine": "m"')
    with pytest.raises(ArtifactCorruptError, match=r"half\.json"):
        merge.read_result(tmp_path / "half.json")
    with pytest.raises(ValueError, match="at least one"):
        merge.merge_results(Tiny(), [])
