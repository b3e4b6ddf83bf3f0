"""The measuring process of :mod:`benchmarks.raster.instruction_sets`.

Arguments: ``CASE THREADS [KERNEL_FOLDER]``. Answers each line on stdin with the seconds of one forward and backward
pass (a median of some) on stdout.
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from unittest.mock import patch

from benchmarks.common.timing import median_call_seconds, on_threads
from benchmarks.raster.scenes import CASES, forward_backward, gradient_leaves, scene
from genre_tasks.render import cpu
from genre_tasks.render.kernel.build import KERNEL
from genre_tasks.render.kernel.library import load_kernel


def main() -> None:
    """Runs until stdin ends."""
    name = sys.argv[1]
    threads = int(sys.argv[2])
    folder = Path(sys.argv[3]) if len(sys.argv) > 3 else KERNEL.folder
    # Made from its seed in each process, so that all builds render the same scene.
    s = scene(next(c for c in CASES if c.name == name))
    leaves = gradient_leaves(s.splats)
    action = on_threads(threads, lambda: forward_backward(s, leaves, threads))
    with patch.object(cpu, "load_kernel", partial(load_kernel, folder)):
        # The first call loads the kernel, which is not to be measured.
        action()
        for _ in sys.stdin:
            sys.stdout.write(f"{median_call_seconds(action)}\n")
            # A pipe is block-buffered, and the parent would wait for ever.
            sys.stdout.flush()


if __name__ == "__main__":
    main()
