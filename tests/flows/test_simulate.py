"""Simulations of a tiny run: the folder, its manifest, the cache, hand-over, and one clear error for each mistake."""

from __future__ import annotations

import errno
import itertools
import json
from dataclasses import replace
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pyarrow.parquet as pq
import pytest
import typer
from typer.testing import CliRunner

from flows.cli.main import app
from flows.cli.simulate_options import read_request
from flows.configuration.loading import apply_settings
from flows.simulation import parked_actors, stored_ranges
from flows.simulation import simulate as simulate_module
from flows.simulation.chunk_outlines import load_outlines
from flows.simulation.edit_file import parse_edit_options
from flows.simulation.edited_runs import open_edited_scenes, open_run, write_edited_run
from flows.simulation.film import FilmWriter
from flows.simulation.request import SimulationRequest
from flows.simulation.rollout_key import compute_rollout_key
from flows.simulation.rollout_metrics import METRICS_FILE
from flows.simulation.run_scenes import RunScenes
from flows.simulation.simulate import simulate_run
from genre_tasks.config import PipelineConfig, SimulateConfig
from genre_tasks.ego_paths import recorded_path
from genre_tasks.ego_paths.recorded_path import ImageTime, join_recorded_path, list_image_times
from genre_tasks.errors import ConfigError, DiskFullError, GenreError, InputError
from genre_tasks.logs.synthetic import SyntheticStreet
from genre_tasks.rollout.handover import plan_handovers
from genre_tasks.rollout.render_rollout import render_rollout
from genre_tasks.rollout.rig import estimate_rig
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene_edits.actor_names import name_actors
from genre_tasks.scene_edits.run_survey import survey_run
from storage.files import digest_file
from storage.manifest import MANIFEST, parse_manifest
from tests.flows.small_simulation import make_run


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> SimulationRequest:
    """The recorded path of a run of two chunks."""
    folder = tmp_path_factory.mktemp("simulate")
    return SimulationRequest(
        store=str(folder), run=make_run(folder), out=folder / "unused", mark_range=False, allow_collision=True
    )


def test_a_simulation_is_complete_and_found_again(recorded: SimulationRequest, tmp_path: Path) -> None:
    out = tmp_path / "rollouts" / "recorded"
    request = replace(recorded, out=out, exr=True, png=True, sensors=("rgb", "depth"))
    record = simulate_run(request)
    assert not record["cached"] and record["metrics"]["poses"] == 12
    manifest = parse_manifest((out / MANIFEST).read_bytes(), out / MANIFEST)
    assert {entry.path: entry.sha256 for entry in manifest.files} == {
        path.relative_to(out).as_posix(): digest_file(path)
        for path in out.rglob("*")
        if path.is_file() and path.name != MANIFEST
    }
    cameras = record["metrics"]["cameras"]
    for camera in cameras:
        film = imageio.imread(out / f"{camera}.mp4")
        image = imageio.imread(out / camera / "000003.png")
        assert film.shape == (12, 36, 64, 3)
        # The film shows the image, as far as its quality allows; a shift of colours would be more.
        assert np.abs(film[3].astype(float) - image).mean() < 4
        assert (out / camera / "000011.exr").is_file() and (out / "depth" / camera / "000000.exr").is_file()
    poses = pq.read_table(out / "poses.parquet").to_pydict()
    assert poses["frame"] == list(range(12)) and poses["chunk"][0] == 0 and poses["chunk"][-1] == 1
    assert np.allclose(poses["time_s"], np.arange(12) * 0.1, atol=1e-3) and poses["reliable"] == [None] * 12
    assert json.loads((out / METRICS_FILE).read_text())["handovers"][0]["seam_psnr_db"] > 10
    assert [path.name for path in out.parent.iterdir()] == ["recorded"]
    # The same request is answered by the folder, a damaged one is not.
    assert simulate_run(request) == {**record, "cached": True}
    (out / f"{cameras[0]}.mp4").write_bytes(b"damaged")
    with pytest.raises(ConfigError, match="damaged rollout"):
        simulate_run(request)
    again = simulate_run(replace(request, overwrite=True))
    assert again["key"] == record["key"]
    assert parse_manifest((out / MANIFEST).read_bytes(), out).payload_digest == manifest.payload_digest


def test_the_poses_of_a_simulation_are_a_path(recorded: SimulationRequest, tmp_path: Path) -> None:
    aside = replace(recorded, out=tmp_path / "a", behaviour="recorded", start_offset_m=1.0, cameras=("front_camera",))
    simulate_run(aside)
    first = pq.read_table(tmp_path / "a" / "poses.parquet")
    read = replace(recorded, out=tmp_path / "b", path_file=tmp_path / "a" / "poses.parquet", cameras=("front_camera",))
    simulate_run(read)
    second = pq.read_table(tmp_path / "b" / "poses.parquet")
    assert np.allclose(first["lateral_m"], 1.0, atol=0.1)
    for name in ("x", "y", "qw", "qz", "time_s"):
        assert np.allclose(first[name], second[name], atol=1e-6)


def test_a_hand_over_spreads_the_seam(recorded: SimulationRequest) -> None:
    scenes = RunScenes(recorded.store, recorded.run)
    chunks = [scenes.load(number).chunk for number in scenes.chunk_numbers]
    rig = estimate_rig(chunks)
    path = join_recorded_path(chunks)
    handovers = plan_handovers(scenes, path, rig, 4)
    cut = plan_handovers(scenes, path, rig, 0)
    assert handovers[0].end_frame - handovers[0].start_frame == 4
    faded = list(render_rollout(scenes, path, rig, handovers=handovers))
    jumped = list(render_rollout(scenes, path, rig, handovers=cut))
    weights = {images.index: images.blend_weight for images in faded if images.blended_chunk is not None}
    assert len(weights) == 4 and max(weights.values()) <= 0.5
    assert all(images.blended_chunk is None for images in jumped)
    # Outside of the fade nothing changes.
    for index in set(range(12)) - set(weights) - {5, 6}:
        assert np.array_equal(faded[index].color, jumped[index].color)


@pytest.mark.parametrize(
    ("change", "kind", "words"),
    [
        ({"behaviour": "brakes"}, ConfigError, "Did you mean 'brake'"),
        ({"cameras": ("front_camra",)}, InputError, "Did you mean 'front_camera'"),
        ({"run": "zzz"}, InputError, "0 runs"),
        ({"chunks": (7,)}, InputError, "no chunk 7"),
        ({"sensors": ("radar",)}, ConfigError, "no sensor is called 'radar'"),
        ({"behaviour": "brake", "path_file": Path("x.json")}, ConfigError, "both say how to drive"),
        ({"path_file": Path("nowhere.json")}, InputError, "no such file"),
        ({"strength": 2.0}, ConfigError, "those of a behaviour"),
        ({"behaviour": "brake", "strength": float("nan")}, ConfigError, "--strength is nan"),
        ({"behaviour": "brake", "delay_s": float("inf")}, ConfigError, "--delay is inf"),
        ({"settings": ("simulate.handover=2",)}, ConfigError, "handover"),
    ],
)
def test_mistakes_are_named(
    recorded: SimulationRequest, tmp_path: Path, change: dict[str, object], kind: type[GenreError], words: str
) -> None:
    with pytest.raises(kind, match=words):
        simulate_run(replace(recorded, out=tmp_path / "out", **change))  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


def test_a_rendered_film_plays_as_fast_as_the_log(recorded: SimulationRequest, tmp_path: Path) -> None:
    film = tmp_path / "film.MP4"
    words = ["render", recorded.run, "--store", recorded.store, "--chunk", "0", "--out", str(film)]
    assert CliRunner().invoke(app, words, catch_exceptions=False).exit_code == 0
    facts = imageio.immeta(film)
    assert facts["fps"] == pytest.approx(10.0) and imageio.imread(film).shape[0] == 6


def test_a_rendered_film_stands_still_over_a_pause_of_the_log(
    recorded: SimulationRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def list_with_pause(chunk: Chunk) -> list[ImageTime]:
        first = chunk.frames[0]
        return [image._replace(time_s=image.time_s + 0.4 * (image.frame > first)) for image in list_image_times(chunk)]

    monkeypatch.setattr(recorded_path, "list_image_times", list_with_pause)
    film = tmp_path / "film.mp4"
    words = ["render", recorded.run, "--store", recorded.store, "--chunk", "0", "--out", str(film)]
    assert CliRunner().invoke(app, words, catch_exceptions=False).exit_code == 0
    images = imageio.imread(film).astype(int)
    assert len(images) == 10
    steps = [abs(after - before).mean() for before, after in itertools.pairwise(images)]
    assert max(steps[:4]) < min(steps[4:])


def test_a_simulations_film_stands_still_over_a_pause_of_its_path(recorded: SimulationRequest, tmp_path: Path) -> None:
    times_s = (0.0, 0.1, 0.2, 0.6, 0.7)
    poses = [{"time_s": t, "frame": k, "lateral_m": 0.0, "ahead_m": 0.0} for k, t in enumerate(times_s)]
    file = tmp_path / "path.json"
    file.write_text(json.dumps(poses))
    change = {"path_file": file, "cameras": ("front_camera",), "allow_implausible": True}
    simulate_run(replace(recorded, out=tmp_path / "out", **change))  # type: ignore[arg-type]
    assert len(imageio.imread(tmp_path / "out" / "front_camera.mp4")) == len(poses) + 3


@pytest.mark.parametrize("setting", ["gnet.iterations=8", "ingest.width_px=640", "novel_views.shifts_m=[1.0]"])
def test_settings_that_change_nothing_of_a_simulation_are_refused(setting: str) -> None:
    request = SimulationRequest(store="s", run="r", out=Path("o"), settings=(setting,))
    with pytest.raises(ConfigError, match="changes nothing of a simulation"):
        request.check()
    replace(request, settings=("simulate.lane_m=2", "fnet.temporal=true", "novel_views.lidar_max_points=9")).check()


def test_a_path_without_poses_is_refused(recorded: SimulationRequest, tmp_path: Path) -> None:
    file = tmp_path / "empty.json"
    file.write_text("[]")
    with pytest.raises(InputError, match="without frames"):
        simulate_run(replace(recorded, out=tmp_path / "out", path_file=file))


def test_foreign_files_are_never_replaced(recorded: SimulationRequest, tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    with pytest.raises(InputError, match="no rollout's"):
        simulate_run(replace(recorded, out=tmp_path, overwrite=True))
    assert (tmp_path / "thesis.txt").read_text() == "years of work"


def test_an_interrupted_simulation_leaves_nothing(
    recorded: SimulationRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class StoppedError(BaseException):
        pass

    def stop(done: int, total: int, note: str = "") -> None:
        if done == 3:
            raise StoppedError

    with pytest.raises(StoppedError):
        simulate_run(replace(recorded, out=tmp_path / "out"), stop)
    assert not list(tmp_path.iterdir())

    def fail(folder: Path, metrics: object) -> None:
        raise OSError(28, "No space left on device", str(folder / "metrics.json"))

    # The same at the very end, when films are complete already.
    monkeypatch.setattr(simulate_module, "write_metrics", fail)
    with pytest.raises(DiskFullError) as caught:
        simulate_run(replace(recorded, out=tmp_path / "out", cameras=("front_camera",)))
    assert caught.value.file == str(tmp_path / "out") and "--out" in caught.value.remedy
    assert not list(tmp_path.iterdir())


def test_what_a_removed_actor_hid_is_in_the_output(recorded: SimulationRequest, tmp_path: Path) -> None:
    name = name_actors(RunScenes(recorded.store, recorded.run))["car-0"]
    edits = parse_edit_options(remove=[name])
    out = tmp_path / "out"
    record = simulate_run(replace(recorded, out=out, edits=edits, cameras=("front_camera",), chunks=(0,)))
    masks = [imageio.imread(out / "filled" / "front_camera" / f"{index:06d}.png") for index in range(6)]
    assert all(mask.shape == (36, 64) and set(np.unique(mask)) <= {0, 255} for mask in masks)
    assert all(mask.any() and not mask.all() for mask in masks)
    shown = CliRunner().invoke(app, ["show", str(out)], catch_exceptions=False)
    assert shown.exit_code == 0 and "filled/front_camera/*.png: 6 pictures" in shown.output
    plain = simulate_run(replace(recorded, out=tmp_path / "plain", cameras=("front_camera",), chunks=(0,)))
    assert plain["key"] != record["key"]
    with pytest.raises(InputError, match="no actor"):
        simulate_run(replace(recorded, out=tmp_path / "none", edits=parse_edit_options(remove=["car-99"])))


def test_a_simulation_of_masks_is_shown(recorded: SimulationRequest, tmp_path: Path) -> None:
    out = tmp_path / "out"
    simulate_run(replace(recorded, out=out, sensors=("masks",), cameras=("front_camera",), chunks=(0,)))
    shown = CliRunner().invoke(app, ["show", str(out)], catch_exceptions=False)
    assert shown.exit_code == 0 and "front_camera/*.png: 6 pictures" in shown.output


def find_seen_actor(recorded: SimulationRequest) -> str:
    """The name of an actor with Gaussians."""
    survey = survey_run(RunScenes(recorded.store, recorded.run))
    return next(survey.names[name] for name, track in survey.tracks.items() if any(track.gaussians.values()))


def test_edits_of_some_chunks_are_those_of_the_run(recorded: SimulationRequest) -> None:
    edits = parse_edit_options(insert=[f"taxi@{find_seen_actor(recorded)},ahead=8,speed=0"])
    everything = open_edited_scenes(recorded.store, recorded.run, edits, SimulateConfig())
    part = open_edited_scenes(recorded.store, recorded.run, edits, SimulateConfig(), chunks=(1,))
    assert list(part.chunk_numbers) == [1] and part.names == everything.names
    # It starts ahead of where the run starts, and not of where the chunk does.
    first, second = (
        next(node for node in scenes.load(1).scene.actors if node.track_id == "taxi") for scenes in (everything, part)
    )
    assert np.array_equal(first.frames, second.frames) and np.array_equal(first.chunk_SE3_box, second.chunk_SE3_box)
    with pytest.raises(InputError, match="no chunk 7"):
        open_edited_scenes(recorded.store, recorded.run, edits, SimulateConfig(), chunks=(7,))


def test_keys_of_edits_depend_on_all_chunks(recorded: SimulationRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    edits = parse_edit_options(remove=[name_actors(RunScenes(recorded.store, recorded.run))["car-0"]])
    request = replace(recorded, edits=edits, chunks=(0,))

    def find_keys() -> tuple[str, set[str]]:
        run = open_run(request.store, request.run, request.stage, request.chunks)
        config = PipelineConfig.model_validate(run.recorded.record["config"])
        stages = write_edited_run(request.store, request.run, edits)["chunks"][0]["stages"]
        keys = {stage["key"] for stage in stages if stage["stage"] != "effects"}
        return compute_rollout_key(request, run, config), keys

    def change(scenes: RunScenes) -> dict[str, str]:
        return {name: "0" * 64 if "chunk 1" in name else digest for name, digest in find_digests(scenes).items()}

    rollout_key, chunk_keys = find_keys()
    find_digests = RunScenes._find_digests
    monkeypatch.setattr(RunScenes, "_find_digests", change)
    other_rollout_key, other_chunk_keys = find_keys()
    assert rollout_key != other_rollout_key and not chunk_keys & other_chunk_keys


def test_an_edited_run_names_other_runs_in_full(recorded: SimulationRequest) -> None:
    edits = parse_edit_options(insert=[f"taxi@{recorded.run[:8]}:{find_seen_actor(recorded)},ahead=8"])
    written = write_edited_run(recorded.store, recorded.run, edits)
    assert written["edited"]["edits"]["edits"][0]["from_run"] == recorded.run


def test_the_points_that_fnet_sees_are_in_the_key(recorded: SimulationRequest) -> None:
    run = open_run(recorded.store, recorded.run)
    config = PipelineConfig.model_validate(run.recorded.record["config"])
    other = apply_settings(config, ("novel_views.lidar_max_points=12345",))
    fixed = replace(recorded, fix=True)
    assert compute_rollout_key(fixed, run, config) != compute_rollout_key(fixed, run, other)
    assert compute_rollout_key(recorded, run, config) == compute_rollout_key(recorded, run, other)


def test_poses_are_marked_by_the_reliable_range(recorded: SimulationRequest, tmp_path: Path) -> None:
    request = replace(recorded, out=tmp_path / "marked", mark_range=True, cameras=("front_camera",))
    ranges = simulate_run(request)["metrics"]["ranges"]
    assert set(ranges) == {"0", "1"} and all(side["left_m"] >= 0 for side in ranges.values())
    assert pq.read_table(tmp_path / "marked" / "poses.parquet")["reliable"].to_pylist() == [True] * 12
    # Kept in the run's folder: the next simulation finds it.
    files = list(RunScenes(recorded.store, recorded.run).folder.glob("ranges/*.json"))
    assert len(files) == 2
    files[0].write_text(json.dumps({"left_m": 7.0, "right_m": 7.0}))
    again = simulate_run(replace(request, out=tmp_path / "again"))
    assert 7.0 in [side["left_m"] for side in again["metrics"]["ranges"].values()]


def test_a_store_that_may_only_be_read_serves_simulations(
    recorded: SimulationRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path, data: bytes) -> None:
        raise OSError(errno.EROFS, "Read-only file system", str(path))

    for file in RunScenes(recorded.store, recorded.run).folder.glob("ranges/*.json"):
        file.unlink()
    monkeypatch.setattr(stored_ranges, "write_atomically", refuse)
    request = replace(recorded, out=tmp_path / "marked", mark_range=True, cameras=("front_camera",))
    assert set(simulate_run(request)["metrics"]["ranges"]) == {"0", "1"}


def test_a_log_whose_boxes_cannot_be_read_has_no_parked_vehicles(
    recorded: SimulationRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(log: object) -> tuple[object, ...]:
        raise InputError("row 0 is of frame 999", remedy="Correct the boxes.")

    monkeypatch.setattr(SyntheticStreet, "tracks", fail)
    scenes = RunScenes(recorded.store, recorded.run)
    assert parked_actors.list_parked(scenes, load_outlines(scenes)) == ()
    done = simulate_run(replace(recorded, out=tmp_path / "out", cameras=("front_camera",)))
    assert any("its boxes cannot be read" in warning for warning in done["warnings"])


def test_a_film_may_have_a_colon_in_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    film = FilmWriter(Path("2026-11-29T12:30.mp4"), 32, 16, 10.0)
    film.write(np.zeros((16, 32, 3), np.uint8))
    film.close()
    assert Path("2026-11-29T12:30.mp4").stat().st_size > 0


@pytest.mark.parametrize(
    ("text", "metres"), [("3", 3.0), ("3m", 3.0), ("-3m", -3.0), ("+1.5 m", 1.5), (None, None), ("3 km", "km")]
)
def test_start_offsets_are_metres(text: str | None, metres: float | str | None) -> None:
    command = typer.main.get_command(app).commands["simulate"]  # type: ignore[attr-defined]
    words = ["abc", "--out", "x", "--behaviour", "brake", *([] if text is None else [f"--start-offset={text}"])]
    options = command.make_context("simulate", words).params
    if isinstance(metres, str):
        with pytest.raises(ConfigError, match=metres):
            read_request(options)
    else:
        request = read_request(options)
        assert request.start_offset_m == metres and request.sensors == ("rgb",) and request.mark_range
