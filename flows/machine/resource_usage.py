"""What a piece of work takes: wall time, CPU time and the peak of memory."""

from __future__ import annotations

import gc
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from genre_tasks.errors import ResourceError


@dataclass
class ResourceUsage:
    """What a block of code took; the fields are filled in when the block ends.

    Attributes:
        seconds: wall time.
        cpu_seconds: CPU time of all threads of the process.
        peak_mib: peak of the process's resident memory during the block, MiB.
    """

    seconds: float = 0.0
    cpu_seconds: float = 0.0
    peak_mib: float = 0.0


@contextmanager
def measure_usage() -> Iterator[ResourceUsage]:
    """Measures the time and the memory of a block, and turns running out of memory into one kind of error.

    Yields:
        The usage, complete once the block has ended.

    Raises:
        ResourceError: the block ran out of memory, in Python or in a library.

    >>> with measure_usage() as usage:
    ...     squares = [n * n for n in range(1000)]
    >>> usage.seconds > 0 and usage.peak_mib > 0
    True
    """
    usage = ResourceUsage()
    # Garbage of the work before would count as memory of this block.
    gc.collect()
    _reset_memory_peak()
    # Neither of these clocks jumps when the machine's time is set.
    wall_start = time.perf_counter()
    cpu_start = time.process_time()
    try:
        yield usage
    except (MemoryError, RuntimeError) as error:
        text = str(error)
        # Torch raises a plain RuntimeError for a failed allocation; only its text tells.
        if isinstance(error, MemoryError) or "alloc" in text or "out of memory" in text.lower():
            raise ResourceError(
                f"memory ran out: {text[:200]}", remedy="Choose a smaller ingest.width_px or fewer cameras."
            ) from error
        raise
    finally:
        usage.seconds = time.perf_counter() - wall_start
        usage.cpu_seconds = time.process_time() - cpu_start
        usage.peak_mib = _memory_peak_mib()


def _reset_memory_peak() -> None:
    try:
        # Linux: writing 5 resets the high-water mark of resident memory. Elsewhere the peak is the process's.
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return


def _memory_peak_mib() -> float:
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    import psutil

    return psutil.Process().memory_info().rss / 2**20
