"""``genre`` that kills itself (SIGKILL) at the n-th file sync inside one stage's commit: a helper of the fault tests.

python die_in_commit.py STAGE N run LOG …
"""

from __future__ import annotations

import os
import signal
import sys
from typing import Any

from storage import local


def arm(stage: str, count: int) -> None:
    """Kill this process at the ``count``-th sync while ``stage`` is committed."""
    commit, fsync = local.LocalStore.commit, os.fsync
    left = {"syncs": -1}

    def counting_commit(self: local.LocalStore, address: Any, *args: Any, **kwargs: Any) -> Any:
        left["syncs"] = count if address.stage == stage else -1
        return commit(self, address, *args, **kwargs)

    def counting_fsync(file: Any) -> None:
        left["syncs"] -= 1
        if left["syncs"] == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        fsync(file)

    local.LocalStore.commit = counting_commit  # type: ignore[method-assign,assignment]
    os.fsync = counting_fsync


if __name__ == "__main__":
    arm(sys.argv[1], int(sys.argv[2]))
    sys.argv = ["genre", *sys.argv[3:]]
    from flows.cli.main import main

    main()
