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


def test_every_rollout_with_collisions_is_counted_in_table_and_claims() -> None:
    collided = [(row, entry) for row in ROWS for entry in row["rollouts"] if entry["collisions"]]
    assert collided
    lines = {line.split(" | ")[0]: line for line in simulation_tables.behaviours().splitlines()}
    for row, entry in collided:
        real = "differences" in row
        count = overlapping(entry["behaviour"], real=real)
        assert not count.startswith("0 ")
        assert count in lines[f"| rollouts on {'the real log' if real else 'streets'} that overlap a road user"]
        name = entry["behaviour"].replace("-", "_")
        metrics = ("kernel",) if real else ("psnr", "perceptual")
        ids = tuple(f"simulation.{metric}_{name}_vs_" for metric in metrics)
        named = [claim for claim in CLAIMS if claim["id"].startswith(ids)]
        assert named and all(f"{count} rollouts overlap a road user" in claim["data"] for claim in named)


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
