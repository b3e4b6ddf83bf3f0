"""The optimiser's benchmark: its races on a tiny street, and the arithmetic between curves and claims."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks import run
from benchmarks.bench import NotMeasuredError
from benchmarks.optimiser import BENCH, cells, race, summary
from benchmarks.optimiser.network import measure_network, scene_of
from benchmarks.optimiser.picture import draw
from benchmarks.optimiser.race import Point
from benchmarks.optimiser.task import Task
from benchmarks.schema import Result
from genre_tasks.config import AdamConfig, GnetConfig, LossConfig, PerSceneConfig
from genre_tasks.optimiser.adam import TunedAdam
from genre_tasks.optimiser.learned import LearnedOptimiser
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.unroll import Plan, unroll
from genre_tasks.scene.graph import DISTANT
from tests.optimiser import street

LOSS = LossConfig(perceptual=0.0)
ADAM = GnetConfig(method="adam", iterations=6, views_per_iteration=2, loss=LOSS)
NEVER = Point(0.05, 8, 99.0, 300)
"""A goal that nobody reaches."""


@pytest.fixture(scope="module")
def task() -> Task:
    truth = street.scene()
    views = street.targets(truth)
    return Task(street.blurred(truth), views, views[:2])


def test_walking_is_unrolling(task: Task) -> None:
    objective = Objective(LOSS)
    expected = unroll(TunedAdam(), task.scene, task.source, (), objective, Plan(5, 2, seed=3))
    moments = list(itertools.islice(race.walk(TunedAdam, task, objective, 2, 3, 5), 5))
    assert torch.equal(moments[-1].scene.gaussians.packed(), expected.scene.gaussians.packed())
    assert [m.renders for m in moments] == [2, 4, 6, 8, 10]
    assert all(a.seconds < b.seconds for a, b in itertools.pairwise(moments))


def test_loading_counts_and_judging_does_not(task: Task, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(race.time, "perf_counter", lambda: now[0])

    def load() -> TunedAdam:
        now[0] += 7.0
        return TunedAdam()

    steps = race.walk(load, task, Objective(LOSS), 2, 0, 5)
    first = next(steps)
    now[0] += 100.0
    assert (first.seconds, next(steps).seconds) == (7.0, 7.0)


def test_a_curve_is_read_between_its_points() -> None:
    curve = [Point(0.0, 0, 10.0, 1), Point(2.0, 4, 20.0, 1), Point(4.0, 8, 18.0, 1), Point(6.0, 12, 22.0, 1)]
    assert race.reached(curve, 15.0) == pytest.approx(1.0)
    assert race.reached(curve, 20.0) == pytest.approx(2.0)
    assert race.reached(curve, 21.0) == pytest.approx(5.5)
    assert race.reached(curve, 22.1) is None
    assert (race.at_renders(curve, 5), race.at_renders(curve, 13)) == (18.0, None)
    assert race.looks(4.0, 2.0) == pytest.approx([1.0, 1.25, 1.5625, 1.953125])


def test_adam_stops_at_its_goal_its_length_or_the_cap(task: Task) -> None:
    easy = Point(0.05, 8, task.psnr(task.scene) + 0.05, 300)
    early = race.adam(task, ADAM, 0, easy, 60.0)
    assert race.reached(early, easy.psnr) is not None and early[-1].renders >= 8
    assert race.adam(task, ADAM, 0, NEVER, 60.0)[-1].renders == 12  # the cosine ends with its length
    endless = ADAM.model_copy(update={"adam": AdamConfig(schedule="constant")})
    capped = race.adam(task, endless, 0, NEVER, 0.2)
    assert capped[-1].seconds >= 0.2 > capped[-2].seconds and capped[-1].renders > 12


@pytest.mark.parametrize("method", ["standard_3dgs", "street_gs"])
def test_per_scene_training_stops_at_its_goal_its_length_or_the_cap(task: Task, method: Any) -> None:
    config = GnetConfig(method=method, per_scene=PerSceneConfig(iterations=40))
    assert race.per_scene(task, config, 0, NEVER, 60.0)[-1].renders == 40
    capped = race.per_scene(task, config, 0, NEVER, 1e-6)
    assert capped[-1].renders <= 1
    easy = Point(1e-4, 1, capped[0].psnr - 3, 300)
    assert race.per_scene(task, config, 0, easy, 60.0)[-1].renders < 40


def test_a_race_says_how_each_variant_ended(task: Task, tmp_path: Path) -> None:
    gnet = GnetConfig(iterations=4, views_per_iteration=4, loss=LOSS)
    row = cells.race_row(task, gnet, {"short": ADAM}, 0, "tuned_adam", 1000.0)
    assert row["gnet"]["renders"] == 16 and row["gnet"]["curve"][0][:2] == [0.0, 0]
    short = row["variants"]["short"]
    assert short["ended"] in ("reached", "length") and (short["reached_s"] is None) == (short["ended"] == "length")
    assert short["best_psnr"] == pytest.approx(max(p[2] for p in short["curve"]), abs=1e-3)
    assert short["psnr_at_equal_renders"] is None  # 12 renders against 16
    draw([{"log": "street", "chunk": 0, "order": 0, **row}], tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 1000


def test_far_past_its_length_the_loss_is_compared_with_that_at_t(task: Task) -> None:
    row = cells.stability_row(task, GnetConfig(iterations=2, views_per_iteration=4, loss=LOSS))
    assert list(row["loss"]) == ["1", "2", "5", "10"]
    assert row["ratio"] == pytest.approx(row["loss"]["10"] / row["loss"]["1"])


def test_the_network_is_measured_at_every_count() -> None:
    row = measure_network(LearnedOptimiser, (200, 400, 800), 2)
    assert list(row["seconds"]) == ["200", "400", "800"] and row["seconds"]["800"]["n"] == 2
    assert set(row["fit"]) == {"seconds", "us_per_gaussian", "r2"}
    assert bool((scene_of(400).nodes == DISTANT).any())


def _race(method: str, times: list[float | None], psnr: list[float | None]) -> dict[str, Any]:
    pairs = zip(times, psnr, strict=True)
    variants = {str(k): {"reached_s": t, "psnr_at_equal_renders": p} for k, (t, p) in enumerate(pairs)}
    gnet = {"seconds": 2.0, "psnr": 25.0}
    where = {"log": "synthetic:street?seed=900", "chunk": 0, "order": 1}
    return where | {"method": method, "cap": 50.0, "gnet": gnet, "variants": variants}


def test_claims_take_the_earliest_variant_and_the_cap_where_there_is_none() -> None:
    rows = {
        "a": _race("standard_3dgs", [90.0, 24.0], [None, None]),
        "b": _race("standard_3dgs", [None, None], [None, None]),
        "c": _race("tuned_adam", [6.0, None], [23.0, 24.0]),
        "d": _race("street_gs", [1.0], [None]),
    }
    claims = {c.id: c for c in summary.claims(rows)}
    standard = claims["optimiser.vs_standard_3dgs"]
    assert (standard.measured, standard.n, standard.holds) == (31.0, 2, True)  # the median of 12 and the cap
    assert "in 1 of 2 cells not within the cap" in standard.data
    assert claims["optimiser.vs_tuned_adam"].measured == 3.0
    db = claims["optimiser.equal_renders_db"]
    assert (db.measured, db.holds) == (1.0, False)
    assert claims["optimiser.stable_10x"].measured is None
    assert claims["optimiser.network_100k"].measured is None


def test_what_is_not_measured_does_not_count() -> None:
    rows = {cell.name: {"not_measured": "no time"} for cell in BENCH.cells(BENCH.options, quick=False)}
    assert not any(c.holds or c.n for c in BENCH.claims(rows))
    assert "no time" in "\n".join(BENCH.table(rows))


def test_options_choose_cells_and_a_quick_run_ends_in_time() -> None:
    names = [c.name for c in BENCH.cells({**BENCH.options, "seeds": "900", "orders": "2", "pandaset": ""}, False)]
    races = [f"synthetic:street?seed=900 chunk 0 order 2 {m}" for m in cells.METHODS]
    assert names == ["network", *races, "stability/synthetic:street?seed=900 chunk 0"]
    quick, full = (BENCH.cells(BENCH.options, q) for q in (True, False))
    assert sum(c.seconds for c in quick) <= run.QUICK_S < sum(c.seconds for c in full)
    assert len({c.name for c in full}) == len(full)


def test_what_would_not_end_in_the_minutes_given_is_left_out() -> None:
    given = {**BENCH.options, "seeds": "900", "pandaset": "", "minutes": "0.1"}
    with pytest.raises(NotMeasuredError, match="minutes given"):
        BENCH.cells(given, False)[1].measure()


def test_committed_rows_make_the_committed_claims() -> None:
    path = Path(__file__).parents[2] / "docs/benchmarks/optimiser.json"
    result = Result.model_validate_json(path.read_text(encoding="utf-8"))
    rows = {str(row["cell"]): dict(row) for row in result.rows}
    assert list(BENCH.claims(rows)) == result.claims
