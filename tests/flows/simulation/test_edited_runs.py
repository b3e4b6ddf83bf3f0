"""Edited runs: every reader finds the actors of the edits, and users hear what edits leave as it was."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from flows.cli.main import app
from flows.reconstruction.stored_values import read_stage_value
from flows.simulation import parked_actors, prepared_rollout
from flows.simulation.edit_file import parse_edit_options
from flows.simulation.edited_runs import open_run, write_edited_run
from flows.simulation.parked_actors import warn_of_standing_actors
from flows.simulation.prepared_rollout import prepare_rollout
from flows.simulation.recorded_settings import read_recorded_config
from flows.simulation.request import SimulationRequest
from flows.simulation.run_scenes import RunScenes
from flows.simulation.simulate import simulate_run
from flows.simulators import driving_world
from flows.simulators.driving_world import DrivingWorld
from flows.simulators.run_facts import read_run_facts
from genre_tasks.logs.synthetic import SyntheticStreet
from genre_tasks.logs.types import CuboidTrack, Float64
from genre_tasks.progress import silent
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.gaussians import map_attributes
from genre_tasks.scene.graph import FIRST_ACTOR
from genre_tasks.scene_edits.actor_names import name_actors
from genre_tasks.scene_edits.chunk_scene import ChunkScene
from genre_tasks.scene_edits.run_survey import survey_run
from tests.flows.small_simulation import CHUNKS, LOG, make_run
from tests.scene_edits.edited_runs import SIZE_M, MadeRun, box_pose


@pytest.fixture(scope="module")
def busy(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """A store and a run with traffic in it."""
    store = tmp_path_factory.mktemp("edited")
    return str(store), make_run(store)


def insert_taxi(store: str, busy_run: str, run: str) -> RunScenes:
    """Writes a run with a standing car of another run ahead of the recorded vehicle."""
    survey = survey_run(RunScenes(store, busy_run))
    tracks = survey.tracks.items()
    car = next(survey.names[t] for t, track in tracks if track.label == "Car" and any(track.gaussians.values()))
    edits = parse_edit_options(insert=[f"taxi@{busy_run}:{car},ahead=9,speed=0"])
    return RunScenes(store, write_edited_run(store, run, edits)["run"])


def test_an_actor_in_a_street_without_traffic_is_one_for_every_reader(busy: tuple[str, str]) -> None:
    store, busy_run = busy
    recorded = RunScenes(store, make_run(Path(store), f"{LOG}&moving=0&pedestrians=0"))
    edited = insert_taxi(store, busy_run, recorded.record["run"])
    for number in CHUNKS:
        before = recorded.load(number).chunk
        after = edited.load(number)
        assert before.actors == ()
        assert [actor.track_id for actor in after.scene.actors] == ["taxi"]
        assert [actor.track_id for actor in after.chunk.actors] == ["taxi"]
        assert np.array_equal(after.chunk.static.positions, before.static.positions)
    assert [actor.track_id for actor in read_run_facts(edited).actors] == ["taxi"]
    world = DrivingWorld(store, edited.record["run"], None, 3.0, silent)
    path = world.recorded
    met = [
        world.find_collision(pose, float(frame)) for pose, frame in zip(path.world_SE3_ego, path.frames, strict=True)
    ]
    assert {collision.actor_id for collision in met if collision is not None} == {"taxi"}


def test_traffic_that_is_no_actor_stays_in_the_background(busy: tuple[str, str]) -> None:
    store, busy_run = busy
    recorded = RunScenes(store, make_run(Path(store), settings=("effects.rigid_actors=off",)))
    edited = insert_taxi(store, busy_run, recorded.record["run"])
    for number in CHUNKS:
        before = recorded.load(number).chunk.static
        ingested = read_stage_value(store, recorded.record["run"], number, "ingest")[1]
        after = edited.load(number)
        assert len(before) > len(ingested.static)
        assert np.array_equal(after.chunk.static.positions, before.positions)
        assert [actor.track_id for actor in after.chunk.actors] == ["taxi"]


def without_actors(part: ChunkScene) -> ChunkScene:
    """A chunk whose actors all belong to the background."""
    stays = part.scene.nodes < FIRST_ACTOR
    gaussians = map_attributes(lambda values: values[stays], part.scene.gaussians)
    scene = replace(part.scene, gaussians=gaussians, nodes=part.scene.nodes[stays], actors=(), deformation=None)
    return ChunkScene(replace(part.chunk, actors=()), scene)


def test_users_hear_where_an_edited_actor_stays(
    busy: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, run = busy
    car = next(actor.track_id for actor in RunScenes(store, run).load(0).chunk.actors if actor.label == "Car")
    read = RunScenes._read_chunk_scene
    list_tracks = SyntheticStreet.tracks

    def read_first(scenes: RunScenes, number: int) -> ChunkScene:
        part = read(scenes, number)
        return without_actors(part) if number == 1 else part

    def stop_at_border(log: SyntheticStreet) -> tuple[CuboidTrack, ...]:
        return tuple(stop(track) if track.track_id == car else track for track in list_tracks(log))

    def stop(track: CuboidTrack) -> CuboidTrack:
        boxes = track.world_SE3_box.copy()
        boxes[track.frames > 6] = boxes[track.frames == 6]
        return replace(track, world_SE3_box=boxes)

    monkeypatch.setattr(RunScenes, "_read_chunk_scene", read_first)
    monkeypatch.setattr(SyntheticStreet, "tracks", stop_at_border)
    scenes = RunScenes(store, run)
    name = name_actors(scenes)[car]
    log = scenes.load(0).chunk.log
    warning = f"log {log}, chunk 1: {name} (track {car}) stands still there, and edits leave it in the background"
    request = SimulationRequest(
        store=store,
        run=run,
        out=tmp_path / "out",
        cameras=("front_camera",),
        mark_range=False,
        allow_collision=True,
        edits=parse_edit_options(move=[f"{name},left=1"]),
    )
    assert warning in simulate_run(request)["warnings"]
    words = ["edit", run, "--store", store, "--move", f"{name},left=1"]
    done = CliRunner().invoke(app, words, catch_exceptions=False)
    assert done.exit_code == 0 and f"warning: {warning}\n" in done.stdout


def test_who_moves_in_a_chunk_does_not_stand_there() -> None:
    def track(track_id: str, frames: range, places: list[float]) -> CuboidTrack:
        boxes: Float64 = np.stack([box_pose(place, 6.0) for place in places])
        return CuboidTrack(track_id, "Car", np.array(frames), boxes, SIZE_M, moving=True)

    tracks = (
        # An actor of the second chunk, which waits in the first.
        track("c", range(12), [20.0] * 8 + [21.0, 22.0, 23.0, 24.0]),
        # Moves in the first chunk, where it has too few points, and is gone in the second.
        track("fast", range(6), [float(k) for k in range(6)]),
        # Comes into view at the end of the first chunk.
        track("brief", range(4, 6), [3.0, 3.2]),
    )
    run = MadeRun()
    recorded: Any = SimpleNamespace(
        log=SimpleNamespace(tracks=lambda: tracks), record={"config": {"ingest": {"min_actor_frames": 3}}}
    )
    chunks = [run.load(number).chunk for number in run.chunk_numbers]
    names = {"c": "pedestrian-3", "fast": "car-4", "brief": "car-5"}
    assert warn_of_standing_actors(recorded, chunks, names) == {
        0: ("log up, chunk 0: pedestrian-3 (track c) stands still there, and edits leave it in the background",)
    }
    assert warn_of_standing_actors(recorded, chunks, {"fast": "car-4"}) == {}


def test_no_image_and_no_point_of_all_chunks_stays_in_memory(
    busy: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    passed: list[list[Chunk]] = []

    def watch(module: ModuleType, name: str) -> None:
        function = getattr(module, name)

        def call(*arguments: Any) -> Any:
            passed.append(list(arguments[-1]))
            return function(*arguments)

        monkeypatch.setattr(module, name, call)

    watch(prepared_rollout, "join_recorded_path")
    watch(parked_actors, "list_parked_actors")
    watch(driving_world, "join_recorded_path")
    store, run = busy
    opened = open_run(store, run)
    request = SimulationRequest(store=store, run=run, out=tmp_path, mark_range=False, allow_collision=True)
    prepare_rollout(request, opened, read_recorded_config(opened.recorded.record), silent)
    DrivingWorld(store, run, None, 3.0, silent)
    assert len(passed) == 4 and all(len(chunks) == len(CHUNKS) for chunks in passed)
    for chunk in (chunk for chunks in passed for chunk in chunks):
        assert len(chunk.static) == 0 and chunk.views and chunk.actors
        assert all(view.image == b"" for view in chunk.views)
        assert all(len(actor.points) == 0 and len(actor.frames) for actor in chunk.actors)
