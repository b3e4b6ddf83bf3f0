"""Finds and loads the compiled kernel for this machine."""

from __future__ import annotations

import ctypes
import os
import platform
from functools import cache
from pathlib import Path

from genre_tasks.errors import ConfigError, ResourceError
from genre_tasks.render import build_kernel

REMEDY = "Run `pip install -e .` in the repository (it needs g++ or clang++, or the ziglang package)"
_NEEDED_FLAGS = {
    "avx512": {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl", "avx2", "fma", "bmi2"},
    "avx2": {"avx", "avx2", "fma", "bmi1", "bmi2", "f16c", "movbe"},
    "sse42": {"sse4_2", "popcnt", "ssse3"},
}
"""What /proc/cpuinfo must list for the x86-64 level that the library was compiled for."""


def _cpu_flags() -> set[str]:
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return set()
    return next((set(line.split(":", 1)[1].split()) for line in text.splitlines() if line.startswith("flags")), set())


def supported_isas() -> list[str]:
    """The instruction sets of the kernel that this machine can run, best first (never one that it lacks)."""
    if "generic" in build_kernel.isas():
        return ["generic"]
    flags = _cpu_flags()
    if not flags and platform.system() != "Linux":
        # No list to read: torch knows the machine's level by other means.
        import torch

        known = {"AVX512": ["avx512", "avx2", "sse42"], "AVX2": ["avx2", "sse42"]}
        return known.get(torch.backends.cpu.get_cpu_capability(), ["sse42"])
    return [isa for isa, needed in _NEEDED_FLAGS.items() if needed <= flags]


def candidate_isas() -> list[str]:
    """What to look for, best first: ``GENRE_RENDER_ISA`` alone if it is set, else all that run here.

    Raises:
        ConfigError: ``GENRE_RENDER_ISA`` names what this machine cannot run.
        ResourceError: the machine runs none.
    """
    supported = supported_isas()
    asked = os.environ.get("GENRE_RENDER_ISA")
    if asked and asked not in supported:
        raise ConfigError(
            f"GENRE_RENDER_ISA={asked} cannot run on this machine", remedy=f"Unset it, or choose from {supported}"
        )
    if not supported:
        raise ResourceError(
            "the CPU is older than the kernel's oldest instruction set (SSE4.2)", remedy="Use backend reference"
        )
    return [asked] if asked else supported


@cache
def load_kernel(folder: Path = build_kernel.HERE) -> ctypes.CDLL:
    """The best kernel in ``folder`` that this machine can run, with its argument types declared; loaded once.

    Raises:
        ResourceError: it was never compiled, is older than its sources, or does not load.
    """
    paths = [folder / build_kernel.library_name(isa) for isa in candidate_isas()]
    path = next((p for p in paths if p.exists()), None)
    if path is None:
        raise ResourceError("the renderer's CPU kernel is not compiled", remedy=REMEDY, file=paths[0])
    try:
        library = ctypes.CDLL(str(path))
        library.genre_digest.restype = ctypes.c_char_p
        digest = library.genre_digest().decode()
    except (OSError, AttributeError) as error:
        raise ResourceError(f"the renderer's CPU kernel does not load: {error}", remedy=REMEDY, file=path) from error
    if digest != build_kernel.source_digest():
        raise ResourceError("the renderer's CPU kernel is older than its sources", remedy=REMEDY, file=path)
    p, i = ctypes.c_void_p, ctypes.c_int
    library.genre_forward.argtypes = [i, p, p, p, p, p, i, p, p, i, i, i, p, p, p, p, p]
    library.genre_backward.argtypes = [p, i, *[p] * 5, *[p] * 6, i, *[p] * 5]
    library.genre_work.argtypes = [p, p]
    library.genre_free.argtypes, library.genre_free.restype = [p], None
    return library
