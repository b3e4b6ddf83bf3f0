"""``docs/reference/stability.md`` is what the tables say, its numbers hold, and the tests that it names exist."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.hard_cases.case_list import LISTED, SECTIONS
from tests.hard_cases.case_measurements import ROWS
from tests.hard_cases.stability import Row, document, key, parsed
from tests.named_tests import is_test

ROOT = Path(__file__).parents[2]
DOCUMENT = ROOT / "docs/reference/stability.md"


def test_the_document_has_the_rows_of_the_tests():
    text = DOCUMENT.read_text()
    measured = parsed(text)
    expected = {key(row, backend) for row in ROWS for backend in row.backends}
    assert set(measured) == expected, "run the command at the head of docs/reference/stability.md"
    assert document(ROWS, measured) == text, "run the command at the head of docs/reference/stability.md"
    over = [row for row in ROWS for b in row.backends if float(measured[key(row, b)]) > row.bound * 1.05]
    assert over == []


def test_every_case_is_there_once():
    assert [n for numbers in SECTIONS.values() for n in numbers] == list(range(1, 55))
    assert {row.number for row in ROWS} == {*range(1, 17), 50, 51} and set(LISTED) == set(range(17, 55))
    assert len({(r.number, r.words, r.quantity) for r in ROWS}) == len(ROWS)


NAMED = {test for _, tests in LISTED.values() if not isinstance(tests, str) for test in tests}


@pytest.mark.parametrize("test", sorted(NAMED))
def test_a_named_test_exists(test):
    assert is_test(test)


def test_a_measurement_over_its_bound_or_of_an_unknown_row_fails(stability):
    with pytest.raises(AssertionError, match="is not a row"):
        stability.record(Row(1, "unknown", "image", 1.0), "cpu", 0.0)
    row = ROWS[0]
    for measured in (row.bound * 2, float("nan")):
        with pytest.raises(AssertionError, match=">"):
            type(stability)({}).record(row, "cpu", measured)
