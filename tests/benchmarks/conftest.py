from __future__ import annotations

import os

import pytest

from benchmarks import run
from benchmarks.optimiser.task import Task
from flows.cli import bench as command
from tests.benchmarks import tiny
from tests.optimiser import street


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch, tmp_path: os.PathLike[str]) -> tiny.Tiny:
    """A fresh tiny benchmark, known to ``genre bench``, in an empty folder."""
    made = tiny.Tiny()
    monkeypatch.setattr(tiny, "BENCH", made)
    monkeypatch.setattr(command, "_BENCHES", dict(command._BENCHES))
    monkeypatch.setattr(run, "machine", lambda: "a machine")
    command.register("tiny", "tests.benchmarks.tiny:BENCH")
    monkeypatch.chdir(tmp_path)
    return made


@pytest.fixture(scope="module")
def task() -> Task:
    truth = street.scene()
    views = street.targets(truth)
    return Task(street.blurred(truth), views, views[:2])
