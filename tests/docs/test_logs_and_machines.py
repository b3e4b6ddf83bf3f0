"""``docs/reference/logs-and-machines.md`` has all rows, names tests that exist, and agrees with the measurements."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.named_tests import is_test

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs/reference/logs-and-machines.md"
FAULTS = ROOT / "docs/results/log-faults.md"
CASES = 28


def read_rows(page: Path, cell_count: int) -> list[list[str]]:
    """The cells of all rows of a page's tables that have so many cells, with their heads."""
    lines = [line for line in page.read_text().splitlines() if line.startswith("| ")]
    rows = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]
    return [row for row in rows if len(row) == cell_count]


ROWS = read_rows(PAGE, 4)[1:]
NAMED = sorted({name for row in ROWS for name in re.findall(r"`([^`]+)`", row[3])})


def test_every_case_has_a_row_with_tests() -> None:
    assert [row[0] for row in ROWS] == [str(number) for number in range(1, CASES + 1)]
    assert all(row[1] and row[2] and "`tests/" in row[3] for row in ROWS)


@pytest.mark.parametrize("name", NAMED)
def test_a_named_test_exists(name: str) -> None:
    assert "::test_" in name and is_test(name)


def test_what_does_not_exist_is_no_test() -> None:
    assert not is_test("tests/docs/test_nothing.py::test_nothing")
    assert not is_test("tests/docs/test_logs_and_machines.py::test_nothing")


def test_what_cannot_be_found_is_measured() -> None:
    measured = read_rows(FAULTS, 5)
    missed = read_rows(PAGE, 3)[1:]
    assert len(missed) > 10
    for fault, strengths, _ in missed:
        (row,) = [row for row in measured if row[0].startswith(fault)]
        for strength in strengths.split(", "):
            assert any(f"({strength})" in cell for cell in row[1:4]), (fault, strength)
