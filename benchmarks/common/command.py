"""Starts ``genre run`` as a user does: in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from benchmarks.common.bench import NotMeasuredError
from flows.machine.facts import CHECKOUT

COMMAND = (sys.executable, "-P", "-c", "from flows.cli.main import main; main()")


def run_genre(log: str, prefect_home: Path, *arguments: str, environment: Mapping[str, str] | None = None) -> str:
    """Runs ``genre run`` to its end.

    Args:
        log: the log's URI.
        prefect_home: folder of Prefect's database, so that a user's server and settings play no part.
        arguments: what stands behind the log.
        environment: of the command; this process's one if not given. Prefect's variables of both are left out.

    Returns:
        What it prints on stdout.

    Raises:
        NotMeasuredError: the command fails.
    """
    given = os.environ if environment is None else environment
    kept = {name: value for name, value in given.items() if not name.startswith("PREFECT_")}
    variables = kept | {"PYTHONPATH": str(CHECKOUT), "PREFECT_HOME": str(prefect_home)}
    command = [*COMMAND, "run", log, *arguments]
    done = subprocess.run(command, env=variables, capture_output=True, text=True, check=False)
    if done.returncode:
        raise NotMeasuredError(f"genre run ended with {done.returncode}: {done.stderr[-500:]}")
    return done.stdout
