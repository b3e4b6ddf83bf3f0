"""A process for each instruction set, since the kernel's is chosen when it is loaded."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import TracebackType


class IsaProcess:
    """A child process that measures the renderer on one instruction set; a context manager that ends it."""

    def __init__(self, isa: str, case: str, threads: int, kernel_folder: Path | None = None) -> None:
        """Starts the child.

        Args:
            isa: set as ``GENRE_RENDER_ISA``.
            case: name of the scene to render.
            threads: of the renderer.
            kernel_folder: where the kernel is loaded from; ``None``: where it is installed.
        """
        # The kernel is chosen when it is loaded, so the choice goes into the environment of a new process.
        folder = [] if kernel_folder is None else [str(kernel_folder)]
        self._child = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.raster.instruction_set_worker", case, str(threads), *folder],
            env=os.environ | {"GENRE_RENDER_ISA": isa},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __enter__(self) -> IsaProcess:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # The child waits for its next line for ever, so it has to be ended.
        self._child.kill()
        self._child.communicate()

    def seconds(self) -> float:
        """Takes one measurement of forward + backward.

        Raises:
            RuntimeError: the child has died; its stderr tells the reason.
        """
        assert self._child.stdin is not None and self._child.stdout is not None
        self._child.stdin.write("\n")
        # The text layer buffers lines, and the child would never see the request.
        self._child.stdin.flush()
        answer = self._child.stdout.readline()
        # An empty line can only be the end of the child's output.
        if not answer:
            raise RuntimeError(f"the measuring process ended with code {self._child.wait()}")
        return float(answer)
