"""What is timed first pays for nothing that a process loads once."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks import pipeline
from benchmarks.common import run_stages
from benchmarks.common.task import OptimisationTask
from benchmarks.optimiser import ablation, convergence, race
from tests.benchmarks.small_races import ADAM, learned


class _TimedError(Exception):
    """Something was timed."""


def test_a_process_is_warmed_up_once(monkeypatch: pytest.MonkeyPatch) -> None:
    warmed: list[tuple[str, ...]] = []
    monkeypatch.setattr(run_stages, "run_on_tiny_log", lambda config, names: warmed.append(names))
    run_stages._warm_up_once.cache_clear()
    values = pipeline.configurations("20")["small"]
    for _ in range(2):
        run_stages.warm_up(values, pipeline.TIMED)
    run_stages._warm_up_once.cache_clear()
    assert warmed == [pipeline.TIMED]


def test_the_pipeline_is_warm_before_its_first_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    steps: list[str] = []

    def reconstruct(*_: Any) -> None:
        raise _TimedError

    monkeypatch.setattr(pipeline, "warm_up", lambda *_: steps.append("warm"))
    monkeypatch.setattr(pipeline, "reconstruct", reconstruct)
    with pytest.raises(_TimedError):
        pipeline.measure("synthetic:street?seed=900", 0, "store", pipeline.configurations("20"))
    assert steps == ["warm"]


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What is run of GNet, in order: a step to warm up, or a run on the clock."""
    found: list[str] = []
    steps = race.gnet_steps

    def warm_up(*_: Any) -> None:
        found.append("warm")

    def gnet_steps(*arguments: Any) -> Any:
        found.append("timed")
        return steps(*arguments)

    monkeypatch.setattr(race, "warm_up", warm_up)
    monkeypatch.setattr(race, "gnet_steps", gnet_steps)
    return found


def test_both_kinds_of_an_ablation_are_warm(
    task: OptimisationTask, calls: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ablation, "_load_task_and_config", lambda *_: (task, learned(2)))
    ablation.measure("gnet.constrain_ground", "log", 0, "store")
    assert calls == 2 * ["warm", "timed"]


def test_a_race_to_convergence_is_warm(task: OptimisationTask, calls: list[str]) -> None:
    convergence.converged_row(task, learned(2), {"cosine": ADAM}, 0)
    assert calls == ["warm", "timed", "timed"]
