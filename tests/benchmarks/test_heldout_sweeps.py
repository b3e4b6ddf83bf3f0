"""A log without the sweeps that simulated ones are compared with."""

from __future__ import annotations

import pytest

from benchmarks.simulation.heldout_sweeps import HeldoutSweepsLog, register_reader
from genre_tasks.errors import InputError
from genre_tasks.logs import registry
from genre_tasks.logs.registry import open_log
from tests.fakes import FakeLog


@pytest.fixture(autouse=True)
def readers(monkeypatch: pytest.MonkeyPatch) -> None:
    # A copy: the users' registry lists no reader of a benchmark.
    monkeypatch.setattr(registry, "_READERS", dict(registry._READERS))
    register_reader()


def test_sweeps_are_held_out_and_nothing_else():
    log = FakeLog(frame_count=6)
    held_out = HeldoutSweepsLog(log, 2)
    assert [held_out.sweep(frame) is None for frame in range(6)] == [False, True] * 3
    assert held_out.image_bytes("front", 1) == log.image_bytes("front", 1)
    assert held_out.frame_count == 6
    assert held_out.name != log.name
    assert len({log.digest(), held_out.digest(), HeldoutSweepsLog(log, 3).digest()}) == 3


def test_it_opens_by_its_uri():
    log = open_log("heldout-sweeps:2/synthetic:street?seed=950")
    assert log.uri == "heldout-sweeps:2/synthetic:street?seed=950"
    assert log.name.endswith("-sweeps=2")


@pytest.mark.parametrize("rest", ["synthetic:street", "x/synthetic:street", "1/synthetic:street?seed=950"])
def test_a_uri_that_holds_nothing_out_is_refused(rest: str):
    with pytest.raises(InputError):
        open_log(f"heldout-sweeps:{rest}")
