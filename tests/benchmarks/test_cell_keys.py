"""A cached row counts for the options that its cell reads: another value measures again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from benchmarks.common.bench import TINY_STREET, Bench
from benchmarks.evaluation import EVALUATION
from benchmarks.log_faults import BENCH as LOG_FAULTS
from benchmarks.scale import BENCH as SCALE
from benchmarks.start_up import BENCH as START_UP


def changed_cells(bench: Bench, quick: bool = False, **options: str) -> set[str]:
    """Names of the cells that an option makes others of, though their names stay."""
    before, after = (
        {cell.name: dict(cell.parameters) for cell in bench.cells(dict(bench.options) | given, is_quick)}
        for given, is_quick in (({}, False), (options, quick))
    )
    return {name for name in before.keys() & after.keys() if before[name] != after[name]}


@pytest.mark.parametrize("options", [{"seed": TINY_STREET}, {"settings": "gnet.iterations=3"}])
def test_the_cached_run_of_another_street_is_measured_again(options: dict[str, str]) -> None:
    assert changed_cells(START_UP, **options) == {"cached_run"}


def test_streets_and_folders_of_sound_and_faulty_logs_count() -> None:
    small = "frames=8&samples=1&cameras=1"
    sound = changed_cells(LOG_FAULTS, sound_street=small)
    assert sound == {f"sound seed={seed}" for seed in range(100)}
    faulty = changed_cells(LOG_FAULTS, street=small)
    assert faulty and all(name.startswith("seed=1001 ") for name in faulty)
    elsewhere = changed_cells(LOG_FAULTS, pandaset="elsewhere/002")
    assert {"sound 002 chunk 0", "sound 002 chunk 1"} < elsewhere


def test_a_false_alarm_is_in_the_table() -> None:
    alarm: dict[str, Any] = {"log": "synthetic:street?seed=1", "name": "seed=1", "fault": "none", "cpu_seconds": 1.0}
    lines = list(LOG_FAULTS.table({"sound seed=1": alarm | {"words": ["turned_camera"]}}))
    assert lines[-1] == "| seed=1 | none | | | **turned_camera** |"


def test_budgets_depend_on_the_content_of_their_table(tmp_path: Path) -> None:
    table = tmp_path / "cost.parquet"
    options = dict(EVALUATION.options) | {"seeds": "1", "budgets": "1.5", "table": str(table)}

    def digests() -> Any:
        cells = {cell.name: cell.parameters for cell in EVALUATION.cells(options, False)}
        assert "table" not in cells["guards street 1 gnet"]
        return cells["budget 1.5 x shortest street 1"]["table"]

    found = [digests()]
    for content in (b"first", b"second"):
        table.write_bytes(content)
        found.append(digests())
    assert found[0] is None and len(set(found)) == 3
    assert changed_cells(EVALUATION, table=str(table)) == {
        cell.name for cell in EVALUATION.cells(dict(EVALUATION.options), False) if cell.name.startswith("budget")
    }


@pytest.mark.parametrize(
    ("options", "names"),
    [
        ({"preset": "demo"}, {"orchestration", "object_store"}),
        ({"settings": "gnet.iterations=3"}, {"throughput", "orchestration", "object_store"}),
        ({"street": "&cameras=2&frames=8"}, {"throughput", "object_store"}),
        ({"cached_street": "&cameras=2"}, {"cached"}),
        ({"cluster": "10x2"}, {"cluster"}),
        ({"inputs": "60"}, {"fuzz"}),
    ],
)
def test_cells_of_scale_depend_on_the_options_that_they_read(options: dict[str, str], names: set[str]) -> None:
    assert changed_cells(SCALE, **options) == names


def test_fewer_rounds_are_another_measurement_of_scale() -> None:
    assert changed_cells(SCALE, quick=True) == {"cached", "object_store"}
