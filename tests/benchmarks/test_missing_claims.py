"""No claim vanishes: what documents claim of a benchmark is claimed, and fails, where nothing was measured."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.common.bench import Bench, Row
from benchmarks.common.claims import Result
from flows.cli.bench import _BENCHES, load_bench

DATA = Path(__file__).resolve().parents[2] / "docs/results/data"


@pytest.mark.parametrize("name", sorted(name for name in _BENCHES if (DATA / f"{name}.json").is_file()))
def test_what_was_not_measured_is_claimed_and_fails(name: str) -> None:
    bench: Bench = load_bench(name)
    rows: dict[str, Row] = {cell.name: {"not_measured": "no time"} for cell in bench.cells(dict(bench.options), False)}
    claims = list(bench.claims(rows))
    assert not any(claim.holds or claim.measured is not None for claim in claims)
    committed = Result.model_validate_json((DATA / f"{name}.json").read_text(encoding="utf-8"))
    assert {claim.id for claim in committed.claims} <= {claim.id for claim in claims}
    # The schema of committed results asks for it.
    names = [(claim.id, claim.data) for claim in claims]
    assert len(set(names)) == len(names)
