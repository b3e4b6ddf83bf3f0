"""``genre export``: edited files are not lost, errors name what the user knows, and Gaussians are counted in files."""

from __future__ import annotations

import json
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from flows.exchange.export_request import ExportRequest
from flows.exchange.export_scenes import export_scenes
from flows.exchange.exporters import list_export_formats
from flows.exchange.import_scene import import_scene
from flows.simulation import edited_runs
from flows.simulation.edited_runs import open_edited_scenes, open_shown_scenes, write_edited_run
from flows.simulation.run_scenes import RunScenes
from genre_tasks.config.simulation_sections import SimulateConfig
from genre_tasks.errors import DiskFullError, GenreError, InputError
from genre_tasks.exchange.registry import load_format
from genre_tasks.exchange.scene_folder import SCENE_FILE, read_document
from genre_tasks.scene_edits.actor_names import name_actors
from genre_tasks.scene_edits.edits import EditList, Insert, Move
from genre_tasks.scene_edits.run_survey import survey_run
from genre_tasks.temporary_names import describe_owner
from tests.exchange.splat_clouds import change_one, make_driving_scene
from tests.flows.small_simulation import make_run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> ExportRequest:
    """A run of two chunks, to be exported as PLY."""
    store = tmp_path_factory.mktemp("exchange")
    return ExportRequest(store=str(store), scene=make_run(store), format="ply", out=store / "unused")


# --- an export that is there already


def test_files_that_were_edited_are_not_overwritten(run: ExportRequest, tmp_path: Path) -> None:
    out = tmp_path / "out"
    export_scenes(replace(run, out=out, chunks=(0,)))
    edited = out / "chunk-0" / "background.ply"
    edited.write_bytes(b"hours of work")
    again = replace(run, out=out, chunks=(1,), overwrite=True)
    with pytest.raises(InputError, match=r"after the export: chunk-0/background\.ply \(.*Move these files away"):
        export_scenes(again)
    assert edited.read_bytes() == b"hours of work"
    # Of a file that is not there nothing can be lost.
    edited.rename(tmp_path / "background.ply")
    assert export_scenes(again)["chunks"] == [1]
    assert [path.name for path in out.iterdir() if path.is_dir()] == ["chunk-1"]


@pytest.mark.parametrize("name", ["ply", "alpasim"])
def test_a_document_that_was_edited_is_not_overwritten(run: ExportRequest, tmp_path: Path, name: str) -> None:
    out = tmp_path / "out"
    again = replace(run, format=name, out=out, overwrite=True)
    export_scenes(again)
    # As it was written it may be replaced.
    export_scenes(again)
    document = (out / SCENE_FILE).read_text()
    for edited in (document.replace("background", "street", 1), document.replace("\n", ""), document + " "):
        assert edited != document
        (out / SCENE_FILE).write_text(edited)
        with pytest.raises(InputError, match=r"after the export: scene\.json \(.*Move the folder away"):
            export_scenes(again)
        assert (out / SCENE_FILE).read_text() == edited
    # Earlier versions wrote no digest: nobody knows whether such a document was changed.
    earlier = json.loads(document)
    del earlier["document_sha256"]
    (out / SCENE_FILE).write_text(json.dumps(earlier))
    export_scenes(again)
    assert (out / SCENE_FILE).read_text() == document


def test_a_document_that_is_a_link_is_not_overwritten(run: ExportRequest, tmp_path: Path) -> None:
    out = tmp_path / "out"
    export_scenes(replace(run, out=out))
    (out / SCENE_FILE).rename(tmp_path / "mine.json")
    (out / SCENE_FILE).symlink_to(tmp_path / "mine.json")
    with pytest.raises(InputError, match=r"after the export: scene\.json"):
        export_scenes(replace(run, out=out, overwrite=True))


def test_a_link_in_the_place_of_a_file_counts_as_an_edit(run: ExportRequest, tmp_path: Path) -> None:
    out = tmp_path / "out"
    export_scenes(replace(run, out=out, chunks=(0,)))
    (out / "chunk-0" / "distant.ply").unlink()
    (out / "chunk-0" / "distant.ply").symlink_to(tmp_path / "nowhere.ply")
    with pytest.raises(InputError, match="distant"):
        export_scenes(replace(run, out=out, overwrite=True))


def test_a_file_that_is_edited_while_the_export_is_written_stays(run: ExportRequest, tmp_path: Path) -> None:
    out = tmp_path / "out"
    export_scenes(replace(run, out=out))

    def edit(done: int, total: int, note: str = "") -> None:
        (out / "chunk-1" / "background.ply").write_bytes(b"hours of work")

    with pytest.raises(InputError, match="chunk-1/background"):
        export_scenes(replace(run, out=out, overwrite=True), edit)
    assert (out / "chunk-1" / "background.ply").read_bytes() == b"hours of work"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


# --- what is counted


def test_gaussians_are_those_of_the_files(tmp_path: Path) -> None:
    """Of 76 Gaussians the 7 of the pedestrian are absent at the second and the fifth of five moments."""
    load_format("glb").write(tmp_path / "drive.glb", make_driving_scene())
    store = str(tmp_path / "store")
    import_scene(store, tmp_path / "drive.glb")
    request = ExportRequest(store=store, scene="drive", format="ply", out=tmp_path / "out")
    frames = read_frames(replace(request, out=tmp_path / "nodes"))
    for index, count in ((0, 76), (1, 69)):
        out = tmp_path / f"frame-{index}"
        record = export_scenes(replace(request, out=out, frame=frames[index]))
        written = load_format("ply").read(out / record["files"][0]).nodes[0].cloud
        assert record["gaussians"] == len(written) == count
    everything = export_scenes(replace(request, out=tmp_path / "frames", all_frames=True))
    assert (len(everything["files"]), everything["gaussians"]) == (5, 3 * 76 + 2 * 69)
    actors = export_scenes(replace(request, out=tmp_path / "actors", per_actor=True))
    assert actors["gaussians"] == 27


def read_frames(request: ExportRequest) -> tuple[int, ...]:
    """Exports by nodes, all of which are counted; the frames."""
    assert export_scenes(request)["gaussians"] == 76
    return read_document(request.out).chunks[0].frames


# --- what is lost


@pytest.mark.parametrize(("name", "words"), [("spz", "rounded to a quarter"), ("splat", "rounded to 256 steps")])
def test_what_files_have_rounded_is_named_ever_after(run: ExportRequest, tmp_path: Path, name: str, words: str) -> None:
    export_scenes(replace(run, format=name, out=tmp_path / "lossy"))
    store = str(tmp_path / "store")
    record = import_scene(store, tmp_path / "lossy", "street")
    assert [sum(words in loss for loss in chunk["losses"]) for chunk in record["chunks"]] == [1, 1]
    for again in ("ply", name, "usdz", "glb"):
        out = tmp_path / again
        export_scenes(ExportRequest(store=store, scene="street", format=again, out=out))
        # Once, also where they are rounded a second time.
        assert sum(words in loss for loss in read_document(out).losses) == 1
    # PLY loses nothing further, and keeps the list.
    further = import_scene(store, tmp_path / "ply", "further")
    assert [chunk["losses"] for chunk in further["chunks"]] == [chunk["losses"] for chunk in record["chunks"]]


def test_files_that_round_nothing_leave_no_loss(run: ExportRequest, tmp_path: Path) -> None:
    export_scenes(replace(run, out=tmp_path / "out"))
    record = import_scene(str(tmp_path / "store"), tmp_path / "out")
    assert not [loss for chunk in record["chunks"] for loss in chunk["losses"] if "rounded" in loss]


# --- what errors say


@pytest.mark.parametrize("posed", [False, True])
def test_an_error_names_the_file_the_chunk_and_the_node(tmp_path: Path, posed: bool) -> None:
    scene = make_driving_scene()
    # 403 m, as a sky has it and SPZ cannot hold it.
    sky = replace(scene.nodes[1], cloud=change_one(scene.nodes[1].cloud, "log_scales", 6.0))
    load_format("glb").write(tmp_path / "sky.glb", replace(scene, nodes=(scene.nodes[0], sky, *scene.nodes[2:])))
    store = str(tmp_path / "store")
    import_scene(store, tmp_path / "sky.glb")
    out = tmp_path / "exported" / "out"
    request = ExportRequest(store=store, scene="sky", format="spz", out=out, all_frames=posed)
    with pytest.raises(InputError, match="a Gaussian has a standard deviation of 403 m") as caught:
        export_scenes(request)
    error = caught.value
    assert error.file is not None and Path(error.file).parent == out / "chunk-0" and error.chunk == 0
    assert (error.frame is not None) == posed
    assert error.problem.startswith("distant: ") != posed and "spz" in error.file
    assert not list(out.parent.iterdir())


@contextmanager
def limit_file_size(most_bytes: int) -> Iterator[None]:
    """No file of this process may become longer meanwhile, as on a disk that is full."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("name", list_export_formats())
def test_an_error_of_the_disk_names_the_folder_that_was_asked_for(
    run: ExportRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    # Half of a module's byte code would stay in its place.
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    out = tmp_path / "out"
    with limit_file_size(1024), pytest.raises(GenreError) as caught:
        export_scenes(replace(run, format=name, out=out))
    # OpenUSD does not say which error it was.
    assert isinstance(caught.value, InputError if name == "usdz" else DiskFullError)
    assert caught.value.file == str(out) and "--out" in caught.value.remedy
    assert describe_owner() not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_a_folder_in_which_nobody_may_write_is_named(run: ExportRequest, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    # Whatever its permissions say, nobody can make files in the first one.
    for out, named in ((Path("/proc/out"), Path("/proc/out")), (tmp_path / "file" / "out", tmp_path / "file")):
        with pytest.raises(InputError, match="name another --out") as caught:
            export_scenes(replace(run, out=out))
        assert caught.value.file == str(named)


# --- names of actors


def find_actor(run: ExportRequest) -> str:
    """The name of an actor with Gaussians."""
    survey = survey_run(RunScenes(run.store, run.scene))
    return next(survey.names[name] for name, track in survey.tracks.items() if any(track.gaussians.values()))


def list_node_names(run: ExportRequest, edited: str, out: Path) -> set[str]:
    export_scenes(replace(run, scene=edited, out=out))
    return {node.name for chunk in read_document(out).chunks for node in chunk.nodes}


def test_inserted_actors_have_their_names_in_files(run: ExportRequest, tmp_path: Path) -> None:
    actor = find_actor(run)
    edits = EditList(edits=(Insert(actor=actor), Insert(actor=actor, name="taxi", ahead_m=20.0)))
    edited = str(write_edited_run(run.store, run.scene, edits)["run"])
    names = set(name_actors(open_shown_scenes(run.store, edited)).values())
    found = list_node_names(run, edited, tmp_path / "out")
    assert found == {"background", "distant", *names} and "taxi" in found
    assert len(names) == 2 + len(name_actors(RunScenes(run.store, run.scene)))


def test_a_run_from_before_names_were_reserved_is_exported(
    run: ExportRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    actor = find_actor(run)
    insert = Insert(actor=actor, name="background")
    reserved = r"\(insert\): every scene has a part that is called '{}'\. Give the inserted actor another name"
    with pytest.raises(InputError, match="edit 1 " + reserved.format("background")):
        write_edited_run(run.store, run.scene, EditList(edits=(insert,)))
    with monkeypatch.context() as patch:
        patch.setattr(edited_runs, "_require_free_names", lambda *_, **__: None)
        edited = str(write_edited_run(run.store, run.scene, EditList(edits=(insert,)))["run"])
    # It is shown, and edited further; a new actor is refused there as well.
    assert name_actors(open_shown_scenes(run.store, edited))["background"] == "background"
    move = Move(actor="background", left_m=1.0)
    moved = open_edited_scenes(run.store, edited, EditList(edits=(move,)), SimulateConfig())
    assert moved.edits.edits == (insert, move)
    assert "background" in {node.track_id for node in moved.load(0).scene.actors}
    further = EditList(edits=(move, Insert(actor=actor, name="distant")))
    with pytest.raises(InputError, match="edit 3 " + reserved.format("distant")):
        open_edited_scenes(run.store, edited, further, SimulateConfig())
    found = list_node_names(run, edited, tmp_path / "out")
    assert {"background", "background-moving"} <= found
