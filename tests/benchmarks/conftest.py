from __future__ import annotations

import os

import pytest

from benchmarks.common import runner
from benchmarks.common.task import OptimisationTask
from flows.cli import bench as command
from tests.benchmarks import small_cells
from tests.optimiser import street_scenes


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch, tmp_path: os.PathLike[str]) -> small_cells.Tiny:
    """A fresh tiny benchmark, known to ``genre bench``, in an empty folder."""
    made = small_cells.Tiny()
    monkeypatch.setattr(small_cells, "BENCH", made)
    monkeypatch.setattr(command, "_BENCHES", dict(command._BENCHES))
    monkeypatch.setattr(runner, "describe_machine", lambda: "a machine")
    command.register_bench("tiny", "tests.benchmarks.small_cells:BENCH")
    monkeypatch.chdir(tmp_path)
    return made


@pytest.fixture(scope="module")
def task() -> OptimisationTask:
    truth = street_scenes.scene()
    views = street_scenes.targets(truth)
    return OptimisationTask(street_scenes.blurred(truth), views, views[:2])
