"""The synthetic street keeps the readers' contract."""

from __future__ import annotations

import pytest

from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import DrivingLog, Truth
from tests.contracts.reader_suite import ReaderSuite

pytest.importorskip("embreex", reason="the synthetic street is ray-cast with Embree")


class TestSyntheticReader(ReaderSuite):
    def open(self) -> DrivingLog:
        return open_log("synthetic:street?seed=1000&frames=8&cameras=6&width=96&height=54&samples=1")

    def test_it_knows_the_truth(self, log: DrivingLog) -> None:
        assert isinstance(log.truth, Truth)
