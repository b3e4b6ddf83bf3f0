"""Compiles the CPU kernel into shared libraries, one per instruction set. Imports nothing but the standard library.

``setup.py`` runs it by path, where torch may be absent; the loader uses the same names and digest.
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
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

HERE = Path(__file__).resolve().parent
SOURCES = (
    "kernel.cpp", "kernel_view.h", "kernel_blend.h", "kernel_project.h", "kernel_simd.h", "kernel_memory.h",
    "constants.py", "build_kernel.py",
)  # fmt: skip
CONSTANTS = (
    "NEAR_M", "BLUR_PX2", "ALPHA_MIN", "ALPHA_MAX", "TRANSMITTANCE_STOP", "JACOBIAN_MARGIN", "QUAT_MIN_NORM2",
    "MAX_VARIANCE_PX2", "MAX_CENTER_PX",
)  # fmt: skip
FLAGS = (
    "-O3", "-std=c++17", "-shared", "-fPIC", "-pthread", "-Wno-psabi", "-fno-math-errno", "-fno-trapping-math",
    "-fno-signed-zeros", "-freciprocal-math",
)  # fmt: skip
"""No -ffinite-math-only: comparisons must keep stopping NaN."""
X86_ISAS = {
    "avx512": ("-march=x86-64-v4", "-mprefer-vector-width=512"),
    "avx2": ("-march=x86-64-v3",),
    "sse42": ("-march=x86-64-v2",),
}
"""Best first. Other machines get the one library ``generic``."""
NO_COMPILER = (
    "no C++ compiler found: install g++ or clang++ (Debian: apt install g++), or `pip install ziglang`, or set CXX"
)


def isas() -> dict[str, tuple[str, ...]]:
    """Instruction sets that are built on this kind of machine, best first, with their compiler flags."""
    return X86_ISAS if platform.machine().lower() in ("x86_64", "amd64") else {"generic": ()}


def library_name(isa: str) -> str:
    """File name of the library for an instruction set."""
    return f"kernel_{isa}.so"


def source_digest(folder: Path = HERE) -> str:
    """First 16 hexadecimal digits of the SHA-256 of the kernel's sources; compiled into the libraries."""
    digest = hashlib.sha256()
    for name in SOURCES:
        digest.update(name.encode() + b"\0" + (folder / name).read_bytes())
    return digest.hexdigest()[:16]


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


def build_kernel(target_dir: Path) -> list[Path]:
    """Compiles into ``target_dir`` every library that the compiler found can make (some seconds); returns their paths.

    Each appears whole or not at all, so a running process keeps the one it has loaded. Raises ``RuntimeError`` without
    a compiler or when it fails, with its last lines.
    """
    compiler = find_compiler()
    constants = runpy.run_path(str(HERE / "constants.py"))
    defines = [f'-DSOURCE_DIGEST="{source_digest()}"', *(f"-D{n}={constants[n]!r}f" for n in CONSTANTS)]
    target_dir.mkdir(parents=True, exist_ok=True)

    def compile_one(isa: str, flags: tuple[str, ...]) -> Path:
        out = target_dir / library_name(isa)
        part = out.with_name(f"{out.name}.{os.getpid()}.tmp")
        command = [*compiler, *FLAGS, *flags, *defines, str(HERE / "kernel.cpp"), "-o", str(part)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            part.unlink(missing_ok=True)
            raise RuntimeError(f"{compiler[0]} failed on the kernel ({isa}):\n" + done.stderr[-2000:])
        part.replace(out)
        return out

    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(lambda item: compile_one(*item), isas_for(compiler).items()))
