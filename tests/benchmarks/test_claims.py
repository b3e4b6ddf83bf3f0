"""The one schema of benchmark results."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from pydantic import ValidationError

from benchmarks.common.claims import Claim, Result, claim, write_json
from benchmarks.common.merge import merge_results, read_result
from flows.cli.bench import _BENCHES, load_bench

DOCUMENTS = sorted((Path(__file__).parents[2] / "docs/results/data").glob("*.json"))


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_committed_results_follow_the_schema(path: Path) -> None:
    result = Result.model_validate_json(path.read_text(encoding="utf-8"))
    assert result.rows
    names = [(c.id, c.data) for c in result.claims]
    assert names and len(set(names)) == len(names)


@pytest.mark.parametrize("name", sorted({path.stem for path in DOCUMENTS} & set(_BENCHES)))
def test_committed_claims_are_those_of_today(name: str) -> None:
    committed = read_result(DOCUMENTS[0].with_name(f"{name}.json"))
    today = merge_results(load_bench(name), [committed])
    fields = {"id", "op", "target", "unit", "measured", "n", "holds"}
    assert [c.model_dump(include=fields) for c in committed.claims] == [
        c.model_dump(include=fields) for c in today.claims
    ]


@pytest.mark.parametrize(
    ("measured", "op", "holds"),
    [(4.0, ">=", True), (4.0, ">", False), (4.0, "<=", True), (4.0, "<", False), (3.9, ">=", False), (3.9, "<", True)],
)
def test_a_claim_holds_when_its_number_meets_the_target(measured: float, op: str, holds: bool) -> None:
    assert claim("a.b", measured, op, 4.0, "s", "data").holds is holds  # type: ignore[arg-type]


def test_what_was_not_measured_does_not_hold() -> None:
    c = claim("a.b", None, "<=", 4.0, "s", "data", n=3, spread=(1.0, 2.0))
    assert (c.measured, c.n, c.spread, c.holds) == (None, 0, None, False)


@pytest.mark.parametrize(
    "change",
    [
        {"holds": True},
        {"measured": float("nan")},
        {"measured": None, "n": 2},
        {"op": "=="},
        {"id": "Not An Id"},
        {"more": 1},
        {"data": ""},
    ],
)
def test_a_claim_that_does_not_fit_is_refused(change: dict[str, object]) -> None:
    good = claim("a.b", 5.0, "<=", 4.0, "s", "data").model_dump()
    with pytest.raises(ValidationError):
        Claim.model_validate(good | change)


def test_a_result_names_its_commit() -> None:
    good = {"machine": "m", "commit": "a" * 40 + "+changes", "rows": [], "claims": []}
    Result.model_validate(good)
    with pytest.raises(ValidationError):
        Result.model_validate(good | {"commit": "main"})
    with pytest.raises(ValidationError):
        Result.model_validate(good | {"machine": ""})


def test_writing_that_fails_leaves_the_file_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "new" / "result.json"
    write_json(path, {"a": 1})
    with pytest.raises(ValueError, match="JSON compliant"):
        write_json(path, {"a": float("nan")})
    assert json.loads(path.read_text()) == {"a": 1}
    assert [p.name for p in path.parent.iterdir()] == ["result.json"]


def test_a_list_of_plain_values_stands_in_one_line(tmp_path: Path) -> None:
    value = {"curve": [0.5, 1, None], "words": ["a, b", "[c]", "line\nbreak", "{"], "rows": [{"n": []}, [[1], [2]]]}
    write_json(tmp_path / "result.json", value)
    text = (tmp_path / "result.json").read_text()
    assert json.loads(text) == value
    assert ' "curve": [0.5, 1, null],\n' in text
