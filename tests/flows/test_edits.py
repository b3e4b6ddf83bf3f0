"""Edits as people write them: files and options, and what is said of mistakes in them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from flows.reconstruction.chunk_configuration import read_chunk_config
from flows.reconstruction.left_out import record_failures
from flows.reconstruction.rewritten_report import read_finished_run
from flows.reconstruction.run_records import find_run_record, summarise_run, write_run_record
from flows.simulation.edit_file import parse_edit_options, read_edit_file
from flows.simulation.edited_runs import write_edited_run
from flows.simulation.run_scenes import RunScenes
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.scene_edits.actor_names import name_actors, resolve_actor
from genre_tasks.scene_edits.edits import Insert, Move, Remove, Retime, Rotate, ScaleSpeed
from tests.flows.command_line import genre
from tests.flows.small_simulation import make_run

ALL_KINDS = """
edits:
  - remove: 12
  - insert: 7
    from_run: 4b1c
    name: taxi
    ahead_m: 12
    turn_deg: 180
  - move: car-3
    forward_m: 2
  - {retime: car-4, delay_s: 0.5}
  - {rotate: car-5, degrees: 90}
  - {scale_speed: taxi, factor: 0.5}
"""


def test_file_holds_every_kind_of_edit(tmp_path: Path) -> None:
    file = tmp_path / "edits.yaml"
    file.write_text(ALL_KINDS)
    assert read_edit_file(file).edits == (
        Remove(actor="12"),
        Insert(actor="7", from_run="4b1c", name="taxi", ahead_m=12, turn_deg=180),
        Move(actor="car-3", forward_m=2),
        Retime(actor="car-4", delay_s=0.5),
        Rotate(actor="car-5", degrees=90),
        ScaleSpeed(actor="taxi", factor=0.5),
    )
    file.write_text("")
    assert len(read_edit_file(file)) == 0


def test_the_bare_number_of_an_actor_is_the_logs() -> None:
    names = {"a": "car-1", "inserted": "taxi-1"}
    assert resolve_actor("1", names) == "a" and resolve_actor("taxi-1", names) == "inserted"
    # The last part of another name is no number: it would hide the start of an actor's name.
    assert resolve_actor("bus", {"a": "car-1", "b": "bus-4", "inserted": "my-bus"}) == "b"


def test_names_that_look_like_numbers_are_taken_as_they_are_written(tmp_path: Path) -> None:
    file = tmp_path / "edits.yaml"
    file.write_text("edits:\n  - remove: 0012\n  - insert: 7.50\n    from_run: 77e2\n    name: 007\n    ahead_m: 1e1\n")
    assert read_edit_file(file).edits == (
        Remove(actor="0012"),
        Insert(actor="7.50", from_run="77e2", name="007", ahead_m=10),
    )


def test_options_hold_every_kind_of_edit() -> None:
    edits = parse_edit_options(
        remove=["12"],
        insert=["taxi@run2:7,ahead=12,left=-3,turn=180,speed=5,start=1", "run2:7", "bus@7", "7"],
        move=["car-3,forward=2,left=-1,up=0.5"],
        retime=["car-4,delay=-0.5"],
        rotate=["car-5,90"],
        scale_speed=["car-3,0.5"],
    ).edits
    assert edits == (
        Remove(actor="12"),
        Insert(actor="7", from_run="run2", name="taxi", ahead_m=12, left_m=-3, turn_deg=180, speed_m_s=5, start_s=1),
        Insert(actor="7", from_run="run2"),
        Insert(actor="7", name="bus"),
        Insert(actor="7"),
        Move(actor="car-3", forward_m=2, left_m=-1, up_m=0.5),
        Retime(actor="car-4", delay_s=-0.5),
        Rotate(actor="car-5", degrees=90),
        ScaleSpeed(actor="car-3", factor=0.5),
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("edit: []", "line 1: a file of edits has no 'edit' (file FILE). Did you mean 'edits'?"),
        ("edits: 3", "line 1: `edits` is no list"),
        ("edits: [car-3]", "edit 1: expected an edit such as `remove: car-3`, got 'car-3'"),
        (
            "edits:\n  - remove: a\n  - remuve: b\n",
            "line 3: edit 2: it says not what to do (file FILE). Did you mean 'r",
        ),
        ("edits:\n  - {remove: a, move: b}\n", "edit 1: it says remove and move, which are two edits"),
        (
            "edits:\n  - move: a\n    forwrd_m: 1\n",
            "line 3: edit 1: move has no 'forwrd_m' (file FILE). Did you mean 'fo",
        ),
        (
            "edits:\n  - move: a\n    left_m: far\n",
            "line 3: edit 1: the value of left_m is not allowed: it should be a n",
        ),
        (
            "edits:\n  - move: a\n    left_m: 1e9\n",
            "the value of left_m is not allowed: it should be less than or equal",
        ),
        ("edits:\n  - retime: a\n", "line 2: edit 1: the value of delay_s is not allowed: it is missing"),
        ("edits:\n  - remove: ''\n", "the value of remove is not allowed: it should not be empty"),
        ("edits:\n  - move: a\n    left_m: .nan\n", "the value of left_m is not allowed: it should be a finite number"),
    ],
)
def test_mistakes_in_a_file_are_named(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "edits.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError) as caught:
        read_edit_file(file)
    assert message.replace("FILE", str(file)) in str(caught.value)


@pytest.mark.parametrize(
    ("option", "text", "message"),
    [
        (
            "move",
            "car-3,lft=1",
            "--move car-3,lft=1: cannot read 'lft=1'. Did you mean 'left'? Known: forward, left, up.",
        ),
        ("move", "car-3,left=x", "--move car-3,left=x: 'left=x' has no number. Write --move car-3,forward=2,left=-1."),
        ("move", "car-3,left=1,left=2", "left is there twice"),
        ("move", ",left=1", "the actor is missing"),
        ("remove", "car-3,1", "cannot read '1'. Known: the actor alone."),
        ("insert", "taxi@run:", "the actor is missing"),
        ("scale_speed", "car-3", "the value of factor is not allowed: it is missing"),
        ("scale_speed", "car-3,-1", "the value of factor is not allowed: it should be greater than or equal to 0"),
    ],
)
def test_mistakes_in_options_are_named(option: str, text: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_edit_options(**{option: [text]})
    assert message in str(caught.value)


def test_an_edited_run_has_the_gaps_and_the_budget_of_its_source(tmp_path: Path) -> None:
    store = str(tmp_path)
    whole = read_finished_run(store, find_run_record(store, make_run(tmp_path)))
    failure = InputError("the chunk has no image", remedy="Choose others with --chunks.", chunk=2)
    partly = replace(whole, left_out=record_failures(whole.log, {2: failure}))
    chosen = {"chunk": 1, "settings": ["gnet.iterations=1"], "choices": []}
    budget = {"budget_s": 60.0, "used_s": 50.0, "chunks": [chosen]}
    source = write_run_record(partly, summarise_run(partly), {"budget": budget})
    car = name_actors(RunScenes(store, source["run"]))["car-0"]
    written = write_edited_run(store, source["run"], parse_edit_options(remove=[car]))
    edited = find_run_record(store, written["run"])
    assert edited["status"] == source["status"] == "partly_done" and edited["edited"]["run"] == source["run"]
    assert [entry["chunk"] for entry in edited["left_out"]] == [2]
    assert edited["left_out"] == source["left_out"] and "no image" in Path(edited["report"]).read_text()
    assert read_chunk_config(edited, 1).gnet.iterations == 1 != read_chunk_config(edited, 0).gnet.iterations


def test_commands_say_what_is_missing(tmp_path: Path) -> None:
    nothing = genre(tmp_path, "edit", "4b1c")
    assert nothing.returncode == 2
    assert b"there is nothing to edit. Give --edits FILE" in nothing.stderr
    (tmp_path / "genre-store").mkdir()
    no_run = genre(tmp_path, "show", "actors", "--store", "genre-store")
    assert no_run.returncode == 2
    assert b"no run is named. Write `genre show actors RUN`" in no_run.stderr
    second = genre(tmp_path, "show", "runs", "4b1c", "--store", "genre-store")
    assert second.returncode == 2
    assert b"'4b1c' after 'runs' has no meaning" in second.stderr
