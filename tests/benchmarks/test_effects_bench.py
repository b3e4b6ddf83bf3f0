"""The benchmark of effects: which logs, what is claimed, where a threshold sits."""

from __future__ import annotations

import pytest

from benchmarks.effects import CASES, EFFECTS, calibrated
from flows.cli.bench import load
from genre_tasks.effects.plan import EFFECTS as NAMES
from genre_tasks.logs.registry import open_log


def row(name: str, factor: float, on: float, off: float, value: float = 3.0, unit: str = "dB") -> dict:
    each = {"heldout_db": 20.0, "beside_db": None, "gnet_s": 2.0, "plan_s": 3.0}
    return {
        "effect": name, "log": f"synthetic:street?seed={factor}", "chunk": 0, "factor": factor, "unit": unit,
        "value": value, "threshold": 1.0, "property_unit": "px", "choice": "on",
        "on": each | {"measure": on}, "off": each | {"measure": off},
    }  # fmt: skip


def test_it_is_registered_and_its_cases_are_effects() -> None:
    assert load("effects") is EFFECTS and set(CASES) < set(NAMES)


@pytest.mark.parametrize("name", list(CASES))
def test_streets_can_be_asked_to_call_for_each(name: str) -> None:
    case = CASES[name]
    for query in (case.plain, case.calls(1.0), case.calls(4.0)):
        open_log(f"synthetic:street?seed=1{query}")


def test_cells_are_streets_with_and_without_and_the_real_chunks() -> None:
    options = dict(EFFECTS.options) | {"seeds": "1,2", "effects": "exposure,ego_mask"}
    assert len(EFFECTS.cells(options, False)) == 2 * (2 * 2 + 2)
    assert len(EFFECTS.cells(options | {"pandaset": ""}, False)) == 8
    assert len(EFFECTS.cells(options | {"chunks": ""}, False)) == 8
    assert len(EFFECTS.cells(options, True)) == 4


def test_claims_are_of_four_times_the_threshold_and_of_plain_streets() -> None:
    rows = {
        "a": row("exposure", 4.0, 27.0, 26.2), "b": row("exposure", 0.0, 27.0, 26.8),
        "c": row("lidar_depth", 4.0, -3.0, -4.0, unit="%"), "d": row("exposure", -1.0, 9.0, 1.0),
        "e": {"not_measured": "no data"},
    }  # fmt: skip
    claims = {c.id: c for c in EFFECTS.claims(rows)}
    assert claims["effects.gain_exposure"].measured == pytest.approx(0.8) and claims["effects.gain_exposure"].holds
    assert claims["effects.loss_exposure"].measured == pytest.approx(0.2) and not claims["effects.loss_exposure"].holds
    assert claims["effects.gain_lidar_depth"].measured == pytest.approx(25.0)
    assert claims["effects.gain_ego_mask"].measured is None and not claims["effects.gain_ego_mask"].holds
    table = list(EFFECTS.table(rows))
    assert len([line for line in table if line.startswith("| ")]) == 5 and "e: not measured: no data" in table[-1]


def test_a_threshold_is_read_between_two_measurements() -> None:
    rows = [row("exposure", f, 27.0 + g, 27.0, value=v) for f, g, v in ((1.0, 0.0, 2.0), (2.0, 0.2, 4.0))]
    assert calibrated(rows, 0.1) == pytest.approx(3.0)
    assert calibrated(rows[:1], 0.1) is None
    assert any("0.1 dB at 3 px" in line for line in EFFECTS.table(dict(zip("ab", rows, strict=True))))
