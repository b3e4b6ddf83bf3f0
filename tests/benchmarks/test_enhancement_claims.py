"""What lies beyond the race: convergence, distillation and enhancement, from their cells to their claims."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks.common import novel_view_truth
from benchmarks.common import task as task_module
from benchmarks.common.pipeline_inputs import render_images
from benchmarks.common.task import OptimisationTask, mean_psnr
from benchmarks.optimiser import BENCH, claims, convergence, distillation, enhancement, enhancement_claims, race
from benchmarks.optimiser.distillation_scores import NovelViewScore, NovelViewScorer
from benchmarks.optimiser.race import Point
from flows.configuration import load_configuration
from genre_tasks.config import (
    AdamConfig,
    IngestConfig,
    LossConfig,
    OptimiserConfig,
    PerSceneConfig,
    PipelineConfig,
)
from genre_tasks.logs.registry import open_log
from genre_tasks.metrics.perceptual import perceptual_distance
from genre_tasks.metrics.scoring import FeatureSet
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.tuned_adam import TunedAdam
from genre_tasks.optimiser.unroll import UnrolledLoop, UnrollSettings
from genre_tasks.scene.novel_views import NovelView
from genre_tasks.stages.ingest import ingest
from tests.benchmarks.small_races import ADAM, TINY_LOG, learned
from tests.optimiser import street_scenes


def test_tuned_adam_runs_until_it_has_settled(task: OptimisationTask) -> None:
    endless = ADAM.model_copy(update={"adam": AdamConfig(schedule="constant")})
    row = convergence.converged_row(task, learned(3), {"cosine": ADAM, "endless": endless}, 0)
    assert row["adam"]["cosine"]["renders"] == 12 and row["adam"]["endless"]["renders"] <= 12
    assert row["plateau"] == max(v["best_psnr"] for v in row["adam"].values())
    assert row["goal"] == pytest.approx(row["plateau"] - 0.2)
    assert row["adam_s"] == min(v["reached_s"] for v in row["adam"].values() if v["reached_s"] is not None)
    own = row["gnet"]
    assert (own["reached_s"] is None) == (own["best_psnr"] < row["goal"])
    rising = [Point(float(t), t, 20.0 + t, 1) for t in range(10)]
    assert not convergence.has_settled(rising)
    assert convergence.has_settled([*rising, Point(15.0, 15, 29.04, 1)]) and not convergence.has_settled(rising[:1])


def test_long_variants_are_constant_or_of_many_renders() -> None:
    short, long = ADAM, ADAM.model_copy(update={"iterations": 480})
    constant = ADAM.model_copy(update={"adam": AdamConfig(schedule="constant")})
    assert list(convergence.long_variants({"short": short, "long": long, "constant": constant})) == ["long", "constant"]


def test_the_long_preset_is_small_with_a_longer_gnet() -> None:
    small, long = (load_configuration(name).model_dump() for name in ("small", "long"))
    assert {k for k in small["gnet"] if small["gnet"][k] != long["gnet"][k]} == {"iterations", "refine"}
    assert {k for k in small if small[k] != long[k]} == {"gnet"}
    assert long["gnet"]["iterations"] > small["gnet"]["iterations"]


def _mark(seconds: float, kernel: float, beside: float | None = None) -> NovelViewScore:
    return NovelViewScore(seconds, 0, kernel, beside, 25.0)


def test_as_good_means_within_a_hundredth_and_a_tenth_of_a_decibel() -> None:
    best = _mark(4.0, 0.2, 22.0)
    assert _mark(1.0, 0.2019, 21.91).is_as_good_as(best)
    assert not _mark(1.0, 0.2021, 23.0).is_as_good_as(best) and not _mark(1.0, 0.1, 21.89).is_as_good_as(best)
    assert _mark(1.0, 0.2019).is_as_good_as(_mark(4.0, 0.2))
    assert not _mark(1.0, -0.11).is_as_good_as(_mark(1.0, -0.2))  # an unbiased distance may be below zero


def test_a_distillation_is_timed_to_its_own_best_and_not_from_its_start() -> None:
    start, better = _mark(0.0, 0.40, 21.0), _mark(2.0, 0.30, 22.0)
    runs = {"a": [start, better, _mark(4.0, 0.20, 22.0), _mark(8.0, 0.25, 22.0)], "b": [start, _mark(9.0, 0.2, 22.0)]}
    found = distillation.summarise_family(runs, _mark(1.0, 0.201, 21.95))
    assert found["best"][2] == 0.2 and found["enet_as_good"]
    assert found["reached_s"] == pytest.approx(2 + 2 * 0.098 / 0.1)  # at 0.202 between the second and third mark
    assert found["as_good_as_enet_s"] == pytest.approx(2 + 2 * (0.3 - 0.201 * 1.01) / 0.1)
    behind = distillation.summarise_family(runs, _mark(1.0, 0.30, 21.95))
    assert not behind["enet_as_good"] and behind["as_good_as_enet_s"] == pytest.approx(0.97 / 0.1 * 0.2)
    assert distillation.summarise_family(runs, _mark(1.0, 0.1, 22.0))["as_good_as_enet_s"] is None
    useless = distillation.summarise_family({"a": [start, _mark(3.0, 0.5, 20.0)]}, _mark(1.0, 0.4, 21.0))
    assert useless["reached_s"] == 3.0 and useless["best"][2] == 0.5 and useless["enet_as_good"]


def test_the_first_of_enets_lengths_that_is_as_good_counts_beside_its_own() -> None:
    runs = {"a": [_mark(0.0, 0.4, 21.0), _mark(3.0, 0.2, 22.0)]}
    own, shorter = _mark(1.0, 0.19, 22.1), [_mark(0.4, 0.21, 22.0), _mark(0.7, 0.2, 22.0)]
    assert distillation.summarise_family(runs, own, shorter)["enet_first_s"] == 0.7
    assert distillation.summarise_family(runs, own)["enet_first_s"] == 1.0
    assert distillation.summarise_family(runs, _mark(1.0, 0.3, 22.0))["enet_first_s"] is None


def test_a_distillation_ends_when_it_has_settled_or_its_budget_is_spent(task: OptimisationTask) -> None:
    class Fading:
        """Better by a tenth a second until ``since``."""

        def __init__(self, since: float) -> None:
            self.since = since

        def score(self, scene: object, seconds: float, renders: int) -> NovelViewScore:
            return _mark(seconds, 1.0 - 0.1 * min(seconds, self.since))

    settings = UnrollSettings(200, 1)
    loop = UnrolledLoop.start(TunedAdam(), task.scene, task.source, (), Objective(LossConfig(perceptual=0.0)), settings)
    moments = [race.Moment(0.1 * k, k, k, loop) for k in range(1, 200)]

    def end(since: float, budget_s: float) -> float:
        scorer: Any = Fading(since)
        return distillation.score_until_settled(iter(moments), scorer, _mark(0.0, 1.0), 2.0, budget_s)[-1].seconds

    assert 6.0 <= end(3.0, 16.0) < 9.4  # twice three seconds, at the next look
    assert 4.0 <= end(0.0, 16.0) < 6.3  # no better at all: after twice the unit
    assert end(8.0, 9.0) == pytest.approx(9.0)


def test_enet_beside_distillations_of_the_same_images(task: OptimisationTask) -> None:
    novel = street_scenes.targets(street_scenes.scene(), novel=True)
    views = tuple(NovelView(t.camera, t.frame, 3.0, t.chunk_SE3_camera, t.lens, ("c0", 0)) for t in novel)
    features = perceptual_distance().pooled_features(render_images(street_scenes.scene(), task.source))
    scorer = NovelViewScorer(views, FeatureSet(features, (0, 0, 1, 1)), replace(task, novel_targets=novel))
    enet = OptimiserConfig(
        iterations=2,
        views_per_iteration=2,
        novel_views_per_iteration=2,
        split_fraction=0.1,
        loss=LossConfig(perceptual=0.0),
    )
    row = distillation.distillation_row(enet, PerSceneConfig(iterations=6), scorer, novel)
    once = len(task.source) + len(novel)  # rendered for the split
    assert row["enet"][1] == 8 + once and row["enet"][0] > 0
    assert {t: mark[1] for t, mark in row["enet_shorter"].items()} == {"1": 4 + once}  # a third of two, and two thirds
    variants = ["1+1 at 0.25", "2+2 at 0.5, no perceptual"]
    assert list(row["adam"]["curves"]) == variants and list(row["standard"]["curves"]) == ["6"]
    assert list(row["adam_split"]["curves"]) == ["2+2 at 0.5, no perceptual, split"]
    given = distillation.adam_variants(enet)
    assert [(c.split_fraction, c.loss.perceptual) for c in given.values()] == [(0.0, 0.1), (0.0, 0.0)]
    for family in ("adam", "adam_split", "standard"):
        assert all(curve[0] == row["start"] for curve in row[family]["curves"].values())
        assert row[family]["reached_s"] > 0
        assert row[family]["best"][2] == min(m[2] for c in row[family]["curves"].values() for m in c[1:])


def test_truth_beside_the_path_is_cast_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chunk = ingest(IngestConfig(width_px=96, height_px=54), open_log(TINY_LOG), 0)
    views = novel_view_truth.views_at_shift(chunk, 3.0)
    assert len(views) == 2 * len(chunk.views) and {v.shift_m for v in views} == {3.0, -3.0}
    cast = novel_view_truth.load_true_targets(TINY_LOG, str(tmp_path), chunk, 3.0, 4)
    few = novel_view_truth.views_at_shift(chunk, 3.0, 4)
    assert [(t.camera, t.frame) for t in cast] == [(v.camera, v.frame) for v in few] and all(t.novel for t in cast)
    truth = open_log(TINY_LOG).truth
    assert truth is not None
    expected = truth.image(few[0].frame, chunk.world_SE3_chunk @ few[0].chunk_SE3_camera, few[0].lens)
    assert np.abs(cast[0].image.pixels.numpy() - expected / 255).max() < 0.003  # half floats in the store

    opened = novel_view_truth.cached_log(TINY_LOG)
    monkeypatch.setattr(type(opened.truth), "image", None)
    again = novel_view_truth.load_true_targets(TINY_LOG, str(tmp_path), chunk, 3.0, 4)
    assert all(torch.equal(a.image.pixels, b.image.pixels) for a, b in zip(cast, again, strict=True))


@pytest.mark.slow
def test_a_cell_of_enhancement_goes_through_the_pipeline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tiny = ["ingest.width_px=96", "ingest.height_px=54", "initial.max_points=2000", "initial.distant_count=200"]
    tiny += ["novel_views.lidar_max_points=2000"] + [f"{s}.iterations=2" for s in ("gnet", "enet")]

    def load(preset: str, settings: Sequence[str] = ()) -> PipelineConfig:
        return load_configuration(preset, settings=[*tiny, *settings])

    monkeypatch.setattr(task_module, "load_configuration", load)
    row = enhancement.measure_enhancement(TINY_LOG, 0, str(tmp_path), 1)
    assert list(row["shifts"]) == list(enhancement_claims.SHIFTS) and row["order"] == 1
    scenes = {"gnet", "enet", "gnet_again"}
    assert all(set(at) == scenes | {"n"} and at["n"] == 12 for at in row["shifts"].values())
    assert set(row["heldout_psnr"]) == scenes and len(set(row["heldout_psnr"].values())) == 3
    job = task_module.make_job(TINY_LOG, 0, str(tmp_path), 1)
    assert (job.config["gnet"]["seed"], job.config["enet"]["seed"], job.config["enet"]["snapshots"]) == (1, 1, 0)
    assert any(
        line.startswith("| street") and "GNet→FNet→ENet" not in line for line in BENCH.table({"enhancement/a": row})
    )


def test_scenes_are_compared_with_the_truth_or_as_sets(task: OptimisationTask) -> None:
    truth = street_scenes.scene()
    scenes = {"gnet": task.scene, "enet": truth, "gnet_again": task.scene}
    novel = street_scenes.targets(truth, novel=True)
    found = enhancement.score_against_truth(scenes, novel)
    assert found["enet"]["perceptual"] < 1e-6 < found["gnet"]["perceptual"] == found["gnet_again"]["perceptual"]
    assert found["enet"]["psnr"] > found["gnet"]["psnr"] == pytest.approx(mean_psnr(task.scene, novel), abs=1e-4)
    views = tuple(NovelView(t.camera, t.frame, 3.0, t.chunk_SE3_camera, t.lens, ("c0", 0)) for t in novel)
    real = FeatureSet(perceptual_distance().pooled_features(render_images(truth, novel)), (0, 0, 1, 1))
    sets = enhancement.score_as_sets(scenes, views, real)
    assert sets["enet"]["difference"] == pytest.approx(sets["enet"]["kernel"] - sets["gnet"]["kernel"], abs=1e-9)
    assert sets["gnet_again"]["difference"] == pytest.approx(0.0, abs=1e-12) and "low" not in sets["gnet"]


def test_gnets_network_enhances_with_its_own_length_and_weights() -> None:
    config = load_configuration("small")
    own = enhancement.gnet_as_enhancer(config)
    assert (own.iterations, own.loss) == (config.gnet.iterations, config.enet.loss)
    # A preset's rates are for the weights they were swept for.
    assert config.enet.learning_rates is not None and own.learning_rates is None
    assert Path(own.weights).name == "gnet.safetensors" and own.novel_views_per_iteration == own.views_per_iteration


def _at(psnr: float, perceptual: float) -> dict[str, float]:
    return {"psnr": psnr, "perceptual": perceptual}


def _enhanced(order: int, enet: dict[str, float], loss: float = 0.0) -> dict[str, Any]:
    at = {"gnet": _at(22.0, 0.8), "enet": enet, "gnet_again": _at(22.0, 0.76)}
    where = {"log": "synthetic:street?seed=900", "chunk": 0, "order": order}
    shifts = dict.fromkeys(enhancement_claims.SHIFTS, at)
    return where | {"shifts": shifts, "heldout_psnr": {"gnet": 26.0, "enet": 26.0 - loss, "gnet_again": 26.0}}


def test_enhancement_must_be_better_in_all_that_is_measured_in_every_cell() -> None:
    rows = {f"enhancement/{k}": _enhanced(k, _at(22.1, 0.72), 0.2) for k in range(3)}
    by_id = {c.id.removeprefix("optimiser."): c for c in claims.claims(rows)}
    assert all(by_id[f"enhance_{s}m"].holds and by_id[f"enhance_{s}m"].n == 3 for s in enhancement_claims.SHIFTS)
    versus = by_id["enet_vs_gnet"]
    assert versus.measured == pytest.approx(0.05) and versus.holds  # 10 % less against 5 % less
    assert by_id["interpolation"].measured == pytest.approx(-0.2) and by_id["interpolation"].holds

    rows["enhancement/3"] = _enhanced(3, _at(21.9, 0.72), 0.4)  # nearer as seen, farther in PSNR
    by_id = {c.id.removeprefix("optimiser."): c for c in claims.claims(rows)}
    assert by_id["enhance_2m"].measured == 0.75 and not by_id["enhance_2m"].holds
    assert "not in: street?seed=900 chunk 0 order 3" in by_id["enhance_2m"].data
    assert by_id["interpolation"].measured == pytest.approx(-0.4) and not by_id["interpolation"].holds


@pytest.mark.parametrize(("high", "better"), [(-0.001, True), (0.001, False), (None, False)])
def test_on_a_real_log_the_interval_decides(high: float | None, better: bool) -> None:
    at = {"gnet": {"kernel": 0.3}, "enet": {"kernel": 0.28, "difference": -0.02, "low": -0.04, "high": high}}
    assert enhancement_claims.is_better({"shifts": {"3": at}}, "3") is better


def _converged(reached_s: float | None) -> dict[str, Any]:
    gnet = {"reached_s": reached_s, "best_psnr": 27.5, "seconds": 9.0}
    where = {"log": "pandaset:002", "chunk": 0, "order": 0, "cap": 50.0}
    return where | {"gnet": gnet, "adam_s": 20.0, "plateau": 28.0}


def test_where_gnet_never_converges_the_cap_counts_and_both_plateaus_are_said() -> None:
    claim = next(c for c in claims.claims({"converged/a": _converged(8.0)}) if c.id == "optimiser.converged")
    assert (claim.measured, claim.holds) == (0.4, True)
    rows = {"converged/a": _converged(None), "converged/b": {"not_measured": "no time"}}
    claim = next(c for c in claims.claims(rows) if c.id == "optimiser.converged")
    assert (claim.measured, claim.n, claim.holds) == (50.0, 1, False)
    assert "in 1 of 1 cells" in claim.data and "GNet 27.50 dB, Adam 28.00 dB" in claim.data
    assert any("never" in line for line in BENCH.table(rows))


def test_where_enet_is_not_as_good_the_cap_counts() -> None:
    best = [9.0, 100, 0.2, None, 25.0]
    good = {"best": best, "reached_s": 10.0, "enet_as_good": True, "as_good_as_enet_s": 9.5}
    bad = good | {"enet_as_good": False, "as_good_as_enet_s": None}
    where = {"log": "pandaset:002", "chunk": 0, "order": 0, "cap": 50.0, "start": best, "enet": [4.0, *best[1:]]}
    rows = {"distillation/a": where | {"adam": good, "standard": bad}}
    by_id = {c.id.removeprefix("optimiser."): c for c in claims.claims(rows)}
    assert (by_id["distillation"].measured, by_id["distillation"].holds) == (0.4, True)
    at_once = where | {"adam": good | {"reached_s": 0.001}, "standard": bad}
    assert enhancement_claims.time_ratio_to_distillation(at_once, "adam") == 50.0
    short = {"enet_shorter": {"24": best}, "adam": good | {"enet_first_s": 2.0}, "standard": bad}
    said = next(c for c in claims.claims({"distillation/a": where | short}) if c.id == "optimiser.distillation")
    assert said.measured == 0.4 and "(24 and its own) that is as good: 0.200 (0.200–0.200, 1 cells)" in said.data
    standard = by_id["distillation_standard"]
    assert (standard.measured, standard.holds) == (50.0, False)
    assert "in 1 of 1 cells ENet does not reach it" in standard.data
    assert "in 1 it never came to ENet's own" in standard.data and "in 0 it never" in by_id["distillation"].data
    assert any("| no |" in line for line in BENCH.table(rows))


def test_a_family_that_was_measured_again_by_itself_takes_the_place_of_its_earlier_row() -> None:
    where = {"log": "synthetic:s", "chunk": 0}
    rows = {
        "distillation/s order 0": where | {"order": 0, "adam": 1, "standard": 1},
        "distillation/s order 1": where | {"order": 1, "adam": 2, "standard": 2},
        "distillation/s order 0 standard": where | {"order": 0, "standard": 3},
        "distillation/t": {"not_measured": "no time"},
    }
    assert [row["standard"] for row in enhancement_claims.distillation_rows(rows, "standard")] == [3, 2]
    assert [row["adam"] for row in enhancement_claims.distillation_rows(rows, "adam")] == [1, 2]
    assert not enhancement_claims.distillation_rows(rows, "adam_split")
    given = {**BENCH.options, "seeds": "900", "pandaset": "", "orders": "0", "parts": "distillation"}
    names = [BENCH.cells(given | {"families": f}, False)[1].name for f in ("standard,adam,adam_split", "standard")]
    assert names == [f"distillation/synthetic:street?seed=900 chunk 0 order 0{end}" for end in ("", " standard")]
