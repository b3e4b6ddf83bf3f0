"""Every benchmark of ``genre bench`` runs end to end in its smallest form, and measures at least one real cell."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

from benchmarks.common.bench import TINY_STREET
from benchmarks.common.claims import Result
from flows.cli.bench import _BENCHES, load_bench
from flows.cli.main import app


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One store for all benchmarks: they share the stages that read the street."""
    return tmp_path_factory.mktemp("store")


def _run(name: str, arguments: list[str]) -> Result:
    threads = torch.get_num_threads()
    try:
        done = CliRunner().invoke(app, ["bench", name, "--json", "result.json", *arguments], catch_exceptions=False)
    finally:
        torch.set_num_threads(threads)  # a timed action leaves its own number behind
    assert done.exit_code == 0, done.output
    assert done.stdout.startswith("| "), done.output
    return Result.model_validate_json(Path("result.json").read_text())


@pytest.mark.parametrize("name", sorted(_BENCHES))
def test_the_smallest_form_measures_a_cell(
    name: str, store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    bench = load_bench(name)
    arguments = bench.smallest.arguments()
    if "store" in bench.options:
        arguments += ["--set", f"store={store}"]
    result = _run(name, arguments)
    measured = [row for row in result.rows if "not_measured" not in row]
    assert len(measured) == 1, [row["cell"] for row in measured]
    assert len(measured[0]) > 1 and result.claims
    cached = list((tmp_path / ".genre" / "bench" / name).glob("*.json"))
    assert [json.loads(path.read_text())["cell"] for path in cached] == [measured[0]["cell"]]


def test_the_smallest_forms_name_options_that_there_are() -> None:
    for name in _BENCHES:
        bench = load_bench(name)
        assert bench.smallest.options.keys() <= bench.options.keys(), name


@pytest.mark.slow
def test_a_budget_is_run_as_a_user_starts_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    options = ["--only", "budget", "--set", f"seeds={TINY_STREET}", "--set", "budgets=1.5"]
    (row,) = [row for row in _run("evaluation", ["--quick", *options]).rows if "not_measured" not in row]
    assert row["used_s"] > 0 and row["budget_s"] > row["shortest_s"] > 0 and row["choices"], row
