"""The ``genre`` command. Commands import what they need when they run, so that ``--help`` answers at once."""

from __future__ import annotations

import logging
import os
import sys
import warnings
from contextlib import suppress
from typing import Annotated

import typer

from flows.cli.augment import augment
from flows.cli.bench import bench
from flows.cli.check import check
from flows.cli.convert import convert
from flows.cli.cost import cost
from flows.cli.dataset import dataset
from flows.cli.diff import diff
from flows.cli.doctor import doctor
from flows.cli.edit import edit
from flows.cli.effects import effects
from flows.cli.enhance import enhance
from flows.cli.export import export
from flows.cli.figure import figure
from flows.cli.gc import gc
from flows.cli.import_command import import_command
from flows.cli.last_resort import run_guarded
from flows.cli.lineage import lineage
from flows.cli.ops import app as ops_app
from flows.cli.outcome import start_outcome, wants_json
from flows.cli.paper_table import table
from flows.cli.parsing import check_words
from flows.cli.perceive import perceive
from flows.cli.pin import pin, unpin
from flows.cli.range import range_command
from flows.cli.render import render
from flows.cli.run import run
from flows.cli.serve import serve
from flows.cli.show import show
from flows.cli.signals import end_on_signals, exit_process
from flows.cli.simulate import simulate
from flows.cli.store import app as store_app
from flows.cli.streams import prepare_streams
from flows.cli.train import app as train_app
from flows.cli.verify import verify
from flows.cli.view import view
from flows.machine.state_folder import find_state_folder
from genre_tasks.errors import ConfigError

app = typer.Typer(
    name="genre",
    no_args_is_help=True,
    # Installing completion would write into the user's shell files.
    add_completion=False,
    # Errors are translated in one place, `run_guarded`.
    pretty_exceptions_enable=False,
    # Plain help starts faster, and the reference of commands is generated from the same text.
    rich_markup_mode=None,
)
# The order here is the order in `genre --help`: from a first run to looking at it, then measuring and training.
app.command(name="run")(run)
app.command(name="dataset")(dataset)
app.command(name="enhance")(enhance)
app.command(name="check")(check)
app.command(name="convert")(convert)
app.command(name="effects")(effects)
app.command(name="render")(render)
app.command(name="view")(view)
app.command(name="simulate")(simulate)
app.command(name="serve")(serve)
app.command(name="range")(range_command)
app.command(name="perceive")(perceive)
app.command(name="augment")(augment)
app.command(name="edit")(edit)
app.command(name="export")(export)
app.command(name="import")(import_command)
app.command(name="show")(show)
app.command(name="diff")(diff)
app.command(name="lineage")(lineage)
app.command(name="verify")(verify)
app.command(name="gc")(gc)
app.command(name="pin")(pin)
app.command(name="unpin")(unpin)
app.add_typer(store_app, name="store")
app.command(name="doctor")(doctor)
app.add_typer(ops_app, name="ops")
app.command(name="cost")(cost)
app.command(name="table")(table)
app.command(name="figure")(figure)
app.command(name="bench")(bench)
app.add_typer(train_app, name="train")


def _print_version(requested: bool) -> None:
    if requested:
        # The installed package's metadata is the one place that is right in a checkout and in an installation.
        from importlib.metadata import version

        typer.echo(f"genre {version('genre')}")
        raise typer.Exit


@app.callback()
def describe_program(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Make driving logs re-simulatable: reconstruct them as 3D Gaussian scenes and enhance the scenes.

    Add --debug to any command to see a traceback after an error. The exit status is 0 after success, 2 after a mistake
    in the input or the configuration, 1 after another error or where a part was left out, 130 after Ctrl-C, and 70
    after a fault of the program, whose traceback is then written to a file.

    Example:

    \b
        genre run 'synthetic:street?seed=1000' --preset demo
    """


def prepare_environment(debug: bool) -> None:
    """Sets what Prefect and the numeric libraries read when they are imported; what the user has set stays.

    Args:
        debug: whether Prefect's own messages are shown.
    """
    defaults = {
        # Nothing is sent to Prefect's makers.
        "DO_NOT_TRACK": "1",
        "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
        "PREFECT_LOGGING_LEVEL": "INFO" if debug else "CRITICAL",
        # The server of this process has another level. It warns of every write that it tries again.
        "PREFECT_SERVER_LOGGING_LEVEL": "WARNING" if debug else "CRITICAL",
        "PREFECT_LOGGING_TO_API_ENABLED": "false",
        # Idle OpenMP threads would spin and take the cores from the renderer's threads: ten times as slow on two cores.
        "OMP_WAIT_POLICY": "PASSIVE",
    }
    for name, value in defaults.items():
        # An empty variable counts as none, as in Prefect: an empty home would be the working folder.
        if not os.environ.get(name):
            os.environ[name] = value
    if not os.environ.get("PREFECT_HOME"):
        # Where nothing can be written, or the folder is not the user's, only what needs a home may fail: help does not.
        with suppress(OSError, ConfigError):
            # Not the working folder, which may be read-only.
            os.environ["PREFECT_HOME"] = str(find_state_folder() / "prefect")
    if not debug:
        # Python prints what a library logs before it has set up its log.
        logging.getLogger("prefect").addHandler(logging.NullHandler())
        # Prefect reads a file `.env` of the working folder, which may be another program's, many times.
        logging.getLogger("dotenv").setLevel(logging.ERROR)
    if any(option.startswith("error") for option in sys.warnoptions):
        # PYTHONWARNINGS=error makes deprecations inside Prefect's server errors, and it answers no more.
        warnings.simplefilter("default")


def main() -> None:
    """Runs the command. An error becomes one line on stderr and an exit status.

    Raises:
        SystemExit: always, with the exit status.
    """
    end_on_signals()
    # Any command takes --debug, in any place, so it is taken out before the arguments are parsed.
    debug = "--debug" in sys.argv
    if debug:
        sys.argv.remove("--debug")
    prepare_streams()
    command = typer.main.get_command(app)
    words = sys.argv[1:]
    start_outcome(as_json=wants_json(command, words))

    def invoke() -> None:
        prepare_environment(debug)
        check_words(words)
        # Not by `app()`, which prints errors and chooses exit statuses by itself.
        with command.make_context("genre", words) as context:
            command.invoke(context)

    exit_process(run_guarded(invoke, debug))


if __name__ == "__main__":
    main()
