"""The measuring process of :mod:`benchmarks.raster.instruction_sets`: ``isa_child CASE THREADS``.

Answers each line on stdin with the seconds of one forward and backward pass (a median of some) on stdout.
"""

from __future__ import annotations

import sys

from benchmarks.common.timing import on_threads, seconds_of
from benchmarks.raster.scenes import CASES, forward_backward, leaves_of, scene


def main() -> None:
    """Runs until stdin ends."""
    name, threads = sys.argv[1], int(sys.argv[2])
    s = scene(next(c for c in CASES if c.name == name))
    leaves = leaves_of(s.splats)
    action = on_threads(threads, lambda: forward_backward(s, leaves, threads))
    action()
    for _ in sys.stdin:
        sys.stdout.write(f"{seconds_of(action)}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
