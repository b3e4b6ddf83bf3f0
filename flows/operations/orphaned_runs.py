"""Runs that outlive their worker: found by their environment, as they lead sessions of their own."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import psutil

_ROUNDS = 5
_SECONDS_TO_END = 5.0


def kill_runs(home: Path) -> bool:
    """Kills what a worker has left running, with all that its runs have started (SIGKILL).

    A worker that is killed alone, as for want of memory, leaves its runs: Prefect starts them in sessions of their own.

    Args:
        home: the worker's ``PREFECT_HOME``, which its runs have inherited. The worker itself has ended.

    Returns:
        Whether there were any.
    """
    import psutil

    is_any = False
    # Another time, as one of them may have started another just before its end.
    for _ in range(_ROUNDS):
        found = _find_processes(home)
        if not found:
            break
        is_any = True
        for process in found:
            with suppress(psutil.Error):
                process.kill()
        # One that is in a call of the system ends after it, and may write until then.
        psutil.wait_procs(found, timeout=_SECONDS_TO_END)
    return is_any


def _find_processes(home: Path) -> list[psutil.Process]:
    import psutil

    wanted = home.resolve()
    found = []
    for process in psutil.process_iter():
        named = ""
        # Those of other users and those that end meanwhile cannot be read.
        with suppress(psutil.Error, OSError):
            named = process.environ().get("PREFECT_HOME", "")
        # The state folder may have been named by a link then.
        if named and Path(named).resolve() == wanted and process.pid != os.getpid():
            found.append(process)
    return found
