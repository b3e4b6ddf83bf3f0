"""Tables of effects, from rows as ``genre bench effects`` writes them."""

from __future__ import annotations

from typing import Any

import pytest

from docs import effect_tables


def row(factor: float, choice: str, gain_db: float) -> dict[str, Any]:
    log = "pandaset:data/002" if factor < 0 else "synthetic:street?seed=1001&bonnet=0.08"
    return {
        "effect": "ego_mask",
        "log": log,
        "chunk": 1,
        "factor": factor,
        "unit": "dB",
        "value": 8.0,
        "threshold": 2.0,
        "property_unit": "%",
        "choice": choice,
        "on": {"measure": 25.0 + gain_db, "heldout_db": 25.0 + gain_db},
        "off": {"measure": 25.0, "heldout_db": 25.0},
    }


@pytest.fixture(autouse=True)
def measured(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [row(4.0, "on", 2.0), row(4.0, "on", 1.0) | {"value": 9.0}, row(0.0, "off", 0.0), row(-1.0, "off", -0.5)]
    monkeypatch.setattr(effect_tables, "result", lambda name: {"rows": rows})
    monkeypatch.setattr(effect_tables, "provenance", lambda name: "")


def test_streets_that_call_for_an_effect_stand_beside_those_that_do_not() -> None:
    lines = effect_tables.on_streets().strip().splitlines()
    # The other effects were not measured, and have no line.
    called = "4.00 to 4.50 | 2 of 2 | +1.50 dB (+1.00 to +2.00)"
    assert lines[2:] == [f"| ego mask | 2 % | {called} | 0 of 1 | +0.00 dB (+0.00 to +0.00) |"]


def test_real_chunks_show_what_decided_and_both_scores() -> None:
    lines = effect_tables.on_real_chunks().strip().splitlines()
    assert lines[2:] == ["| ego mask | PandaSet 002, chunk 1 | 8 % | off | -0.50 dB | 24.50 | 25.00 |"]
