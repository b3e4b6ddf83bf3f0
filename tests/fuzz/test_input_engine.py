"""The fuzzers: what they count as what, that inputs follow from their index, and that no reader has a finding."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.fuzz import fuzz_inputs, input_fuzz
from benchmarks.fuzz.input_fuzz import FINDINGS, OUTCOMES, make_input, measure_input_fuzz
from tests.fuzz import planted_worker

INPUTS = 10_000
SEED = 42


def test_everything_that_must_not_happen_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(input_fuzz, "_MODULE", "tests.fuzz.planted_worker")
    monkeypatch.setattr(fuzz_inputs, "list_targets", planted_worker.plant_targets)
    measured = measure_input_fuzz(inputs=len(planted_worker.READERS), seed=0)
    found = {name: [outcome for outcome in OUTCOMES if counts[outcome]] for name, counts in measured["formats"].items()}
    assert found == {name: [outcome] for name, (_, outcome) in planted_worker.READERS.items()}
    expected = [outcome for _, outcome in planted_worker.READERS.values() if outcome in FINDINGS]
    assert sorted(row["outcome"] for row in measured["findings"]) == sorted(expected)


def test_an_input_follows_from_seed_and_index(tmp_path: Path) -> None:
    made = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        made.append([make_input(50, SEED, index, tmp_path / name) for index in range(0, 50, 7)])
    assert [path.read_bytes() for path in made[0]] == [path.read_bytes() for path in made[1]]
    assert [path.relative_to(tmp_path / "a") for path in made[0]] == [
        path.relative_to(tmp_path / "b") for path in made[1]
    ]


def test_few_inputs_of_all_formats() -> None:
    measured = measure_input_fuzz(inputs=60, seed=SEED)
    assert measured["findings"] == []
    assert sum(sum(counts[outcome] for outcome in OUTCOMES) for counts in measured["formats"].values()) == 60


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_no_input_of_ten_thousand_is_a_finding() -> None:
    measured = measure_input_fuzz(inputs=INPUTS, seed=SEED)
    assert measured["findings"] == []
    assert len(measured["formats"]) >= 15
    # Formats whose inputs are all refused, or all read, would be damaged too much or too little.
    assert all(counts["read"] and counts["refused"] for counts in measured["formats"].values())
