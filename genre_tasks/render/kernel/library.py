"""The renderer's compiled kernel, with the types of its functions."""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path

from genre_tasks.compiled.loader import load
from genre_tasks.render.kernel.build import KERNEL


@cache
def load_kernel(folder: Path = KERNEL.folder) -> ctypes.CDLL:
    """Loads the best kernel that this machine can run, once, with its argument types declared.

    Args:
        folder: where the libraries are.

    Returns:
        The library; its functions are described in kernel.cpp.

    Raises:
        ConfigError: ``GENRE_RENDER_ISA`` names what this machine cannot run.
        ResourceError: the library was never compiled, is older than its sources, or does not load.
    """
    library = load(KERNEL, folder)
    # Pointers are passed as integers: ctypes would check and convert typed ones at each of thousands of calls.
    p = ctypes.c_void_p
    i = ctypes.c_int
    library.genre_forward.argtypes = [i, *[p] * 5, i, p, i, *[p] * 4, i, i, i, i, i, *[p] * 6]
    library.genre_backward.argtypes = [p, i, *[p] * 5, i, p, *[p] * 8, i, *[p] * 6]
    library.genre_sh_colors.argtypes = [p, i, p]
    library.genre_sh_colors_backward.argtypes = [p, i, *[p] * 5]
    library.genre_work.argtypes = [p, p]
    # Declared although it is simple: ctypes passes undeclared integers with 32 bits, which would cut the pointer.
    library.genre_free.argtypes = [p]
    library.genre_free.restype = None
    library.genre_release.argtypes = []
    library.genre_release.restype = None
    return library


def release_pooled_memory() -> None:
    """Gives back the memory that waits for later renders, after the last one of a piece of work.

    >>> release_pooled_memory()
    """
    # Nothing waits in a kernel that was never loaded, and loading it may fail.
    if load_kernel.cache_info().currsize:
        load_kernel().genre_release()
