"""Compiles the renderer's CPU kernel while the package is installed; everything else is in pyproject.toml."""

from __future__ import annotations

import runpy
from pathlib import Path

from setuptools import Distribution, Extension, setup
from setuptools.command.build_ext import build_ext

ROOM = Path("genre_tasks/render")


class BuildKernel(build_ext):
    """Puts the libraries beside their sources (editable install) or into the build tree (wheel)."""

    def run(self) -> None:
        """Compiles; without a compiler one clear line instead of a trace."""
        target = ROOM if self.inplace or self.editable_mode else Path(self.build_lib) / ROOM
        recipe = runpy.run_path(str(ROOM / "build_kernel.py"))
        try:
            recipe["build_kernel"](Path(__file__).parent / target if not target.is_absolute() else target)
        except RuntimeError as error:
            raise SystemExit(f"error: {error}") from None

    def get_outputs(self) -> list[str]:
        """Files that a wheel takes."""
        recipe = runpy.run_path(str(ROOM / "build_kernel.py"))
        return [
            str(Path(self.build_lib) / ROOM / recipe["library_name"](isa))
            for isa in recipe["isas_for"](recipe["find_compiler"]())
        ]

    def get_output_mapping(self) -> dict[str, str]:
        """Nothing for setuptools to copy: an editable install has the libraries in place already."""
        return {}


class BinaryDistribution(Distribution):
    """Marks the wheel as belonging to one platform."""

    def has_ext_modules(self) -> bool:
        """There is a compiled library."""
        return True


setup(
    cmdclass={"build_ext": BuildKernel},
    ext_modules=[Extension("genre_tasks.render.kernel", sources=[])],
    distclass=BinaryDistribution,
)
