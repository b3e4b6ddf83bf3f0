"""The optimiser's benchmark: its races on a tiny street, and the arithmetic between curves and claims."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks import run
from benchmarks.bench import NotMeasuredError
from benchmarks.optimiser import (
    BENCH,
    beside,
    beyond,
    cells,
    converged,
    distillation,
    enhancement,
    race,
    summary,
    trade,
)
from benchmarks.optimiser import task as task_module
from benchmarks.optimiser.distillation import Judge, Mark
from benchmarks.optimiser.network import measure_network, scene_of
from benchmarks.optimiser.picture import draw, draw_network
from benchmarks.optimiser.race import Point
from benchmarks.optimiser.steps import images_of
from benchmarks.optimiser.task import Task, psnr
from benchmarks.schema import Result
from flows.configuration import load_configuration
from genre_tasks.config import (
    AdamConfig,
    GnetConfig,
    IngestConfig,
    LossConfig,
    OptimiserConfig,
    PerSceneConfig,
    PipelineConfig,
)
from genre_tasks.errors import ConfigError
from genre_tasks.logs.registry import open_log
from genre_tasks.metrics.collect import FeatureSet
from genre_tasks.metrics.perceptual import perceptual_distance
from genre_tasks.optimiser.adam import TunedAdam
from genre_tasks.optimiser.learned import LearnedOptimiser
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.state import Frame, State
from genre_tasks.optimiser.unroll import Plan, unroll
from genre_tasks.scene.graph import DISTANT
from genre_tasks.scene.views import NovelView
from genre_tasks.stages.ingest import ingest
from genre_tasks.weights import resolve_weights
from tests.optimiser import street

TINY_LOG = "synthetic:street?seed=903&width=96&height=54&samples=1&lidar_beams=32&lidar_azimuths=450&frames=9&cameras=2"
LOSS = LossConfig(perceptual=0.0)
ADAM = GnetConfig(method="adam", iterations=6, views_per_iteration=2, loss=LOSS)
NEVER = Point(0.05, 8, 99.0, 300)
"""A goal that nobody reaches."""


def learned(iterations: int) -> GnetConfig:
    return GnetConfig(iterations=iterations, views_per_iteration=4, loss=LOSS)


@pytest.fixture(scope="module")
def task() -> Task:
    truth = street.scene()
    views = street.targets(truth)
    return Task(street.blurred(truth), views, views[:2])


def test_walking_is_unrolling(task: Task) -> None:
    plan, novel, objective = Plan(5, 2, 1, seed=3), street.targets(street.scene(), novel=True), Objective(LOSS)
    expected = unroll(TunedAdam(), task.scene, task.source, novel, objective, plan)
    moments = list(itertools.islice(race.walk(lambda: (TunedAdam(), objective), task, plan, novel), 5))
    assert torch.equal(moments[-1].scene.gaussians.packed(), expected.scene.gaussians.packed())
    assert [m.renders for m in moments] == [3, 6, 9, 12, 15]
    assert all(a.seconds < b.seconds for a, b in itertools.pairwise(moments))


def test_loading_counts_and_judging_does_not(task: Task, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(race.time, "perf_counter", lambda: now[0])

    def load() -> tuple[TunedAdam, Objective]:
        now[0] += 7.0
        return TunedAdam(), Objective(LOSS)

    steps = race.walk(load, task, Plan(5, 2))
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


def test_adam_stops_at_its_goal_its_length_or_the_cap(task: Task, monkeypatch: pytest.MonkeyPatch) -> None:
    easy = Point(0.05, 8, task.psnr(task.scene) + 0.05, 300)
    early = race.adam(task, ADAM, 0, easy, 60.0)
    assert race.reached(early, easy.psnr) is not None and early[-1].renders >= 8
    assert race.adam(task, ADAM, 0, NEVER, 60.0)[-1].renders == 12  # the cosine ends with its length
    endless = ADAM.model_copy(update={"adam": AdamConfig(schedule="constant")})
    ticks = itertools.count()
    monkeypatch.setattr(race.time, "perf_counter", lambda: 0.01 * next(ticks))  # a step takes a hundredth of a second
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
    row = cells.race_row(task, learned(4), {"short": ADAM}, 0, "tuned_adam", 1000.0)
    assert row["gnet"]["renders"] == 16 and row["gnet"]["curve"][0][:2] == [0.0, 0]
    short = row["variants"]["short"]
    assert short["ended"] in ("reached", "length") and (short["reached_s"] is None) == (short["ended"] == "length")
    assert short["best_psnr"] == pytest.approx(max(p[2] for p in short["curve"]), abs=1e-3)
    assert short["psnr_at_equal_renders"] is None  # 12 renders against 16
    draw([{"log": "street", "chunk": 0, "order": 0, **row}], tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 1000


def test_far_past_its_length_the_loss_is_compared_with_that_at_t(task: Task) -> None:
    row = cells.stability_row(task, learned(2))
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


def test_a_race_is_judged_beside_the_path_where_there_is_truth(task: Task, tmp_path: Path) -> None:
    with_truth = replace(task, beside=street.targets(street.scene(), novel=True))
    row = cells.race_row(with_truth, learned(4), {"short": ADAM}, 0, "tuned_adam", 1000.0)
    assert all(len(point) == 5 for point in row["gnet"]["curve"] + row["variants"]["short"]["curve"])
    assert row["gnet"]["curve"][0][4] == pytest.approx(with_truth.psnr_beside(task.scene), abs=1e-3)
    rows = [{"log": name, "chunk": 0, "order": k, **row} for name, k in (("a", 0), ("a", 1), ("b", 1))]
    draw(rows, tmp_path / "curves.png")
    draw_network(measure_network(LearnedOptimiser, (200, 400), 2), tmp_path / "network.png")
    assert min((tmp_path / f"{name}.png").stat().st_size for name in ("curves", "network")) > 1000


def test_tuned_adam_runs_until_it_has_settled(task: Task) -> None:
    endless = ADAM.model_copy(update={"adam": AdamConfig(schedule="constant")})
    row = converged.converged_row(task, learned(3), {"cosine": ADAM, "endless": endless}, 0)
    assert row["adam"]["cosine"]["renders"] == 12 and row["adam"]["endless"]["renders"] <= 12
    assert row["plateau"] == max(v["best_psnr"] for v in row["adam"].values())
    assert row["goal"] == pytest.approx(row["plateau"] - 0.2)
    assert row["adam_s"] == min(v["reached_s"] for v in row["adam"].values() if v["reached_s"] is not None)
    own = row["gnet"]
    assert (own["reached_s"] is None) == (own["best_psnr"] < row["goal"])
    rising = [Point(float(t), t, 20.0 + t, 1) for t in range(10)]
    assert not converged.settled(rising)
    assert converged.settled([*rising, Point(15.0, 15, 29.04, 1)]) and not converged.settled(rising[:1])


def test_long_variants_are_constant_or_of_many_renders() -> None:
    short, long = ADAM, ADAM.model_copy(update={"iterations": 480})
    constant = ADAM.model_copy(update={"adam": AdamConfig(schedule="constant")})
    assert list(converged.long_variants({"short": short, "long": long, "constant": constant})) == ["long", "constant"]


def test_the_long_preset_is_small_with_a_longer_gnet() -> None:
    small, long = (load_configuration(name).model_dump() for name in ("small", "long"))
    longer = {"iterations", "views_per_iteration"}
    assert {k for k in small["gnet"] if small["gnet"][k] != long["gnet"][k]} <= longer
    assert {k for k in small if small[k] != long[k]} == {"gnet"}
    assert long["gnet"]["iterations"] > small["gnet"]["iterations"]


def _mark(seconds: float, kernel: float, beside: float | None = None) -> Mark:
    return Mark(seconds, 0, kernel, beside, 25.0)


def test_as_good_means_within_a_hundredth_and_a_tenth_of_a_decibel() -> None:
    best = _mark(4.0, 0.2, 22.0)
    assert _mark(1.0, 0.2019, 21.91).as_good_as(best)
    assert not _mark(1.0, 0.2021, 23.0).as_good_as(best) and not _mark(1.0, 0.1, 21.89).as_good_as(best)
    assert _mark(1.0, 0.2019).as_good_as(_mark(4.0, 0.2))
    assert not _mark(1.0, -0.11).as_good_as(_mark(1.0, -0.2))  # an unbiased distance may be below zero


def test_a_distillation_is_timed_to_its_own_best_and_not_from_its_start() -> None:
    start, better = _mark(0.0, 0.40, 21.0), _mark(2.0, 0.30, 22.0)
    runs = {"a": [start, better, _mark(4.0, 0.20, 22.0), _mark(8.0, 0.25, 22.0)], "b": [start, _mark(9.0, 0.2, 22.0)]}
    found = distillation.family(runs, _mark(1.0, 0.201, 21.95))
    assert found["best"][2] == 0.2 and found["enet_as_good"]
    assert found["reached_s"] == pytest.approx(2 + 2 * 0.098 / 0.1)  # at 0.202 between the second and third mark
    assert found["as_good_as_enet_s"] == pytest.approx(2 + 2 * (0.3 - 0.201 * 1.01) / 0.1)
    behind = distillation.family(runs, _mark(1.0, 0.30, 21.95))
    assert not behind["enet_as_good"] and behind["as_good_as_enet_s"] == pytest.approx(0.97 / 0.1 * 0.2)
    assert distillation.family(runs, _mark(1.0, 0.1, 22.0))["as_good_as_enet_s"] is None
    useless = distillation.family({"a": [start, _mark(3.0, 0.5, 20.0)]}, _mark(1.0, 0.4, 21.0))
    assert useless["reached_s"] == 3.0 and useless["best"][2] == 0.5 and useless["enet_as_good"]


def test_a_distillation_ends_when_it_has_settled_or_its_budget_is_spent(task: Task) -> None:
    class Fading:
        """Better by a tenth a second until ``since``."""

        def __init__(self, since: float) -> None:
            self.since = since

        def mark(self, scene: object, seconds: float, renders: int) -> Mark:
            return _mark(seconds, 1.0 - 0.1 * min(seconds, self.since))

    frame, state = Frame.of(task.scene), State.start(len(task.scene), task.scene.gaussians.means)
    moments = [race.Moment(0.1 * k, k, k, frame, state) for k in range(1, 200)]

    def end(since: float, budget_s: float) -> float:
        judge: Any = Fading(since)
        return distillation.distilled(iter(moments), judge, _mark(0.0, 1.0), 2.0, budget_s)[-1].seconds

    assert 6.0 <= end(3.0, 16.0) < 9.4  # twice three seconds, at the next look
    assert 4.0 <= end(0.0, 16.0) < 6.3  # no better at all: after twice the unit
    assert end(8.0, 9.0) == pytest.approx(9.0)


def test_enet_beside_distillations_of_the_same_images(task: Task) -> None:
    novel = street.targets(street.scene(), novel=True)
    views = tuple(NovelView(t.camera, t.frame, 3.0, t.chunk_SE3_camera, t.lens, ("c0", 0)) for t in novel)
    features = perceptual_distance().pooled_features(images_of(street.scene(), task.source))
    judge = Judge(views, FeatureSet(features, (0, 0, 1, 1)), replace(task, beside=novel))
    enet = OptimiserConfig(
        iterations=2, views_per_iteration=2, novel_views_per_iteration=2, loss=LossConfig(perceptual=0.1)
    )
    row = distillation.distillation_row(enet, PerSceneConfig(iterations=6), judge, novel)
    assert row["enet"][1] == 8 and row["enet"][0] > 0
    variants = ["1+1 at 0.25", "2+2 at 0.5, no perceptual"]
    assert list(row["adam"]["curves"]) == variants and list(row["standard"]["curves"]) == ["6"]
    for family in ("adam", "standard"):
        assert all(curve[0] == row["start"] for curve in row[family]["curves"].values())
        assert row[family]["reached_s"] > 0
        assert row[family]["best"][2] == min(m[2] for c in row[family]["curves"].values() for m in c[1:])


def test_truth_beside_the_path_is_cast_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chunk = ingest(IngestConfig(width_px=96, height_px=54), open_log(TINY_LOG), 0)
    views = beside.views_at(chunk, 3.0)
    assert len(views) == 2 * len(chunk.views) and {v.shift_m for v in views} == {3.0, -3.0}
    cast = beside.true_targets(TINY_LOG, str(tmp_path), chunk, 3.0, 4)
    few = beside.views_at(chunk, 3.0, 4)
    assert [(t.camera, t.frame) for t in cast] == [(v.camera, v.frame) for v in few] and all(t.novel for t in cast)
    truth = open_log(TINY_LOG).truth
    assert truth is not None
    expected = truth.image(few[0].frame, chunk.world_SE3_chunk @ few[0].chunk_SE3_camera, few[0].lens)
    assert np.abs(cast[0].image.image.numpy() - expected / 255).max() < 0.003  # half floats in the store

    opened = beside.opened_log(TINY_LOG)
    monkeypatch.setattr(type(opened.truth), "image", None)
    again = beside.true_targets(TINY_LOG, str(tmp_path), chunk, 3.0, 4)
    assert all(torch.equal(a.image.image, b.image.image) for a, b in zip(cast, again, strict=True))


@pytest.mark.slow
def test_a_cell_of_enhancement_goes_through_the_pipeline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tiny = ["ingest.width_px=96", "ingest.height_px=54", "initial.max_points=2000", "initial.distant_count=200"]
    tiny += ["novel_views.lidar_max_points=2000"] + [f"{s}.iterations=2" for s in ("gnet", "enet")]

    def load(preset: str, settings: Sequence[str] = ()) -> PipelineConfig:
        return load_configuration(preset, settings=[*tiny, *settings])

    monkeypatch.setattr(task_module, "load_configuration", load)
    row = enhancement.measure_enhancement(TINY_LOG, 0, str(tmp_path), 1)
    assert list(row["shifts"]) == list(beyond.SHIFTS) and row["order"] == 1
    scenes = {"gnet", "enet", "gnet_again"}
    assert all(set(at) == scenes | {"n"} and at["n"] == 12 for at in row["shifts"].values())
    assert set(row["heldout_psnr"]) == scenes and len(set(row["heldout_psnr"].values())) == 3
    job = task_module.job_of(TINY_LOG, 0, str(tmp_path), 1)
    assert (job.config["gnet"]["seed"], job.config["enet"]["seed"], job.config["enet"]["snapshots"]) == (1, 1, 0)
    assert any(
        line.startswith("| street") and "GNet→FNet→ENet" not in line for line in BENCH.table({"enhancement/a": row})
    )


def test_scenes_are_compared_with_the_truth_or_as_sets(task: Task) -> None:
    truth = street.scene()
    scenes = {"gnet": task.scene, "enet": truth, "gnet_again": task.scene}
    novel = street.targets(truth, novel=True)
    found = enhancement.against_truth(scenes, novel)
    assert found["enet"]["perceptual"] < 1e-6 < found["gnet"]["perceptual"] == found["gnet_again"]["perceptual"]
    assert found["enet"]["psnr"] > found["gnet"]["psnr"] == pytest.approx(psnr(task.scene, novel), abs=1e-4)
    views = tuple(NovelView(t.camera, t.frame, 3.0, t.chunk_SE3_camera, t.lens, ("c0", 0)) for t in novel)
    real = FeatureSet(perceptual_distance().pooled_features(images_of(truth, novel)), (0, 0, 1, 1))
    sets = enhancement.as_sets(scenes, views, real)
    assert sets["enet"]["difference"] == pytest.approx(sets["enet"]["kernel"] - sets["gnet"]["kernel"], abs=1e-9)
    assert sets["gnet_again"]["difference"] == pytest.approx(0.0, abs=1e-12) and "low" not in sets["gnet"]


def test_gnets_network_enhances_with_its_own_length_and_weights() -> None:
    config = load_configuration("small")
    own = enhancement.as_enhancer(config)
    assert (own.iterations, own.loss) == (config.gnet.iterations, config.enet.loss)
    assert Path(own.weights).name == "gnet.safetensors" and own.novel_views_per_iteration == own.views_per_iteration


def _at(psnr: float, perceptual: float) -> dict[str, float]:
    return {"psnr": psnr, "perceptual": perceptual}


def _enhanced(order: int, enet: dict[str, float], loss: float = 0.0) -> dict[str, Any]:
    at = {"gnet": _at(22.0, 0.8), "enet": enet, "gnet_again": _at(22.0, 0.76)}
    where = {"log": "synthetic:street?seed=900", "chunk": 0, "order": order}
    shifts = dict.fromkeys(beyond.SHIFTS, at)
    return where | {"shifts": shifts, "heldout_psnr": {"gnet": 26.0, "enet": 26.0 - loss, "gnet_again": 26.0}}


def test_enhancement_must_be_better_in_all_that_is_measured_in_every_cell() -> None:
    rows = {f"enhancement/{k}": _enhanced(k, _at(22.1, 0.72), 0.2) for k in range(3)}
    claims = {c.id.removeprefix("optimiser."): c for c in summary.claims(rows)}
    assert all(claims[f"enhance_{s}m"].holds and claims[f"enhance_{s}m"].n == 3 for s in beyond.SHIFTS)
    versus = claims["enet_vs_gnet"]
    assert versus.measured == pytest.approx(0.05) and versus.holds  # 10 % less against 5 % less
    assert claims["interpolation"].measured == pytest.approx(-0.2) and claims["interpolation"].holds

    rows["enhancement/3"] = _enhanced(3, _at(21.9, 0.72), 0.4)  # nearer as seen, farther in PSNR
    claims = {c.id.removeprefix("optimiser."): c for c in summary.claims(rows)}
    assert claims["enhance_2m"].measured == 0.75 and not claims["enhance_2m"].holds
    assert "not in: street?seed=900 chunk 0 order 3" in claims["enhance_2m"].data
    assert claims["interpolation"].measured == pytest.approx(-0.4) and not claims["interpolation"].holds


@pytest.mark.parametrize(("high", "better"), [(-0.001, True), (0.001, False), (None, False)])
def test_on_a_real_log_the_interval_decides(high: float | None, better: bool) -> None:
    at = {"gnet": {"kernel": 0.3}, "enet": {"kernel": 0.28, "difference": -0.02, "low": -0.04, "high": high}}
    assert beyond.better({"shifts": {"3": at}}, "3") is better


def _converged(reached_s: float | None) -> dict[str, Any]:
    gnet = {"reached_s": reached_s, "best_psnr": 27.5, "seconds": 9.0}
    where = {"log": "pandaset:002", "chunk": 0, "order": 0, "cap": 50.0}
    return where | {"gnet": gnet, "adam_s": 20.0, "plateau": 28.0}


def test_where_gnet_never_converges_the_cap_counts_and_both_plateaus_are_said() -> None:
    claim = next(c for c in summary.claims({"converged/a": _converged(8.0)}) if c.id == "optimiser.converged")
    assert (claim.measured, claim.holds) == (0.4, True)
    rows = {"converged/a": _converged(None), "converged/b": {"not_measured": "no time"}}
    claim = next(c for c in summary.claims(rows) if c.id == "optimiser.converged")
    assert (claim.measured, claim.n, claim.holds) == (50.0, 1, False)
    assert "in 1 of 1 cells" in claim.data and "GNet 27.50 dB, Adam 28.00 dB" in claim.data
    assert any("never" in line for line in BENCH.table(rows))


def test_where_enet_is_not_as_good_the_cap_counts() -> None:
    best = [9.0, 100, 0.2, None, 25.0]
    good = {"best": best, "reached_s": 10.0, "enet_as_good": True, "as_good_as_enet_s": 9.5}
    bad = good | {"enet_as_good": False, "as_good_as_enet_s": None}
    where = {"log": "pandaset:002", "chunk": 0, "order": 0, "cap": 50.0, "start": best, "enet": [4.0, *best[1:]]}
    rows = {"distillation/a": where | {"adam": good, "standard": bad}}
    claims = {c.id.removeprefix("optimiser."): c for c in summary.claims(rows)}
    assert (claims["distillation"].measured, claims["distillation"].holds) == (0.4, True)
    at_once = where | {"adam": good | {"reached_s": 0.001}, "standard": bad}
    assert beyond.times_distillation(at_once, "adam") == 50.0
    standard = claims["distillation_standard"]
    assert (standard.measured, standard.holds) == (50.0, False)
    assert "in 1 of 1 cells ENet does not reach it" in standard.data
    assert any("| no |" in line for line in BENCH.table(rows))


def test_the_worst_of_the_stable_cells_counts() -> None:
    rows = {f"stability/{k}": {"log": "a", "chunk": k, "ratio": 1.0 + 0.015 * k} for k in range(3)}
    claim = next(c for c in summary.claims(rows) if c.id == "optimiser.stable_10x")
    assert (claim.measured, claim.holds) == (1.03, False)


def test_what_is_not_measured_does_not_count() -> None:
    rows = {cell.name: {"not_measured": "no time"} for cell in BENCH.cells(BENCH.options, quick=False)}
    assert not any(c.holds or c.n for c in BENCH.claims(rows))
    assert "no time" in "\n".join(BENCH.table(rows))


def test_the_trade_counts_renders_and_judges_the_end(task: Task) -> None:
    named = trade.settings(learned(4))
    assert [named[n].loss.perceptual_every for n in trade.PERCEPTUAL] == [1, 4]
    config = learned(4).model_copy(update={"views_per_iteration": 1000})
    found = trade.trade(replace(task, beside=task.heldout), config)
    rule, plan = LearnedOptimiser.load(resolve_weights("gnet", "builtin")), Plan(4, 1000)
    expected = unroll(rule, task.scene, task.source, (), Objective(LOSS), plan).scene
    assert found["renders"] == 4 * len(task.source) and found["seconds"] > 0
    assert found["psnr"] == found["psnr_3m"] == task.psnr(expected)
    rows = {f"trade/{k}": {"log": "a", "chunk": 0, "trade": {"4x30": found | {"seconds": k}}} for k in (1.0, 2.0)}
    assert f"| 4x30 | 1.50 | {found['renders']} |" in "\n".join(BENCH.table(rows))


def test_options_choose_cells_and_a_quick_run_ends_in_time() -> None:
    given = {**BENCH.options, "seeds": "900", "orders": "2", "pandaset": ""}
    log = "synthetic:street?seed=900 chunk 0"
    races = [f"{log} order 2 {m}" for m in cells.METHODS]
    parts = [f"{part}/{log} order 2" for part in ("enhancement", "distillation", "converged")]
    trades = [f"trade/street {seed}" for seed in trade.SEEDS]
    assert [c.name for c in BENCH.cells(given, False)] == ["network", *trades, *races, *parts, f"stability/{log}"]
    few = given | {"parts": "enhancement,converged", "long_orders": "0"}
    assert [c.name for c in BENCH.cells(few, False)] == ["network", parts[0]]
    with pytest.raises(ConfigError, match=r"no part.*races"):
        BENCH.cells(given | {"parts": "races"}, False)
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
