"""A process for each instruction set, since the kernel's is chosen when it is loaded."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import TracebackType


class IsaProcess:
    """A running child that measures the case with this name under ``GENRE_RENDER_ISA``.

    ``packages``: a folder whose packages come before the installed ones.
    """

    def __init__(self, isa: str, case: str, threads: int, packages: Path | None = None) -> None:
        env = os.environ | {"GENRE_RENDER_ISA": isa}
        if packages is not None:
            env["PYTHONPATH"] = str(packages)
        self._child = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.raster.instruction_set_worker", case, str(threads)],
            env=env,
            cwd=packages,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __enter__(self) -> IsaProcess:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._child.kill()
        self._child.communicate()

    def seconds(self) -> float:
        """One measurement. Raises ``RuntimeError`` when the child has died; its stderr says of what."""
        assert self._child.stdin is not None and self._child.stdout is not None
        self._child.stdin.write("\n")
        self._child.stdin.flush()
        answer = self._child.stdout.readline()
        if not answer:
            raise RuntimeError(f"the measuring process ended with code {self._child.wait()}")
        return float(answer)
