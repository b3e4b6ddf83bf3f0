"""``genre augment`` on a tiny street: which images a set has, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from flows.cli.main import app
from flows.cli.shifts import parse_shifts
from flows.configuration import load_configuration
from flows.perception.labelled_renders import render_labelled_images
from flows.pipeline.definition import STAGE_BY_NAME
from flows.pipeline.log_cache import cached_log
from flows.pipeline.stage_runner import ArtifactRef, Job, run_stage
from flows.reconstruction.run_records import FinishedRun, summarise_run, write_run_record
from flows.simulation import run_scenes
from flows.simulation.edited_runs import write_edited_run
from flows.simulation.run_scenes import RunScenes
from genre_tasks.errors import ConfigError, GenreError, InputError
from genre_tasks.logs.registry import open_log
from genre_tasks.scene_edits.edits import EditList
from genre_tasks.training_sets.reading import read_training_set

pytest.importorskip("embreex", reason="the synthetic street is ray-cast with Embree")

LOG = "synthetic:street?seed=900&frames=8&cameras=1&width=96&height=54&samples=1&lidar_beams=32&lidar_azimuths=300"
SETTINGS = ["ingest.width_px=96", "ingest.height_px=54", "initial.max_points=3000", "initial.distant_count=300"]
STAGES = ("ingest", "effects", "initial", "evaluate/initial")


def finish_run(store: Path, log: str) -> FinishedRun:
    """A run that ended with the initial scene."""
    settings = [*SETTINGS, "evaluate.bootstrap=0", "evaluate.every=8", "evaluate.shifts_m=[3]"]
    config = load_configuration("demo", settings=settings).model_dump(mode="json")
    job, refs = Job(log, 0, str(store), config), dict[str, ArtifactRef]()
    for name in STAGES:
        refs[name] = run_stage(name, job, {k: refs[k] for k in STAGE_BY_NAME[name].inputs})
    run = FinishedRun(log, "demo", str(store), config, {}, {0: refs})
    write_run_record(run, summarise_run(run), {})
    return run


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> FinishedRun:
    return finish_run(tmp_path_factory.mktemp("store"), LOG)


def augment(run: FinishedRun, *words: str) -> str:
    done = CliRunner().invoke(app, ["augment", run.name, "--store", run.store, *words], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.output


def refusal(run: FinishedRun, *words: str) -> GenreError:
    done = CliRunner().invoke(app, ["augment", run.name, "--store", run.store, *words])
    assert isinstance(done.exception, GenreError), (done.exception, done.output)
    return done.exception


def test_a_set_has_recorded_and_moved_images(finished: FinishedRun, tmp_path: Path) -> None:
    out = tmp_path / "set"
    said = augment(finished, "--shift", "±2m", "--every", "4", "--format", "own", "--out", str(out))
    images = read_training_set(out)
    boxes = sum(len(image.boxes) for image in images)
    assert f"wrote {out}: 6 images with {boxes} boxes, as own" in said and boxes > 20
    expected = [(frame, shift, shift != 0) for frame in (0, 4) for shift in (0.0, 2.0, -2.0)]
    assert [(image.frame, image.shift_m, image.rendered) for image in images] == expected
    log = open_log(LOG)
    recorded, left, right = images[:3]
    pose = log.world_SE3_camera(recorded.camera, 0)
    assert recorded.world_SE3_camera == pytest.approx(pose, abs=1e-6)
    moved = left.world_SE3_camera[:3, 3] - right.world_SE3_camera[:3, 3]
    assert np.linalg.norm(moved) == pytest.approx(4) and moved[2] == 0
    for image in images:
        # Of all images it is known what is hidden, and nothing stays that no detector could find.
        assert all(box.occluded <= 0.95 and box.lidar_points > 0 for box in image.boxes)
        assert image.image.shape == (54, 96, 3) and image.image.std() > 10


def test_options_change_the_set(finished: FinishedRun, tmp_path: Path) -> None:
    common = ("--shift", "-1", "--every", "4", "--format", "coco", "--stage", "initial")
    augment(finished, *common, "--no-recorded", "--out", str(tmp_path / "few"), "--min-points", "50")
    augment(finished, *common, "--out", str(tmp_path / "all"), "--min-points", "0")
    few, full = (json.loads((tmp_path / n / "annotations.json").read_text()) for n in ("few", "all"))
    assert [(i["shift_m"], i["rendered"]) for i in few["images"]] == [(-1, True)] * 2
    assert len(full["images"]) == 4
    assert min(a["lidar_points"] for a in few["annotations"]) >= 50
    assert min(a["lidar_points"] for a in full["annotations"]) < 50


@pytest.mark.parametrize("layout", ["kitti", "nuscenes"])
def test_other_layouts_are_written(finished: FinishedRun, tmp_path: Path, layout: str) -> None:
    augment(finished, "--shift", "1", "--every", "8", "--format", layout, "--out", str(tmp_path / "set"))
    first = {"kitti": "training/label_2/000001.txt", "nuscenes": "v1.0-trainval/sample_annotation.json"}[layout]
    assert (tmp_path / "set" / first).stat().st_size > 50


def test_chosen_frames_are_rendered_without_a_record(finished: FinishedRun) -> None:
    part = RunScenes(finished.store, finished.name).load(0)
    log = cached_log(LOG)
    reported: list[tuple[int, int]] = []
    images = list(
        render_labelled_images(
            log,
            part.chunk,
            part.scene,
            (0.0,),
            frames=(5, 2),
            progress=lambda done, total, note="": reported.append((done, total)),
        )
    )
    assert [(image.frame, image.rendered) for image in images] == [(2, False), (2, True), (5, False), (5, True)]
    assert reported == [(k, 4) for k in range(4)]
    for recorded, rendered in zip(images[::2], images[1::2], strict=True):
        # Unmoved, a render shows the same boxes at the same places.
        assert [box.box_px for box in recorded.boxes] == [box.box_px for box in rendered.boxes]
        assert np.abs(recorded.image.astype(float) - rendered.image).mean() < 30
    with pytest.raises(InputError, match=r"no frame 99.*It has 0 to 7"):
        list(render_labelled_images(log, part.chunk, part.scene, (1.0,), frames=(99,)))
    with pytest.raises(InputError, match="chunk is of another log"):
        list(render_labelled_images(open_log("synthetic:street?seed=901"), part.chunk, part.scene, (1.0,)))


def test_what_cannot_work_is_refused_before_anything_is_rendered(finished: FinishedRun, tmp_path: Path) -> None:
    out = tmp_path / "set"
    assert "Did you mean 'kitti'?" in str(refusal(finished, "--format", "kiti", "--out", str(out)))
    assert "cannot read --shift 'left'" in str(refusal(finished, "--shift", "left", "--out", str(out)))
    assert "--every 0 is out of range" in str(refusal(finished, "--every", "0", "--out", str(out)))
    assert "--min-points -1" in str(refusal(finished, "--min-points", "-1", "--out", str(out)))
    assert "no stage 'gnet'" in str(refusal(finished, "--stage", "gnet", "--out", str(out)))
    assert "makes no scene" in str(refusal(finished, "--stage", "ingest", "--out", str(out)))
    assert not out.exists()
    (out / "old").mkdir(parents=True)
    assert "holds something already" in str(refusal(finished, "--out", str(out)))
    other = replace(finished, preset="other")
    write_run_record(other, summarise_run(other), {})
    assert "both have frame 0 of the log" in str(refusal(finished, other.name, "--out", str(tmp_path / "two")))


def test_runs_with_other_chunks_share_frames(finished: FinishedRun, tmp_path: Path) -> None:
    config = {**finished.config, "ingest": {**finished.config["ingest"], "chunk_frames": 4, "source_every": 2}}
    job, refs = Job(LOG, 1, finished.store, config), dict[str, ArtifactRef]()
    for name in STAGES:
        refs[name] = run_stage(name, job, {k: refs[k] for k in STAGE_BY_NAME[name].inputs})
    halved = FinishedRun(LOG, "demo", finished.store, config, {}, {1: refs})
    write_run_record(halved, summarise_run(halved), {})
    problem = str(refusal(finished, halved.name, "--out", str(tmp_path / "two")))
    assert f"the runs {finished.name} and {halved.name} both have frame 4" in problem


def test_renders_have_no_box_of_what_their_chunk_left_out(finished: FinishedRun) -> None:
    part, log = RunScenes(finished.store, finished.name).load(0), cached_log(LOG)
    gone = part.chunk.actors[0].track_id
    without = replace(part.chunk, actors=tuple(a for a in part.chunk.actors if a.track_id != gone))
    found = []
    for chunk in (part.chunk, without):
        images = list(render_labelled_images(log, chunk, part.scene, (0.0,), frames=chunk.frames[::4]))
        found.append([{box.track_id for i in images if i.rendered is r for box in i.boxes} for r in (True, False)])
    assert gone in found[0][0] and found[1] == [found[0][0] - {gone}, found[0][1]]


def test_a_faint_scene_hides_nothing(finished: FinishedRun) -> None:
    part, log = RunScenes(finished.store, finished.name).load(0), cached_log(LOG)
    gaussians = part.scene.gaussians
    thin = replace(gaussians, logit_opacities=torch.full_like(gaussians.logit_opacities, -4.0))
    hidden = [
        [box.occluded for i in render_labelled_images(log, part.chunk, scene, (2.0,), every=4) for box in i.boxes]
        for scene in (part.scene, part.scene.with_gaussians(thin))
    ]
    assert max(hidden[0]) > 0.2 and set(hidden[1]) == {0.0}


def test_another_log_in_the_place_of_the_runs_is_refused(
    finished: FinishedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    there = LOG.replace("seed=900", "seed=901")
    monkeypatch.setattr(run_scenes, "cached_log", lambda uri: cached_log(there))
    assert "another log is where the run's was" in str(refusal(finished, "--out", str(tmp_path / "set")))


def test_a_run_counts_once_and_edited_traffic_has_no_labels(finished: FinishedRun, tmp_path: Path) -> None:
    out = ("--out", str(tmp_path / "set"))
    assert f"the run {finished.name} is there twice" in str(refusal(finished, finished.name[:6], *out))
    edited = write_edited_run(finished.store, finished.name, EditList())["run"]
    done = CliRunner().invoke(app, ["augment", edited, "--store", finished.store, *out])
    assert isinstance(done.exception, InputError)
    assert f"Take the recorded run {finished.name}." in str(done.exception)
    assert not (tmp_path / "set").exists()


def test_a_log_without_annotations_is_one_clear_error(tmp_path: Path) -> None:
    run = finish_run(tmp_path / "store", f"{LOG}&cuboids=0")
    error = refusal(run, "--out", str(tmp_path / "set"))
    assert isinstance(error, InputError) and "has no annotations" in str(error) and "cuboids=0" in str(error)
    assert not (tmp_path / "set").exists()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("3", [3.0]),
        ("±3m", [3.0, -3.0]),
        ("+-1.5", [1.5, -1.5]),
        ("+/-2", [2.0, -2.0]),
        ("-3,3", [-3.0, 3.0]),
        (" 1 m, 2 m ", [1.0, 2.0]),
        ("0", [0.0]),
    ],
)
def test_shifts_are_read(text: str, expected: list[float]) -> None:
    assert parse_shifts(text, "--shift") == expected


@pytest.mark.parametrize("text", ["", "3km", "1,,2", "nan", "3,3", "±0", "±2,-2", "1001", "--3", "٣"])
def test_other_shifts_are_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="--shift"):
        parse_shifts(text, "--shift")
