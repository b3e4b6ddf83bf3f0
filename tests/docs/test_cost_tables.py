"""The tables that budgets choose from, and that the page on accuracy against time shows, are those of their cells."""

from __future__ import annotations

import json
import statistics

import pyarrow.parquet as pq
import pytest

from docs.cost_tables import PRESETS
from docs.result_tables import DATA
from flows.budget.cost_table import find_shipped_table
from flows.cost_sweep.parquet import read_settings


@pytest.mark.parametrize("preset", PRESETS)
def test_a_shipped_table_is_that_of_its_cells(preset: str) -> None:
    settings, facts = read_settings(find_shipped_table(preset))
    table = pq.read_table(DATA / f"cost_{preset}.parquet")
    cells = table.to_pylist()
    assert {c["setting"] for c in cells} == {x.setting for x in settings}
    assert table.schema.metadata[b"commit"].decode() == facts["commit"]
    for x in settings:
        of_setting = [c for c in cells if c["setting"] == x.setting]
        assert len(of_setting) == x.n
        psnrs = [json.loads(c["metrics"])["interpolation/psnr"] for c in of_setting]
        assert x.values["psnr"].average == pytest.approx(statistics.mean(psnrs))
        seconds = [sum(json.loads(c["seconds"]).values()) for c in of_setting]
        assert x.seconds == pytest.approx(statistics.median(seconds))
