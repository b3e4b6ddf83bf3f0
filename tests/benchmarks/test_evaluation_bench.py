"""The benchmark of budgets and guards: what its claims make of rows, and runs that cannot be."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.common.bench import NotMeasuredError
from benchmarks.common.claims import Claim
from benchmarks.evaluation import EVALUATION, budgets
from benchmarks.evaluation.budgets import budget_claims, budget_table, run_with_multiple
from benchmarks.evaluation.range_seconds import range_seconds_claims, range_seconds_table
from benchmarks.evaluation.reliability import fit_estimate, reliability_claims, reliability_table, true_reach_m
from flows.budget.cost_table import find_shipped_table, load_cost_table
from genre_tasks.reliability.guards import PSNR_COEFFICIENTS


def run(budget_s: float, used_s: float, distance: float, log: str = "a", point: str = "preset") -> Any:
    """A run at the shipped table's own pace."""
    own = next(p for p in load_cost_table(find_shipped_table("small"), "small").points if p.name == point)
    return {
        "log": log,
        "budget_s": budget_s,
        "multiple": budget_s / 10,
        "shortest_s": 10.0,
        "used_s": used_s,
        "settings": [],
        "end": own.end,
        "seconds": dict(own.seconds),
        "choices": [{"point": point, "why": "the best that fits"}],
        "metrics": {"interpolation/psnr": 27.0, "shift_3m/perceptual": distance},
    }


def by_name(claims: Any) -> dict[str, Claim]:
    return {c.id.partition(".")[2]: c for c in claims}


def test_budgets_are_kept_used_and_worth_it() -> None:
    rows = [run(10 * k, 9.0 * k, 0.7 - 0.01 * k) for k in range(1, 10)] + [run(100, 104, 0.6)]
    found = by_name(budget_claims(rows))
    assert all(c.holds for c in found.values())
    assert found["budget_kept"].measured == pytest.approx(0.9)
    assert found["budget_overrun"].measured == pytest.approx(1.04)
    assert found["budget_used"].measured == pytest.approx(0.9)


@pytest.mark.parametrize(
    ("row", "failing"),
    [
        (run(10, 12, 0.65), {"budget_overrun", "budget_kept"}),
        (run(100, 60, 0.5), {"budget_used"}),
        (run(30, 29, 0.8), {"budget_worth"}),
        (
            run(10, 6, 0.65, point="more_gaussians=160000, GNet 144 alone"),
            set(),
        ),  # what is better would have passed the budget
        (run(900, 30, 0.55, point="together=most"), set()),  # nothing is better: time may be left
        (run(90, 85, 0.9, log="b"), set()),  # another street's accuracy is no fall
    ],
)
def test_each_claim_can_fail(row: Any, failing: set[str]) -> None:
    found = by_name(budget_claims([run(20, 19, 0.65), run(60, 55, 0.6), row]))
    assert {name for name, c in found.items() if not c.holds} == failing


def test_a_setting_that_the_table_no_longer_has_does_not_count() -> None:
    gone = run(60, 30, 0.6)
    gone["choices"] = [{"point": "of an older sweep", "why": "the best that fits"}]
    used = by_name(budget_claims([run(100, 60, 0.5), gone]))["budget_used"]
    assert used.n == 1 and used.measured == pytest.approx(0.6)
    assert "without 1, whose setting the table no longer has" in used.data


def guards(log: str, stage: str, agreement: list[float]) -> Any:
    """Views at 0, 1, 2 … m on both sides, each a dB worse than the one before it in truth."""
    views = [
        {"camera": "c", "frame": 4, "shift_m": float(side * k), "agreement_db": a, "shown": 0.5, "thin": 0.0}
        | {"floating": 0.0, "psnr": 30.0 - k}
        for k, a in enumerate(agreement)
        for side in (1, -1)
    ]
    return {"log": log, "stage": stage, "views": views}


def test_guards_are_judged_beside_the_path_over_all_streets_and_on_the_worst() -> None:
    good, bad = (
        guards("s?seed=1", "enet", [30.0, 29.0, 28.0, 27.0, 26.0]),
        guards("s?seed=2", "enet", [30.0, 27.0, 32.0, 37.0, 42.0]),
    )
    found = by_name(reliability_claims([good]))
    assert found["reliability"].measured == pytest.approx(1.0)
    # Ten views, of which two are on the path.
    assert found["reliability"].holds and found["reliability"].n == 8
    assert found["reliability_gnet"].measured is None and not found["reliability_gnet"].holds
    both = by_name(reliability_claims([good, bad]))
    assert not both["reliability"].holds and both["reliability_worst"].measured == pytest.approx(-1.0)
    lost = PSNR_COEFFICIENTS["agreement_db"] - PSNR_COEFFICIENTS["shift_m"]  # dB told a metre; in truth 1
    assert any(f"{3 / lost:.1f} m / {3 / lost:.1f} m | 3.0 m / 3.0 m |" in line for line in reliability_table([good]))
    farther = [v | {"psnr": 30.0 - 2 * abs(v["shift_m"])} for v in good["views"]]
    assert true_reach_m(farther, 1) == true_reach_m(farther, -1) == pytest.approx(1.5)


def test_the_slowest_range_counts() -> None:
    rows: list[Any] = [
        {"log": "s?seed=1", "stage": "enet", "range_s": s, "range_cpu_s": 2 * s, "rendered_views": 510}
        for s in (40, 61)
    ]
    fast, slow, none = (by_name(range_seconds_claims(r))["range_s"] for r in (rows[:1], rows, []))
    assert fast.holds and fast.measured == 40 and not slow.holds and slow.measured == 61
    assert none.measured is None and not none.holds
    assert list(range_seconds_table(rows))[-1] == "| seed=1 | enet | 510 | 61.0 | 122.0 |"


def test_the_estimate_can_be_fitted_again() -> None:
    """On views whose PSNR is linear in the guards the fit is exact, also of a street that it was not made on."""
    g, rows = np.random.default_rng(0), []
    for log in ("a", "b", "c"):
        views = [
            {"shift_m": s, "agreement_db": 20 + 8 * g.random(), "shown": g.random()} for s in (-2.0, 1.0, 0.0, 3.0)
        ]
        for v in views:
            v["psnr"] = 5 + 0.5 * v["agreement_db"] + 9 * v["shown"] - 0.7 * abs(v["shift_m"])
        rows.append({"log": log, "views": views})
    fit = fit_estimate(rows)
    assert fit.coefficients == pytest.approx({"constant": 5, "agreement_db": 0.5, "shown": 9, "shift_m": -0.7})
    assert fit.rank_correlation == pytest.approx(1.0) and math.isnan(fit_estimate(rows[:1]).rank_correlation)
    path = [v for row in rows for v in row["views"] if v["shift_m"] == 0]
    for v in path:
        v["psnr"] += 3  # what the path alone shows is fitted, too: ranges are relative to it
    again = fit_estimate(rows)
    assert again.coefficients["shift_m"] < -0.8 and again.rank_correlation > 0.9


def test_rounds_bring_every_budget_to_every_seed() -> None:
    options = dict(EVALUATION.options) | {"budgets": "1.2,1.5,2", "seeds": "1,2,3", "stages": "gnet"}
    names = [c.name for c in EVALUATION.cells(options | {"rounds": "1"}, quick=False)]
    assert names[3:-2] == [
        "budget 1.2 x shortest street 1",
        "budget 1.5 x shortest street 2",
        "budget 2 x shortest street 3",
    ]
    assert names[-2:] == ["range street 1 gnet", "range real chunk 0 gnet"]
    all_ = [c.name for c in EVALUATION.cells(options | {"range_log": ""}, quick=False)][3:-1]
    assert len(set(all_)) == len(all_) == 9
    assert len(EVALUATION.cells(options, quick=True)) == 5


def test_a_run_that_fails_says_what_the_command_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / ".genre" / "prefect-budgets").mkdir(parents=True)  # else a whole run would make it
    with pytest.raises(NotMeasuredError, match=r"there is no table.*nothing\.parquet"):
        run_with_multiple("900", 1.2, str(tmp_path / "nothing.parquet"))


def test_a_budget_is_a_multiple_of_the_shortest_run_right_before(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    # The machine is slower the second time.
    shortest_s = iter([20.04, 30.0])

    def pretend(seed: str, budget_s: float, table: str, settings: tuple[str, ...] = ()) -> Any:
        asked.append((seed, budget_s))
        return run(budget_s, next(shortest_s) if budget_s == budgets.SHORTEST_BUDGET_S else 0.9 * budget_s, 0.5)

    monkeypatch.setattr(budgets, "run_with_budget", pretend)
    rows = [run_with_multiple("7", m, "") for m in (1.5, 1.2)]
    assert asked == [("7", 1.0), ("7", 30.1), ("7", 1.0), ("7", 36.0)]
    assert [(r["multiple"], r["shortest_s"]) for r in rows] == [(1.5, 20.04), (1.2, 30.0)]
    # What a larger multiple buys is compared with a smaller one, whatever their seconds are.
    later = [r | {"metrics": r["metrics"] | {budgets.DISTANCE: d}} for r, d in zip(rows, (0.4, 0.5), strict=True)]
    assert by_name(budget_claims(later))["budget_worth"].measured == pytest.approx(-0.1)


def test_the_table_names_what_was_chosen() -> None:
    lines = list(budget_table([run(20, 19, 0.65)]))
    assert "| 2 | 20 | " in lines[2] and "the preset" in lines[2] and "0.95" in lines[-1]
