"""Child runs under supervision, by a fake server whose clock the test moves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import pytest

from flows.dataset.child_runs import ACTIVE_STATES, SILENT, ChildRun
from flows.dataset.supervisor import SupervisionLimits, Supervisor, read_limits
from flows.dataset.work_units import WorkUnit
from genre_tasks.errors import ConfigError

A = WorkUnit("synthetic:a")
B = WorkUnit("synthetic:b")
DONE = {"status": "done", "run": "5f41", "why": "", "is_passing": False}
LIMITS = SupervisionLimits(in_flight=2, attempts=3, poll_s=1.0, pending_s=5.0, silent_s=9.0)


class FakeRuns:
    """Runs that follow a script of states, one a poll; the last state stays."""

    def __init__(self, scripts: Mapping[WorkUnit, Sequence[Sequence[str]]]) -> None:
        self.scripts = scripts
        self.runs: dict[str, ChildRun] = {}
        self.polls: dict[str, int] = {}
        self.outcomes: dict[str, dict[str, Any]] = {}
        self.beating: set[str] = set()
        self.submitted: list[tuple[WorkUnit, int]] = []
        self.crashed: list[str] = []
        self.most_active = 0
        self.outcome_requests = 0
        self.event_delay_s = 5.0
        self.now_s = 0.0

    def find(self) -> list[ChildRun]:
        return list(self.runs.values())

    def submit(self, requests: Sequence[tuple[WorkUnit, int]]) -> Sequence[ChildRun]:
        return [self._submit(unit, attempt) for unit, attempt in requests]

    def _submit(self, unit: WorkUnit, attempt: int) -> ChildRun:
        id_ = f"{unit.log}/{attempt}"
        assert not [run for run in self.runs.values() if run.unit == unit and run.state in ACTIVE_STATES]
        self.submitted.append((unit, attempt))
        self.runs[id_] = ChildRun(id_, unit, "SCHEDULED")
        active = sum(run.state in ACTIVE_STATES for run in self.runs.values())
        self.most_active = max(self.most_active, active)
        return self.runs[id_]

    def read(self, ids: Sequence[str]) -> Mapping[str, ChildRun]:
        return {id_: self._step(id_) for id_ in ids if id_ in self.runs}

    def _step(self, id_: str) -> ChildRun:
        run = self.runs[id_]
        if id_ not in self.crashed:
            script = self.scripts[run.unit][int(id_.rpartition("/")[2])]
            position = min(self.polls.get(id_, 0), len(script) - 1)
            self.polls[id_] = position + 1
            self.runs[id_] = replace(run, state=script[position])
        return self.runs[id_]

    def read_heartbeats(self, ids: Sequence[str]) -> Mapping[str, str]:
        return {id_: str(self.now_s) for id_ in ids if id_ in self.beating}

    def read_event_delay(self) -> float:
        return self.event_delay_s

    def read_stages(self, ids: Sequence[str]) -> Mapping[str, str]:
        return dict.fromkeys(ids, "gnet · chunk 0")

    def crash(self, run: ChildRun, reason: str) -> None:
        self.crashed.append(run.id)
        self.runs[run.id] = replace(run, state="CRASHED", message=reason)

    def read_outcomes(self, ids: Sequence[str]) -> Mapping[str, dict[str, Any]]:
        self.outcome_requests += 1
        found = {id_: self.outcomes.get(id_, DONE if self.runs[id_].state == "COMPLETED" else None) for id_ in ids}
        return {id_: outcome for id_, outcome in found.items() if outcome is not None}


def supervise(
    runs: FakeRuns, units: Sequence[WorkUnit], limits: SupervisionLimits = LIMITS, outages_end_s: float = -1.0
) -> list[dict[str, Any]]:
    def sleep(seconds: float) -> None:
        runs.now_s += seconds
        assert runs.now_s < 500, "the supervisor does not come to its end"

    def last_outage() -> float:
        # The server is away for a moment in every poll until then.
        return min(runs.now_s, outages_end_s)

    return Supervisor(units, runs, limits, clock=lambda: runs.now_s, sleep=sleep, last_outage=last_outage).run()


def test_runs_are_bounded_in_flight_and_all_end() -> None:
    units = [WorkUnit(f"synthetic:{n}") for n in range(7)]
    runs = FakeRuns({unit: [["PENDING", "RUNNING", "COMPLETED"]] for unit in units})
    rows = supervise(runs, units)
    assert [row["log"] for row in rows] == [unit.log for unit in units]
    assert {row["status"] for row in rows} == {"done"} and runs.most_active == LIMITS.in_flight
    assert {row["stage"] for row in rows} == {"gnet · chunk 0"}


@pytest.mark.parametrize("states", [["RUNNING"], ["PENDING"]])
def test_a_silent_run_is_freed_and_submitted_again(states: list[str]) -> None:
    runs = FakeRuns({A: [states, ["RUNNING", "COMPLETED"]]})
    (row,) = supervise(runs, [A])
    assert (row["status"], row["attempts"]) == ("done", 2)
    assert runs.crashed == ["synthetic:a/0"] and runs.submitted == [(A, 0), (A, 1)]


def test_heartbeats_keep_a_long_run_alive() -> None:
    runs = FakeRuns({A: [["RUNNING"] * 60 + ["COMPLETED"]]})
    runs.beating.add("synthetic:a/0")
    (row,) = supervise(runs, [A])
    assert row["status"] == "done" and not runs.crashed


def test_heartbeats_that_were_lost_with_the_server_make_no_run_dead() -> None:
    runs = FakeRuns({A: [["RUNNING"] * 60 + ["COMPLETED"]]})
    (row,) = supervise(runs, [A], outages_end_s=55.0)
    assert row["status"] == "done" and not runs.crashed
    # Dead all the same, once the server is there to stay.
    dead = FakeRuns({A: [["RUNNING"], ["COMPLETED"]]})
    (row,) = supervise(dead, [A], outages_end_s=55.0)
    assert row["status"] == "done" and row["attempts"] == 2 and dead.crashed


def test_a_run_that_the_server_calls_silent_goes_on_while_it_sends_heartbeats() -> None:
    runs = FakeRuns({A: [["RUNNING", *[SILENT] * 60, "COMPLETED"]]})
    runs.beating.add("synthetic:a/0")
    (row,) = supervise(runs, [A])
    assert (row["status"], row["attempts"]) == ("done", 1) and not runs.crashed
    dead = FakeRuns({A: [["RUNNING", SILENT], ["COMPLETED"]]})
    (row,) = supervise(dead, [A])
    assert (row["status"], row["attempts"]) == ("done", 2) and dead.crashed == ["synthetic:a/0"]


def test_a_cancelled_run_whose_worker_died_ends_and_is_not_submitted_again() -> None:
    runs = FakeRuns({A: [["RUNNING", "CANCELLING"]], B: [["RUNNING", "COMPLETED"]]})
    rows = supervise(runs, [A, B])
    assert [(row["status"], row["why"]) for row in rows] == [("failed", "cancelled"), ("done", "")]
    assert runs.crashed == ["synthetic:a/0"] and runs.submitted == [(A, 0), (B, 0)]


def test_a_run_in_the_queue_is_never_freed() -> None:
    runs = FakeRuns({A: [["SCHEDULED"] * 100 + ["COMPLETED"]]})
    assert supervise(runs, [A])[0]["status"] == "done" and not runs.crashed


def test_attempts_are_bounded() -> None:
    runs = FakeRuns({A: [["CRASHED"]] * 3, B: [["COMPLETED"]]})
    rows = supervise(runs, [A, B])
    assert [row["status"] for row in rows] == ["failed", "done"]
    assert [attempt for unit, attempt in runs.submitted if unit == A] == [0, 1, 2]
    assert "attempt 3" in rows[0]["why"]


def test_an_error_of_the_log_is_final_and_the_others_go_on() -> None:
    runs = FakeRuns({A: [["FAILED"]], B: [["RUNNING", "COMPLETED"]]})
    runs.outcomes["synthetic:a/0"] = {"status": "failed", "why": "no image. Copy it.", "is_passing": False}
    rows = supervise(runs, [A, B])
    assert [(row["status"], row["why"]) for row in rows] == [("failed", "no image. Copy it."), ("done", "")]
    assert runs.submitted == [(A, 0), (B, 0)]


def test_an_error_that_may_pass_is_tried_again() -> None:
    runs = FakeRuns({A: [["FAILED"], ["COMPLETED"]]})
    runs.outcomes["synthetic:a/0"] = {"status": "failed", "why": "the store is away", "is_passing": True}
    (row,) = supervise(runs, [A])
    assert (row["status"], row["why"], row["attempts"]) == ("done", "", 2)


def test_what_is_done_after_the_last_attempt_stays_in_the_row() -> None:
    runs = FakeRuns({A: [["FAILED"]] * 3})
    runs.outcomes["synthetic:a/0"] = {"status": "partly_done", "run": "5f41", "why": "disk full", "is_passing": True}
    runs.outcomes["synthetic:a/1"] = runs.outcomes["synthetic:a/2"] = runs.outcomes["synthetic:a/0"]
    (row,) = supervise(runs, [A])
    assert (row["status"], row["run"], row["why"]) == ("partly_done", "5f41", "disk full (attempt 3)")
    assert "is_passing" not in row


def test_active_and_ended_runs_are_adopted() -> None:
    runs = FakeRuns({A: [["RUNNING", "COMPLETED"]], B: [["COMPLETED"]]})
    runs.runs["synthetic:a/0"] = ChildRun("synthetic:a/0", A, "RUNNING", is_ours=False)
    runs.runs["synthetic:b/0"] = ChildRun("synthetic:b/0", B, "COMPLETED")
    rows = supervise(runs, [A, B])
    assert {row["status"] for row in rows} == {"done"} and not runs.submitted


def test_an_adopted_run_that_crashed_counts_as_an_attempt() -> None:
    runs = FakeRuns({A: [["CRASHED"], ["COMPLETED"]]})
    runs.runs["synthetic:a/0"] = ChildRun("synthetic:a/0", A, "CRASHED", message="killed")
    (row,) = supervise(runs, [A])
    assert row["status"] == "done" and runs.submitted == [(A, 1)]


def test_an_outage_of_the_server_does_not_make_runs_stale() -> None:
    runs = FakeRuns({A: [["RUNNING"] * 6 + ["COMPLETED"]]})
    real = runs.read

    def away_for_a_minute(ids: Sequence[str]) -> Mapping[str, ChildRun]:
        if runs.now_s == 3.0:
            runs.now_s += 60.0
        return real(ids)

    runs.read = away_for_a_minute  # type: ignore[method-assign]
    assert supervise(runs, [A])[0]["status"] == "done" and not runs.crashed


def test_the_environment_changes_when_a_run_counts_as_dead() -> None:
    limits = read_limits(8, 3, {})
    assert (limits.in_flight, limits.attempts) == (8, 3)
    assert (limits.silent_s, limits.pending_s) == (90, 180)
    changed = read_limits(4, 2, {"GENRE_PENDING_SECONDS": "600", "GENRE_SILENT_SECONDS": "75.5"})
    assert changed == SupervisionLimits(in_flight=4, attempts=2, pending_s=600.0, silent_s=75.5)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("GENRE_PENDING_SECONDS", "soon"),
        ("GENRE_PENDING_SECONDS", "0"),
        ("GENRE_PENDING_SECONDS", "inf"),
        # Less than two heartbeats would end runs that live.
        ("GENRE_SILENT_SECONDS", "59"),
        ("GENRE_SILENT_SECONDS", "nan"),
    ],
)
def test_a_wrong_time_in_the_environment_is_an_error(name: str, value: str) -> None:
    with pytest.raises(ConfigError, match=name):
        read_limits(8, 3, {name: value})


def test_runs_that_end_together_are_read_by_one_request() -> None:
    units = [WorkUnit(f"log-{number}") for number in range(40)]
    runs = FakeRuns({unit: [["PENDING", "RUNNING", "COMPLETED"]] for unit in units})
    rows = supervise(runs, units, replace(LIMITS, in_flight=40))
    assert {row["status"] for row in rows} == {"done"}
    assert runs.outcome_requests == 1


@pytest.mark.parametrize(("delay_s", "crashes"), [(5.0, 1), (300.0, 0)])
def test_a_server_that_is_behind_with_heartbeats_is_no_dead_run(delay_s: float, crashes: int) -> None:
    unit = WorkUnit("log-0")
    polls = round((LIMITS.silent_s + 60) / LIMITS.poll_s)
    runs = FakeRuns({unit: [["RUNNING"] * polls + ["COMPLETED"], ["COMPLETED"]]})
    runs.event_delay_s = delay_s
    assert supervise(runs, [unit])[0]["status"] == "done"
    assert len(runs.crashed) == crashes


def test_a_delay_does_not_keep_a_dead_run_for_ever() -> None:
    unit = WorkUnit("log-0")
    limits = replace(LIMITS, silent_s=20.0)
    runs = FakeRuns({unit: [["RUNNING"], ["COMPLETED"]]})
    runs.event_delay_s = 1e6
    assert supervise(runs, [unit], limits)[0]["status"] == "done"
    assert len(runs.crashed) == 1


def slow_down(runs: FakeRuns, seconds: float) -> None:
    """Makes every reading of states take so long."""
    real = runs.read

    def read(ids: Sequence[str]) -> Mapping[str, ChildRun]:
        runs.now_s += seconds
        return real(ids)

    runs.read = read  # type: ignore[method-assign]


@pytest.mark.parametrize("states", [["RUNNING"], ["PENDING"]])
def test_a_server_that_is_always_slow_keeps_no_dead_run_for_ever(states: list[str]) -> None:
    runs = FakeRuns({A: [states, ["RUNNING", "COMPLETED"]]})
    slow_down(runs, LIMITS.silent_s / 2)
    (row,) = supervise(runs, [A])
    assert (row["status"], row["attempts"]) == ("done", 2) and runs.crashed == ["synthetic:a/0"]


def test_a_run_that_sends_heartbeats_lives_however_slow_the_server_is() -> None:
    runs = FakeRuns({A: [["RUNNING"] * 15 + ["COMPLETED"]]})
    runs.beating.add("synthetic:a/0")
    slow_down(runs, 2 * LIMITS.silent_s)
    assert supervise(runs, [A])[0]["status"] == "done" and not runs.crashed
