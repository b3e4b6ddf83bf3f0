"""Freed memory stays with the process while a stage runs: what is asked for next takes it without page faults.

Tensors of large images are tens of megabytes each. glibc gives every such block back to the system when it is freed
and asks for a new one a moment later, whose pages the system has to clear: a quarter of ENet's time at 1280×720.
"""

from __future__ import annotations

import ctypes
import sys
from functools import lru_cache

# Of glibc's malloc.h.
_M_TRIM_THRESHOLD = -1
_M_MMAP_THRESHOLD = -3
_M_MMAP_MAX = -4
_M_ARENA_MAX = -8

# The allocator is only told by how much its heap may be free at the end: more than any stage needs.
_NEVER = 2**31 - 1

# glibc's own values.
_USUAL_MMAP_MAX = 65_536
_USUAL_THRESHOLD = 2**17


def reuse_freed_memory() -> None:
    """Keeps freed memory with the process from now on, until :func:`return_freed_memory`.

    Elsewhere than on glibc it does nothing: other allocators keep freed memory by themselves.

    >>> reuse_freed_memory()
    """
    libc = _load_glibc()
    if libc is not None:
        # No block of its own for a large tensor: blocks go back to the system as soon as they are freed.
        libc.mallopt(_M_MMAP_MAX, 0)
        libc.mallopt(_M_TRIM_THRESHOLD, _NEVER)
        # One heap for all threads: what one of them has freed, any other can take.
        libc.mallopt(_M_ARENA_MAX, 1)


def return_freed_memory() -> None:
    """Undoes :func:`reuse_freed_memory`: freed memory goes back at once, which takes longer and needs less at a time.

    >>> return_freed_memory()
    """
    libc = _load_glibc()
    if libc is not None:
        libc.mallopt(_M_MMAP_MAX, _USUAL_MMAP_MAX)
        libc.mallopt(_M_MMAP_THRESHOLD, _USUAL_THRESHOLD)
        libc.mallopt(_M_TRIM_THRESHOLD, _USUAL_THRESHOLD)
        trim_memory()


def trim_memory() -> None:
    """Gives the memory that is free now back to the system, which other stages of the machine may need.

    >>> trim_memory()
    """
    # Not imported: a process that has rendered nothing need not load the renderer for this.
    renderer = sys.modules.get("genre_tasks.render.kernel.library")
    if renderer is not None:
        renderer.release_pooled_memory()
    libc = _load_glibc()
    if libc is not None:
        libc.malloc_trim(0)


@lru_cache(maxsize=1)
def _load_glibc() -> ctypes.CDLL | None:
    """The process's C library; ``None`` if it is not glibc."""
    try:
        libc = ctypes.CDLL(None)
        # Neither musl nor macOS has both.
        if not (hasattr(libc, "mallopt") and hasattr(libc, "malloc_trim")):
            return None
    except (OSError, TypeError):
        return None
    return libc
