"""What the installed command ``genre`` calls: signals are handled before anything else is imported."""

from __future__ import annotations

import sys

from flows.cli.signals import Interrupted, end_on_signals, exit_process


def main() -> None:
    """Runs the command.

    Raises:
        SystemExit: always, with the exit status.
    """
    end_on_signals()
    try:
        # Some tenths of a second, in which a user may think better of it.
        from flows.cli.main import main as run_main

        run_main()
    except Interrupted as interruption:
        # Before the command itself has begun; later on it catches this, too.
        sys.stderr.write("stopped\n")
        exit_process(interruption.exit_status)
