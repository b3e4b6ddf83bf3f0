"""``stability.record`` holds a measured error to its bound; ``--stability-report FILE`` writes them all down."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.hard_cases.case_measurements import ROWS
from tests.hard_cases.stability import Row, document, key

_largest: dict[tuple[int, str, str, str], float] = {}


class Stability:
    """Records of one run; the largest of a row counts."""

    def __init__(self, largest: dict[tuple[int, str, str, str], float]) -> None:
        self._largest = largest

    def record(self, row: Row, backend: str, measured: float) -> None:
        """Fails if the row is not in the tables, or ``measured`` exceeds its bound (a NaN does)."""
        assert row in ROWS, f"{row} is not a row of tests/hard_cases/case_measurements.py"
        place = key(row, backend)
        self._largest[place] = max(measured, self._largest.get(place, measured))
        what = f"{row.number} {row.words}: {row.quantity} on {backend}"
        assert measured <= row.bound, f"{what}: {measured:.2g} > {row.bound:.2g}"


@pytest.fixture(scope="session")
def stability() -> Stability:
    return Stability(_largest)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--stability-report", metavar="FILE", help="write the measured errors of the hard cases to FILE")


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    file = session.config.getoption("--stability-report", default=None)
    if file is None:
        return
    wanted = {key(row, b) for row in ROWS for b in row.backends}
    if exitstatus or wanted - set(_largest):
        missing = sorted(wanted - set(_largest))
        print(f"\n{file} not written: tests failed, or rows were not measured: {missing[:3]}")  # noqa: T201
        session.exitstatus = 1
        return
    Path(file).write_text(document(ROWS, {place: f"{number:.1e}" for place, number in _largest.items()}))
