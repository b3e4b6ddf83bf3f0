"""The sweep of accuracy against time: its settings, its sums, its files, and that it goes on where it was stopped."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from flows.budget.budget import resolve_table
from flows.cli.main import app
from flows.configuration import load_configuration
from flows.configuration.absolute_paths import make_paths_absolute
from flows.cost_sweep import cell as cell_module
from flows.cost_sweep import flow as flow_module
from flows.cost_sweep import knobs
from flows.cost_sweep.cell import Cell, Sweep, list_cells, measure_cold_start, predict_cells, run_cell
from flows.cost_sweep.evaluation_plan import take_ego_pixels
from flows.cost_sweep.flow import SweepRequest, write_results
from flows.cost_sweep.knobs import PRESET_ITSELF, Setting, list_settings
from flows.cost_sweep.summary import KERNEL_3M, PERCEPTUAL_3M, novel_view_measure, pareto_front, summarise_settings
from flows.experiments import warm_up
from flows.experiments.log_chunks import LogChunk
from flows.pipeline.stage_runner import ArtifactRef, Job, read_artifact, run_stage
from genre_tasks.config import PipelineConfig
from genre_tasks.effects import pose_refinement
from genre_tasks.effects.measurements import ChunkMeasurements
from genre_tasks.effects.plan import EFFECT_NAMES, load_effect
from genre_tasks.effects.types import Effect, EffectParameters, EffectsPlan, Measurement
from genre_tasks.errors import ConfigError
from genre_tasks.scene.chunk import Chunk
from tests.faults.small_run import LOG, SETTINGS, Stopped, stopping
from tests.storage.artifact_values import make


def row(value: str, seed: int, seconds: float, psnr: float, log: str = "a", **more: float) -> dict[str, Any]:
    metrics = {"interpolation/psnr": psnr, "shift_3m/kernel": 1 / psnr, "shift_3m/n": 30} | more
    knob = "views" if value else PRESET_ITSELF
    return {
        "knob": knob,
        "value": value,
        "setting": f"{knob}={value}" if value else PRESET_ITSELF,
        "log": log,
        "chunk": 0,
        "seed": seed,
        "seconds": {"ingest": 1.0, "gnet": seconds},
        "cpu_seconds": {"ingest": 1.5, "gnet": 2 * seconds},
        "peak_mib": 500.0,
        "gaussians": 1000,
        "metrics": metrics,
        "images": 120,
        "end": "enet",
        "threads": 0,
        "changes": [f"gnet.views_per_iteration={value}"] if value else [],
    }


ROWS = [
    row("", 0, 4.0, 25.0),
    row("", 1, 4.0, 27.0),
    row("", 0, 4.0, 20.0, "b"),
    row("", 1, 4.0, 22.0, "b"),
    row("1", 0, 2.0, 24.0),
    row("1", 1, 2.0, 26.0),
    row("1", 0, 2.0, 19.0, "b"),
    row("1", 1, 2.0, 21.0, "b"),
    row("9", 0, 9.0, 25.0),
    row("9", 1, 9.0, 26.0),
    row("9", 0, 9.0, 20.0, "b"),
    row("9", 1, 9.0, 22.0, "b"),
]


def test_lines_are_means_with_spreads_over_seeds_and_gains_in_the_same_place() -> None:
    preset, fewer, more = summarise_settings(ROWS)
    assert (preset.setting, preset.n, preset.seconds) == (PRESET_ITSELF, 4, 5.0)
    assert preset.values["psnr"].average == pytest.approx(23.5)
    assert preset.values["psnr"].sd == pytest.approx(math.sqrt(2))  # of the seeds, not of the logs
    assert fewer.gains["psnr"].average == pytest.approx(-1.0) and fewer.gains["psnr"].sd == pytest.approx(0.0)
    assert fewer.gains["seconds"].average == pytest.approx(2.0)  # less is better
    assert more.gains["psnr"].average == pytest.approx(-0.25)
    assert fewer.values["cpu_seconds"].average == pytest.approx(5.5)
    assert fewer.on_front and preset.on_front and not more.on_front
    assert math.isnan(summarise_settings(ROWS[:1])[0].values["psnr"].sd)


def test_what_was_not_measured_everywhere_is_not_on_the_front() -> None:
    easier = [row("2", 0, 1.0, 26.0), row("2", 1, 1.0, 26.5)]  # on one of two logs
    *whole, part = summarise_settings([*ROWS, *easier])
    assert [x.on_front for x in whole] == [x.on_front for x in summarise_settings(ROWS)] and part.on_front == ()


def test_the_front_is_what_no_other_setting_beats() -> None:
    points = [(1.0, 20.0), (2.0, 25.0), (3.0, 24.0), (2.0, 25.0), (2.0, 24.0), (5.0, math.nan)]
    assert pareto_front(points, more_is_better=True) == {0, 1, 3}
    assert pareto_front([(1.0, 0.5), (2.0, 0.6), (3.0, 0.4)], more_is_better=False) == {0, 2}
    assert pareto_front([], more_is_better=True) == set()


def test_beside_the_path_the_truth_judges_where_there_is_one() -> None:
    assert novel_view_measure(ROWS) is KERNEL_3M
    assert novel_view_measure([row("", 0, 1.0, 25.0, **{"shift_3m/perceptual": 0.5})]) is PERCEPTUAL_3M


def test_settings_start_with_the_preset_and_differ_from_it() -> None:
    settings = list_settings("small")
    base = load_configuration("small")
    assert settings[0].name == PRESET_ITSELF and settings[0].configuration("small", (), 0) == base
    assert len({s.name for s in settings}) == len(settings)
    for s in settings[1:]:
        assert s.end == "gnet" or s.threads or s.configuration("small", (), 0) != base, s.name
    assert [s.value for s in list_settings("small", knobs=["views"])[1:]] == ["1", "6", "12"]
    assert {s.knob for s in settings} >= {"gnet_iterations", "resolution", "gaussians", "fixer", "shifts", "threads"}
    with pytest.raises(ConfigError, match=r"no knob 'view'.*Did you mean 'views'"):
        list_settings("small", knobs=["view"])
    with pytest.raises(ConfigError, match=r"the knobs fixer, views, fixer name one twice"):
        list_settings("small", knobs=["fixer", "views", "fixer"])


def test_values_that_rounding_makes_equal_are_one_setting() -> None:
    settings = list_settings("small", ["enet.iterations=2"])
    names = [s.name for s in settings]
    assert len(set(names)) == len(names)
    assert [name for name in names if name.startswith("enet_iterations")] == ["enet_iterations=1", "enet_iterations=4"]


def test_a_short_enet_has_low_learning_rates_and_splits_nothing() -> None:
    by_value = {s.value: s for s in list_settings("small", knobs=["more_gaussians"])}
    setting = by_value["160000, GNet 144, ENet 16 at low rates"]
    config = setting.configuration("small", (), 0)
    base = load_configuration("small").enet
    assert config.enet.learning_rates is not None and base.learning_rates is not None
    ratios = [a / b for a, b in zip(config.enet.learning_rates.as_tuple(), base.learning_rates.as_tuple(), strict=True)]
    assert ratios == pytest.approx([knobs.LOW_RATE_FACTOR] * 5, rel=1e-3)
    assert (config.enet.split_fraction, config.enet.iterations) == (0, 16)
    turns = by_value["160000, GNet 144, ENet 16 at low rates, sides in turns"].configuration("small", (), 0)
    assert turns == config.model_copy(update={"novel_views": config.novel_views.model_copy(update={"every": 2})})
    trained = list_settings("small", ["enet.learning_rates=null"], ["more_gaussians"])
    assert all("learning_rates" not in change for s in trained for change in s.changes)


def test_threads_are_fewer_than_the_cores_that_may_be_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """A container may have two of the machine's many cores."""
    for cores, expected in ((1, []), (2, ["1"]), (8, ["1", "2", "4"])):
        monkeypatch.setattr(knobs, "count_cores", lambda n=cores: n)
        assert [setting.value for setting in list_settings("small", knobs=["threads"])[1:]] == expected


COMMAND = "genre cost 'synthetic:street?seed=900' --preset small --seeds 0,1 --knobs fixer --set enet.snapshots=0"


def test_the_command_is_the_one_that_was_given() -> None:
    sweep = Sweep("small", ("enet.snapshots=0",), "store")
    request = SweepRequest(sweep, ["synthetic:street?seed=900"], None, [0, 1], ["fixer"])
    assert request.command == COMMAND
    assert SweepRequest(Sweep("demo", (), "s"), ["a"], [2]).command == "genre cost a --preset demo --chunks 2"


def test_the_files_say_the_same(tmp_path: Path) -> None:
    write_results(
        tmp_path, Sweep("small", (), "store"), ROWS[:2], [], "", {}
    )  # an earlier one, whose files are written anew
    files = write_results(
        tmp_path, Sweep("small", (), "store"), ROWS, ["views=99: memory ran out"], COMMAND, {"calibration_s": "0.1"}
    )
    lines, cells, picture, page = (Path(f) for f in files)
    table = pq.read_table(lines).to_pydict()
    assert table["value"] == ["", "1", "9"] and table["psnr_mean"][1] == pytest.approx(22.5)
    assert table["psnr_gain"][1] == pytest.approx(-1.0) and table["psnr_3m_mean"] == [None] * 3
    assert table["on_front"][:2] == ["psnr,kernel_3m"] * 2
    assert len(pq.read_table(cells)) == len(ROWS)
    assert picture.read_bytes()[:4] == b"\x89PNG"
    text = page.read_text()
    assert "**22.50 ± 1.41**" in text and "left out: views=99: memory ran out" in text and "N = 30" in text
    assert f"* command: `{COMMAND}`" in text


RIGHT = np.eye(1, 16, 3).reshape(4, 4)
"""Added to a pose, moves it by one metre along the first axis of the chunk."""

SWEEP_SETTINGS = tuple(s for s in SETTINGS if "snapshots" not in s)
CELLS = [
    Cell(LogChunk(LOG, 0), 0, s)
    for s in (
        Setting(PRESET_ITSELF, ""),
        Setting("resolution", "48x27", ("ingest.width_px=48", "ingest.height_px=27"), end="gnet"),
        Setting("effects", "lidar_depth off", ("effects.lidar_depth=off",), end="gnet"),
        Setting("effects", "rigid_actors on", ("effects.rigid_actors=on",), end="gnet"),
        Setting("effects", "rolling_shutter on", ("effects.rolling_shutter=on",), end="gnet"),
        Setting("resolution", "3840x2160", ("ingest.width_px=3840", "ingest.height_px=2160"), end="gnet"),
    )
]


def test_a_sweep_goes_on_where_it_was_stopped_and_judges_alike(tmp_path: Path) -> None:
    sweep = Sweep("demo", SWEEP_SETTINGS, str(tmp_path))
    computed, counted = stopping(after=6)
    with pytest.raises(Stopped):
        for cell in CELLS:
            run_cell(sweep, cell, counted)
    assert computed == ["ingest", "effects", "initial", "gnet", "novel_views", "fnet"]
    computed.append("stopped here")
    rows = [run_cell(sweep, cell, counted) for cell in CELLS]
    assert computed[7:9] == ["enet", "evaluate/enet"]
    assert computed.count("evaluate/gnet") == 2
    # It is on as planned; the log states no readout time; its images are no larger.
    assert rows[3:] == [None, None, None]
    whole, coarse, left = rows[:3]
    assert whole is not None and coarse is not None and left is not None
    assert set(whole["seconds"]) == {"ingest", "effects", "initial", "gnet", "novel_views", "fnet", "enet"}
    assert coarse["metrics"]["interpolation/n"] == whole["metrics"]["interpolation/n"]
    assert whole["cpu_seconds"]["gnet"] > 0 and left["gaussians"] < whole["gaussians"] <= 1 + 1.7 * left["gaussians"]
    before = len(computed)
    assert [run_cell(sweep, cell, counted) for cell in CELLS] == rows and len(computed) == before
    told = predict_cells(sweep, CELLS[:1])
    assert told[0]["seconds"] == 0 and told[0]["cached"] == "8 of 8 stages"


def test_a_plan_takes_only_the_recording_vehicles_pixels_of_another_size() -> None:
    plan, reference = (make("effects", seed=seed) for seed in (1, 2))
    plan, reference = (
        replace(p, decisions=(replace(p.decisions[0], name="ego_mask", reason=reason), *p.decisions[1:]))
        for p, reason in ((plan, "few pixels"), (reference, "many pixels"))
    )
    taken = take_ego_pixels(plan, reference)
    pixels = ("ego_masks", "ego_points")
    for field in fields(EffectParameters):
        source = reference if field.name in pixels else plan
        assert getattr(taken.parameters, field.name) is getattr(source.parameters, field.name), field.name
    assert taken.decisions == (reference.decisions[0], *plan.decisions[1:])


def _refine_poses_of_large_images(monkeypatch: pytest.MonkeyPatch, pixels: int) -> None:
    """Has ``pose_refinement`` move every camera, as on logs whose poses err, but in no images of fewer pixels."""

    def measure(measurements: ChunkMeasurements) -> Measurement:
        chunk = measurements.chunk
        return Measurement(9.0 if chunk.width_px * chunk.height_px >= pixels else None, "by the test")

    def fit(measurements: ChunkMeasurements) -> EffectParameters:
        views = measurements.chunk.views
        return EffectParameters(poses={(v.camera, v.frame): v.chunk_SE3_camera + 0.01 * RIGHT for v in views})

    monkeypatch.setattr(pose_refinement, "EFFECT", replace(pose_refinement.EFFECT, measure=measure, fit=fit))


def test_scenes_of_every_image_size_are_judged_at_their_own_poses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _refine_poses_of_large_images(monkeypatch, 64 * 36)
    sweep = Sweep("demo", SWEEP_SETTINGS, str(tmp_path))
    planned: list[str] = []
    judged: list[tuple[str, EffectsPlan, Chunk]] = []

    def watch(stage: str, job: Job, inputs: dict[str, ArtifactRef]) -> ArtifactRef:
        if stage.startswith("evaluate/"):
            plan, chunk = (read_artifact(job, inputs[name]) for name in ("effects", "ingest"))
            judged.append((inputs["effects"].key, plan, chunk))
        ref = run_stage(stage, job, inputs)
        planned.extend([ref.key] if stage == "effects" else [])
        return ref

    coarse = CELLS[1]
    for cell in (Cell(coarse.where, 0, Setting("fixer", "off", end="gnet")), coarse, coarse):
        assert run_cell(sweep, cell, watch) is not None
    (key, plan, chunk), (coarse_key, coarse_plan, coarse_chunk), again = judged
    # Of the preset's size, the stage's own plan.
    assert key == planned[0] and set(plan.parameters.poses) == {(v.camera, v.frame) for v in chunk.views}
    # Too coarse to be refined: GNet took the recorded poses, and so does the comparison with larger images.
    assert coarse_plan.parameters.poses == {} and coarse_chunk.width_px == 64
    assert not coarse_plan.is_on("pose_refinement") and plan.is_on("pose_refinement")
    assert again[0] == coarse_key and coarse_key not in planned


def test_a_stage_that_settings_share_is_predicted_once(tmp_path: Path) -> None:
    settings = [Setting(PRESET_ITSELF, ""), Setting("enet_iterations", "4", ("enet.iterations=4",))]
    both = predict_cells(Sweep("small", (), str(tmp_path)), list_cells([LogChunk(LOG, 0)], [0], settings))
    assert 0 < both[1]["seconds"] < both[0]["seconds"]


def test_a_number_of_threads_has_a_store_beside_the_store(tmp_path: Path) -> None:
    cell = Cell(LogChunk(LOG, 0), 0, Setting("threads", "1", threads=1))
    # A shell completes the name of a folder with a slash.
    assert Sweep("demo", (), f"{tmp_path}/store/").job(cell).store == f"{tmp_path}/store-threads-1"
    assert Sweep("demo", (), f"file://{tmp_path}/store").job(cell).store == f"file://{tmp_path}/store-threads-1"


@pytest.mark.parametrize("uri", ["s3://bucket", "s3://bucket/", "s3://bucket/prefix"])
def test_a_number_of_threads_stays_in_the_bucket(uri: str) -> None:
    cell = Cell(LogChunk(LOG, 0), 0, Setting("threads", "2", threads=2))
    assert Sweep("demo", (), uri).job(cell).store == f"{uri.rstrip('/')}/.threads-2"


def test_the_command_lists_what_it_would_run_and_refuses_what_it_does_not_know(tmp_path: Path) -> None:
    told = ["cost", LOG, "--preset", "demo", "--knobs", "fixer", "--store", str(tmp_path), "--seeds", "0", "--dry-run"]
    done = CliRunner().invoke(app, told, terminal_width=200)
    assert done.exit_code == 0, done.output
    assert "fixer=off" in done.output and "minutes" in done.output
    spaced = CliRunner().invoke(app, [*told, "--knobs", " views, fixer"], terminal_width=200)
    assert spaced.exit_code == 0 and "fixer=off" in spaced.output and "views=6" in spaced.output
    with pytest.raises(ConfigError, match="--seeds"):
        CliRunner().invoke(app, ["cost", LOG, "--seeds", "one"], catch_exceptions=False)


@pytest.mark.parametrize(("first_s", "second_s", "start_s"), [(3.0, 1.0, 2.0), (1.0, 3.0, 0.0)])
def test_first_calls_are_told_apart_from_the_stages_own_time(
    monkeypatch: pytest.MonkeyPatch, first_s: float, second_s: float, start_s: float
) -> None:
    seconds = [first_s, second_s]
    runs: list[tuple[str, ...]] = []

    def measure(config: PipelineConfig, names: Sequence[str]) -> dict[str, float]:
        runs.append(tuple(names))
        return dict.fromkeys(names, seconds[len(runs) - 1])

    monkeypatch.setattr(cell_module, "run_on_tiny_log", measure)
    cold = measure_cold_start(Sweep("demo", SWEEP_SETTINGS, "never-used"))
    stages = ["ingest", "effects", "initial", "gnet", "novel_views", "fnet", "enet"]
    # The evaluation is run as well, but distances between sets of images are no stage's own time.
    assert runs == [(*stages, "evaluate/enet")] * 2
    assert cold == dict.fromkeys(stages, start_s)
    assert not Path("never-used").exists()


def test_stages_of_the_tiny_log_are_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    # The images of this one are smaller, and so is the time that drawing them takes.
    monkeypatch.setattr(warm_up, "TINY_LOG", LOG)
    stages = ["ingest", "effects", "initial"]
    seconds = warm_up.run_on_tiny_log(load_configuration("demo", settings=SWEEP_SETTINGS), stages)
    assert list(seconds) == stages and all(0 < value < 60 for value in seconds.values())


@pytest.mark.parametrize("setting", ["ingest.source_every=10", "effects.rolling_shutter=on", "effects.motion_blur=on"])
def test_a_setting_that_the_tiny_log_does_not_support_is_left_out(
    monkeypatch: pytest.MonkeyPatch, setting: str
) -> None:
    monkeypatch.setattr(warm_up, "TINY_LOG", LOG)
    config = load_configuration("demo", settings=[*SWEEP_SETTINGS, setting])
    assert list(warm_up.run_on_tiny_log(config, ["ingest", "effects"])) == ["ingest", "effects"]


def test_effects_that_a_log_may_make_impossible_are_known_to_the_warm_up() -> None:
    effects = {name: load_effect(name) for name in EFFECT_NAMES}
    lacking = {name for name, effect in effects.items() if effect.find_missing is not Effect.find_missing}
    assert lacking == set(warm_up.EFFECTS_OF_STATED_TIMES)


def test_a_table_of_weights_in_this_folder_fits_a_run_with_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[list[str]] = []

    def sweep(logs: list[str], *, settings: list[str], **options: Any) -> dict[str, Any]:
        asked.append(settings)
        speed = {"calibration_s": "0.1", "cold_seconds": "{}"}
        files = write_results(Path(options["out"]), Sweep("small", tuple(settings), "store"), ROWS, [], "", speed)
        return {"cells": len(ROWS), "failed": [], "files": files}

    monkeypatch.setattr(SweepRequest, "cells", lambda request: [])
    monkeypatch.setattr(flow_module, "cost_of_accuracy", sweep)
    monkeypatch.setattr("flows.cli.terminal.report_on_terminal", nullcontext)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.safetensors").touch()
    settings = ["gnet.weights=mine.safetensors"]
    CliRunner().invoke(app, ["cost", LOG, "--set", *settings, "--out", "cost"], catch_exceptions=False)
    assert asked == [[f"gnet.weights={tmp_path}/mine.safetensors"]]
    # As `genre run` and its flow make it.
    config = make_paths_absolute(load_configuration("small", settings=settings))
    assert resolve_table("cost/cost.parquet", "small", config).settings == tuple(asked[0])
    # A table of before names the file as the user wrote it.
    sweep([LOG], settings=settings, out="before")
    assert resolve_table("before/cost.parquet", "small", config).settings == tuple(settings)
