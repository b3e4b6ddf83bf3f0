"""Supervises child runs: bounded in flight, freed and submitted again when they are dead, adopted after a restart."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from flows.dataset.child_runs import ACTIVE_STATES, SENDING_STATES, SILENT, ChildRun, ChildRuns
from flows.dataset.work_units import WorkUnit
from genre_tasks.errors import ConfigError

PENDING_VARIABLE = "GENRE_PENDING_SECONDS"
"""The variable of the environment for :attr:`SupervisionLimits.pending_s`."""
SILENT_VARIABLE = "GENRE_SILENT_SECONDS"
"""The variable of the environment for :attr:`SupervisionLimits.silent_s`."""
HEARTBEAT_S = 30
"""Seconds between two heartbeats of a child run."""
# As a multiple of the seconds that a run may be silent.
_MOST_DELAY = 10.0
Rows = list[dict[str, Any]]
_STATUS_BY_STATE = {"SCHEDULED": "waiting", "PENDING": "starting", "RUNNING": "running", SILENT: "running"}


@dataclass(frozen=True)
class SupervisionLimits:
    """How many runs at once, how often, and when a run counts as dead.

    Attributes:
        in_flight: runs that are submitted and have not ended, at most.
        attempts: how often a unit is submitted, at most.
        poll_s: seconds between two looks at the server.
        pending_s: seconds that a worker may take to start a run.
        silent_s: seconds that a run may be without a heartbeat.
    """

    in_flight: int = 8
    attempts: int = 3
    poll_s: float = 2.0
    pending_s: float = 180.0
    silent_s: float = 3.0 * HEARTBEAT_S


def read_limits(in_flight: int, attempts: int, environment: Mapping[str, str] = os.environ) -> SupervisionLimits:
    """Makes limits whose times the environment of the coordinator's worker may change.

    Args:
        in_flight: runs that are submitted and have not ended, at most.
        attempts: how often a unit is submitted, at most.
        environment: ``GENRE_PENDING_SECONDS`` for machines that are slow to start a run, ``GENRE_SILENT_SECONDS`` for
            how long a run may be without a heartbeat, which comes every thirty seconds.

    Returns:
        The limits.

    Raises:
        ConfigError: a variable is no number, or too small.

    >>> read_limits(8, 3, {"GENRE_PENDING_SECONDS": "600"}).pending_s
    600.0
    """
    defaults = SupervisionLimits(in_flight=in_flight, attempts=attempts)
    return SupervisionLimits(
        in_flight=in_flight,
        attempts=attempts,
        pending_s=_read_seconds(environment, PENDING_VARIABLE, defaults.pending_s, 1.0),
        # A living run must be able to miss one heartbeat.
        silent_s=_read_seconds(environment, SILENT_VARIABLE, defaults.silent_s, 2.0 * HEARTBEAT_S),
    )


def _read_seconds(environment: Mapping[str, str], name: str, default: float, least: float) -> float:
    text = environment.get(name)
    if not text:
        return default
    try:
        seconds = float(text)
    except ValueError:
        seconds = float("nan")
    # Also false for NaN.
    if not least <= seconds < float("inf"):
        raise ConfigError(f"{name} is {text!r}", remedy=f"Give seconds, {least:.0f} or more, or unset it.")
    return seconds


@dataclass
class _Watch:
    """When a run that is in flight last changed, by the clock of this process.

    Attributes:
        run: as last read.
        since_s: when its state or heartbeat changed.
        heartbeat: the last one.
        is_cancelled: whether somebody has asked for its end.
        excused: the heartbeat after which a slow poll has put off its end.
    """

    run: ChildRun
    since_s: float
    heartbeat: str = ""
    is_cancelled: bool = False
    excused: str | None = None


@dataclass
class _Supervision:
    """What the supervisor knows of its units.

    Attributes:
        rows: the table's rows by unit.
        waiting: units to submit.
        watches: runs in flight, by id.
        attempts: how often a unit was submitted.
    """

    rows: dict[WorkUnit, dict[str, Any]]
    waiting: deque[WorkUnit] = field(default_factory=deque)
    watches: dict[str, _Watch] = field(default_factory=dict)
    attempts: dict[WorkUnit, int] = field(default_factory=dict)


class Supervisor:
    """Runs every unit to its end through child runs; the failure of one does not stop the others.

    Args:
        units: what to run, without doubles.
        runs: the child runs.
        limits: bounds and times.
        on_change: called with the rows of the table after every poll.
        clock: seconds of a clock that never jumps.
        sleep: waits for seconds.
        last_outage: when the server was last found away, by the same clock.
    """

    def __init__(
        self,
        units: Sequence[WorkUnit],
        runs: ChildRuns,
        limits: SupervisionLimits,
        on_change: Callable[[Rows], None] = lambda rows: None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
        last_outage: Callable[[], float] = lambda: float("-inf"),
    ) -> None:
        self._runs = runs
        self._limits = limits
        self._on_change = on_change
        self._clock = clock
        self._sleep = sleep
        self._last_outage = last_outage
        self._last_poll_s = clock()
        self._state = _Supervision({unit: _new_row(unit) for unit in units})

    @property
    def rows(self) -> Rows:
        """The table as it stands, one row for each unit."""
        return [dict(row) for row in self._state.rows.values()]

    def run(self) -> Rows:
        """Submits, polls and submits again until every unit has ended.

        Returns:
            The final rows.
        """
        self._adopt()
        while self._state.waiting or self._state.watches:
            self._submit()
            self._on_change(self.rows)
            self._sleep(self._limits.poll_s)
            self._poll()
        self._on_change(self.rows)
        return self.rows

    def _adopt(self) -> None:
        """Takes over the runs that an earlier life of this parent, or an earlier parent, has left."""
        newest: dict[WorkUnit, ChildRun] = {}
        for run in self._runs.find():
            if run.unit not in self._state.rows:
                continue
            if run.is_ours:
                self._state.attempts[run.unit] = self._state.attempts.get(run.unit, 0) + 1
            # An active run wins over an ended one, as its unit must not be run twice at a time.
            before = newest.get(run.unit)
            if before is None or before.state not in ACTIVE_STATES:
                newest[run.unit] = run
        for unit in self._state.rows:
            run_found = newest.get(unit)
            if run_found is None:
                self._state.waiting.append(unit)
            else:
                self._watch(run_found)
        self._judge(list(self._state.watches.values()))

    def _submit(self) -> None:
        requests: list[tuple[WorkUnit, int]] = []
        while self._state.waiting and len(self._state.watches) + len(requests) < self._limits.in_flight:
            unit = self._state.waiting.popleft()
            requests.append((unit, self._state.attempts.get(unit, 0)))
            self._state.attempts[unit] = requests[-1][1] + 1
        if requests:
            for run in self._runs.submit(requests):
                self._watch(run)

    def _watch(self, run: ChildRun) -> None:
        self._state.watches[run.id] = _Watch(run, self._clock(), is_cancelled=run.state == "CANCELLING")
        self._update_row(run)

    def _poll(self) -> None:
        found = self._runs.read(list(self._state.watches))
        # After the call, which waits as long as the server is away.
        now = self._clock()
        is_slow = now - self._last_poll_s > self._limits.silent_s / 3
        was_away = self._last_outage() >= self._last_poll_s
        for watch in list(self._state.watches.values()):
            run = found.get(watch.run.id)
            if run is None:
                self._end_attempt(watch, {"why": "the flow run was deleted"})
                continue
            # That the server misses heartbeats is no sign of life.
            has_changed = run.state not in (watch.run.state, SILENT)
            # Heartbeats are away with the server. Where all polls are slow, only one of them stands for an outage.
            if has_changed or was_away or (is_slow and watch.excused != watch.heartbeat):
                watch.since_s = now
                watch.excused = watch.heartbeat if is_slow else None
            watch.run = run
            watch.is_cancelled |= run.state == "CANCELLING"
            self._update_row(run)
        # Signs first: a poll may take longer than a run may be silent.
        self._read_signs_of_life()
        self._judge(list(self._state.watches.values()))
        self._last_poll_s = self._clock()

    def _read_signs_of_life(self) -> None:
        running = {id_: watch for id_, watch in self._state.watches.items() if watch.run.state in SENDING_STATES}
        if not running:
            return
        for id_, stage in self._runs.read_stages(list(running)).items():
            self._state.rows[running[id_].run.unit]["stage"] = stage
        # Asked only for runs that may be late: most polls ask for none.
        late = [id_ for id_, watch in running.items() if self._age(watch) > self._limits.silent_s / 3]
        for id_, heartbeat in (self._runs.read_heartbeats(late) if late else {}).items():
            if heartbeat != running[id_].heartbeat:
                running[id_].heartbeat = heartbeat
                running[id_].since_s = self._clock()

    def _judge(self, watches: Sequence[_Watch]) -> None:
        """Ends the watches of runs that have ended, or are dead."""
        ended: list[_Watch] = []
        for watch in watches:
            run = watch.run
            if run.state == "PENDING" and self._age(watch) > self._limits.pending_s:
                is_ended = self._free(watch, f"not started within {self._limits.pending_s:.0f} s")
            elif run.state in SENDING_STATES and self._is_silent(watch):
                is_ended = self._free(watch, f"no heartbeat for {self._limits.silent_s:.0f} s")
            else:
                is_ended = run.state not in ACTIVE_STATES
            if is_ended:
                ended.append(watch)
        # All at once: a hundred workers may end their logs at the same moment.
        outcomes = self._runs.read_outcomes([watch.run.id for watch in ended]) if ended else {}
        for watch in ended:
            self._end(watch, outcomes.get(watch.run.id))

    def _is_silent(self, watch: _Watch) -> bool:
        age_s = self._age(watch)
        if age_s <= self._limits.silent_s:
            return False
        # A busy server is minutes behind with heartbeats that it has received: their runs are alive.
        delay_s = self._runs.read_event_delay() - HEARTBEAT_S
        # Bounded, as a parent whose own heartbeats are lost would wait for ever.
        return age_s > self._limits.silent_s + min(max(delay_s, 0.0), _MOST_DELAY * self._limits.silent_s)

    def _age(self, watch: _Watch) -> float:
        return self._clock() - watch.since_s

    def _free(self, watch: _Watch, reason: str) -> bool:
        """Sets a dead run to Crashed; whether it has ended."""
        self._runs.crash(watch.run, reason)
        # It may have ended just before: then that is how it ended.
        run = self._runs.read([watch.run.id]).get(watch.run.id)
        if run is None or run.state in ACTIVE_STATES:
            # The server does not take the state yet; the next poll tries again.
            return False
        watch.run = run
        return True

    def _end(self, watch: _Watch, outcome: dict[str, Any] | None) -> None:
        # A dead worker cannot end what was cancelled, and nobody wants it submitted again.
        if watch.run.state == "CANCELLED" or (watch.run.state == "CRASHED" and watch.is_cancelled):
            self._finish(watch, {"status": "failed", "why": "cancelled"})
        elif watch.run.state == "CRASHED" or outcome is None or outcome["is_passing"]:
            # A run that says nothing was ended from outside, or by an error of its surroundings.
            self._end_attempt(watch, outcome or {"why": watch.run.message or watch.run.state.lower()})
        else:
            self._finish(watch, outcome)

    def _end_attempt(self, watch: _Watch, outcome: dict[str, Any]) -> None:
        unit = watch.run.unit
        why = outcome["why"]
        if (attempt := self._state.attempts.get(unit, 0)) >= self._limits.attempts:
            # Of a log of several chunks some may be done.
            self._finish(watch, {"status": "failed"} | outcome | {"why": f"{why} (attempt {attempt})"})
            return
        del self._state.watches[watch.run.id]
        self._state.rows[unit] |= {"status": "waiting", "why": why}
        self._state.waiting.append(unit)

    def _finish(self, watch: _Watch, outcome: dict[str, Any]) -> None:
        del self._state.watches[watch.run.id]
        # The log's URI and chunk stay as this flow names them.
        self._state.rows[watch.run.unit] |= {k: outcome[k] for k in outcome if k not in ("log", "chunk", "is_passing")}

    def _update_row(self, run: ChildRun) -> None:
        self._state.rows[run.unit] |= {
            "status": _STATUS_BY_STATE.get(run.state, run.state.lower()),
            "seconds": round(run.seconds, 1),
            "where": run.where,
            "attempts": self._state.attempts.get(run.unit, 0),
        }


def _new_row(unit: WorkUnit) -> dict[str, Any]:
    return {
        "log": unit.log,
        "chunk": "" if unit.chunk is None else unit.chunk,
        "stage": "",
        "status": "waiting",
        "seconds": 0.0,
        "where": "",
        "attempts": 0,
        "chunks": 0,
        "left_out": 0,
        "run": "",
        "report": "",
        "why": "",
    }
