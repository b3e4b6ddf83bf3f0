"""The renderer's compiled kernel, with the types of its functions."""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path

from genre_tasks.compiled.loader import load
from genre_tasks.render.kernel.build import KERNEL


@cache
def load_kernel(folder: Path = KERNEL.folder) -> ctypes.CDLL:
    """The best kernel in ``folder`` that this machine can run, with its argument types declared; loaded once.

    Raises ``ResourceError`` and ``ConfigError`` as :func:`genre_tasks.compiled.loader.load`.
    """
    library = load(KERNEL, folder)
    p, i = ctypes.c_void_p, ctypes.c_int
    library.genre_forward.argtypes = [i, *[p] * 5, i, p, i, *[p] * 4, i, i, i, i, i, *[p] * 6]
    library.genre_backward.argtypes = [p, i, *[p] * 5, i, p, *[p] * 8, i, *[p] * 6]
    library.genre_gloss.argtypes = [p, i, p]
    library.genre_gloss_backward.argtypes = [p, i, *[p] * 5]
    library.genre_work.argtypes = [p, p]
    library.genre_free.argtypes, library.genre_free.restype = [p], None
    return library
