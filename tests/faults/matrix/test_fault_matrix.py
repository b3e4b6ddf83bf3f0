"""Every fault of the matrix, injected at random moments into datasets on real services: nothing is lost or doubled.

The table of ``docs/results/faults.md`` is made by these tests::

    python -m pytest -m fault tests/faults/matrix --write-fault-table
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from typing import NamedTuple

import pytest

from flows.machine.facts import git_commit
from tests.faults.matrix import machine_faults, service_faults, store_faults, worker_faults
from tests.faults.matrix.cluster import Cluster, start_cluster
from tests.faults.matrix.fault_table import TABLE, find_faults, merge_row
from tests.faults.matrix.scenario import Fault, run_fault, run_quietly

pytestmark = [pytest.mark.slow, pytest.mark.fault, pytest.mark.timeout(1800)]
FAULTS: tuple[type[Fault], ...] = (
    machine_faults.RetryUnderLimit,
    machine_faults.AllocationFails,
    machine_faults.TwoWorkersOneArtifact,
    machine_faults.DiskFull,
    worker_faults.RunKilled,
    worker_faults.WorkerKilledAlone,
    worker_faults.WorkerKilledWithChildren,
    worker_faults.WorkerKilledWhilePending,
    worker_faults.WorkerKilledBeforeHeartbeat,
    service_faults.ServerKilled,
    service_faults.DatabaseRestarted,
    machine_faults.ClockJumps,
    store_faults.StoreUnreachable,
    store_faults.StoreFails,
    store_faults.StoreSlow,
    store_faults.UploadTruncated,
    store_faults.WorkerKilledWithLease,
    store_faults.TwoWorkersOneObject,
    store_faults.ClockJumpsWithLeases,
)


class Services(NamedTuple):
    """What all faults share."""

    cluster: Cluster
    quiet: dict[str, str]
    commit: str


@pytest.fixture(scope="module")
def services(request: pytest.FixtureRequest) -> Iterator[Services]:
    """All services, started once, and the digests of an undisturbed run."""
    with start_cluster(request.config.getoption("keep_fault_folder")) as cluster:
        # Before the first row is written, which changes the table.
        yield Services(cluster, run_quietly(cluster), git_commit())


@pytest.mark.parametrize("kind", FAULTS, ids=lambda kind: kind.__name__)
def test_nothing_is_lost(kind: type[Fault], services: Services, request: pytest.FixtureRequest) -> None:
    if kind is machine_faults.DiskFull and shutil.which("mount") is None:
        pytest.skip("a small disk cannot be mounted")
    times = request.config.getoption("fault_times")
    try:
        row, problems = run_fault(services.cluster, kind(), times, services.quiet)
    finally:
        services.cluster.stop_runs()
    if request.config.getoption("write_fault_table"):
        merge_row(TABLE, row, services.commit)
    wrong = find_faults(row, times)
    assert not wrong, "\n".join([*wrong, str(row), *problems])
