"""The code that a module can run: the modules that it imports, and the C++ files that these name."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from genre_tasks.errors import ConfigError
from genre_tasks.source_code import read_source

PACKAGE = "genre_tasks"


@dataclass(frozen=True)
class ImportClosure:
    """All code that a module can run.

    Attributes:
        modules: module of the followed packages → its file.
        cpp_files: C++ files that these modules name, and what those include.
        packages: names of the other top-level packages that are imported.
    """

    modules: dict[str, Path]
    cpp_files: tuple[Path, ...]
    packages: frozenset[str]


def import_closure(module: str, lazy_modules: Sequence[str], root: Path) -> ImportClosure:
    """Finds everything that modules import, directly and through others, and the C++ files that they name.

    Imports of ``genre_tasks`` and of the packages that the named modules are in are followed, others are not.

    Args:
        module: the module to start from.
        lazy_modules: further modules to start from.
        root: the folder that holds the package.

    Returns:
        The modules, the C++ files and the other packages.

    Raises:
        ConfigError: one of the modules does not exist.
    """
    for name in (module, *lazy_modules):
        if find_module_file(name, root) is None:
            raise ConfigError(
                f"There is no module {name!r}", remedy="Name a module inside the package, as genre_tasks.stages.gnet."
            )
    todo = [part for name in (module, *lazy_modules) for part in _with_packages(name)]
    # A stage imports its own package alone; a benchmark imports the product's code by way of others.
    followed = {PACKAGE, *(name.partition(".")[0] for name in (module, *lazy_modules))}
    modules: dict[str, Path] = {}
    packages: set[str] = set()
    cpp_files: list[Path] = []
    while todo:
        name = todo.pop()
        path = None if name in modules else find_module_file(name, root)
        if path is None:
            continue
        modules[name] = path
        source = read_source(path, name)
        # Kernels are not imported: the Python file that names their sources stands for the import.
        cpp_files += [path.parent / cpp_name for cpp_name in source.cpp_names]
        for imported in source.imports:
            package = imported.partition(".")[0]
            if package in followed:
                # The last part of "from a.b import c" may be a name and no module.
                todo += _with_packages(imported)
            else:
                packages.add(package)
    return ImportClosure(modules, tuple(include_closure(cpp_files)), frozenset(packages))


def _with_packages(name: str) -> list[str]:
    """Lists a, a.b and a.b.c for a.b.c, since importing a module runs its packages too."""
    parts = name.split(".")
    return [".".join(parts[: i + 1]) for i in range(len(parts))]


def digest_modules(module: str, root: Path) -> list[tuple[str, str]]:
    """Digests a module and all modules of its own package that it imports, directly or through others.

    Args:
        module: the module's full name.
        root: the folder that holds the top-level package.

    Returns:
        (full name, digest of its code) of each, sorted.

    Raises:
        ConfigError: there is no such module.
    """
    package = module.rpartition(".")[0]
    modules = import_closure(module, (), root).modules
    inside = [name for name in sorted(modules) if name == package or name.startswith(f"{package}.")]
    return [(name, read_source(modules[name], name).digest) for name in inside]


def include_closure(files: Sequence[Path]) -> list[Path]:
    """Finds the C++ files that C++ files include, directly and through others.

    Args:
        files: the files to start from; paths where there is no file are left out.

    Returns:
        These files and all that they include by a relative path, sorted.
    """
    todo = list(files)
    found: set[Path] = set()
    while todo:
        # Without "..", so that a file has one name whichever folder it was reached from.
        path = Path(os.path.normpath(todo.pop()))
        if path not in found and path.is_file():
            found.add(path)
            todo += [path.parent / name for name in read_source(path).cpp_names]
    return sorted(found)


def find_module_file(name: str, root: Path) -> Path | None:
    """Finds the file of a module.

    Args:
        name: the module's full name.
        root: the folder that holds its top-level package.

    Returns:
        The file, or ``None`` where there is none.
    """
    base = root.joinpath(*name.split("."))
    siblings = _list_names(base.parent)
    # By listed names: a disk that ignores case would give the file graph.py for a class Graph.
    if base.name in siblings and "__init__.py" in _list_names(base):
        return base / "__init__.py"
    return base.parent / f"{base.name}.py" if f"{base.name}.py" in siblings else None


@lru_cache(maxsize=4096)
def _list_names(folder: Path) -> frozenset[str]:
    try:
        return frozenset(path.name for path in folder.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return frozenset()
