"""Tests that documents name, as ``file::function``."""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).parents[1]


def is_test(name: str) -> bool:
    """Whether a test exists: ``file::function``, of a class or not; or ``file`` alone, which has any test."""
    file, _, function = name.partition("::")
    if not (ROOT / file).is_file():
        return False
    tree = ast.parse((ROOT / file).read_text())
    functions = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
    return function in functions if function else any(name.startswith("test_") for name in functions)
