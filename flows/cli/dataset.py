"""``genre dataset``: many logs, here one after another or on the workers of a Prefect work pool."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flows.cli.options import JsonOption, LogsArgument, PresetOption, SettingsOption, StoreOption
from flows.defaults import DEFAULT_ATTEMPTS, DEFAULT_IN_FLIGHT, DEFAULT_PRESET, DEFAULT_STORE

if TYPE_CHECKING:
    from uuid import UUID

PoolOption = Annotated[
    str | None,
    typer.Option(help="The Prefect work pool whose workers run the logs. Here, one after another, if not given."),
]
FollowOption = Annotated[
    bool, typer.Option("--follow", help="Show the table of all logs until the end. Ctrl-C leaves the dataset running.")
]
InFlightOption = Annotated[int, typer.Option(min=1, help="How many runs are submitted to the pool at once, at most.")]
ByOption = Annotated[str, typer.Option("--by", help="What one run on the pool is about: log or chunk.")]
AttemptsOption = Annotated[
    int, typer.Option(min=1, help="How often a log is submitted, at most, where its worker dies.")
]
GpuLimitOption = Annotated[
    str | None,
    typer.Option(help="The Prefect concurrency limit of which GNet, FNet, ENet and evaluation take a slot."),
]


def dataset(
    logs: LogsArgument,
    pool: PoolOption = None,
    follow: FollowOption = False,
    in_flight: InFlightOption = DEFAULT_IN_FLIGHT,
    unit: ByOption = "log",
    attempts: AttemptsOption = DEFAULT_ATTEMPTS,
    gpu_limit: GpuLimitOption = None,
    preset: PresetOption = DEFAULT_PRESET,
    store: StoreOption = DEFAULT_STORE,
    settings: SettingsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Reconstruct many driving logs, here or on many workers.

    A log that fails does not stop the others. With --pool every log is a run on a worker of a Prefect work pool, to
    which paths of logs and the store must mean the same as here. A log whose worker dies is submitted again. The same
    command run again goes on where the dataset was.

    The record is written to STORE/datasets/DATASET/dataset.json.

    Example:

    \b
        genre dataset 'pandaset:data/*' --preset small
        genre dataset 'pandaset:data/*' --pool genre --follow
    """
    from flows.cli.outcome import add_facts
    from flows.configuration import load_configuration
    from flows.configuration.absolute_paths import make_setting_absolute
    from flows.dataset.dataset_record import name_dataset
    from flows.pipeline.log_cache import expand_logs
    from genre_tasks.errors import ConfigError

    if unit not in ("log", "chunk"):
        raise ConfigError(f"--by is '{unit}'", remedy="Give log or chunk.")
    for_a_pool = {
        "--follow": follow,
        "--in-flight": in_flight != DEFAULT_IN_FLIGHT,
        "--by": unit != "log",
        "--attempts": attempts != DEFAULT_ATTEMPTS,
        "--gpu-limit": gpu_limit is not None,
    }
    for option, is_given in for_a_pool.items():
        if is_given and pool is None:
            raise ConfigError(f"{option} is for a dataset on a pool", remedy="Give a --pool, too, or leave it out.")
    # A mistake in a setting or a path shows here, before anything is submitted.
    load_configuration(preset, settings=settings or ())
    # Records of runs name files, and are read from other folders.
    settings = [make_setting_absolute(setting) for setting in settings or ()]
    expanded = expand_logs(logs)
    if pool is not None:
        expanded, store = _make_absolute(expanded, store)
    name = name_dataset(expanded, preset, store, settings)
    facts = {"dataset": name, "preset": preset, "store": store}
    add_facts(**facts, logs=[])
    parameters = {"logs": expanded, "preset": preset, "store": store, "settings": settings}
    if pool is None:
        _run_here(parameters, facts, as_json)
        return
    on_pool = {"pool": pool, "in_flight": in_flight, "unit": unit, "attempts": attempts, "gpu_limit": gpu_limit}
    run_id = _submit(name, {**parameters, **on_pool}, follow, as_json)
    if follow:
        _follow(run_id, facts, as_json)


def _make_absolute(logs: list[str], store: str) -> tuple[list[str], str]:
    """The same logs and store for a worker, which runs in a folder of its own."""
    from genre_tasks.logs.registry import make_log_absolute
    from storage.opening import make_address_absolute

    # Its folder is removed with all that a relative store has got there.
    store = make_address_absolute(store)
    return [make_log_absolute(log) for log in logs], store


def _run_here(parameters: Mapping[str, Any], facts: Mapping[str, Any], as_json: bool) -> None:
    from flows.cli.terminal import report_on_terminal
    from flows.reconstruction.left_out import LogsFailedError

    with report_on_terminal():
        from flows.dataset.flow import reconstruct_dataset

        try:
            outcomes = reconstruct_dataset(**parameters)
        except LogsFailedError as error:
            _print_outcomes(error.outcomes, facts, as_json, error)
            raise
    _print_outcomes(outcomes, facts, as_json)


def _submit(name: str, parameters: Mapping[str, Any], follow: bool, as_json: bool) -> UUID:
    from flows.cli.outcome import add_facts, print_outcome
    from flows.prefect_api.connection import check_server, read_api_url
    from genre_tasks.errors import ConfigError

    url = read_api_url()
    if url is None:
        remedy = "Set PREFECT_API_URL to the address of its API, such as http://127.0.0.1:4200/api."
        raise ConfigError("a dataset on a pool needs a Prefect server, and none is named", remedy=remedy)
    check_server(url)
    from flows.dataset.submission import submit_dataset

    submission = submit_dataset(name, parameters)
    add_facts(flow_run=str(submission.id))
    if as_json and not follow:
        facts = {"dataset": name, "flow_run": str(submission.id), "is_new": submission.is_new}
        print_outcome("done", facts)
        return submission.id
    started = "started" if submission.is_new else "is running already"
    typer.echo(f"dataset {name} {started}: flow run {submission.id}", err=as_json)
    if not follow:
        typer.echo("watch it by the same command with --follow, or in Prefect's UI")
    return submission.id


def _follow(run_id: UUID, facts: Mapping[str, Any], as_json: bool) -> None:
    from flows.cli.signals import Interrupted
    from flows.dataset.submission import follow_dataset
    from flows.reconstruction.left_out import LogsFailedError
    from genre_tasks.errors import ResourceError

    try:
        with _LiveRows() as live:
            state, rows = follow_dataset(run_id, live.show)
    except Interrupted as error:
        typer.echo("no longer following; the dataset goes on: the same command follows it again", err=True)
        raise typer.Exit(error.exit_status) from error
    if state.startswith("COMPLETED"):
        _print_outcomes(rows, facts, as_json)
        return
    if not rows or all(row["status"] == "done" for row in rows):
        raise ResourceError(f"the dataset's flow run ended as {state}", remedy="Run the same command again.")
    failure = LogsFailedError(rows)
    _print_outcomes(rows, facts, as_json, failure)
    raise failure


class _LiveRows:
    """The table of all logs on stderr, rewritten in place on a terminal; elsewhere a line whenever it changes."""

    def __init__(self) -> None:
        import sys

        from rich.console import Console
        from rich.live import Live

        from flows.cli.streams import is_rewritable

        self._last_line = ""
        console = Console(file=sys.stderr, markup=False, emoji=False)
        self._live = Live(console=console, refresh_per_second=2) if is_rewritable(sys.stderr) else None

    def __enter__(self) -> _LiveRows:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._live is not None:
            self._live.stop()

    def show(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Shows the rows.

        Args:
            rows: of the table.
        """
        from flows.dataset.live_table import describe_progress

        if self._live is not None:
            self._live.update(_build_table(rows))
            return
        line = describe_progress(rows)
        if rows and line != self._last_line:
            self._last_line = line
            typer.echo(line, err=True)


def _build_table(rows: Sequence[Mapping[str, Any]]) -> Any:
    from rich.table import Table

    from flows.dataset.live_table import describe_progress

    table = Table(title=describe_progress(rows))
    names = ("log", "chunk", "stage", "status", "seconds", "where", "why")
    for name in names:
        table.add_column("error" if name == "why" else name)
    for row in rows:
        table.add_row(*(str(row.get(name, "")) for name in names))
    return table


def _print_outcomes(
    rows: Sequence[Mapping[str, Any]], facts: Mapping[str, Any], as_json: bool, error: Any = None
) -> None:
    from flows.cli.outcome import print_outcome
    from flows.cli.printing import print_rows

    if as_json:
        print_outcome("done" if error is None else error.status, {**facts, "logs": [dict(row) for row in rows]}, error)
        return
    names = ("log", "chunk", "status", "run", "seconds", "where")
    print_rows("logs", [{name: row.get(name, "") for name in names} for row in rows])
