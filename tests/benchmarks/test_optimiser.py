"""The optimiser's benchmark: its races on a tiny street, and the arithmetic between curves and claims."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks.common import runner
from benchmarks.common.bench import NotMeasuredError
from benchmarks.common.claims import Result
from benchmarks.common.task import OptimisationTask
from benchmarks.optimiser import BENCH, cells, claims, iteration_tradeoff, race
from benchmarks.optimiser.network_speed import measure_network, street_scene_graph
from benchmarks.optimiser.plots import draw, draw_network, envelope
from benchmarks.optimiser.race import Point
from genre_tasks.config import (
    AdamConfig,
    GnetConfig,
    OptimiserConfig,
    PerSceneConfig,
)
from genre_tasks.errors import ConfigError
from genre_tasks.learned.learned_optimiser import LearnedOptimiser
from genre_tasks.learned.weights import load_optimiser
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.tuned_adam import TunedAdam
from genre_tasks.optimiser.unroll import UnrollSettings, unroll
from genre_tasks.scene.graph import DISTANT
from genre_tasks.stages.optimise import UnrolledOptimiser, UnrolledPart
from genre_tasks.weights import resolve_weights
from tests.benchmarks.small_races import ADAM, LOSS, NEVER, learned
from tests.optimiser import street_scenes


def test_walking_is_unrolling(task: OptimisationTask) -> None:
    plan, novel, objective = (
        UnrollSettings(5, 2, 1, seed=3),
        street_scenes.targets(street_scenes.scene(), novel=True),
        Objective(LOSS),
    )
    expected = unroll(TunedAdam(), task.scene, task.source, novel, objective, plan)
    optimiser = UnrolledOptimiser(objective, (UnrolledPart(TunedAdam(), plan),))
    moments = list(itertools.islice(race.timed_steps(lambda: optimiser, task, novel), 5))
    assert torch.equal(moments[-1].scene.gaussians.pack(), expected.scene.gaussians.pack())
    assert [m.renders for m in moments] == [3, 6, 9, 12, 15]
    assert all(a.seconds < b.seconds for a, b in itertools.pairwise(moments))


def test_of_a_walk_to_its_end_one_moment_is_kept_at_a_time() -> None:
    class Counted:
        alive, most = 0, 0

        def __init__(self, iteration: int) -> None:
            self.iteration = iteration
            Counted.alive += 1
            Counted.most = max(Counted.most, Counted.alive)

        def __del__(self) -> None:
            Counted.alive -= 1

    end: Any = race.take_last((Counted(i + 1) for i in itertools.count()), 7)  # type: ignore[misc]
    assert end.iteration == 7 and Counted.most <= 2


def test_loading_counts_and_judging_does_not(task: OptimisationTask, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(race.time, "perf_counter", lambda: now[0])

    def load() -> UnrolledOptimiser:
        now[0] += 7.0
        return UnrolledOptimiser(Objective(LOSS), (UnrolledPart(TunedAdam(), UnrollSettings(5, 2)),))

    steps = race.timed_steps(load, task)
    first = next(steps)
    now[0] += 100.0
    assert (first.seconds, next(steps).seconds) == (7.0, 7.0)


def test_a_curve_is_read_between_its_points() -> None:
    curve = [Point(0.0, 0, 10.0, 1), Point(2.0, 4, 20.0, 1), Point(4.0, 8, 18.0, 1), Point(6.0, 12, 22.0, 1)]
    assert race.time_to_reach(curve, 15.0) == pytest.approx(1.0)
    assert race.time_to_reach(curve, 20.0) == pytest.approx(2.0)
    assert race.time_to_reach(curve, 21.0) == pytest.approx(5.5)
    assert race.time_to_reach(curve, 22.1) is None
    assert (race.psnr_at_renders(curve, 5), race.psnr_at_renders(curve, 13)) == (18.0, None)
    assert race.score_times(4.0, 2.0) == pytest.approx([1.0, 1.25, 1.5625, 1.953125])


def test_adam_stops_at_its_goal_its_length_or_the_cap(task: OptimisationTask, monkeypatch: pytest.MonkeyPatch) -> None:
    easy = Point(0.05, 8, task.psnr(task.scene) + 0.05, 300)
    early = race.run_adam(task, ADAM, 0, easy, 60.0)
    assert race.time_to_reach(early, easy.psnr) is not None and early[-1].renders >= 8
    assert race.run_adam(task, ADAM, 0, NEVER, 60.0)[-1].renders == 12  # the cosine ends with its length
    endless = ADAM.model_copy(update={"adam": AdamConfig(schedule="constant")})
    ticks = itertools.count()
    monkeypatch.setattr(race.time, "perf_counter", lambda: 0.01 * next(ticks))  # a step takes a hundredth of a second
    capped = race.run_adam(task, endless, 0, NEVER, 0.2)
    assert capped[-1].seconds >= 0.2 > capped[-2].seconds and capped[-1].renders > 12


@pytest.mark.parametrize("method", ["standard_3dgs", "street_gs"])
def test_per_scene_training_stops_at_its_goal_its_length_or_the_cap(task: OptimisationTask, method: Any) -> None:
    config = GnetConfig(method=method, per_scene=PerSceneConfig(iterations=40))
    assert race.run_per_scene(task, config, 0, NEVER, 60.0)[-1].renders == 40
    capped = race.run_per_scene(task, config, 0, NEVER, 1e-6)
    assert capped[-1].renders <= 1
    easy = Point(1e-4, 1, capped[0].psnr - 3, 300)
    assert race.run_per_scene(task, config, 0, easy, 60.0)[-1].renders < 40


def test_a_race_says_how_each_variant_ended(task: OptimisationTask, tmp_path: Path) -> None:
    row = cells.race_row(task, learned(4), {"short": ADAM}, 0, "tuned_adam", 1000.0)
    assert row["gnet"]["renders"] == 16 and row["gnet"]["curve"][0][:2] == [0.0, 0]
    short = row["variants"]["short"]
    assert short["ended"] in ("reached", "length") and (short["reached_s"] is None) == (short["ended"] == "length")
    assert short["best_psnr"] == pytest.approx(max(p[2] for p in short["curve"]), abs=1e-3)
    assert short["psnr_at_equal_renders"] is None  # 12 renders against 16
    draw([{"log": "street", "chunk": 0, "order": 0, **row}], tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 1000


def test_far_past_its_length_the_loss_is_compared_with_that_at_t(task: OptimisationTask) -> None:
    row = cells.stability_row(task, "gnet", learned(2))
    assert list(row["loss"]) == ["1", "2", "5", "10"]
    assert row["ratio"] == pytest.approx(row["loss"]["10"] / row["loss"]["1"])


def test_enet_past_its_length_is_judged_on_its_fixed_views_too(task: OptimisationTask) -> None:
    fixed = street_scenes.targets(street_scenes.scene(), novel=True)
    config = OptimiserConfig(
        iterations=1, views_per_iteration=1, novel_views_per_iteration=1, split_fraction=0.1, loss=LOSS
    )
    with_fixed = cells.stability_row(task, "enet", config, fixed)
    alone = cells.stability_row(task, "enet", config.model_copy(update={"novel_views_per_iteration": 0}))
    assert with_fixed["loss"]["1"] != pytest.approx(alone["loss"]["1"], rel=1e-3)
    assert set(with_fixed["heldout_psnr"]) == {"1", "2", "5", "10"}


def test_the_network_is_measured_at_every_count() -> None:
    row = measure_network(LearnedOptimiser, (200, 400, 800), 2)
    assert list(row["seconds"]) == ["200", "400", "800"] and row["seconds"]["800"]["n"] == 2
    assert set(row["fit"]) == {"seconds", "us_per_gaussian", "r2"}
    assert bool((street_scene_graph(400).nodes == DISTANT).any())


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
    by_id = {c.id: c for c in claims.claims(rows)}
    standard = by_id["optimiser.vs_standard_3dgs"]
    assert (standard.measured, standard.n, standard.holds) == (31.0, 2, True)  # the median of 12 and the cap
    assert "in 1 of 2 cells not within the cap" in standard.data
    assert by_id["optimiser.vs_tuned_adam"].measured == 3.0
    db = by_id["optimiser.equal_renders_db"]
    assert (db.measured, db.holds) == (1.0, False)
    assert by_id["optimiser.stable_10x"].measured is None
    assert by_id["optimiser.network_100k"].measured is None


def test_a_race_is_judged_beside_the_path_where_there_is_truth(task: OptimisationTask, tmp_path: Path) -> None:
    with_truth = replace(task, novel_targets=street_scenes.targets(street_scenes.scene(), novel=True))
    row = cells.race_row(with_truth, learned(4), {"short": ADAM}, 0, "tuned_adam", 1000.0)
    assert all(len(point) == 5 for point in row["gnet"]["curve"] + row["variants"]["short"]["curve"])
    assert row["gnet"]["curve"][0][4] == pytest.approx(with_truth.psnr_novel(task.scene), abs=1e-3)
    rows = [{"log": name, "chunk": 0, "order": k, **row} for name, k in (("a", 0), ("a", 1), ("b", 1))]
    draw(rows, tmp_path / "curves.png")
    draw_network(measure_network(LearnedOptimiser, (200, 400), 2), tmp_path / "network.png")
    assert min((tmp_path / f"{name}.png").stat().st_size for name in ("curves", "network")) > 1000


def test_the_worst_of_the_stable_cells_counts() -> None:
    rows = {f"stability/{k}": {"log": "a", "chunk": k, "ratio": 1.0 + 0.015 * k} for k in range(3)}
    claim = next(c for c in claims.claims(rows) if c.id == "optimiser.stable_10x")
    assert (claim.measured, claim.holds) == (1.03, False)
    line = {"log": "a", "chunk": 0, "network": "enet", "loss": {"1": 1.0, "10": 1.1}, "ratio": 1.1}
    rows["stability/enet a chunk 0"] = line
    claim = next(c for c in claims.claims(rows) if c.id == "optimiser.stable_10x")
    assert claim.measured == 1.1 and claim.data.endswith("gnet a chunk 2, enet a chunk 0")
    assert "ENet past its length: loss at 1 T: 1.00000, 10 T: 1.10000" in "".join(BENCH.table({"a": line}))


def test_what_is_not_measured_does_not_count() -> None:
    rows = {cell.name: {"not_measured": "no time"} for cell in BENCH.cells(BENCH.options, quick=False)}
    assert not any(c.holds or c.n for c in BENCH.claims(rows))
    assert "no time" in "\n".join(BENCH.table(rows))


def test_the_trade_counts_renders_and_judges_the_end(task: OptimisationTask) -> None:
    named = iteration_tradeoff.variant_configs(learned(4))
    assert named["preset"] == learned(4)
    assert [named[n].loss.perceptual_every for n in iteration_tradeoff.PERCEPTUAL] == [1, 4]
    config = learned(4).model_copy(update={"views_per_iteration": 1000})
    found = iteration_tradeoff.measure_config(replace(task, novel_targets=task.heldout), config)
    rule, settings = load_optimiser(resolve_weights("gnet", "builtin")), UnrollSettings(4, 1000)
    expected = unroll(rule, task.scene, task.source, (), Objective(LOSS), settings).scene
    assert found["renders"] == 4 * len(task.source) and found["seconds"] > 0
    assert found["psnr"] == found["psnr_3m"] == task.psnr(expected)
    rows = {f"trade/{k}": {"log": "a", "chunk": 0, "trade": {"4x30": found | {"seconds": k}}} for k in (1.0, 2.0)}
    assert f"| 4x30 | 1.50 | {found['renders']} |" in "\n".join(BENCH.table(rows))


def test_options_choose_cells_and_a_quick_run_ends_in_time() -> None:
    given = {**BENCH.options, "seeds": "900", "orders": "2", "pandaset": ""}
    log = "synthetic:street?seed=900 chunk 0"
    races = [f"{log} order 2 {m}" for m in cells.METHODS]
    parts = [f"{part}/{log} order 2" for part in ("enhancement", "distillation", "converged")]
    trades = [f"trade/street {seed}" for seed in iteration_tradeoff.SEEDS]
    past = [f"stability/{log}", f"stability/enet {log}"]
    assert [c.name for c in BENCH.cells(given, False)] == ["network", *trades, *races, *parts, *past]
    few = given | {"parts": "enhancement,converged", "long_orders": "0"}
    assert [c.name for c in BENCH.cells(few, False)] == ["network", parts[0]]
    with pytest.raises(ConfigError, match=r"no part.*races"):
        BENCH.cells(given | {"parts": "races"}, False)
    with pytest.raises(ConfigError, match=r"no method.*g3r"):
        BENCH.cells(given | {"methods": "g3r"}, False)
    quick, full = (BENCH.cells(BENCH.options, q) for q in (True, False))
    assert sum(c.seconds for c in quick) <= runner.QUICK_S < sum(c.seconds for c in full)
    assert len({c.name for c in full}) == len(full)


def test_tuned_adam_has_a_cap_of_its_own() -> None:
    listed = BENCH.cells({**BENCH.options, "parts": "race", "orders": "0", "cap": "50", "adam_cap": "5"}, False)
    caps = {cell.name.rsplit(" ", 1)[1]: cell.parameters["cap"] for cell in listed if " order " in cell.name}
    assert caps == {"tuned_adam": 5.0, "tuned_adam_split": 5.0, "standard_3dgs": 50.0, "street_gs": 50.0}


def test_what_would_not_end_in_the_minutes_given_is_left_out() -> None:
    given = {**BENCH.options, "seeds": "900", "pandaset": "", "minutes": "0.1"}
    with pytest.raises(NotMeasuredError, match="minutes given"):
        BENCH.cells(given, False)[1].measure()


def test_an_envelope_is_the_best_so_far_of_all_curves_without_their_starts() -> None:
    curves = [[[0, 0, 99], [1, 0, 20], [3, 0, 19]], [[0, 0, 99], [2, 0, 22], [4, 0, 21]]]
    assert envelope(curves, 2) == ([1, 2, 3, 4], [20, 22, 22, 22])


def test_committed_rows_make_the_committed_claims() -> None:
    path = Path(__file__).parents[2] / "docs/results/data/optimiser.json"
    result = Result.model_validate_json(path.read_text(encoding="utf-8"))
    rows = {str(row["cell"]): dict(row) for row in result.rows}
    assert list(BENCH.claims(rows)) == result.claims
