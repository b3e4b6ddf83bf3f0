"""One scenario for every fault: a dataset on the pool, the fault at seeded random moments, the checks at the end."""

from __future__ import annotations

import random
import subprocess
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field

from storage.opening import open_store
from tests.faults import small_run
from tests.faults.matrix import checks
from tests.faults.matrix.cluster import Cluster
from tests.faults.matrix.compute_log import (
    Computations,
    Note,
    count_computations,
    find_running,
    measure_recovery,
    read_notes,
)
from tests.faults.matrix.fault_table import FaultRow

LOGS = tuple(small_run.LOG.replace("seed=900", f"seed={seed}") for seed in (900, 902, 904, 906, 908))
_POLL_S = 0.2
_FIRST_STAGE_S = 180.0
_DATASET_S = 900.0
# What a dead worker's lease of a slot lasts, and the server's loop that takes it back.
_SLOTS_S = 160.0
_RUNS_S = 30.0


@dataclass(frozen=True)
class Injection:
    """A fault that has happened.

    Attributes:
        moment: of the system's monotonic clock.
        logs: that it hit; ``None`` for those of which a stage was being computed.
    """

    moment: float
    logs: set[str] | None = None


class Fault:
    """Base of the faults.

    Attributes:
        name: in words, as the table names it.
        how: how it is injected, for the table.
        store: where the artifacts are, for the table.
        pause_s: least and most seconds between two injections.
        first_stage: whether the first injection waits until a stage is computed.
    """

    name: str
    how: str
    store = "folder"
    pause_s = (1.0, 6.0)
    first_stage = True

    def surround(self, cluster: Cluster) -> AbstractContextManager[None]:
        """What must be true while the fault's datasets run."""
        return _nothing()

    def make_store(self, cluster: Cluster, number: int) -> str:
        """The address of an empty store."""
        return str(cluster.folder / f"store-{type(self).__name__}-{number}")

    def start(self, cluster: Cluster, store: str) -> list[subprocess.Popen[bytes]]:
        """Starts the dataset, or several at a time."""
        return [cluster.start_dataset(LOGS, store)]

    def inject(self, cluster: Cluster, rng: random.Random) -> Injection | None:
        """Makes the fault happen and be over; ``None`` where there was nothing to hit."""
        raise NotImplementedError


@contextmanager
def _nothing() -> Iterator[None]:
    yield


@dataclass
class Round:
    """A dataset that was disturbed, and what was found of it."""

    complete: bool
    identical: int
    computations: Computations
    slots: int
    leases: int
    temporaries: int
    recovery_s: list[float]
    problems: list[str] = field(default_factory=list)


def run_quietly(cluster: Cluster) -> dict[str, str]:
    """Runs the dataset undisturbed; the digest of every artifact's bytes."""
    store = str(cluster.folder / "store-quiet")
    command = cluster.start_dataset(LOGS, store)
    command.wait(_DATASET_S)
    assert command.returncode == 0, cluster.read_error(command)
    payloads = checks.read_payloads(store)
    counted = count_computations(read_notes(cluster.faults, store))
    assert (counted.computed, counted.twice, counted.cut_short, counted.failed) == (len(payloads), 0, 0, 0)
    return payloads


def run_fault(cluster: Cluster, fault: Fault, times: int, quiet: dict[str, str]) -> tuple[FaultRow, list[str]]:
    """Injects a fault into as many datasets as it takes, and checks each of them.

    Args:
        cluster: the services.
        fault: the fault.
        times: how often it is injected.
        quiet: digests of the undisturbed run.

    Returns:
        The row of the table, and problems in words for whoever reads a failed test.
    """
    rng = random.Random(fault.name)
    rounds: list[Round] = []
    injected = 0
    with fault.surround(cluster):
        # A dataset may end before all injections; more rounds than injections would be a fault that never hits.
        while injected < times and len(rounds) < times:
            store = fault.make_store(cluster, len(rounds))
            commands = fault.start(cluster, store)
            injections = _disturb(cluster, fault, commands, store, times - injected, rng)
            injected += len(injections)
            for command in commands:
                command.wait(_DATASET_S)
            rounds.append(_check(cluster, commands, store, injections, quiet))
    counts = [round_.computations for round_ in rounds]
    row = FaultRow(
        fault=fault.name,
        how=fault.how,
        store=fault.store,
        injected=injected,
        runs=len(rounds),
        complete=sum(round_.complete for round_ in rounds),
        artifacts=len(quiet) * len(rounds),
        identical=sum(round_.identical for round_ in rounds),
        twice=sum(count.twice for count in counts),
        cut_short=sum(count.cut_short for count in counts),
        failed=sum(count.failed for count in counts),
        slots=sum(round_.slots for round_ in rounds),
        leases=sum(round_.leases for round_ in rounds),
        temporaries=sum(round_.temporaries for round_ in rounds),
        recovery_s=[round(seconds, 1) for round_ in rounds for seconds in round_.recovery_s],
    )
    return row, [problem for round_ in rounds for problem in round_.problems]


def _disturb(
    cluster: Cluster,
    fault: Fault,
    commands: list[subprocess.Popen[bytes]],
    store: str,
    times: int,
    rng: random.Random,
) -> list[Injection]:
    def is_over() -> bool:
        return all(command.poll() is not None for command in commands)

    injections: list[Injection] = []
    deadline = time.monotonic() + _FIRST_STAGE_S
    while fault.first_stage and not read_notes(cluster.faults, store) and not is_over():
        assert time.monotonic() < deadline, "no stage was started"
        time.sleep(_POLL_S)
    while len(injections) < times and not is_over():
        resume = time.monotonic() + rng.uniform(*fault.pause_s)
        while time.monotonic() < resume and not is_over():
            time.sleep(_POLL_S)
        injection = None if is_over() else fault.inject(cluster, rng)
        if injection is not None:
            injections.append(injection)
    return injections


def _check(
    cluster: Cluster,
    commands: list[subprocess.Popen[bytes]],
    store: str,
    injections: list[Injection],
    quiet: dict[str, str],
) -> Round:
    problems = []
    for command in commands:
        rows = cluster.read_rows(command)
        if command.returncode != 0 or not rows or any(row["status"] != "done" for row in rows):
            problems.append(f"exit {command.returncode}: {rows} {cluster.read_error(command)}")
    complete = not problems
    payloads = checks.read_payloads(store)
    notes = read_notes(cluster.faults, store)
    computations = count_computations(notes)
    damaged = checks.find_damage(store)
    runs = checks.wait_for_zero(lambda: len(cluster.read_active_runs()), _RUNS_S)
    slots = checks.wait_for_zero(cluster.count_slots, _SLOTS_S)
    opened = open_store(store)
    # Before the cleaning, which removes those of a bucket.
    leases = checks.list_leases(opened)
    temporaries = checks.list_temporaries(opened)
    problems += [*damaged, *temporaries, *leases, *computations.doubled]
    problems += sorted({note.why for note in notes if note.event == "failed"})
    return Round(
        complete=complete and not damaged,
        identical=checks.count_identical(payloads, quiet),
        computations=computations,
        slots=slots + runs,
        leases=len(leases),
        temporaries=len(temporaries),
        recovery_s=_recoveries(notes, injections),
        problems=problems,
    )


def _recoveries(notes: list[Note], injections: list[Injection]) -> list[float]:
    found = []
    for injection in injections:
        logs = find_running(notes, injection.moment) if injection.logs is None else injection.logs
        seconds = measure_recovery(notes, injection.moment, logs)
        if seconds is not None:
            found.append(seconds)
    return found
