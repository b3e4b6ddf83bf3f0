"""The code reads as CONTRIBUTING says: short files and functions, documented, commented, and in the field's words."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("flows", "genre_tasks", "storage", "configs", "benchmarks")
FILE_LINES = 340
FUNCTION_LINES = 66
NAMES_OUT = frozenset(
    {"told", "said", "beside", "own", "whole", "each", "beyond", "held", "given", "seen", "begun", "kept"}
    | {"sight", "shine", "gloss", "dull", "whoever"}
)
PROSE_OUT = re.compile(
    r"\b(anew|whoever|bears? (?:it |them )?out|borne out|is told|are told|was told|thinks? nothing of)\b", re.IGNORECASE
)
SECTIONS = re.compile(r"^\s*(Args|Returns|Raises|Yields|Attributes):", re.MULTILINE)


@dataclass(frozen=True)
class Source:
    """A file of the code: its path below the root, its text, and its syntax tree."""

    path: str
    text: str
    tree: ast.Module


@cache
def sources() -> tuple[Source, ...]:
    files = sorted(file for room in ROOMS for file in (ROOT / room).rglob("*.py"))
    texts = [(file.relative_to(ROOT).as_posix(), file.read_text()) for file in files]
    return tuple(Source(path, text, ast.parse(text)) for path, text in texts)


def nodes(*kinds: type[ast.AST]) -> Iterator[tuple[Source, ast.AST]]:
    for source in sources():
        for node in ast.walk(source.tree):
            if isinstance(node, kinds):
                yield source, node


def public_functions() -> list[tuple[str, str]]:
    """Path and docstring of every public function and method."""
    return [
        (f"{source.path}:{node.lineno} {node.name}", ast.get_docstring(node) or "")
        for source, node in nodes(ast.FunctionDef, ast.AsyncFunctionDef)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and not node.name.startswith("_")
    ]


def test_files_are_short() -> None:
    assert not [s.path for s in sources() if len(s.text.splitlines()) > FILE_LINES]


def test_functions_fit_a_screen() -> None:
    long = [
        f"{source.path}:{node.lineno} {node.name}"
        for source, node in nodes(ast.FunctionDef, ast.AsyncFunctionDef)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and (node.end_lineno or 0) - node.lineno >= FUNCTION_LINES
    ]
    assert not long


def test_no_name_is_vague() -> None:
    vague = []
    for source, node in nodes(ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef):
        assert isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)
        words = re.findall(r"[a-z]+", re.sub(r"([A-Z])", r" \1", node.name).lower())
        if NAMES_OUT & set(words):
            vague.append(f"{source.path}:{node.lineno} {node.name}")
    assert not vague


def test_a_line_holds_one_statement() -> None:
    packed = sum(
        isinstance(node.targets[0], ast.Tuple) and isinstance(node.value, ast.Tuple)
        for _, node in nodes(ast.Assign)
        if isinstance(node, ast.Assign)
    )
    lines = sum(len(s.text.splitlines()) for s in sources())
    assert 1000 * packed / lines <= 5


def test_the_formatter_is_never_switched_off() -> None:
    assert not [s.path for s in sources() if re.search(r"# fmt: (skip|off)", s.text)]


def test_comments_are_there() -> None:
    lines = [line for s in sources() for line in s.text.splitlines()]
    assert sum(line.strip().startswith("#") for line in lines) >= 0.03 * len(lines)


def test_public_functions_are_documented() -> None:
    documented = [doc for _, doc in public_functions() if doc]
    assert len(documented) >= 0.85 * len(public_functions())
    assert sum(bool(SECTIONS.search(doc)) for doc in documented) >= 0.60 * len(documented)
    assert sum(">>>" in doc for doc in documented) >= 0.05 * len(documented)


def test_docstrings_are_plain_english() -> None:
    found = [f"{place}: {m[0]}" for place, doc in public_functions() for m in PROSE_OUT.finditer(doc)]
    assert not found


@pytest.mark.parametrize(
    "page", ["README.md", "CONTRIBUTING.md", *(str(p.relative_to(ROOT)) for p in (ROOT / "docs").rglob("*.md"))]
)
def test_documents_are_plain_english(page: str) -> None:
    if page.endswith(("stability.md", "CONTRIBUTING.md")):  # written by commands; the list of these words
        return
    assert not PROSE_OUT.findall((ROOT / page).read_text())


def test_no_two_files_of_a_room_share_a_name() -> None:
    """Within one level of a package a base name stands for one thing."""
    for room in ROOMS:
        for folder in {file.parent for file in (ROOT / room).rglob("*.py")}:
            names = [
                entry.stem if entry.is_file() else entry.name
                for entry in folder.iterdir()
                if entry.suffix == ".py" or (entry.is_dir() and (entry / "__init__.py").exists())
            ]
            assert len(names) == len(set(names)), folder
