"""Re-simulation's page and claims say which rollouts run through a road user, and which chunk is training data."""

from __future__ import annotations

from typing import Any

import pytest

from docs import simulation_tables
from docs.result_tables import result

ROWS = [row for row in result("simulation")["rows"] if row["cell"].startswith("behaviours")]
CLAIMS = result("simulation")["claims"]


def overlapping(behaviour: str, *, real: bool) -> str:
    """``k of n``, counted here from the rollouts of GenRe+ alone: all methods drive the same."""
    found = [
        bool(entry["collisions"])
        for row in ROWS
        for entry in row["rollouts"]
        if ("differences" in row) == real and entry["behaviour"] == behaviour and entry["method"] == "GenRe+"
    ]
    return f"{sum(found)} of {len(found)}"


@pytest.mark.parametrize("real", [False, True], ids=["streets", "the real log"])
@pytest.mark.parametrize("behaviour", ["brake", "accelerate", "lane-change", "swerve"])
def test_rollouts_with_collisions_are_counted_in_table_and_claims(behaviour: str, real: bool) -> None:
    count = overlapping(behaviour, real=real)
    lines = {line.split(" | ")[0]: line for line in simulation_tables.behaviours().splitlines()}
    cells = lines[f"| rollouts on {'the real log' if real else 'streets'} that overlap a road user"].split(" | ")
    assert cells[2 + simulation_tables.BEHAVIOURS.index(behaviour.replace("-", "_"))].rstrip(" |") == count
    name = behaviour.replace("-", "_")
    ids = tuple(f"simulation.{metric}_{name}_vs_" for metric in (("kernel",) if real else ("psnr", "perceptual")))
    named = [claim for claim in CLAIMS if claim["id"].startswith(ids)]
    assert named and all(f"{count} rollouts overlap a road user" in claim["data"] for claim in named)


@pytest.mark.parametrize("real", [False, True], ids=["streets", "the real log"])
def test_starts_are_those_of_the_rollouts(real: bool) -> None:
    rows = [row for row in ROWS if ("differences" in row) == real]
    words = "the real log" if real else "streets"
    line = next(
        x for x in simulation_tables.behaviours().splitlines() if x.startswith(f"| starts of rollouts on {words}")
    )
    for cell, behaviour in zip(line.strip(" |").split(" | ")[2:], simulation_tables.BEHAVIOURS, strict=True):
        entries = [e for row in rows for e in row["rollouts"] if e["behaviour"].replace("-", "_") == behaviour]
        counts = dict(part.split(" at ")[::-1] for part in cell.split(", "))
        starts = [f"{abs(e['start_offset_m']):g} m" for e in entries if e["method"] == "GenRe+"]
        assert {start: str(starts.count(start)) for start in starts} == counts


def test_claims_of_the_real_log_name_its_training_data() -> None:
    recorded = ("simulation.kernel_", "simulation.handover")
    streets = ("simulation.psnr_", "simulation.perceptual_", "simulation.flicker")
    for ids, is_named in ((recorded, True), (streets, False)):
        data = [claim["data"] for claim in CLAIMS if claim["id"].startswith(ids)]
        assert data and all(("chunk 0 of pandaset 002 is training data" in text) == is_named for text in data)


def test_a_log_that_was_not_measured_has_no_count(monkeypatch: pytest.MonkeyPatch) -> None:
    def street_alone(name: str) -> dict[str, Any]:
        return {"rows": [row for row in ROWS if "differences" not in row]}

    monkeypatch.setattr(simulation_tables, "result", street_alone)
    last = simulation_tables.behaviours().strip().splitlines()[-1]
    assert last == "| rollouts on the real log that overlap a road user | all | – | – | – | – |"
