"""Files from outside run no code: rules on calls that Ruff's rules on security (``S``) do not know."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("genre_tasks", "storage", "flows", "benchmarks")
PICKLE_MODULES = {"pickle", "cPickle", "_pickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"}
MAY_IMPORT_PICKLE = {
    # Its names of opcodes: the writer of PandaSet's layout emits them, and loads nothing.
    "genre_tasks/logs/pandaset/pickle_writer.py",
    # It writes pickles that would run code, for the readers to refuse.
    "benchmarks/fuzz/fuzz_attacks.py",
}
MAY_LOAD_TORCH_SCRIPT = {
    # FID's and LPIPS's networks exist as TorchScript alone; it is a language without files and processes.
    "genre_tasks/metrics/fid_lpips.py",
}


def find_unsafe(source: str) -> list[str]:
    """What a module does that could run code of a file."""
    return sorted(set(_find(ast.parse(source))))


def _find(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ("import of pickle" for name in node.names if name.name.split(".")[0] in PICKLE_MODULES)
        elif isinstance(node, ast.ImportFrom):
            if (node.module or "").split(".")[0] in PICKLE_MODULES:
                yield "import of pickle"
        elif isinstance(node, ast.Call):
            yield from _find_in_call(node)


def _find_in_call(call: ast.Call) -> Iterator[str]:
    name = ast.unparse(call.func)
    constants = {
        keyword.arg: keyword.value.value for keyword in call.keywords if isinstance(keyword.value, ast.Constant)
    }
    if name == "torch.load" and constants.get("weights_only") is not True:
        yield "torch.load without weights_only"
    if name in ("torch.jit.load", "jit.load"):
        yield "torch.jit.load"
    if name in ("np.load", "numpy.load") and constants.get("allow_pickle", False) is not False:
        yield "numpy.load with pickles"
    if name.rpartition(".")[2] in ("read_pickle", "unsafe_load", "full_load", "unsafe_load_all", "full_load_all"):
        yield name
    if name in ("yaml.load", "yaml.load_all"):
        loaders = [keyword.value for keyword in call.keywords if keyword.arg == "Loader"] + list(call.args[1:2])
        if [ast.unparse(loader) for loader in loaders] not in (["yaml.SafeLoader"], ["yaml.CSafeLoader"]):
            yield "yaml.load without the safe loader"


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "import os, dill",
        "from pickle import loads",
        "torch.load(path)",
        "torch.load(path, weights_only=False)",
        "torch.load(path, weights_only=wanted)",
        "torch.jit.load(path)",
        "np.load(path, allow_pickle=True)",
        "pandas.read_pickle(path)",
        "yaml.unsafe_load(text)",
        "yaml.load(text)",
        "yaml.load(text, Loader=yaml.Loader)",
    ],
)
def test_the_rules_find_what_runs_code(source: str) -> None:
    assert find_unsafe(source)


def test_the_rules_leave_what_runs_none() -> None:
    source = "import json\ntorch.load(p, weights_only=True)\nnp.load(p)\nyaml.load(t, Loader=yaml.SafeLoader)"
    assert not find_unsafe(source)


def test_no_module_runs_code_of_a_file() -> None:
    found = {}
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            name = path.relative_to(ROOT).as_posix()
            unsafe = find_unsafe(path.read_text(encoding="utf-8"))
            if unsafe:
                found[name] = unsafe
    expected = {name: ["import of pickle"] for name in MAY_IMPORT_PICKLE}
    expected |= {name: ["torch.jit.load"] for name in MAY_LOAD_TORCH_SCRIPT}
    assert found == expected
