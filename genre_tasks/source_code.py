"""Source files as data: a digest of a file's code, and the names in it, found without running anything.

Equal code has equal digests on every version of Python, whatever formatter, editor or checkout it went through:
comments, docstrings, layout and line endings are left out. Only the standard library is imported, because kernels are
built where nothing else is installed.
"""

from __future__ import annotations

import ast
import hashlib
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

CPP_SUFFIXES = (".c", ".cc", ".cpp", ".cxx", ".h", ".hpp", ".cu", ".cuh")

# ctx follows from the position; the others are comments, or spellings of the same value.
_FIELDS_WITHOUT_MEANING = frozenset({"ctx", "kind", "type_comment", "type_ignores"})

_CPP_COMMENT = r"//(?:\\\n|[^\n])*|/\*.*?\*/"
_CPP_PARTS = re.compile(
    rf"(?P<gap>(?:{_CPP_COMMENT}|\s)+)"
    # Strings, raw ones first; numbers, whose digit separator would pass for a quote; words, which may end in R.
    r'|(?:u8|[uUL])?R"(?P<end>[^()\\\s]*)\(.*?\)(?P=end)"'
    r"|\"(?:\\.|[^\"\\\n])*\"|'(?:\\.|[^'\\\n])*'|\.?\d(?:'?[\w.])*|\w+",
    re.DOTALL,
)
_CPP_INCLUDE = re.compile(r'^#\s*include\s*"([^"]+)"', re.MULTILINE)


@dataclass(frozen=True)
class Source:
    """The code of one file.

    Attributes:
        digest: sha256 of the code without comments, docstrings and layout.
        imports: the full names that a Python file imports, at any level; empty for C++.
        cpp_names: C++ files relative to this file: those that a Python file's strings name, or C++ includes.
    """

    digest: str
    imports: tuple[str, ...]
    cpp_names: tuple[str, ...]


def digest_source(path: Path) -> str:
    """Digests the code of a file, without comments, docstrings, layout and line endings.

    Args:
        path: a Python file, or a C++ file, which is known by its suffix.

    Returns:
        64 hex digits of sha256, the same on every version of Python.

    Raises:
        OSError: the file cannot be read.
        SyntaxError: it is not valid Python.

    >>> digest_source(Path(__file__)) == digest_source(Path(__file__))
    True
    """
    return read_source(path).digest


KNOWN_SOURCES: dict[str, Source] = {}
"""What files were found to hold, by a digest of all that it follows from; filled by this process or an earlier one."""


# Most modules share most files: each is read once.
@lru_cache(maxsize=4096)
def read_source(path: Path, module: str = "") -> Source:
    """Reads the code of a file.

    Args:
        path: a Python or C++ file.
        module: the module's full name, from which relative imports start.

    Returns:
        The file's digest and the names in it.

    Raises:
        OSError: the file cannot be read.
        SyntaxError: it is not valid Python.
    """
    data = path.read_bytes()
    # Relative imports start from the package, which a file's module and its name give.
    name = f"{path.name} {module}".encode()
    key = hashlib.sha256(name + b"\0" + data).hexdigest()
    if key not in KNOWN_SOURCES:
        KNOWN_SOURCES[key] = _parse(data, path, module)
    return KNOWN_SOURCES[key]


def _parse(data: bytes, path: Path, module: str) -> Source:
    if path.suffix in CPP_SUFFIXES:
        text = strip_cpp_comments(data.decode("utf-8-sig"))
        return Source(_sha256(text), (), tuple(_CPP_INCLUDE.findall(text)))
    # From bytes, so that byte order mark, encoding line and line endings are read as Python itself reads them.
    tree = ast.parse(data, filename=str(path))
    package = (module if path.name == "__init__.py" else module.rpartition(".")[0]).split(".")
    imports, cpp_names = _read_names(package, tree)
    return Source(_sha256(write_tree(tree)), tuple(imports), tuple(cpp_names))


def strip_cpp_comments(source: str) -> str:
    r"""Removes what does not change a C++ program: comments, empty lines and repeated spaces.

    Args:
        source: the text of a C++ file, with any line endings.

    Returns:
        The text that is left, with "\n" between lines. Strings and character literals are unchanged.

    >>> strip_cpp_comments('int  a;  // why\n\nputs("// no comment");')
    'int a;\nputs("// no comment");'
    """
    text = source.replace("\r\n", "\n")
    return _CPP_PARTS.sub(lambda m: m[0] if m["gap"] is None else _shorten_gap(m[0]), text).strip()


def _shorten_gap(gap: str) -> str:
    # A line break inside a comment is none of the program's, and a comment counts as one space.
    return "\n" if "\n" in re.sub(_CPP_COMMENT, "", gap, flags=re.DOTALL) else " "


def write_tree(tree: ast.AST) -> str:
    """Writes a syntax tree as text, equal for equal code on every version of Python.

    ``ast.dump`` and ``ast.unparse`` change from version to version. Here fields that are empty are left out, since
    later versions only add such fields; the parts of f-strings, which versions divide differently, are joined.

    Args:
        tree: from :func:`ast.parse`.

    Returns:
        ASCII text, without docstrings.

    >>> write_tree(ast.parse("x = (1)  # one")) == write_tree(ast.parse("x=1"))
    True
    """
    parts: list[str] = []
    _write(tree, parts)
    return "".join(parts)


def _write(value: object, parts: list[str]) -> None:
    if isinstance(value, ast.Constant):
        parts.append(_write_literal(value.value))
    elif isinstance(value, ast.JoinedStr):
        _write_f_string(value, parts)
    elif isinstance(value, ast.AST):
        parts.append(f"{type(value).__name__}(")
        for name in _order_fields(value._fields):
            field = getattr(value, name, None)
            if isinstance(field, list):
                field = [item for item in field if not _is_without_effect(item)]
            # The format of f"{x:}" says nothing, and some versions drop it.
            if field is None or field == [] or (name == "format_spec" and _is_empty_f_string(field)):
                continue
            parts.append(f" {name}=")
            _write(field, parts)
        parts.append(")")
    elif isinstance(value, list):
        parts.append("[")
        for item in value:
            _write(item, parts)
            parts.append(",")
        parts.append("]")
    else:
        # A name or a number of the grammar's own. A list can lack an item, which is not the literal None.
        parts.append("absent" if value is None else _write_literal(value))


@lru_cache(maxsize=256)
def _order_fields(names: tuple[str, ...]) -> list[str]:
    # Sorted, since versions have them in different orders.
    return sorted(set(names) - _FIELDS_WITHOUT_MEANING)


def _write_literal(value: object) -> str:
    # Not by repr: which characters it escapes depends on the version's tables of Unicode.
    if isinstance(value, str):
        return json.dumps(value)
    if isinstance(value, bytes):
        return f"bytes {value.hex()}"
    return repr(value)


def _write_f_string(f_string: ast.JoinedStr, parts: list[str]) -> None:
    joined: list[object] = []
    for part in f_string.values:
        text = part.value if isinstance(part, ast.Constant) else None
        if isinstance(text, str) and joined and isinstance(joined[-1], str):
            joined[-1] += text
        else:
            joined.append(part if text is None else text)
    parts.append("JoinedStr")
    _write([part for part in joined if part != ""], parts)


def _is_empty_f_string(value: object) -> bool:
    return isinstance(value, ast.JoinedStr) and all(isinstance(p, ast.Constant) and not p.value for p in value.values)


def _is_without_effect(value: object) -> bool:
    """Whether it is a statement that does nothing: a docstring, any other bare string, or ``pass``."""
    if isinstance(value, ast.Expr):
        return isinstance(value.value, ast.Constant) and isinstance(value.value.value, str)
    return isinstance(value, ast.Pass)


def _read_names(package: Sequence[str], tree: ast.Module) -> tuple[list[str], list[str]]:
    """The full names that a module imports, and the C++ files that its strings name."""
    imports: list[str] = []
    cpp_names: list[str] = []
    # One walk for both, as it takes a third of the time of reading a file.
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imports += (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            source = ".".join([*above, *([node.module] if node.module else [])])
            imports += (source, *(f"{source}.{alias.name}" for alias in node.names))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.endswith(CPP_SUFFIXES):
            cpp_names.append(node.value)
    return imports, cpp_names


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
