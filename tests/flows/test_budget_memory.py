"""A budget chooses among the settings of a table that fit into memory."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from flows.budget import budget as budgets
from flows.budget.budget import Budget
from flows.cli.main import app
from flows.configuration import load_configuration
from flows.cost_sweep.parquet import write_settings
from flows.cost_sweep.summary import summarise_settings
from flows.pipeline import memory_limit
from flows.reconstruction import flow
from genre_tasks.errors import ResourceError
from tests.flows.test_budget import table_row

LOG = "synthetic:street?seed=900&frames=20&cameras=6&width=320&height=180"


@pytest.fixture
def table(tmp_path: Path) -> str:
    """The most accurate setting needs 3.4 GiB, the preset itself 1.5 and GNet alone 0.9, with images on disk."""
    rows = [
        table_row("", (), "enet", 0.1, 25.0),
        table_row("large", ("initial.max_points=320000",), "enet", 0.1, 30.0),
        table_row("alone", ("gnet.iterations=8",), "gnet", 0.1, 20.0),
    ]
    facts = {"base": "fine", "judged": "psnr", "calibration_s": "0.1", "cold_seconds": "{}", "machine": "somewhere"}
    path = tmp_path / "cost.parquet"
    write_settings(path, summarise_settings(rows), facts)
    return str(path)


def budget_of(table: str, limit_gib: float | None) -> Budget:
    config = load_configuration("fine", settings=[f"limits.memory_gib={json.dumps(limit_gib)}"])
    return Budget(1000.0, None, table, "fine", config)


@pytest.mark.parametrize(
    ("limit_gib", "machine_gib", "point"),
    [
        pytest.param(None, 64.0, "together=large", id="enough"),
        pytest.param(8.0, 64.0, "together=large", id="enough under a limit"),
        pytest.param(2e9 / 2**30, 64.0, "preset", id="a limit of 2 GB"),
        pytest.param(None, 3.0, "preset", id="a small machine"),
        pytest.param(8.0, 3.0, "preset", id="a limit above a small machine"),
        pytest.param(1.2, 64.0, "together=alone", id="a limit below the preset"),
        pytest.param(None, 0.5, "together=alone", id="a machine that is too small for all"),
    ],
)
def test_a_setting_that_does_not_fit_into_memory_is_not_chosen(
    table: str, monkeypatch: pytest.MonkeyPatch, limit_gib: float | None, machine_gib: float, point: str
) -> None:
    monkeypatch.setattr(memory_limit, "memory_limit_gib", lambda: machine_gib)
    chooser = budget_of(table, limit_gib).make_chooser(LOG, 0)
    assert chooser.next_stage()
    assert chooser.choices[0].point == point
    # What was left out is in the explanation, which else stays as it is.
    left_out = {"together=large": 0, "preset": 1, "together=alone": 2}[point]
    expected = f" ({left_out} left out for lack of memory)" if left_out else ""
    assert f"that fits{expected}, and of all {3 - left_out}" in chooser.choices[0].why


def test_a_limit_below_all_settings_is_an_error_before_work(table: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory_limit, "memory_limit_gib", lambda: 64.0)
    budget = budget_of(table, 0.5)
    with pytest.raises(ResourceError, match=r"gnet needs about 0\.\d GiB.*may use 0\.5 GiB.*--memory"):
        budget.make_chooser(LOG, 0)


def run_words(table: str, store: Path, memory: str, *words: str) -> list[str]:
    where = ["--preset", "fine", "--table", table, "--store", str(store)]
    return ["run", LOG, *where, "--budget", "1000", "--memory", memory, *words]


def test_a_dry_run_chooses_what_fits_where_the_preset_does_not(
    table: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory_limit, "memory_limit_gib", lambda: 64.0)
    monkeypatch.setattr(budgets, "measure_calibration_s", lambda: 0.1)
    done = CliRunner().invoke(app, run_words(table, tmp_path, "1.2GB", "--dry-run", "--json"), catch_exceptions=False)
    assert done.exit_code == 0
    assert "together=alone" in done.output and "2 left out for lack of memory" in done.output
    stages = {row["stage"] for row in json.loads(done.stdout.splitlines()[-1])["stages"]}
    assert stages == {"ingest", "effects", "initial", "gnet", "evaluate/initial", "evaluate/gnet"}


@pytest.mark.parametrize("words", [(), ("--dry-run",)], ids=["run", "dry run"])
def test_a_limit_below_all_settings_is_an_error_before_a_server_is_started(
    table: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    monkeypatch.setattr(flow, "reconstruct_log", None)  # would end in a TypeError
    with pytest.raises(ResourceError, match=r"gnet needs about 0\.\d GiB.*may use 0\.5 GiB.*--memory"):
        CliRunner().invoke(app, run_words(table, tmp_path, "0.5GB", *words), catch_exceptions=False)


class ReachedError(Exception):
    """The checks before the first stage have let the run go on."""


def test_a_worker_checks_memory_as_the_command_does(
    table: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory_limit, "memory_limit_gib", lambda: 64.0)

    def reach(*_: Any) -> None:
        raise ReachedError

    monkeypatch.setattr(flow, "_reconstruct_chunks", reach)
    for limit_gib, expected in ((1.2, ReachedError), (0.5, ResourceError)):
        budget = budget_of(table, limit_gib)
        with pytest.raises(expected):
            flow._compute(LOG, "fine", str(tmp_path), None, budget._config, budget)
    # Without a budget nothing else is chosen.
    with pytest.raises(ResourceError, match="enet needs about"):
        flow._compute(LOG, "fine", str(tmp_path), None, budget_of(table, 1.2)._config, None)


def test_a_chunk_that_ended_early_is_computed_again_within_its_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory_limit, "memory_limit_gib", lambda: 64.0)
    config = load_configuration("fine", settings=["limits.memory_gib=1.2"])
    made = ["ingest", "effects", "initial", "gnet"]
    record = {
        "run": "abc",
        "log": LOG,
        "config": config.model_dump(mode="json"),
        "chunks": [{"chunk": 0, "stages": [{"stage": name} for name in made]}],
        "budget": {"chunks": [{"chunk": 0, "settings": ["gnet.iterations=8"]}]},
    }
    again: list[str] = []
    monkeypatch.setattr(flow, "find_run_record", lambda store, run: record)
    monkeypatch.setattr(flow, "_run_stage_task", lambda spec, job, refs: again.append(spec.name))
    flow.recompute_run.fn(str(tmp_path), "abc")
    assert again == made


@pytest.mark.parametrize("preset", ["small", "fine", "hd"])
def test_where_memory_suffices_all_settings_of_a_shipped_table_stay(
    preset: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory_limit, "memory_limit_gib", lambda: 64.0)
    budget = Budget(1000.0, None, None, preset, load_configuration(preset))
    assert budget.make_chooser(LOG, 0)._table == budget._table
