"""The claims and the table of what a setting brings."""

from __future__ import annotations

from benchmarks.common.bench import Row
from benchmarks.optimiser.ablation import FACADES, GROUND


def _row(log: str, without: tuple[float, float | None], completed: tuple[float, float | None]) -> Row:
    kinds = {"without": without, "with": completed}
    return {"log": log, "chunk": 0} | {
        kind: {"initial": [20.0, None], "gnet": list(psnr), "gnet_s": 1.5} for kind, psnr in kinds.items()
    }


def test_gains_are_medians_over_streets_and_the_real_log_has_its_own() -> None:
    rows = {
        "a": _row("synthetic:street?seed=1", (25.0, 21.0), (26.0, 21.5)),
        "b": _row("synthetic:street?seed=2", (25.0, 21.0), (25.5, 21.25)),
        "c": _row("synthetic:street?seed=3", (25.0, 21.0), (25.25, 23.0)),
        "real": _row("pandaset:logs/002", (27.0, None), (26.9, None)),
    }
    claims = {c.id: c for c in FACADES.claims(rows)}
    assert claims["facades.street_heldout_db"].measured == 0.5
    assert claims["facades.street_3m_db"].measured == 0.5
    assert abs(claims["facades.real_heldout_db"].measured + 0.1) < 1e-9
    assert not claims["facades.real_heldout_db"].holds
    lines = list(FACADES.table(rows))
    assert len(lines) == 2 + 2 * 4 and "| 26.00 | 21.50 | 1.50 |" in lines[3]


def test_what_is_not_measured_is_said() -> None:
    rows: dict[str, Row] = {"real": {"not_measured": "no data"}}
    assert all(c.measured is None for c in FACADES.claims(rows))
    assert "no data" in "\n".join(FACADES.table(rows))


def test_a_quick_run_takes_one_street() -> None:
    assert len(FACADES.cells(FACADES.options, quick=False)) == 4
    (cell,) = FACADES.cells(FACADES.options, quick=True)
    assert "seed=1001" in cell.name


def test_each_setting_has_its_own_name_and_switch() -> None:
    assert [b.name for b in (FACADES, GROUND)] == ["facades", "ground"]
    rows = {"a": _row("synthetic:street?seed=1", (25.0, 21.0), (26.0, 21.5))}
    assert {c.id for c in GROUND.claims(rows)} >= {"ground.street_3m_db"}
    assert "ground held" in "\n".join(GROUND.table(rows)) and "façades completed" in "\n".join(FACADES.table(rows))
