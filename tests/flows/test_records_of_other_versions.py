"""Records of runs that another version wrote: simulations read what they need of them, and name what they cannot."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from flows.simulation.edited_runs import open_run, open_shown_scenes, write_edited_run
from flows.simulation.request import SimulationRequest
from flows.simulation.run_scenes import RunScenes
from flows.simulation.simulate import simulate_run
from flows.simulators.alpasim.local_frame import read_local_frame
from flows.simulators.driving_world import DrivingWorld
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.logs.vehicle_center import REAR_AXLE_TO_CENTER_M
from genre_tasks.progress import silent
from genre_tasks.scene_edits.actor_names import name_actors
from genre_tasks.scene_edits.edits import EditList, Remove
from tests.flows.small_simulation import make_run

Change = Callable[[str, Callable[[dict[str, Any]], Any]], None]
"""Changes the record of a run by its name."""


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("versions")
    make_run(folder)
    return folder


@pytest.fixture
def change(store: Path) -> Iterator[Change]:
    """Changes the record of a run on the disk; it is as before after the test."""
    before: dict[Path, bytes] = {}

    def change_record(run: str, edit: Callable[[dict[str, Any]], Any]) -> None:
        file = store / "runs" / run / "run.json"
        before.setdefault(file, file.read_bytes())
        record = json.loads(file.read_text())
        edit(record)
        file.write_text(json.dumps(record))

    yield change_record
    for file, content in before.items():
        file.write_bytes(content)


def find_run(store: Path) -> str:
    """The name of the run that is not edited."""
    records = [json.loads(file.read_text()) for file in (store / "runs").glob("*/run.json")]
    return next(str(record["run"]) for record in records if "edited" not in record)


def remove_first_actor(store: Path, run: str) -> str:
    """An edited run without one of its actors."""
    actor = next(iter(name_actors(RunScenes(str(store), run)).values()))
    return str(write_edited_run(str(store), run, EditList(edits=(Remove(actor=actor),)))["run"])


def test_settings_of_other_sections_play_no_part(store: Path, change: Change, tmp_path: Path) -> None:
    run = find_run(store)

    def set_gone(record: dict[str, Any]) -> None:
        record["config"]["gnet"]["no_such_setting"] = 1
        record["config"]["simulate"]["center_ahead_m"] = 1.0

    change(run, set_gone)
    where = str(store)
    frame = read_local_frame(RunScenes(where, run))
    assert frame.ego_SE3_rig[0, 3] == pytest.approx(1.0 - REAR_AXLE_TO_CENTER_M)
    assert DrivingWorld(where, run, None, 3.0, silent).config.center_ahead_m == 1.0
    edited = remove_first_actor(store, run)
    assert len(name_actors(open_shown_scenes(where, edited))) == len(name_actors(RunScenes(where, run)))
    # A rollout has settings of other stages in its key.
    request = SimulationRequest(store=where, run=run, out=tmp_path / "out", mark_range=False, allow_collision=True)
    with pytest.raises(ConfigError, match=rf"'gnet\.no_such_setting' \(file the record of run {run}\)"):
        simulate_run(request)


def test_a_record_from_before_simulations_has_their_defaults(store: Path, change: Change) -> None:
    run = find_run(store)
    change(run, lambda record: record["config"].pop("simulate"))
    assert read_local_frame(RunScenes(str(store), run)).ego_SE3_rig[0, 3] == -REAR_AXLE_TO_CENTER_M


def test_unknown_settings_of_simulations_are_one_error(store: Path, change: Change) -> None:
    run = find_run(store)
    where = str(store)
    edited = remove_first_actor(store, run)
    change(run, lambda record: record["config"]["simulate"].update(no_such_setting=1))
    for read in (
        lambda: read_local_frame(RunScenes(where, run)),
        lambda: DrivingWorld(where, run, None, 3.0, silent),
        lambda: open_shown_scenes(where, edited),
        lambda: write_edited_run(where, run, EditList()),
    ):
        with pytest.raises(ConfigError, match=rf"'simulate\.no_such_setting' \(file the record of run {run}\)"):
            read()


def test_edits_of_another_version_are_one_error(store: Path, change: Change) -> None:
    run = find_run(store)
    edited = remove_first_actor(store, run)
    change(edited, lambda record: record["edited"]["edits"]["edits"][0].update(kind="teleport"))
    with pytest.raises(InputError, match=rf"the edits of run {edited} \(edits\.0: .*Edit run {run} again"):
        open_run(str(store), edited)
