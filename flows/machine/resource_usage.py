"""What a piece of work takes: wall time, CPU time and the peak of memory.

Memory is what the system cannot take back: pages of files, such as images that are held on disk, do not count.
"""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from genre_tasks.errors import ResourceError

_STATUS = Path("/proc/self/status")
_SAMPLE_S = 0.01
"""A peak of memory is rarely shorter, and a sample takes a tenth of a millisecond."""


@dataclass
class ResourceUsage:
    """What a block of code took; the fields are filled in when the block ends.

    Attributes:
        seconds: wall time.
        cpu_seconds: CPU time of all threads of the process.
        peak_mib: peak of the process's memory during the block, MiB, without pages of files.
    """

    seconds: float = 0.0
    cpu_seconds: float = 0.0
    peak_mib: float = 0.0


@contextmanager
def measure_usage() -> Iterator[ResourceUsage]:
    """Measures the time and the memory of a block; running out of memory is :func:`memory_errors_translated`'s error.

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
    peak = _MemoryPeak()
    # Neither of these clocks jumps when the machine's time is set.
    wall_start = time.perf_counter()
    cpu_start = time.process_time()
    try:
        with memory_errors_translated():
            yield usage
    finally:
        usage.seconds = time.perf_counter() - wall_start
        usage.cpu_seconds = time.process_time() - cpu_start
        usage.peak_mib = peak.stop()


@contextmanager
def memory_errors_translated() -> Iterator[None]:
    """Turns running out of memory, in Python or in a library, into one kind of error.

    Yields:
        Nothing.

    Raises:
        ResourceError: the block ran out of memory.
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        text = str(error)
        # Torch raises a plain RuntimeError for a failed allocation; only its text tells.
        if isinstance(error, MemoryError) or "alloc" in text or "out of memory" in text.lower():
            raise ResourceError(
                f"memory ran out: {text[:200]}", remedy="Choose a smaller ingest.width_px or fewer cameras."
            ) from error
        raise


class _MemoryPeak:
    """Watches the process's memory from a thread of its own; the kernel's mark counts pages of files, too."""

    def __init__(self) -> None:
        self._peak_mib = measure_memory_mib()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="memory-peak", daemon=True)
        self._thread.start()

    def _watch(self) -> None:
        while not self._ended.wait(_SAMPLE_S):
            self._peak_mib = max(self._peak_mib, measure_memory_mib())

    def stop(self) -> float:
        """Ends the watch and gives the peak, MiB."""
        self._ended.set()
        self._thread.join()
        return max(self._peak_mib, measure_memory_mib())


def measure_memory_mib() -> float:
    """Measures the memory of this process that the system cannot take back.

    Returns:
        MiB: on Linux its resident memory without pages of files, elsewhere all of it.

    >>> measure_memory_mib() > 1
    True
    """
    if _STATUS.exists():
        lines = (line.split() for line in _STATUS.read_text().splitlines())
        sizes = {words[0]: int(words[1]) for words in lines if words[0] in ("RssAnon:", "RssShmem:")}
        if sizes:
            return sum(sizes.values()) / 1024
    import psutil

    return float(psutil.Process().memory_info().rss) / 2**20
