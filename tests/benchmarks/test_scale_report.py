"""The claims of scale say what they were measured on."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks.scale import BENCH
from benchmarks.scale.report import scale_claims

ORCHESTRATION: dict[str, Any] = {
    "worker_s": 300.0,
    "compute_s": 288.0,
    "share": 12 / 288,
    "stages_s": {"gnet": 60.0, "evaluate/gnet": 228.0},
}


def test_the_share_of_orchestration_says_what_evaluation_is_of_it() -> None:
    claim = {claim.id: claim for claim in scale_claims({"orchestration": ORCHESTRATION})}["scale.orchestration_share"]
    assert claim.measured == pytest.approx(0.0417, abs=1e-4)
    assert "12.0 s a log over 288 s, 228 s of them evaluation" in claim.data
    named = ORCHESTRATION | {"log": "synthetic:street?seed=900", "preset": "fine"}
    claim = {claim.id: claim for claim in scale_claims({"orchestration": named})}["scale.orchestration_share"]
    assert claim.data.endswith("; synthetic:street?seed=900, preset fine")


def test_numbers_of_logs_workers_and_files_are_those_of_the_rows() -> None:
    stages = {"lost": 0, "doubled": 3}
    rows = {
        "throughput": {"logs": 4, "ratio": 1.5},
        "cluster": {"logs": 20, "workers": 5, "seconds_scale": 0.1, "stages": stages},
        "fuzz": {"inputs": 60, "findings": []},
    }
    claims = {claim.id.removeprefix("scale."): claim for claim in scale_claims(rows)}
    assert claims["two_workers"].data.startswith("4 logs, ")
    assert claims["cluster_lost"].data == "20 logs on 5 simulated workers, seconds of stages times 0.1"
    assert claims["cluster_lost"].holds and not claims["cluster_doubled"].holds
    assert claims["fuzz_findings"].data.startswith("60 damaged")


def test_what_was_not_measured_fails() -> None:
    claims = list(BENCH.claims({"throughput": {"not_measured": "no PostgreSQL"}}))
    assert len(claims) == 7 and not any(claim.holds or claim.n for claim in claims)
