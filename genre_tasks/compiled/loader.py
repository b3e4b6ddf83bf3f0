"""Finds and loads a compiled kernel's best library for this machine."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

from genre_tasks.compiled import build
from genre_tasks.compiled.build import Kernel
from genre_tasks.errors import ConfigError, UnsupportedMachineError

REMEDY = "Run `pip install -e .` in the repository (it needs a C++ compiler: g++ 11, clang++ 12, or what CXX names)"
# Linux calls LZCNT abm. A CPU without it takes its code for BSR, and computes something else.
_X86_64_V3_FLAGS = {"avx", "avx2", "fma", "bmi1", "bmi2", "f16c", "movbe", "abm"}
_NEEDED_FLAGS = {
    "avx512": _X86_64_V3_FLAGS | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"},
    "avx2": _X86_64_V3_FLAGS,
    "sse42": {"sse4_2", "popcnt", "ssse3"},
}
"""What /proc/cpuinfo must list for the x86-64 level that the library was compiled for."""


def _cpu_flags() -> set[str]:
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return set()
    return next((set(line.split(":", 1)[1].split()) for line in text.splitlines() if line.startswith("flags")), set())


def supported_instruction_sets() -> list[str]:
    """Lists the kernels' instruction sets that this machine can run, best first; never one that it lacks."""
    if "generic" in build.instruction_sets():
        return ["generic"]
    flags = _cpu_flags()
    if not flags:
        # No list to read, as on other systems and where a container hides it: torch knows the level by other means.
        import torch

        known = {"AVX512": ["avx512", "avx2", "sse42"], "AVX2": ["avx2", "sse42"]}
        return known.get(torch.backends.cpu.get_cpu_capability(), ["sse42"])
    return [isa for isa, needed in _NEEDED_FLAGS.items() if needed <= flags]


def candidate_instruction_sets() -> list[str]:
    """Lists the instruction sets to look for, best first: ``GENRE_RENDER_ISA`` alone if it is set, else all.

    Raises:
        ConfigError: ``GENRE_RENDER_ISA`` names what this machine cannot run.
        UnsupportedMachineError: the machine runs none.
    """
    supported = supported_instruction_sets()
    wanted = os.environ.get("GENRE_RENDER_ISA")
    # Loading it would end the process with an illegal instruction.
    if wanted and wanted not in supported:
        raise ConfigError(
            f"GENRE_RENDER_ISA={wanted} cannot run on this machine", remedy=f"Unset it, or choose from {supported}"
        )
    if not supported:
        raise UnsupportedMachineError(
            "the CPU is older than the kernel's oldest instruction set (SSE4.2)", remedy="Use backend reference"
        )
    return [wanted] if wanted else supported


def load(kernel: Kernel, folder: Path) -> ctypes.CDLL:
    """Loads the best library of a kernel that this machine can run.

    Args:
        kernel: what it is made of; its sources must be those that the library was compiled from.
        folder: where its libraries are.

    Returns:
        The library, without argument types: the caller declares them.

    Raises:
        ConfigError: ``GENRE_RENDER_ISA`` names what this machine cannot run.
        UnsupportedMachineError: the library was never compiled, is older than its sources, or does not load.
    """
    # The best that exists: a compiler may not have been able to make the best that runs.
    paths = [folder / kernel.library_name(isa) for isa in candidate_instruction_sets()]
    path = next((p for p in paths if p.exists()), None)
    if path is None:
        raise UnsupportedMachineError(f"{kernel.title} is not compiled", remedy=REMEDY, file=paths[0])
    try:
        library = ctypes.CDLL(str(path))
        # The digest comes first: argument types declared on a stale library would crash, not raise.
        library.genre_digest.restype = ctypes.c_char_p
        digest = library.genre_digest().decode()
    except (OSError, AttributeError) as error:
        raise UnsupportedMachineError(f"{kernel.title} does not load: {error}", remedy=REMEDY, file=path) from error
    if digest != kernel.source_digest():
        raise UnsupportedMachineError(f"{kernel.title} is older than its sources", remedy=REMEDY, file=path)
    return library
