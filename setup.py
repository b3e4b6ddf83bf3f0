"""Compiles the CPU kernels while the package is installed; everything else is in pyproject.toml."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

from setuptools import Distribution, Extension, setup
from setuptools.command.build_ext import build_ext

ROOT = Path(__file__).resolve().parent
sys.path.insert(0, str(ROOT))  # a build backend leaves it out

from genre_tasks.compiled import build as kernel_build  # noqa: E402 — imports no torch

# By path: a room's __init__ may import torch, which an isolated build lacks.
KERNELS = [
    runpy.run_path(str(ROOT / "genre_tasks" / file))["KERNEL"]
    for file in (
        "render/kernel/build.py",
        "losses/build_image_loss.py",
        "optimiser/kernels/build_network.py",
        "optimiser/kernels/build_posing.py",
    )
]


class BuildKernels(build_ext):
    """Puts the libraries beside their sources (editable install) or into the build tree (wheel)."""

    def run(self) -> None:
        """Compiles; without a compiler one clear line instead of a trace."""
        target = ROOT if self.inplace or self.editable_mode else Path(self.build_lib).resolve()
        try:
            kernel_build.build([(kernel, target / kernel.folder.relative_to(ROOT)) for kernel in KERNELS])
        except RuntimeError as error:
            raise SystemExit(f"error: {error}") from None

    def get_outputs(self) -> list[str]:
        """Files that a wheel takes."""
        return [
            str(Path(self.build_lib) / kernel.folder.relative_to(ROOT) / kernel.library_name(isa))
            for kernel in KERNELS
            for isa in kernel_build.instruction_sets_for(kernel_build.find_compiler())
        ]

    def get_output_mapping(self) -> dict[str, str]:
        """Nothing for setuptools to copy: an editable install has the libraries in place already."""
        return {}


class BinaryDistribution(Distribution):
    """Marks the wheel as belonging to one platform."""

    def has_ext_modules(self) -> bool:
        """There are compiled libraries."""
        return True


setup(
    cmdclass={"build_ext": BuildKernels},
    ext_modules=[Extension("genre_tasks.compiled.kernels", sources=[])],
    distclass=BinaryDistribution,
)
