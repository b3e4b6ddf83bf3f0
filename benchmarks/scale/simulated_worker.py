"""Many workers in one process: Prefect's worker itself, whose flow runs are simulated in place of being processes.

Run as ``python -m benchmarks.scale.simulated_worker PLAN.json`` with the environment of a worker.
"""

from __future__ import annotations

import asyncio
import json
import os
import random
import resource
import sys
import time
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from prefect.client.schemas.objects import FlowRun
from prefect.workers.base import BaseJobConfiguration, BaseVariables, BaseWorker, BaseWorkerResult

from benchmarks.scale.request_meter import RequestMeter
from benchmarks.scale.simulated_run import RunCounts, RunPlan, run_log
from benchmarks.scale.simulated_stages import run_simulated_stage, write_simulated_record
from storage.opening import open_store

_LAG_EVERY_S = 0.2


@dataclass(frozen=True)
class WorkersPlan:
    """What a process of workers does.

    Attributes:
        names: of the workers.
        pool: the work pool.
        queue: the work queue.
        store: URI of the store.
        seed: of the artifacts' keys, and of when the workers start.
        scale: by what the seconds of stages are multiplied.
        seconds: of the stages, by name.
        poll_s: seconds between two polls of a worker.
        stop_file: the workers stop when it is there.
        result_file: where the process writes what it did.
    """

    names: list[str]
    pool: str
    queue: str
    store: str
    seed: int
    scale: float
    seconds: dict[str, float]
    poll_s: float
    stop_file: str
    result_file: str


class SimulatedWorker(BaseWorker[BaseJobConfiguration, BaseVariables, BaseWorkerResult]):
    """A worker of Prefect that polls, sends heartbeats and proposes states, and simulates the run's process.

    Args:
        plan: how logs are run.
        counts: what is done is added to it.
        threads: for the stages.
        options: of Prefect's worker.
    """

    type = "simulated"
    job_configuration = BaseJobConfiguration

    def __init__(self, plan: RunPlan, counts: RunCounts, threads: Executor, **options: Any) -> None:
        super().__init__(**options)
        self._plan = plan
        self._counts = counts
        self._threads = threads

    async def run(
        self,
        flow_run: FlowRun,
        configuration: BaseJobConfiguration,
        task_status: Any = None,
    ) -> BaseWorkerResult:
        """Simulates the process of a flow run.

        Args:
            flow_run: the run, which is pending.
            configuration: not used, as there is no process.
            task_status: takes the id of the process.

        Returns:
            A result of status 0; of status 1 where the run failed.
        """
        identifier = f"{self.name}:{os.getpid()}"
        if task_status is not None:
            task_status.started(identifier)
        try:
            await run_log(flow_run, self._plan, self._counts, self._threads)
        except Exception as error:
            # As a process that ends with an error: the worker sets the run to Crashed.
            self._counts.errors.append(f"{type(error).__name__}: {error}"[:500])
            return BaseWorkerResult(identifier=identifier, status_code=1)
        return BaseWorkerResult(identifier=identifier, status_code=0)


async def run_workers(plan: WorkersPlan, meter: RequestMeter) -> dict[str, Any]:
    """Runs workers until the stop file is there.

    Args:
        plan: of the process.
        meter: of the process's requests.

    Returns:
        What they did, as JSON values.
    """
    counts = RunCounts()
    store = open_store(plan.store)
    chooser = random.Random(f"{plan.seed} {plan.names[0]}")

    def compute(log: str, stage: str, seconds: float) -> bool:
        return run_simulated_stage(store, log, stage, plan.seed, seconds)

    run_plan = RunPlan(plan.seconds, plan.scale, compute, partial(write_simulated_record, store))
    lags: list[float] = []
    with ThreadPoolExecutor(len(plan.names)) as threads:
        tasks = [asyncio.create_task(_measure_lag(lags))]
        for name in plan.names:
            options = {"work_pool_name": plan.pool, "work_queues": [plan.queue], "name": name, "limit": 1}
            make = partial(SimulatedWorker, run_plan, counts, threads, create_pool_if_not_found=False, **options)
            # Workers of a cluster do not poll at the same moment.
            tasks.append(asyncio.create_task(_start_after(chooser.uniform(0.0, plan.poll_s), make)))
        while not Path(plan.stop_file).exists():
            await asyncio.sleep(_LAG_EVERY_S)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return {
        **asdict(meter),
        **asdict(counts),
        "lags": lags,
        "cpu_s": usage.ru_utime + usage.ru_stime,
        "failed_workers": [repr(task.exception()) for task in tasks if not task.cancelled() and task.exception()],
    }


async def _start_after(seconds: float, make: Any) -> None:
    await asyncio.sleep(seconds)
    await make().start(printer=lambda line: None)


async def _measure_lag(lags: list[float]) -> None:
    # How late this process is: its measured latencies of requests are too long by as much.
    while True:
        start_s = time.monotonic()
        await asyncio.sleep(_LAG_EVERY_S)
        lags.append(time.monotonic() - start_s - _LAG_EVERY_S)


def main(plan_file: Path) -> None:
    """Runs the workers of a plan and writes what they did.

    Args:
        plan_file: a :class:`WorkersPlan` as JSON.
    """
    plan = WorkersPlan(**json.loads(plan_file.read_text(encoding="utf-8")))
    meter = RequestMeter()
    meter.install()
    with suppress(KeyboardInterrupt):
        result = asyncio.run(run_workers(plan, meter))
        Path(plan.result_file).write_text(json.dumps(result), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
