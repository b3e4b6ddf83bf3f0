"""Compiles C++ kernels into shared libraries, one per instruction set. Imports no package but this one.

``setup.py`` uses it where torch may be absent; the loader uses the same names and digest.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import platform
import runpy
import shlex
import shutil
import subprocess
import sys
import uuid
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from genre_tasks.source_code import digest_source

SHARED_SOURCES = ("runtime.h", "vectors.h", "build.py")
"""Files of this folder that every library depends on."""
SHARED_FLAGS = (
    "-O3",
    "-std=c++17",
    "-shared",
    "-fPIC",
    "-pthread",
    "-Wno-psabi",
    "-fno-math-errno",
    "-fno-trapping-math",
)
"""No -ffinite-math-only: comparisons must keep stopping NaN."""
X86_INSTRUCTION_SETS = {
    "avx512": ("-march=x86-64-v4", "-mprefer-vector-width=512"),
    "avx2": ("-march=x86-64-v3",),
    "sse42": ("-march=x86-64-v2",),
}
"""Best first. Other machines get the one library ``generic``."""
NO_COMPILER = (
    "no C++ compiler found: install g++ or clang++ (Debian: apt install g++), or set CXX to another one, "
    "or `pip install ziglang setuptools` and build with `pip install --no-build-isolation`"
)


@dataclass(frozen=True)
class Kernel:
    """What one kernel is made of.

    Attributes:
        title: how messages call it ("the renderer's CPU kernel").
        stem: its libraries are ``<stem>_<isa>.so``.
        folder: where its sources are, and in an editable install its libraries.
        sources: file names in ``folder``, the one that is compiled first.
        constants_file: which of them defines the constants, in Python, without imports.
        constants: names of the constants that the kernel takes (int, or float as float32).
        flags: of the compiler, added to ``SHARED_FLAGS``.
    """

    title: str
    stem: str
    folder: Path
    sources: tuple[str, ...]
    constants_file: str
    constants: tuple[str, ...]
    flags: tuple[str, ...] = ()

    def library_name(self, isa: str) -> str:
        """File name of the library for an instruction set.

        >>> Kernel("a kernel", "example", Path(), (), "", ()).library_name("avx2")
        'example_avx2.so'
        """
        return f"{self.stem}_{isa}.so"

    def source_digest(self) -> str:
        """Identifies the sources, so that a library that is older than them is noticed when it is loaded.

        Returns:
            First 16 hexadecimal digits of the SHA-256 over the code of all sources; compiled into the libraries.
        """
        # Code, not times or bytes: a checkout, a copy or another comment must not make libraries stale.
        digest = hashlib.sha256()
        files = [self.folder / name for name in self.sources]
        for path in files + [Path(__file__).parent / name for name in SHARED_SOURCES]:
            digest.update(f"{path.name}\0{digest_source(path)}\n".encode())
        return digest.hexdigest()[:16]

    def defines(self) -> list[str]:
        """The constants and the digest, as arguments of the compiler."""
        # Run by its path: an import of its package would load torch, which an isolated build does not have.
        values = runpy.run_path(str(self.folder / self.constants_file))
        literals = {n: f"{values[n]!r}f" if isinstance(values[n], float) else repr(values[n]) for n in self.constants}
        return [f'-DSOURCE_DIGEST="{self.source_digest()}"', *(f"-D{n}={x}" for n, x in literals.items())]


def instruction_sets() -> dict[str, tuple[str, ...]]:
    """Lists the instruction sets that are built on this kind of machine.

    Returns:
        Name → compiler flags, best first.
    """
    return X86_INSTRUCTION_SETS if platform.machine().lower() in ("x86_64", "amd64") else {"generic": ()}


def find_compiler() -> tuple[str, ...]:
    """Finds a C++ compiler: $CXX, g++, clang++, c++, the ``ziglang`` wheel, in this order.

    Returns:
        Its command.

    Raises:
        RuntimeError: there is none.
    """
    if os.environ.get("CXX"):
        return tuple(shlex.split(os.environ["CXX"]))
    for name in ("g++", "clang++", "c++"):
        if found := shutil.which(name):
            return (found,)
    # A compiler from PyPI, for machines without a system one.
    if importlib.util.find_spec("ziglang"):
        return (sys.executable, "-m", "ziglang", "c++")
    raise RuntimeError(NO_COMPILER)


def _is_zig(compiler: tuple[str, ...]) -> bool:
    return "ziglang" in compiler or "zig" in Path(compiler[0]).name


def instruction_sets_for(compiler: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
    """Lists the instruction sets that a compiler builds on this kind of machine.

    Args:
        compiler: its command.

    Returns:
        Name → flags as this compiler spells them, best first.

    >>> "avx512" in instruction_sets_for(("zig", "c++"))
    False
    """
    if not _is_zig(compiler):
        return instruction_sets()
    # zig spells architectures with underscores. It compiles its C++ library anew for each (half a minute, once), so
    # AVX-512 is left out.
    flags = {isa: tuple(f.replace("x86-64-v", "x86_64_v") for f in flags) for isa, flags in instruction_sets().items()}
    return {isa: f for isa, f in flags.items() if isa != "avx512"}


@dataclass(frozen=True)
class _Job:
    kernel: Kernel
    folder: Path
    isa: str
    options: list[str]


def build(
    kernels: Sequence[tuple[Kernel, Path]], defines: Sequence[str] = (), isas: Sequence[str] | None = None
) -> list[Path]:
    """Compiles kernels, libraries side by side. Takes some seconds.

    A library appears only when it is complete, so a running process keeps the one it has loaded.

    Args:
        kernels: each with the folder that its libraries go to.
        defines: compile-time switches of the kernels' sources that are on, as ``GENRE_ABLATE_GUARDS`` of the
            renderer's: such a library is for timing only. The digest does not tell it from an ordinary one, so it
            belongs into a folder of its own.
        isas: instruction sets to build for; ``None``: all that the compiler found can make.

    Returns:
        Paths of the libraries.

    Raises:
        RuntimeError: there is no compiler, or it fails; with its last lines.
    """
    compiler = find_compiler()
    switches = [f"-D{name}" for name in defines]
    jobs = []
    for kernel, folder in kernels:
        constants = kernel.defines()
        for isa, flags in instruction_sets_for(compiler).items():
            if isas is None or isa in isas:
                jobs.append(_Job(kernel, folder, isa, [*flags, *constants, *switches]))
    # The compiler is a process: threads only wait for it.
    with ThreadPoolExecutor(max(2, os.cpu_count() or 1)) as pool:
        libraries = list(pool.map(lambda job: _compile(compiler, job), jobs))
    if isas is None:
        _remove_what_is_not_made(kernels, set(instruction_sets_for(compiler)))
    return libraries


def _remove_what_is_not_made(kernels: Sequence[tuple[Kernel, Path]], made: set[str]) -> None:
    """Removes libraries of another compiler, which would stay behind, older than their sources, and be preferred."""
    for kernel, folder in kernels:
        for isa in instruction_sets().keys() - made:
            (folder / kernel.library_name(isa)).unlink(missing_ok=True)


def _compile(compiler: tuple[str, ...], job: _Job) -> Path:
    kernel = job.kernel
    job.folder.mkdir(parents=True, exist_ok=True)
    out = job.folder / kernel.library_name(job.isa)
    # Renamed at the end: another process may load the library at any moment. Containers that share a folder may have
    # processes of the same number.
    part = out.with_name(f"{out.name}.{os.getpid()}-{uuid.uuid4().hex[:8]}.tmp")
    source = str(kernel.folder / kernel.sources[0])
    command = [*compiler, *SHARED_FLAGS, *kernel.flags, *job.options, source, "-o", str(part)]
    try:
        done = _run_compiler(command)
        if done.returncode:
            raise RuntimeError(f"{compiler[0]} failed on {kernel.title} ({job.isa}):\n" + done.stderr[-2000:])
        part.replace(out)
    finally:
        part.unlink(missing_ok=True)
    return out


def _run_compiler(command: Sequence[str]) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        raise RuntimeError(f"the C++ compiler {command[0]} does not start: {error.strerror}") from error
