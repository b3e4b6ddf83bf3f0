"""Says what is missing where no child run of a dataset is started: its parent would wait for ever without a word."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence

from prefect.client.orchestration import SyncPrefectClient
from prefect.client.schemas.filters import (
    FlowRunFilter,
    FlowRunFilterState,
    FlowRunFilterStateType,
    FlowRunFilterTags,
)
from prefect.client.schemas.objects import FlowRun, StateType
from prefect.client.schemas.sorting import FlowRunSort

from flows.dataset.child_runs import DATASET_TAG
from flows.dataset.server_calls import call_server
from flows.dataset.start_watch import StartWatch
from flows.dataset.work_units import read_unit

_log = logging.getLogger("genre")
_POLL_S = 30.0
# A log whose run is cancelled is given up, and one whose run is gone is submitted again.
_WAY_OUT = "delete the run (prefect flow-run delete {id}): its log is submitted again."
_ACTIVE = [StateType.SCHEDULED, StateType.PENDING, StateType.RUNNING, StateType.CANCELLING]


class ChildStartWatch:
    """Warns where all child runs wait for a worker.

    While one of them runs, the others wait for its slot, which is nothing to warn of.

    Args:
        client: of the server.
        clock: seconds of a clock that never jumps.
    """

    def __init__(self, client: SyncPrefectClient, clock: Callable[[], float] = time.monotonic) -> None:
        self._client = client
        self._clock = clock
        self._watch = StartWatch(client, clock, subject="the oldest run of a log", way_out=_WAY_OUT)
        self._next_s = clock()

    def check(self, runs: Sequence[FlowRun]) -> None:
        """Warns if all child runs have waited long, and says why the oldest one waits.

        Args:
            runs: the child runs that were active when they were last looked at, the oldest first.
        """
        if not runs or any(run.state is None or run.state.type is not StateType.SCHEDULED for run in runs):
            self._watch.restart()
            return
        # A server that does not tell of its queues is no reason to end a dataset.
        try:
            self._watch.check(runs[0])
        except Exception as error:
            _log.warning("why runs of logs do not start could not be asked: %s", error)

    def follow(self, parent: FlowRun) -> None:
        """Reads the child runs of a running parent now and then, and checks them.

        Args:
            parent: as the server has it now.
        """
        tags = [tag for tag in parent.tags if tag.startswith(DATASET_TAG)]
        is_running = parent.state is not None and parent.state.type is StateType.RUNNING
        now_s = self._clock()
        if not is_running or not tags or now_s < self._next_s:
            return
        self._next_s = now_s + _POLL_S
        # By the dataset and not by the parent: it takes over the runs of earlier parents.
        wanted = FlowRunFilter(
            tags=FlowRunFilterTags(all_=tags),
            state=FlowRunFilterState(type=FlowRunFilterStateType(any_=_ACTIVE)),
        )
        found = call_server(
            self._client.read_flow_runs, flow_run_filter=wanted, sort=FlowRunSort.EXPECTED_START_TIME_ASC
        )
        # The parent has the dataset's tag, too.
        self.check([run for run in found if read_unit(run.tags) is not None])
