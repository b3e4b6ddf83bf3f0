"""Claims and table of the enhancement of a file: made of the rows, and failing where nothing was measured."""

from __future__ import annotations

import pytest

from benchmarks.exchange.enhancement import enhancement_claims, enhancement_table

ROW = {
    "log": "synthetic:street?seed=1001",
    "given": {"heldout_psnr": 28.0, "psnr": 21.0, "perceptual": 0.6},
    "scene": {"heldout_psnr": 27.9, "psnr": 22.0, "perceptual": 0.57},
}


def test_claims_are_changes_from_the_scene_as_it_was() -> None:
    claims = {claim.id.rpartition("enhance_")[2]: claim for claim in enhancement_claims([ROW])}
    assert {name: claim.measured for name, claim in claims.items()} == {
        "psnr_3m": pytest.approx(1.0),
        "perceptual_3m": pytest.approx(0.05),
        "heldout": pytest.approx(0.1),
    }
    assert {name: claim.holds for name, claim in claims.items()} == {
        "psnr_3m": True,
        "perceptual_3m": False,
        "heldout": True,
    }
    assert not any(claim.holds for claim in enhancement_claims([]))


def test_the_table_has_a_line_for_every_scene() -> None:
    lines = list(enhancement_table([ROW]))
    assert len(lines) == 4 and "28.00" in lines[2] and "0.570" in lines[3]
