"""The ``genre`` command. Commands import what they need when they run, so that ``--help`` answers at once."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import typer

from flows.cli import bench, check, cost, doctor, effects, figure, paper_table, range, render, run, show, train, verify

app = typer.Typer(
    name="genre",
    help="Make driving logs re-simulatable: reconstruct, fix and enhance 3D Gaussian scenes.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.command(name="run")(run.run)
app.command(name="check")(check.check)
app.command(name="effects")(effects.effects)
app.command(name="render")(render.render)
app.command(name="range")(range.reliable)
app.command(name="show")(show.show)
app.command(name="verify")(verify.verify)
app.command(name="doctor")(doctor.doctor)
app.command(name="cost")(cost.cost)
app.command(name="table")(paper_table.table)
app.command(name="figure")(figure.figure)
app.command(name="bench")(bench.bench)
app.add_typer(train.app, name="train")


def prepare_environment(debug: bool) -> None:
    """Settings that Prefect and the numeric libraries read at import: a home per project, no telemetry, no chatter."""
    os.environ.setdefault("PREFECT_HOME", str(Path.cwd() / ".genre" / "prefect"))
    os.environ.setdefault("DO_NOT_TRACK", "1")
    os.environ.setdefault("PREFECT_SERVER_ANALYTICS_ENABLED", "false")
    # Twenty seconds, its default, are not enough for its server on a busy machine.
    os.environ.setdefault("PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS", "180")
    os.environ.setdefault("PREFECT_LOGGING_LEVEL", "INFO" if debug else "CRITICAL")
    os.environ.setdefault("PREFECT_LOGGING_TO_API_ENABLED", "false")
    # Idle OpenMP threads would spin and take the cores from the renderer's and the pools' own: ten times as slow here.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def main() -> None:
    """Runs the command; an expected error is one line on stderr and an exit code, a traceback only with ``--debug``."""
    debug = "--debug" in sys.argv
    if debug:
        sys.argv.remove("--debug")
    prepare_environment(debug)
    from genre_tasks.errors import ConfigError, GenreError, InputError

    try:
        app()
    except GenreError as error:
        if debug:
            raise
        typer.echo(f"error: {error}", err=True)
        raise SystemExit(2 if isinstance(error, ConfigError | InputError) else 1) from None


if __name__ == "__main__":
    main()
