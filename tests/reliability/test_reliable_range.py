"""The reliable range: guards that fall where renders get worse, the curve's limits, files and the command."""

from __future__ import annotations

import errno
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from matplotlib.figure import Figure
from typer.testing import CliRunner

from flows.cli.main import app
from flows.configuration import load_configuration
from flows.pipeline.definition import STAGE_BY_NAME
from flows.pipeline.log_cache import cached_log
from flows.pipeline.stage_runner import ArtifactRef, Job, run_stage
from flows.reconstruction.reliable_range import _plot_guards, write_range
from flows.reconstruction.run_records import (
    FinishedRun,
    summarise_run,
    write_run_record,
)
from flows.reconstruction.stored_values import find_last_stage, read_stage_value
from genre_tasks import atomic_path
from genre_tasks.config import RangeConfig
from genre_tasks.effects.types import EffectsPlan
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.fixer.source_images import load_source_images
from genre_tasks.metrics.image_quality import psnr
from genre_tasks.metrics.scoring import truth_image
from genre_tasks.reliability.chunk_seam import measure_seam, median_psnr_by_distance
from genre_tasks.reliability.guards import MAX_AGREEMENT_DB, PSNR_COEFFICIENTS, Guards, compute_guards
from genre_tasks.reliability.reliable_range import estimate_reliable_range, find_reliable_range
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.novel_poses import place_novel_views
from genre_tasks.scene.novel_views import NovelViews
from genre_tasks.stages.novel_views import render_novel

LOG = "synthetic:street?seed=900&frames=8&cameras=1&width=128&height=72&moving=0&pedestrians=0"
SETTINGS = [
    "ingest.width_px=128",
    "ingest.height_px=72",
    "initial.max_points=6000",
    "initial.distant_count=500",
    "gnet.iterations=4",
    "evaluate.shifts_m=[3]",
    "evaluate.bootstrap=0",
    "evaluate.every=4",
]
STAGES = ("ingest", "effects", "initial", "gnet", "evaluate/initial", "evaluate/gnet")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> FinishedRun:
    """A run that ended with GNet's scene."""
    store = str(tmp_path_factory.mktemp("store"))
    config = load_configuration("demo", settings=SETTINGS).model_dump(mode="json")
    job, refs = Job(LOG, 0, store, config), dict[str, ArtifactRef]()
    for name in STAGES:
        refs[name] = run_stage(name, job, {k: refs[k] for k in STAGE_BY_NAME[name].inputs})
    run = FinishedRun(LOG, "demo", store, config, {}, {0: refs})
    write_run_record(run, summarise_run(run), {})
    return run


@pytest.fixture(scope="module")
def chunk(finished: FinishedRun) -> Chunk:
    value: Chunk = read_stage_value(finished.store, finished.name, 0, "ingest")[1]
    return value


@pytest.fixture(scope="module")
def scene(finished: FinishedRun) -> SceneGraph:
    value: SceneGraph = read_stage_value(finished.store, finished.name, 0, "gnet")[1].scene
    return value


def rendered(chunk: Chunk, scene: SceneGraph, *shifts: float) -> NovelViews:
    return render_novel(chunk, scene, place_novel_views(chunk, shifts), 4000)


def test_agreement_falls_as_the_scene_gets_worse(chunk: Chunk, scene: SceneGraph) -> None:
    sources, g = load_source_images(chunk), torch.Generator().manual_seed(0)
    found = []
    for noise in (0.0, 0.05, 0.2):
        colors = scene.gaussians.colors + noise * torch.randn(scene.gaussians.colors.shape, generator=g)
        worse = scene.with_gaussians(replace(scene.gaussians, colors=colors))
        found.append(compute_guards(chunk, rendered(chunk, worse, 1.0), sources)[0].agreement_db)
    assert found[0] > found[1] + 0.1 and found[1] > found[2] + 1


def test_estimates_are_in_the_order_of_the_truth(chunk: Chunk, scene: SceneGraph) -> None:
    truth = cached_log(LOG).truth
    novel = rendered(chunk, scene, 0.0, 1.5, 5.0)
    guards = compute_guards(chunk, novel, load_source_images(chunk))
    true = {
        shift: np.mean(
            [
                psnr(novel.color[i].clamp(0, 1).numpy(), truth_image(chunk, truth, v).astype(np.float32) / 255)
                for i, v in enumerate(novel.views)
                if v.shift_m == shift
            ]
        )
        for shift in (0.0, 1.5, 5.0)
    }
    ours = {shift: np.mean([g.estimate_db for g in guards if g.shift_m == shift]) for shift in true}
    assert sorted(true, key=true.__getitem__) == sorted(ours, key=ours.__getitem__) == [5.0, 1.5, 0.0]


def test_holes_and_floaters_are_seen(chunk: Chunk, scene: SceneGraph) -> None:
    sources, novel = load_source_images(chunk), rendered(chunk, scene, 0.0)
    whole = compute_guards(chunk, novel, sources)[0]
    hole = replace(novel, alpha=novel.alpha.clone(), depth=novel.depth.clone())
    hole.alpha[:, :, :64] = 0
    near = replace(novel, depth=0.1 * novel.depth)
    assert compute_guards(chunk, hole, sources)[0].thin == pytest.approx(0.5, abs=0.05)
    assert compute_guards(chunk, hole, sources)[0].shown < 0.75 * whole.shown
    assert whole.floating < 0.1 and compute_guards(chunk, near, sources)[0].floating > 0.95


def test_a_view_that_nothing_speaks_for_has_no_agreement(chunk: Chunk, scene: SceneGraph) -> None:
    far = place_novel_views(chunk, (500.0,))[0]
    (guard,) = compute_guards(chunk, render_novel(chunk, scene, [far], 4000), load_source_images(chunk))
    assert guard.agreement_db == 0 and guard.shown < 0.05 and np.isfinite(guard.estimate_db)
    assert Guards("c", 0, 0.0, MAX_AGREEMENT_DB, 1, 0, 0).estimate_db > guard.estimate_db


def view(shift: float, agreement: float, shown: float = 0.7, thin: float = 0.0, floating: float = 0.0) -> Guards:
    return Guards("front", 0, shift, agreement, shown, thin, floating)


def test_the_range_ends_where_the_first_limit_is_crossed() -> None:
    limits = RangeConfig(shifts_m=(1.0, 2.0), max_drop_db=1.0, max_hidden=0.1)
    drop, a_metre = (
        1.0 / PSNR_COEFFICIENTS["agreement_db"],
        -PSNR_COEFFICIENTS["shift_m"],
    )  # of agreement, for one of the estimate
    flat = [view(0.0, 30.0), view(1.0, 30.0 - (0.2 - a_metre) * drop), view(2.0, 30.0 - (1.8 - 2 * a_metre) * drop)]
    right = [view(-1.0, 30.0, shown=0.55), view(-2.0, 30.0, shown=0.2)]
    found = find_reliable_range([*flat, *right], limits)
    assert [p.shift_m for p in found.points] == [-2, -1, 0, 1, 2]
    assert found.left_m == pytest.approx(1.5)  # 0.2 and 1.8 dB lost at 1 and 2 m
    lost = 0.15 * PSNR_COEFFICIENTS["shown"] + a_metre
    assert found.right_m == pytest.approx(1.0 / lost, abs=1e-2)  # the estimate falls before the share
    assert str(found).startswith("usable to 1.5 m left")


def test_what_holds_everywhere_is_usable_to_the_last_shift_or_more() -> None:
    limits = RangeConfig(shifts_m=(1.0, 2.0), max_drop_db=3.0)
    found = find_reliable_range([view(s, 30.0) for s in (0.0, 1.0, 2.0, -1.0, -2.0)], limits)
    assert (found.left_m, found.right_m) == (2.0, 2.0) and "2.0 m or more left" in str(found)
    later = find_reliable_range([view(s, 30.0, thin=0.5 * (s == 1.0)) for s in (0.0, 1.0, 2.0)], limits)
    assert later.left_m < 0.1 and later.points[-1].holds  # what holds behind a gap cannot be reached


def test_without_the_path_nothing_can_be_judged() -> None:
    with pytest.raises(ValueError, match="shift 0"):
        find_reliable_range([view(1.0, 30.0)], RangeConfig())


def test_every_shift_is_rendered_on_both_sides(chunk: Chunk, scene: SceneGraph, tmp_path: Path) -> None:
    config = RangeConfig(shifts_m=(1.0, 4.0), every=4)
    reported: list[int] = []
    found = estimate_reliable_range(config, chunk, scene, progress=lambda done, total, note="": reported.append(done))
    assert [p.shift_m for p in found.points] == [-4, -1, 0, 1, 4] and {p.views for p in found.points} == {2}
    assert reported == [0, 1, 2, 3, 4, 5]
    write_range(tmp_path, found, {"log": "an earlier one"})
    table, picture = (Path(p) for p in write_range(tmp_path, found, {"log": LOG}))
    rows = pq.read_table(table)
    assert rows.num_rows == 10 and rows.schema.metadata[b"left_m"] == f"{found.left_m:.3f}".encode()
    assert picture.read_bytes()[:4] == b"\x89PNG"


def test_the_picture_has_every_limit_that_ends_the_range() -> None:
    limits = RangeConfig(shifts_m=(1.0,), max_hidden=0.2, max_thin=0.03, max_floating=0.05)
    found = find_reliable_range([view(0.0, 30.0), view(1.0, 30.0, floating=0.1), view(-1.0, 30.0)], limits)
    assert found.left_m == pytest.approx(0.5)
    axes = Figure().subplots()
    _plot_guards(axes, found)
    drawn = {line.get_ydata()[0] for line in axes.get_lines() if line.get_linestyle() == ":"}
    assert drawn == {-0.2, 0.03, 0.05}


def test_the_command_answers_for_a_finished_run(finished: FinishedRun, tmp_path: Path) -> None:
    arguments = ["range", finished.name, "--store", finished.store, "--out", str(tmp_path)]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    assert "usable to" in done.output and "after gnet" in done.output and (tmp_path / "range.png").is_file()
    assert "The scene after GNet can be trusted" in (finished.folder / "report.html").read_text()
    assert find_last_stage(finished.store, finished.name, 0) == "gnet"
    with pytest.raises(ConfigError, match="range --help"):
        CliRunner().invoke(app, [*arguments, "--max-drop-db", "-1"], catch_exceptions=False)
    for command in (arguments, ["render", finished.name, "--store", finished.store, "--out", str(tmp_path / "x.png")]):
        with pytest.raises(InputError, match=r"ingest makes no scene.*initial, gnet, enet"):
            CliRunner().invoke(app, [*command, "--stage", "ingest"], catch_exceptions=False)
        with pytest.raises(InputError, match=r"no stage 'enet'.*ingest, effects, initial, gnet, evaluate"):
            CliRunner().invoke(app, [*command, "--stage", "enet"], catch_exceptions=False)
    with pytest.raises(InputError, match="runs of this store begin with"):
        CliRunner().invoke(app, ["range", "zzz", "--store", finished.store], catch_exceptions=False)


def test_a_store_that_may_only_be_read_answers_too(
    finished: FinishedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path, data: bytes) -> None:
        raise OSError(errno.EROFS, "Read-only file system", str(path))

    monkeypatch.setattr(atomic_path, "write_atomically", refuse)
    done = CliRunner().invoke(app, ["range", finished.name, "--store", finished.store, "--out", str(tmp_path)])
    assert done.exit_code == 0, done.output
    assert "usable to" in done.output and "the run's report stays as it was" in done.output


@pytest.mark.parametrize("suffix", ["png", "exr", "mp4"])
def test_a_finished_run_is_rendered_beside_the_path(finished: FinishedRun, tmp_path: Path, suffix: str) -> None:
    out = tmp_path / f"lane.{suffix}"
    for _ in range(2):
        done = CliRunner().invoke(
            app, ["render", finished.name, "--store", finished.store, "--shift", "1", "--out", str(out)]
        )
        assert done.exit_code == 0 and "+1 m, chunk 0, after gnet" in done.output, done.output
    assert list(tmp_path.iterdir()) == [out] and out.stat().st_size > 1000


def test_a_finished_run_is_rendered_from_refined_poses(
    finished: FinishedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def move(chunk: Chunk, plan: EffectsPlan) -> Chunk:
        poses = [view.chunk_SE3_camera.copy() for view in chunk.views]
        for pose in poses:
            pose[2, 3] += 1.0
        views = zip(chunk.views, poses, strict=True)
        return replace(chunk, views=tuple(replace(view, chunk_SE3_camera=pose) for view, pose in views))

    pictures = []
    for name in ("recorded.png", "refined.png"):
        words = ["render", finished.name, "--store", finished.store, "--out", str(tmp_path / name)]
        assert CliRunner().invoke(app, words).exit_code == 0
        pictures.append((tmp_path / name).read_bytes())
        monkeypatch.setattr("genre_tasks.effects.apply_plan.apply_plan", move)
    assert pictures[0] != pictures[1]


def test_a_record_says_what_a_budget_did(finished: FinishedRun) -> None:
    record = write_run_record(finished, summarise_run(finished), {"budget": {"budget_s": 1.0}})
    assert json.loads((finished.folder / "run.json").read_text())["budget"] == record["budget"] == {"budget_s": 1.0}
    # The range, if it was measured, is for the report.
    assert {p.name for p in finished.folder.iterdir()} - {"ranges"} == {"run.json", "report.html"}


def test_a_seam_is_the_same_view_from_both_scenes(chunk: Chunk, scene: SceneGraph) -> None:
    """A chunk cut in two, whose second half lies elsewhere in its own coordinates, and is a little darker."""
    shift = np.eye(4)
    shift[:3, 3] = (7.0, -3.0, 0.5)
    first = replace(chunk, frames=chunk.frames[:4], views=tuple(v for v in chunk.views if v.frame in chunk.frames[:4]))
    moved = [
        replace(v, chunk_SE3_camera=shift @ v.chunk_SE3_camera) for v in chunk.views if v.frame in chunk.frames[4:]
    ]
    second = replace(
        chunk,
        index=1,
        frames=chunk.frames[4:],
        views=tuple(moved),
        chunk_SE3_ego=shift @ chunk.chunk_SE3_ego[4:],
        world_SE3_chunk=chunk.world_SE3_chunk @ np.linalg.inv(shift),
    )
    first = replace(first, chunk_SE3_ego=chunk.chunk_SE3_ego[:4])
    offset = torch.tensor([7.0, -3.0, 0.5])
    same = replace(scene.gaussians, means=scene.gaussians.means + offset)
    darker = replace(same, colors=same.colors - 0.05)
    alike = measure_seam((first, scene), (second, scene.with_gaussians(same)))
    jump = measure_seam((first, scene), (second, scene.with_gaussians(darker)))
    assert len(alike) == 6 and {v.frame for v in alike} == {chunk.frames[3], chunk.frames[4]}
    assert min(median_psnr_by_distance(alike).values()) > 45  # but for rounding and the order of equal depths
    assert all(
        25 < db < 30 for db in median_psnr_by_distance(jump).values()
    )  # 0.05 is 26 dB; what is black stays black
    with pytest.raises(ValueError, match="follow each other"):
        measure_seam((second, scene), (first, scene))
