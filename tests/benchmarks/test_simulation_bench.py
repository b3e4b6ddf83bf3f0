"""Claims of the benchmark of re-simulation follow from its rows, and fail where a row says so."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks.common.bench import NotMeasuredError, Row
from benchmarks.common.claims import Claim
from benchmarks.simulation import BENCH
from benchmarks.simulation.behaviour_quality import measure_behaviours
from benchmarks.simulation.plausibility import measure_plausibility
from benchmarks.simulation.removal import pool_psnr
from benchmarks.simulation.scenes import SimulationCase, cases_from_options
from benchmarks.simulation.steadiness import measure_handover
from flows.paper_tables.rollouts import BEHAVIOUR_LABELS

LOGS = [f"synthetic:street?seed={seed}&frames=40" for seed in (1, 2, 3)]
# Better by (dB, perceptual distance) than 3DGS on each of three streets.
CLEAR = [(1.0, -0.02), (1.1, -0.021), (0.9, -0.019)]


def claims_of(rows: dict[str, Row]) -> dict[str, Claim]:
    return {claim.id.removeprefix("simulation."): claim for claim in BENCH.claims(rows)}


def rollouts(gain_db: float, gain_perceptual: float) -> list[dict[str, Any]]:
    found = []
    for behaviour in BEHAVIOUR_LABELS:
        for method, db, perceptual in (("GenRe+", gain_db, gain_perceptual), ("3DGS", 0, 0), ("Difix3D-style", 0, 0)):
            metrics = {"psnr": 20.0 + db, "perceptual": 0.3 + perceptual, "kernel": 0.1}
            entry = {"method": method, "behaviour": behaviour, "start_offset_m": 3.0, "strength": 1.0, "poses": 40}
            found.append(entry | {"collisions": [], "metrics": metrics})
    return found


def behaviours(gains: list[tuple[float, float]]) -> dict[str, Row]:
    rows = zip(LOGS, gains, strict=True)
    return {f"behaviours {log}": {"log": log, "chunks": [0, 1], "rollouts": rollouts(*gain)} for log, gain in rows}


def test_a_method_is_nearer_where_the_interval_over_streets_excludes_zero() -> None:
    claims = claims_of(behaviours(CLEAR))
    for name in ("psnr_swerve_vs_3dgs", "perceptual_lane_change_vs_difix"):
        assert claims[name].holds and claims[name].n == 3
    # Student's t of three streets: 1.0 ± 4.303 · 0.1 / √3.
    assert claims["psnr_brake_vs_3dgs"].measured == pytest.approx(1.0 - 4.3027 * 0.1 / 3**0.5, abs=1e-3)


def test_a_gain_that_streets_disagree_on_is_none() -> None:
    claims = claims_of(behaviours([(2.0, -0.05), (1.0, -0.02), (-0.5, 0.01)]))
    assert not claims["psnr_swerve_vs_3dgs"].holds
    assert not claims["perceptual_swerve_vs_3dgs"].holds


def test_one_street_has_no_interval_and_proves_nothing() -> None:
    name, row = next(iter(behaviours(CLEAR).items()))
    claim = claims_of({name: row})["psnr_swerve_vs_3dgs"]
    assert claim.measured is None and not claim.holds


def test_kernel_distances_are_compared_on_the_real_log() -> None:
    difference = {"metric": "kernel", "method": "GenRe+", "mean": -0.1}
    entries = [
        difference | {"behaviour": "brake", "other": "3DGS", "interval": [-0.2, -0.05]},
        difference | {"behaviour": "swerve", "other": "3DGS", "interval": [-0.2, 0.01]},
    ]
    row = {"log": "pandaset:002", "chunks": [0, 1], "rollouts": [], "differences": entries}
    claims = claims_of({"behaviours pandaset:002": row})
    assert claims["kernel_brake_vs_3dgs"].measured == -0.05 and claims["kernel_brake_vs_3dgs"].holds
    assert not claims["kernel_swerve_vs_3dgs"].holds
    assert claims["kernel_brake_vs_difix"].measured is None


def test_claims_count_the_rollouts_that_overlap_a_road_user() -> None:
    rows = behaviours(CLEAR)
    for entry in rows[f"behaviours {LOGS[1]}"]["rollouts"]:
        if entry["behaviour"] == "accelerate":
            entry["collisions"] = ["Car car-1 at 3.4 s (frame 34), 1.98 m deep"]
    claims = claims_of(rows)
    assert "; 1 of 3 rollouts overlap a road user" in claims["psnr_accelerate_vs_3dgs"].data
    assert "; 0 of 3 rollouts overlap a road user" in claims["perceptual_brake_vs_difix"].data
    table = list(BENCH.table(rows))
    assert any(line.startswith("| street 2 | accelerate | 1 | 1 of 1 | GenRe+ |") for line in table)
    assert any(line.startswith("| street 1 | accelerate | 1 | 0 of 1 | GenRe+ |") for line in table)


def removed(squared_error: float, outside: float) -> Row:
    part = {"squared_error": squared_error, "pixels": 100}
    scores = {"recorded": part, "never_recorded": {"squared_error": 0.0, "pixels": 0}, "around": part}
    scores |= {"change_outside": outside, "share_changed_off_rim": 0.0}
    # What is claimed is the filled image; the render alone is better here, and does not count.
    rendered = scores | {"recorded": {"squared_error": 0.0, "pixels": 100}, "change_outside": 0.0}
    view = {"area": 0.01, "filled": scores, "rendered": rendered}
    return {"actor": "car-0", "views": [view]}


def test_removal_is_claimed_for_the_median_and_the_worst_actor() -> None:
    # 0.1 of 100 pixels is 30 dB, 1 is 20 dB.
    actors = [removed(0.1, 0.5), removed(0.1, 2.5), removed(1.0, 0.0)]
    rows = {"removal x": {"log": LOGS[0], "chunks": [0], "actors": actors}}
    claims = claims_of(rows)
    assert claims["removal_psnr"].measured == pytest.approx(30.0) and claims["removal_psnr"].holds
    assert claims["removal_psnr_worst"].measured == pytest.approx(20.0) and not claims["removal_psnr_worst"].holds
    assert claims["removal_outside"].measured == 2.5 and not claims["removal_outside"].holds
    assert any("| car-0 | 1 | 1.0% | filled | 30.0 | 100 | – |" in line for line in BENCH.table(rows))
    assert pool_psnr([]) is None


def test_a_round_trip_that_never_went_away_is_none() -> None:
    trip = {"actor": "car-0", "changes_when_away": False, "same_scene": True, "same_image": True}
    actor = {"actor": "car-0", "label": "Car", "pixels": 10, "psnr": {"turned": 20.0, "straight": 17.0}}
    row = {"log": LOGS[0], "chunks": [0], "actors": [actor], "round_trips": [trip]}
    claims = claims_of({"insertion x": row})
    assert claims["round_trip"].measured == 0.0 and not claims["round_trip"].holds
    assert claims["insertion_turned"].measured == 3.0 and claims["insertion_turned"].holds


def test_flicker_and_steps_are_ratios() -> None:
    flicker = {"rollout": "swerve", "strength": 1.0, "poses": 8, "flicker": {"render": 0.024, "truth": 0.02}}
    step = {"rollout": "swerve", "border_psnr": [25.0], "seam_psnr": [26.0], "largest_at_cut": 0.05}
    step |= {"largest_at_fade": 0.024, "largest_within": 0.02, "median_within": 0.01}
    rows = {
        "flicker x": {"log": LOGS[0], "chunks": [0, 1], "rollouts": [flicker]},
        "hand-over x": {"log": LOGS[0], "chunks": [0, 1], "rollouts": [step]},
    }
    claims = claims_of(rows)
    assert claims["flicker"].measured == pytest.approx(1.2) and not claims["flicker"].holds
    assert claims["handover_step"].measured == pytest.approx(1.2) and claims["handover_step"].holds
    assert len(list(BENCH.table(rows))) == 2 * 3 + 1


def test_memory_growth_is_from_the_first_mark_to_the_last() -> None:
    rate = {"median": 25.0, "low": 24.0, "high": 26.0, "n": 3}
    speed = {"log": LOGS[0], "chunks": [0], "images": {"small": 120, "large": 24}}
    speed["images_per_s"] = {"small": rate, "large": rate | {"median": 1.5}}
    memory = {"log": LOGS[0], "chunks": [0], "poses": 2000, "rss_mib": {"200": 500.0, "1100": 600.0, "2000": 520.0}}
    claims = claims_of({"speed x": speed, "memory x": memory})
    assert claims["memory"].measured == pytest.approx(0.04) and claims["memory"].holds
    assert claims["speed_small"].holds and not claims["speed_large"].holds


def test_an_error_without_numbers_is_not_clear() -> None:
    requests = [
        {"request": "a start 500 m aside", "error": "ConfigError", "text": "--start-offset is 500"},
        {"request": "a path without frames", "error": "InputError", "text": "no frames"},
        {"request": "an unknown actor", "error": None, "text": ""},
        {"request": "an unknown behaviour", "error": "ConfigError", "text": "unknown behaviour"},
    ]
    planned = {"asked": 10, "planned": 8, "within": 8, "planned_by_behaviour": {"brake": 8}, "refused_by_behaviour": {}}
    claims = claims_of({"plausibility": planned, "refusals x": {"log": LOGS[0], "chunks": [0], "requests": requests}})
    assert claims["clear_errors"].measured == 0.5 and not claims["clear_errors"].holds
    assert claims["plausible"].holds and claims["plausible"].n == 8


def test_what_was_not_measured_holds_nothing() -> None:
    rows = {cell.name: {"not_measured": "left out"} for cell in BENCH.cells(BENCH.options, quick=True)}
    assert rows and not any(claim.holds for claim in BENCH.claims(rows))
    cases = cases_from_options(BENCH.options, ())
    assert [case.chunks for case in cases] == [(0, 1)] * 6


def test_a_log_that_is_not_there_is_not_measured() -> None:
    case = SimulationCase("pandaset:nowhere/002", (0, 1), "store", ())
    for measure in (measure_handover, lambda case: measure_behaviours(case, ())):
        with pytest.raises(NotMeasuredError, match="there is no folder nowhere/002"):
            measure(case)
    options = dict(BENCH.options) | {"seeds": "1", "pandaset": "nowhere/002"}
    parameters = {cell.name: cell.parameters for cell in BENCH.cells(options, quick=False)}
    assert parameters["plausibility"]["logs"] == ["synthetic:street?seed=1"]
    with pytest.raises(NotMeasuredError, match="no log"):
        measure_plausibility([])
    with pytest.raises(NotMeasuredError, match="single chunk"):
        measure_handover(SimulationCase("synthetic:street?seed=1", (0,), "store", ()))
