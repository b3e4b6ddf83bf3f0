"""Says what is missing where a flow run of a dataset waits long for its worker."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from uuid import UUID

from prefect.client.orchestration import SyncPrefectClient
from prefect.client.schemas.objects import FlowRun, StateType, WorkQueue, WorkQueueStatus
from prefect.exceptions import ObjectNotFound

from flows.dataset.server_calls import call_server

_log = logging.getLogger("genre")
# The server notices after 75 s that nobody asks a queue for runs any more.
_PATIENCE_S = 90.0


class StartWatch:
    """Warns where a watched flow run is not started, and again where another reason shows.

    Args:
        client: of the server.
        clock: seconds of a clock that never jumps.
        subject: what a warning calls the flow run.
        way_out: what helps a flow run that no worker will take, with ``{id}`` in the place of its id.
    """

    def __init__(
        self,
        client: SyncPrefectClient,
        clock: Callable[[], float] = time.monotonic,
        subject: str = "the dataset's flow run",
        way_out: str = "cancel it (prefect flow-run cancel {id}), and run the same command again.",
    ) -> None:
        self._client = client
        self._clock = clock
        self._subject = subject
        self._way_out = way_out
        self._state_id: UUID | None = None
        self._since_s = clock()
        self._last_reason = ""

    def restart(self) -> None:
        """Counts the next wait from its first check on, and warns of it again."""
        self._state_id = None
        self._last_reason = ""

    def check(self, run: FlowRun) -> None:
        """Warns if the flow run has waited long, and says why it waits.

        Args:
            run: as the server has it now.
        """
        if run.state is None or run.state.type not in (StateType.SCHEDULED, StateType.PENDING):
            return
        now_s = self._clock()
        if run.state.id != self._state_id:
            self._state_id = run.state.id
            self._since_s = now_s
        if now_s - self._since_s <= _PATIENCE_S:
            return
        # The next look is as far away, as reasons change slowly.
        self._since_s = now_s
        reason = self._find_reason(run)
        if reason != self._last_reason:
            self._last_reason = reason
            _log.warning("%s has not started: %s", self._subject, reason)

    def _find_reason(self, run: FlowRun) -> str:
        again = self._way_out.format(id=run.id)
        if run.state is not None and run.state.type is StateType.PENDING:
            return f"a worker has taken it, and starts no process. If that worker is dead, {again}"
        queue = self._read_queue(run)
        if queue is None:
            return f"its work queue was deleted. Deploy the flows (genre ops deploy --store STORE), {again}"
        pool = queue.work_pool_name
        where = f"the work queue '{queue.name}' of the pool '{pool}'"
        if queue.status is WorkQueueStatus.NOT_READY:
            return (
                f"no worker asks for runs of {where}. "
                f"Start one: prefect worker start --pool {pool} --work-queue {queue.name}."
            )
        if queue.status is WorkQueueStatus.PAUSED:
            return f"{where} is paused. Resume it: prefect work-queue resume {queue.name} --pool {pool}."
        return f"{where} has a worker, and no free slot. Raise its limit, resume its pool, or wait for other runs."

    def _read_queue(self, run: FlowRun) -> WorkQueue | None:
        if run.work_queue_id is None:
            return None
        try:
            return call_server(self._client.read_work_queue, run.work_queue_id)
        except ObjectNotFound:
            # Deleted since the run was read, which must not end who only watches.
            return None
