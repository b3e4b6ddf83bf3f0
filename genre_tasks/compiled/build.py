"""Compiles C++ kernels into shared libraries, one per instruction set. Imports nothing but the standard library.

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
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

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
X86_ISAS = {
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
        folder: where its sources are, and its libraries beside them in an editable install.
        sources: file names in ``folder``, the one that is compiled first.
        constants_file: which of them defines the constants, in Python, without imports.
        constants: names of the constants that the kernel takes (int, or float as float32).
        flags: of the compiler, besides ``SHARED_FLAGS``.
    """

    title: str
    stem: str
    folder: Path
    sources: tuple[str, ...]
    constants_file: str
    constants: tuple[str, ...]
    flags: tuple[str, ...] = ()

    def library_name(self, isa: str) -> str:
        """File name of the library for an instruction set."""
        return f"{self.stem}_{isa}.so"

    def source_digest(self) -> str:
        """First 16 hexadecimal digits of the SHA-256 of all sources; compiled into the libraries."""
        digest = hashlib.sha256()
        files = [self.folder / name for name in self.sources]
        for path in files + [Path(__file__).parent / name for name in SHARED_SOURCES]:
            digest.update(path.name.encode() + b"\0" + path.read_bytes())
        return digest.hexdigest()[:16]

    def defines(self) -> list[str]:
        """The constants and the digest, as the compiler takes them."""
        values = runpy.run_path(str(self.folder / self.constants_file))
        literals = {n: f"{values[n]!r}f" if isinstance(values[n], float) else repr(values[n]) for n in self.constants}
        return [f'-DSOURCE_DIGEST="{self.source_digest()}"', *(f"-D{n}={x}" for n, x in literals.items())]


def isas() -> dict[str, tuple[str, ...]]:
    """Instruction sets that are built on this kind of machine, best first, with their compiler flags."""
    return X86_ISAS if platform.machine().lower() in ("x86_64", "amd64") else {"generic": ()}


def find_compiler() -> tuple[str, ...]:
    """The command of a C++ compiler: $CXX, g++, clang++, c++, the ``ziglang`` wheel. Raises ``RuntimeError``."""
    if os.environ.get("CXX"):
        return tuple(shlex.split(os.environ["CXX"]))
    for name in ("g++", "clang++", "c++"):
        if found := shutil.which(name):
            return (found,)
    if importlib.util.find_spec("ziglang"):
        return (sys.executable, "-m", "ziglang", "c++")
    raise RuntimeError(NO_COMPILER)


def _is_zig(compiler: tuple[str, ...]) -> bool:
    return "ziglang" in compiler or "zig" in Path(compiler[0]).name


def isas_for(compiler: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
    """:func:`isas` as a compiler takes them.

    zig spells architectures with underscores, and compiles its C++ library anew for each (half a minute, once): it
    leaves AVX-512 out.
    """
    if not _is_zig(compiler):
        return isas()
    flags = {isa: tuple(f.replace("x86-64-v", "x86_64_v") for f in flags) for isa, flags in isas().items()}
    return {isa: f for isa, f in flags.items() if isa != "avx512"}


def build(kernels: Sequence[tuple[Kernel, Path]]) -> list[Path]:
    """Compiles each kernel into the folder beside it, every library that the compiler found can make; their paths.

    Takes some seconds, libraries side by side. Each appears whole or not at all, so a running process keeps the one it
    has loaded. Raises ``RuntimeError`` without a compiler or when it fails, with its last lines.
    """
    compiler = find_compiler()
    jobs = [
        (kernel, target, isa, [*flags, *defines])
        for kernel, target in kernels
        for defines in [kernel.defines()]
        for isa, flags in isas_for(compiler).items()
    ]

    def compile_one(job: tuple[Kernel, Path, str, list[str]]) -> Path:
        kernel, target, isa, options = job
        target.mkdir(parents=True, exist_ok=True)
        out = target / kernel.library_name(isa)
        part = out.with_name(f"{out.name}.{os.getpid()}.tmp")
        source = str(kernel.folder / kernel.sources[0])
        command = [*compiler, *SHARED_FLAGS, *kernel.flags, *options, source, "-o", str(part)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            part.unlink(missing_ok=True)
            raise RuntimeError(f"{compiler[0]} failed on {kernel.title} ({isa}):\n" + done.stderr[-2000:])
        part.replace(out)
        return out

    with ThreadPoolExecutor(max(2, os.cpu_count() or 1)) as pool:
        return list(pool.map(compile_one, jobs))
