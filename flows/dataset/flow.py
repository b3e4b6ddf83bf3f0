"""The flow of a dataset: its logs one after another in this process, or as child runs through a work pool."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from functools import partial
from typing import Any

from prefect import flow
from prefect.runtime import flow_run

from flows.configuration import load_configuration
from flows.dataset.dataset_record import name_dataset, write_dataset_record
from flows.dataset.live_table import FINAL_STATUSES, LiveTable
from flows.dataset.prefect_runs import ChildRequest, PrefectRuns
from flows.dataset.server_calls import call_server, read_last_outage
from flows.dataset.submission import mark_as_parent, require_parent
from flows.dataset.supervisor import SupervisionLimits, Supervisor, read_limits
from flows.dataset.work_units import Unit, WorkUnit, list_units
from flows.defaults import DEFAULT_ATTEMPTS, DEFAULT_IN_FLIGHT, DEFAULT_PRESET, DEFAULT_STORE
from flows.pipeline.log_cache import expand_logs
from flows.pipeline.progress import get_reporter
from flows.reconstruction.flow import reconstruct_log
from flows.reconstruction.left_out import LogsFailedError, describe_log
from genre_tasks.errors import ConfigError, GenreError

_log = logging.getLogger("genre")
Outcomes = list[dict[str, Any]]


@flow(name="reconstruct-dataset", persist_result=False, validate_parameters=False)
def reconstruct_dataset(
    logs: list[str],
    preset: str = DEFAULT_PRESET,
    store: str = DEFAULT_STORE,
    settings: list[str] | None = None,
    pool: str | None = None,
    in_flight: int = DEFAULT_IN_FLIGHT,
    unit: Unit = "log",
    attempts: int = DEFAULT_ATTEMPTS,
    gpu_limit: str | None = None,
) -> list[dict[str, Any]]:
    """Reconstructs many logs, each in a child flow run; a log that fails does not stop the others.

    With a pool the child runs are runs of the deployment ``reconstruct-log/log`` on its workers. One that dies is set
    to Crashed and submitted again. A parent that is started again takes over the child runs that are still active.

    A table of all logs is shown by Prefect while they run. At the end a line for each log says how it ended and why.

    Args:
        logs: URIs of logs; ``pandaset:PATH/*`` stands for every sequence in a folder.
        preset: demo, small, fine, long, hd or paper.
        store: folder (or URI) of the store; with a pool, one that every worker reaches.
        settings: ``section.key=value`` strings over the preset.
        pool: the work pool of the child runs; ``None`` runs the logs in this process, one after another.
        in_flight: child runs that are submitted and have not ended, at most.
        unit: ``log`` for one child run a log, ``chunk`` for one a chunk.
        attempts: how often a log is submitted, at most, where its run dies or meets a damaged artifact.
        gpu_limit: name of a global concurrency limit of Prefect, of which each heavy stage takes a slot, on any device.

    Returns:
        How each log (or chunk) ended, in order: ``log``, ``status``, ``run``, ``report`` and more.

    Raises:
        InputError: a star matches no folder.
        ConfigError: a setting, a parameter or a variable of the environment is wrong.
        ResourceError: with a pool, its own flow run was deleted while it ran.
        LogsFailedError: some logs are not complete, raised once all were tried; its ``outcomes`` has all of them.

    Example::

        try:
            outcomes = reconstruct_dataset(["pandaset:data/*"], preset="small")
        except LogsFailedError as error:
            failed = [outcome["log"] for outcome in error.outcomes if outcome["status"] == "failed"]
    """
    _check_parameters(in_flight, unit, attempts)
    expanded = expand_logs(logs)
    name = name_dataset(expanded, preset, store, settings)
    table = LiveTable()
    if pool is None:
        outcomes = _reconstruct_here(expanded, preset, store, settings, table)
    else:
        units = list_units(expanded, unit, load_configuration(preset, settings=settings or ()))
        parameters = {"preset": preset, "store": store, "settings": settings}
        mark_as_parent(str(flow_run.id), name)
        request = ChildRequest(name, str(flow_run.id), pool, parameters, gpu_limit)
        outcomes = _reconstruct_on_pool(request, units, read_limits(in_flight, attempts), table)
    _report(outcomes)
    report = write_dataset_record(store, name, preset, outcomes)
    get_reporter().message(f"report {report}")
    # After the lines and the record: if Prefect's server fails now, they are there nevertheless.
    call_server(table.show_now, outcomes)
    if any(outcome["status"] != "done" for outcome in outcomes):
        raise LogsFailedError(outcomes)
    return outcomes


def _check_parameters(in_flight: int, unit: str, attempts: int) -> None:
    # A flow's parameters may be anything, as a command line of Prefect's passes them.
    for name, value in (("in_flight", in_flight), ("attempts", attempts)):
        if not isinstance(value, int) or isinstance(value, bool) or value < 1:
            raise ConfigError(f"{name} is {value!r}", remedy=f"{name} is a whole number from 1 on.")
    if unit not in ("log", "chunk"):
        raise ConfigError(f"unit is {unit!r}", remedy="unit is log or chunk.")


def _reconstruct_on_pool(
    request: ChildRequest, units: Sequence[WorkUnit], limits: SupervisionLimits, table: LiveTable
) -> Outcomes:
    # A parent that was deleted must not submit, nor write the record: another one may have taken its place.
    check_parent = partial(require_parent, request.parent)
    runs = PrefectRuns(request, before_submission=check_parent)
    outcomes = Supervisor(units, runs, limits, table.show, last_outage=read_last_outage).run()
    check_parent()
    return outcomes


def _reconstruct_here(
    logs: Sequence[str], preset: str, store: str, settings: list[str] | None, table: LiveTable
) -> Outcomes:
    outcomes: Outcomes = [{"log": log, "status": "waiting", "why": ""} for log in logs]
    for position, log in enumerate(logs):
        outcomes[position] |= {"status": "running"}
        table.show(outcomes)
        start_s = time.monotonic()
        try:
            record = reconstruct_log(log, preset=preset, store=store, settings=settings)
        except Exception as error:
            # A fault of ours with one log is no reason to leave the others either.
            if not isinstance(error, GenreError):
                _log.exception("%s failed by a fault of ours", log)
            outcomes[position] = describe_log(log, getattr(error, "record", None), error)
        else:
            outcomes[position] = describe_log(log, record, None)
        outcomes[position]["seconds"] = round(time.monotonic() - start_s, 1)
    return outcomes


def _report(outcomes: Outcomes) -> None:
    for outcome in outcomes:
        # A row of a log that has ended has nothing to say on its stage.
        hidden = ("stage",) if outcome["status"] in FINAL_STATUSES else ()
        shown = {name: value for name, value in outcome.items() if name not in hidden and value not in ("", 0)}
        get_reporter().message("  ".join(f"{name} {value}" for name, value in shown.items()))
