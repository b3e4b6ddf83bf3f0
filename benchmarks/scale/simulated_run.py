"""The flow run of one log as its process appears to the servers: the same requests, events, and stages that sleep."""

from __future__ import annotations

import asyncio
import base64
import json
import os
from collections.abc import Callable, Coroutine
from concurrent.futures import Executor
from contextlib import AsyncExitStack
from dataclasses import dataclass, field
from typing import Any
from uuid import UUID, uuid4

import prefect.utilities.engine
from prefect._internal.observers import FlowRunCancellingObserver
from prefect.client.orchestration import PrefectClient, get_client
from prefect.client.schemas.actions import ArtifactCreate, LogCreate
from prefect.client.schemas.objects import FlowRun, State, TaskRun
from prefect.events import Event, RelatedResource
from prefect.events.clients import PrefectEventsClient
from prefect.events.related import object_as_related_resource, tags_as_related_resources
from prefect.states import Completed, Pending, Running
from prefect.types._datetime import now

from flows.dataset.prefect_runs import HEARTBEAT_EVENT
from flows.dataset.supervisor import HEARTBEAT_S
from flows.reconstruction.outcome_artifact import OUTCOME_KEY

# Of a small log: a picture of each of four stages, and lines in the log of the run.
_PICTURES = 4
_PICTURE_BYTES = 75_000
_LINES_PER_STAGE = 3


@dataclass(frozen=True)
class RunPlan:
    """How logs are run.

    Attributes:
        seconds: of the stages, by name, as they were measured.
        scale: by what the seconds of stages, and between two heartbeats, are multiplied.
        compute: runs a stage of a log in a thread: log, stage, seconds. Returns whether it was computed.
        write_record: writes the record of a log's run into the store.
    """

    seconds: dict[str, float]
    scale: float
    compute: Callable[[str, str, float], bool]
    write_record: Callable[[str], None]


@dataclass
class RunCounts:
    """What runs have done in this process.

    Attributes:
        computed: stages that were computed, as ``LOG STAGE``.
        events: that were sent, by name.
        runs: that ended.
        errors: of runs that failed.
    """

    computed: list[str] = field(default_factory=list)
    events: dict[str, int] = field(default_factory=dict)
    runs: int = 0
    errors: list[str] = field(default_factory=list)


async def run_log(flow_run: FlowRun, plan: RunPlan, counts: RunCounts, threads: Executor) -> None:
    """Runs a log.

    Args:
        flow_run: a pending run of ``reconstruct-log/log``.
        plan: how.
        counts: what is done is added to it.
        threads: for the stages, one for every worker.
    """
    async with AsyncExitStack() as stack:
        # The worker watches its child, and so does the command that the child's process runs.
        await stack.enter_async_context(PrefectEventsClient())
        await stack.enter_async_context(FlowRunCancellingObserver(on_cancelling=lambda run_id: None))
        client = await stack.enter_async_context(get_client())
        run = await client.read_flow_run(flow_run.id)
        deployment_id = run.deployment_id
        assert deployment_id is not None
        await client.read_deployment(deployment_id)
        await stack.enter_async_context(PrefectEventsClient())
        await stack.enter_async_context(FlowRunCancellingObserver(on_cancelling=lambda run_id: None))
        # The command, the engine and the task runner of a process ask each.
        for route in ("/admin/version", "/admin/version", "/admin/version", "/admin/storage", "/admin/storage"):
            await client.request("GET", route)
        await client.update_flow_run(run.id, flow_version="simulated")
        await client.read_flow_run(run.id)
        await client.read_flow_run(run.id)
        await client.update_flow_run(run.id, name=run.name)
        await client.set_flow_run_state(run.id, Running())
        await client.read_flow_run(run.id)
        related = await _read_related(client, run, deployment_id)
        events = await stack.enter_async_context(PrefectEventsClient())
        process = _RunProcess(run, client, events, related, counts)
        heartbeats = asyncio.create_task(process.send_heartbeats(HEARTBEAT_S * plan.scale))
        stack.callback(heartbeats.cancel)
        log = str(run.parameters["log"])
        loop = asyncio.get_running_loop()
        for stage, seconds in plan.seconds.items():

            async def compute(stage: str = stage, seconds: float = seconds) -> bool:
                return await loop.run_in_executor(threads, plan.compute, log, stage, seconds * plan.scale)

            if await process.run_task(stage, compute):
                counts.computed.append(f"{log} {stage}")
        await loop.run_in_executor(threads, plan.write_record, log)
        await process.publish_results(log)
        await client.set_flow_run_state(run.id, Completed())
        await process.write_lines(["Finished in state Completed()"])
        counts.runs += 1


class _RunProcess:
    def __init__(
        self,
        run: FlowRun,
        client: PrefectClient,
        events: PrefectEventsClient,
        related: list[RelatedResource],
        counts: RunCounts,
    ) -> None:
        self._run = run
        self._client = client
        self._events = events
        self._related = related
        self._counts = counts

    async def send_heartbeats(self, every_s: float) -> None:
        while True:
            resource = {
                "prefect.resource.id": f"prefect.flow-run.{self._run.id}",
                "prefect.resource.name": self._run.name,
            }
            # The engine names the flow, the deployment and the tags alone.
            related = [entry for entry in self._related if entry.role in ("flow", "deployment", "tag")]
            await self._emit(Event(event=HEARTBEAT_EVENT, resource=resource, related=related))
            await asyncio.sleep(every_s)

    async def run_task(self, stage: str, compute: Callable[[], Coroutine[Any, Any, bool]]) -> bool:
        task = TaskRun(
            id=uuid4(),
            name=f"{stage} · chunk 0",
            flow_run_id=self._run.id,
            task_key="stage",
            dynamic_key=str(uuid4()),
            state=Pending(),
        )
        await self._change_state(task, None, Pending())
        await self._change_state(task, task.state, Running())
        computed = await compute()
        # Lines of a task reach the server in batches, every few seconds.
        await self.write_lines([f"chunk 0 {stage}: line {k}" for k in range(_LINES_PER_STAGE)])
        await self._change_state(task, task.state, Completed(name=None if computed else "Cached"))
        return computed

    async def write_lines(self, lines: list[str]) -> None:
        logs = [
            LogCreate(name="genre", level=20, message=line, timestamp=now("UTC"), flow_run_id=self._run.id)
            for line in lines
        ]
        await self._client.create_logs(logs)

    async def publish_results(self, log: str) -> None:
        """Publishes what :mod:`flows.reconstruction.flow` shows in Prefect's UI, and the outcome."""
        await self._publish("report", "markdown", f"[report](file:///{log}/report.html)")
        await self._publish("chunk-0", "table", [{"stage": "gnet", "served": "computed", "seconds": 1.0}])
        for number in range(_PICTURES):
            picture = base64.b64encode(os.urandom(_PICTURE_BYTES)).decode()
            await self._publish(f"chunk-0-{number}", "image", f"data:image/png;base64,{picture}")
        outcome = {
            "log": log,
            "status": "done",
            "chunks": 1,
            "left_out": 0,
            "run": "simulated",
            "report": "",
            "why": "",
        }
        await self._publish(OUTCOME_KEY, "table", [outcome | {"is_passing": False}])

    async def _publish(self, key: str, kind: str, data: Any) -> None:
        text = data if isinstance(data, str) else json.dumps(data)
        await self._client.create_artifact(ArtifactCreate(key=key, type=kind, data=text, flow_run_id=self._run.id))

    async def _change_state(self, task: TaskRun, before: State[Any] | None, state: State[Any]) -> None:
        task.state = state
        if state.is_running():
            task.run_count += 1
        event = _make_task_event(task, before, state)
        event.related += [*self._related, *tags_as_related_resources(task.tags)]
        await self._emit(event)

    async def _emit(self, event: Event) -> None:
        self._counts.events[event.event] = self._counts.events.get(event.event, 0) + 1
        await self._events.emit(event)


def _make_task_event(task: TaskRun, before: State[Any] | None, state: State[Any]) -> Event:
    """The event that Prefect's engine sends for a state of a task, not yet sent."""
    emit = prefect.utilities.engine.emit_event
    # The engine builds the event and sends it over the only connection of a process. Here many runs share a process,
    # and each has a connection of its own.
    prefect.utilities.engine.emit_event = Event  # type: ignore[assignment]
    try:
        event = prefect.utilities.engine.emit_task_run_state_change_event(task, before, state)
    finally:
        prefect.utilities.engine.emit_event = emit
    assert event is not None
    return event


async def _read_related(client: PrefectClient, run: FlowRun, deployment_id: UUID) -> list[RelatedResource]:
    """What every event of a run is related to; the engine reads it once for a process."""
    related = [object_as_related_resource("flow-run", "flow-run", run)]
    related.append(object_as_related_resource("flow", "flow", await client.read_flow(run.flow_id)))
    related.append(object_as_related_resource("deployment", "deployment", await client.read_deployment(deployment_id)))
    if run.work_queue_id is not None:
        queue = await client.read_work_queue(run.work_queue_id)
        related.append(object_as_related_resource("work-queue", "work-queue", queue))
    if run.work_pool_name is not None:
        pool = await client.read_work_pool(run.work_pool_name)
        related.append(object_as_related_resource("work-pool", "work-pool", pool))
    return [*related, *tags_as_related_resources(run.tags)]
