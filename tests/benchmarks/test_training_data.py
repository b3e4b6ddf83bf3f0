"""Claims on unseen data are of none that networks were trained on, and others say so."""

from __future__ import annotations

from pathlib import Path

from benchmarks.common.claims import Result
from benchmarks.perception import BENCH
from benchmarks.perception.camera_transfer import camera_transfer_claims
from benchmarks.simulation.scenes import describe_training

FILE = Path(__file__).parents[2] / "docs/results/data/perception.json"


def test_no_committed_claim_across_cameras_is_of_chunk_0() -> None:
    result = Result.model_validate_json(FILE.read_text(encoding="utf-8"))
    claims = [claim for claim in result.claims if claim.id.startswith("perception.transfer_")]
    assert claims and not any("chunk 0" in claim.data for claim in claims)
    # Its numbers stay in the tables.
    assert any(row["cell"] == "transfer pandaset 002 chunk 0" for row in result.rows)


def test_a_row_of_training_data_makes_no_claim_across_cameras() -> None:
    difference = {"detector": "d", "other": "3dgs", "measure": "box/ap", "mean": 0.5, "interval": [0.4, 0.6]}
    rows = [{"log": f"pandaset 002 chunk {chunk}", "differences": [difference]} for chunk in (0, 1, 10)]
    measured = [claim.data for claim in camera_transfer_claims(rows) if claim.measured is not None]
    assert [data.split(",")[0] for data in measured] == ["pandaset 002 chunk 1", "pandaset 002 chunk 10"]
    # Where nothing else was measured, the claim fails and is not left out.
    (claim,) = [c for c in camera_transfer_claims(rows[:1]) if c.id == "perception.transfer_3dgs_box_ap"]
    assert claim.measured is None and not claim.holds


def test_a_quick_run_measures_the_chunk_that_claims_are_of() -> None:
    options = dict(BENCH.options) | {"seeds": "1001"}
    names = [cell.name for cell in BENCH.cells(options, quick=True) if cell.name.startswith("transfer")]
    assert names == ["transfer pandaset 002 chunk 1"]


def test_a_log_without_its_first_chunk_is_unseen() -> None:
    assert describe_training([{"log": "pandaset:data/002", "chunks": [1]}]) == ""
    assert describe_training([]) == ""
