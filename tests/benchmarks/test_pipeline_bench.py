"""The pipeline benchmark's claims are those that its committed rows make."""

from __future__ import annotations

from pathlib import Path

from benchmarks.common.claims import Result
from benchmarks.pipeline import BENCH

RESULT = Result.model_validate_json((Path(__file__).parents[2] / "docs/results/data/pipeline.json").read_text())


def test_committed_rows_make_the_committed_claims() -> None:
    rows = {f"{row['log']} chunk {row['chunk']}": dict(row) for row in RESULT.rows}
    assert list(BENCH.claims(rows)) == RESULT.claims


def test_cells_are_named_as_the_rows() -> None:
    names = [cell.name for cell in BENCH.cells(dict(BENCH.options), quick=False)]
    assert names == [f"{row['log']} chunk {row['chunk']}" for row in RESULT.rows]


def test_a_log_that_is_not_there_is_not_measured() -> None:
    name = "pandaset:nowhere/002 chunk 1"
    claims = list(BENCH.claims({name: {"not_measured": "no folder"}}))
    assert {c.id for c in claims} >= {"main.gnet_vs_adam_db", "main.enet_kernel_3m"}
    assert not any(c.holds or c.n for c in claims)
