"""``genre export`` and ``genre import`` on a tiny run: files, documents, round trips, and an error for each mistake."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from flows.cli.main import app
from flows.exchange.export_request import ExportRequest
from flows.exchange.export_scenes import export_scenes
from flows.exchange.exporters import list_export_formats
from flows.exchange.import_scene import import_scene
from flows.exchange.stored_scenes import open_stored_scenes
from flows.reconstruction.run_records import list_runs
from flows.simulation.edit_file import parse_edit_options
from flows.simulation.edited_runs import write_edited_run
from flows.simulation.run_scenes import RunScenes
from flows.upkeep.store_copy import copy_store
from genre_tasks.errors import ConfigError, GenreError, InputError
from genre_tasks.exchange.conversion import to_scene_graph
from genre_tasks.exchange.one_cloud import make_resting_scene
from genre_tasks.exchange.registry import known_formats, load_format
from genre_tasks.exchange.scene_file import read_scene_file, read_scene_files
from genre_tasks.exchange.scene_folder import SCENE_FILE, read_document
from genre_tasks.exchange.types import SplatCloud
from genre_tasks.exchange.usd.format import USDZ
from genre_tasks.scene_edits.actor_names import name_actors
from storage.files import digest_file, payload_files
from storage.local import LocalStore
from tests.exchange.splat_clouds import make_cloud, make_driving_scene
from tests.flows.small_simulation import make_run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> ExportRequest:
    """A run of two chunks, to be exported as PLY."""
    store = tmp_path_factory.mktemp("exchange")
    return ExportRequest(store=str(store), scene=make_run(store), format="ply", out=store / "unused")


@pytest.fixture
def genre(run: ExportRequest) -> Callable[..., str]:
    """The command; its output."""

    def invoke(*words: object) -> str:
        done = CliRunner().invoke(app, [*map(str, words), "--store", run.store], catch_exceptions=False)
        assert done.exit_code == 0, done.output
        return done.output

    return invoke


def files_of(folder: Path) -> dict[str, bytes]:
    """Bytes by path."""
    return {name: path.read_bytes() for name, path in payload_files(folder)}


# --- what is written


def test_a_format_of_clouds_has_a_file_for_each_node(run: ExportRequest, tmp_path: Path) -> None:
    record = export_scenes(replace(run, out=tmp_path / "new" / "nodes"))
    document = read_document(tmp_path / "new" / "nodes")
    scenes = RunScenes(run.store, run.scene)
    names = set(name_actors(scenes).values())
    assert record["chunks"] == [0, 1] and document.layout == "nodes" and document.source["run"] == run.scene
    for chunk in document.chunks:
        loaded = scenes.load(chunk.chunk)
        assert {node.name for node in chunk.nodes} - {"background", "distant"} <= names
        assert sum(node.gaussians for node in chunk.nodes) == len(loaded.scene)
        assert chunk.frames == loaded.chunk.frames
        np.testing.assert_allclose(chunk.times_s, 0.1 * np.arange(6), atol=1e-6)
        np.testing.assert_array_equal(chunk.world_SE3_scene, loaded.chunk.world_SE3_chunk)
        assert chunk.source["stage"] == "initial"
        digests = scenes.payload_digests()
        assert chunk.source["payload_digest"] == digests[f"chunk {chunk.chunk} initial"]
        for node in chunk.nodes:
            assert node.file == f"chunk-{chunk.chunk}/{node.name}.ply"
    listed = {entry.path: entry.sha256 for entry in document.files}
    there = {name: digest_file(path) for name, path in payload_files(tmp_path / "new" / "nodes") if name != SCENE_FILE}
    assert listed == there and [*there] == record["files"]
    assert "scene.json" in " ".join(record["losses"])
    # Nothing else is left beside the folder.
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["nodes"]


@pytest.mark.parametrize("name", ["usdz", "glb"])
def test_a_format_of_nodes_has_a_file_for_each_chunk(run: ExportRequest, tmp_path: Path, name: str) -> None:
    record = export_scenes(replace(run, format=name, out=tmp_path / "out", chunks=(1,)))
    assert record["files"] == [f"chunk-1.{name}"]
    scene = read_scene_file(tmp_path / "out")
    expected = RunScenes(run.store, run.scene).load(1)
    assert scene.frames == expected.chunk.frames
    actors = {node.track_id: node for node in scene.nodes if node.motion is not None}
    assert set(actors) == {actor.track_id for actor in expected.scene.actors}
    for actor in expected.scene.actors:
        motion = actors[actor.track_id].motion
        assert motion is not None
        np.testing.assert_allclose(motion.scene_SE3_node[motion.present], actor.chunk_SE3_box, atol=1e-5)


def test_a_frame_is_the_scene_as_it_is_then(run: ExportRequest, tmp_path: Path) -> None:
    record = export_scenes(replace(run, out=tmp_path / "one", frame=8))
    assert record["files"] == ["chunk-1/frame-000008.ply"] and record["chunks"] == [1]
    cloud = read_scene_file(tmp_path / "one" / "chunk-1" / "frame-000008.ply").nodes[0].cloud
    posed = RunScenes(run.store, run.scene).load(1).scene.gaussians_at(8)
    shown = posed.logit_opacities > -29
    # Node by node in the file, and in the order of the scene there.
    order = np.lexsort(cloud.means.T)
    expected = posed.means[shown].numpy()
    np.testing.assert_allclose(cloud.means[order], expected[np.lexsort(expected.T)], atol=1e-4)
    record = export_scenes(replace(run, out=tmp_path / "all", all_frames=True))
    assert len(record["files"]) == 12
    one, other = (tmp_path / folder / "chunk-1" / "frame-000008.ply" for folder in ("one", "all"))
    assert one.read_bytes() == other.read_bytes()
    with pytest.raises(InputError, match="at single frames"):
        read_scene_file(tmp_path / "all")


@pytest.mark.parametrize("name", ["ply", "usdz"])
def test_actors_alone_are_in_their_own_coordinates(run: ExportRequest, tmp_path: Path, name: str) -> None:
    export_scenes(replace(run, format=name, out=tmp_path / "actors", per_actor=True, chunks=(0,)))
    scene = read_scene_file(tmp_path / "actors")
    actors = RunScenes(run.store, run.scene).load(0).scene.actors
    assert {node.track_id for node in scene.nodes} == {actor.track_id for actor in actors} and actors
    for node in scene.nodes:
        assert node.motion is not None and node.motion.present.any()
        # Its box is around the origin.
        assert np.abs(node.cloud.means).max(initial=0) < max(node.size_m)


def test_the_same_export_gives_the_same_bytes(run: ExportRequest, tmp_path: Path) -> None:
    for name in ("ply", "usdz", "glb", "spz", "splat"):
        for out in ("a", "b"):
            export_scenes(replace(run, format=name, out=tmp_path / name / out, chunks=(0,)))
        assert files_of(tmp_path / name / "a") == files_of(tmp_path / name / "b")


# --- in and out again


def test_a_round_trip_of_ply_is_exact(run: ExportRequest, tmp_path: Path) -> None:
    export_scenes(replace(run, out=tmp_path / "first"))
    store = str(tmp_path / "store")
    record = import_scene(store, tmp_path / "first", "street")
    assert [chunk["chunk"] for chunk in record["chunks"]] == [0, 1]
    export_scenes(ExportRequest(store=store, scene="street", format="ply", out=tmp_path / "second"))
    first = files_of(tmp_path / "first")
    second = files_of(tmp_path / "second")
    documents = [json.loads(files.pop(SCENE_FILE)) for files in (first, second)]
    assert first == second and len(first) > 4
    for before, after in zip(*(document["chunks"] for document in documents), strict=True):
        for name in ("chunk", "world_SE3_scene", "times_s", "frames", "losses", "nodes"):
            assert before[name] == after[name]


@pytest.mark.parametrize("name", ["ply", "usdz"])
def test_an_imported_scene_is_the_one_of_the_run(run: ExportRequest, tmp_path: Path, name: str) -> None:
    export_scenes(replace(run, format=name, out=tmp_path / "out"))
    for number, scene in read_scene_files(tmp_path / "out").items():
        found = to_scene_graph(scene)
        expected = RunScenes(run.store, run.scene).load(number).scene
        # Parts lie one after the other in a file: sorted by node, in the order of the scene within each.
        order = torch.argsort(expected.nodes, stable=True)
        for attribute in ("means", "log_scales", "colors"):
            before = getattr(expected.gaussians, attribute)[order]
            torch.testing.assert_close(getattr(found.gaussians, attribute), before, atol=1e-6, rtol=1e-6)
        assert torch.equal(found.nodes, expected.nodes[order]) and found.antialiased == expected.antialiased


def test_commands_find_an_imported_scene(genre: Callable[..., str], tmp_path: Path) -> None:
    cloud = write_random_scene(tmp_path / "street.ply")
    printed = genre("import", tmp_path / "street.ply")
    assert "street, chunk 0" in printed and "300" in printed
    key = printed.rpartition("key ")[2].strip()
    assert "reconstruction" in genre("show", key, "--picture", tmp_path / "map.png")
    assert (tmp_path / "map.png").is_file()
    # By key and by name; the same file again is the same artifact.
    assert key in genre("import", tmp_path / "street.ply")
    for word in (key, "street"):
        genre("export", word, "--format", "ply", "--out", tmp_path / word)
    found = read_scene_file(tmp_path / "street").nodes[0].cloud
    np.testing.assert_allclose(found.sh_rest, cloud.sh_rest)
    assert files_of(tmp_path / "street") == files_of(tmp_path / key)


def write_random_scene(path: Path, count: int = 300) -> SplatCloud:
    """Writes a file of random Gaussians with harmonics of degree 3; their cloud."""
    cloud = make_cloud(count, 3)
    load_format("ply").write(path, make_resting_scene(cloud))
    return cloud


def test_a_name_with_two_files_asks_for_a_key(genre: Callable[..., str], run: ExportRequest, tmp_path: Path) -> None:
    for folder, count in (("a", 5), ("b", 6)):
        (tmp_path / folder).mkdir()
        write_random_scene(tmp_path / folder / "twice.ply", count)
        genre("import", tmp_path / folder / "twice.ply")
    with pytest.raises(InputError, match="several imported scenes") as caught:
        export_scenes(replace(run, scene="twice", out=tmp_path / "out"))
    key = caught.value.remedy.split()[-1].strip(".")
    assert export_scenes(replace(run, scene=key, out=tmp_path / "out"))["gaussians"] in (5, 6)


def test_a_changed_file_is_read_and_named(run: ExportRequest, tmp_path: Path) -> None:
    export_scenes(replace(run, out=tmp_path / "out", chunks=(0,)))
    path = tmp_path / "out" / "chunk-0" / "background.ply"
    scene = load_format("ply").read(path)
    cleaned = replace(scene.nodes[0], cloud=scene.nodes[0].cloud.select(slice(0, 10)))
    load_format("ply").write(path, replace(scene, nodes=(cleaned,)))
    record = import_scene(str(tmp_path / "store"), tmp_path / "out")
    assert record["chunks"][0]["nodes"][0]["gaussians"] == 10
    assert "chunk-0/background.ply was changed after the export." in record["chunks"][0]["warnings"]


def test_an_edited_run_is_exported_as_it_is(run: ExportRequest, tmp_path: Path) -> None:
    names = name_actors(RunScenes(run.store, run.scene))
    removed = names["car-0"]
    edited = write_edited_run(run.store, run.scene, parse_edit_options(remove=[removed]))["run"]
    export_scenes(replace(run, scene=edited, out=tmp_path / "out"))
    found = {node.name for chunk in read_document(tmp_path / "out").chunks for node in chunk.nodes}
    assert found == {"background", "distant", *names.values()} - {removed}


def test_the_whole_name_of_an_imported_scene_is_not_the_start_of_a_run(run: ExportRequest, tmp_path: Path) -> None:
    store = str(tmp_path / "store")
    name = run.scene[:2]
    shutil.copytree(run.store, store)
    write_random_scene(tmp_path / f"{name}.ply", 5)
    import_scene(store, tmp_path / f"{name}.ply", name)
    assert "run" not in open_stored_scenes(store, name).describe()
    assert open_stored_scenes(store, run.scene).describe()["run"] == run.scene


def test_a_copied_edited_run_has_the_run_that_it_is_made_from(run: ExportRequest, tmp_path: Path) -> None:
    actor = name_actors(RunScenes(run.store, run.scene))["car-0"]
    edited = write_edited_run(run.store, run.scene, parse_edit_options(remove=[actor]))
    target = LocalStore(tmp_path / "copy")
    copied = copy_store(LocalStore(Path(run.store)), target, runs=[str(edited["run"])])
    assert copied.records == 2
    assert {record["run"] for record in list_runs(target.uri)} == {edited["run"], run.scene}


def test_names_of_somebody_else_do_not_leave_the_folder(tmp_path: Path) -> None:
    scene = make_driving_scene()
    names = ("../../up", "/etc/x", "background", "Ünï cødé/..")
    nodes = tuple(replace(node, name=name) for node, name in zip(scene.nodes, names, strict=True))
    # Two actors with one track id, one of them called as the background is, and frames that do not rise.
    nodes = tuple(replace(node, track_id="7") if node.motion is not None else node for node in nodes)
    USDZ.write(tmp_path / "odd.usdz", replace(scene, nodes=nodes, frames=(3, 3, 2, 1, 0)))
    store = str(tmp_path / "store")
    record = import_scene(store, tmp_path / "odd.usdz")
    assert record["chunks"][0]["gaussians"] == sum(len(node.cloud) for node in nodes)
    out = tmp_path / "deep" / "out"
    export_scenes(ExportRequest(store=store, scene="odd", format="ply", out=out))
    # What rests is one background in a scene graph.
    assert sorted(files_of(out)) == [
        "chunk-0/background-moving.ply",
        "chunk-0/background.ply",
        "chunk-0/Ünï-cødé.ply",
        SCENE_FILE,
    ]
    again = read_scene_file(out)
    assert again.frames == (0, 1, 2, 3, 4) and len({node.track_id for node in again.nodes if node.motion}) == 2


def test_an_actor_that_never_appears_is_kept(tmp_path: Path) -> None:
    scene = make_driving_scene()
    motion = scene.nodes[2].motion
    assert motion is not None
    absent = replace(motion, present=np.zeros(len(scene.times_s), bool))
    USDZ.write(tmp_path / "a.usdz", replace(scene, nodes=(scene.nodes[0], replace(scene.nodes[2], motion=absent))))
    store = str(tmp_path / "store")
    import_scene(store, tmp_path / "a.usdz")
    export_scenes(ExportRequest(store=store, scene="a", format="usdz", out=tmp_path / "out"))
    found = read_scene_file(tmp_path / "out").nodes[1].motion
    assert found is not None and not found.present.any()


# --- the command


def test_the_commands_print_what_they_did(genre: Callable[..., str], run: ExportRequest, tmp_path: Path) -> None:
    printed = genre("export", run.scene, "--format", "splat", "--out", tmp_path / "out", "--chunks", "0")
    assert "splat files" in printed and "not in the files:" in printed and "rounded to 256 steps" in printed
    printed = genre("import", tmp_path / "out", "--json")
    record = json.loads(printed[printed.index("{") :])
    assert record["status"] == "done" and record["name"] == "out" and record["chunks"][0]["nodes"]
    printed = genre("export", run.scene, "--format", "ply", "--out", tmp_path / "new", "--json", "--frame", 3)
    record = json.loads(printed[printed.index("{") :])
    assert record["files"] == ["chunk-0/frame-000003.ply"] and record["source"]["run"] == run.scene


def test_progress_names_each_file(run: ExportRequest, tmp_path: Path) -> None:
    notes: list[str] = []
    export_scenes(replace(run, out=tmp_path / "out"), lambda done, total, note="": notes.append(note))
    assert notes[0] == "chunk-0/background" and len(notes) == len(read_document(tmp_path / "out").files)


# --- mistakes


@pytest.mark.parametrize(
    ("change", "kind", "words"),
    [
        ({"format": "plyy"}, ConfigError, "Did you mean 'ply'"),
        ({"format": "compressed.ply"}, ConfigError, "only read"),
        ({"scene": "zzz"}, InputError, "0 runs"),
        ({"chunks": (7,)}, InputError, "no chunk 7"),
        ({"stage": "enet"}, InputError, "no stage 'enet'"),
        ({"frame": 99}, InputError, "none of the chunks 0, 1 has frame 99"),
        ({"frame": 3, "chunks": (1,)}, InputError, "none of the chunks 1 has frame 3"),
    ],
)
def test_mistakes_of_exports_are_named(
    run: ExportRequest, tmp_path: Path, change: dict[str, object], kind: type[GenreError], words: str
) -> None:
    with pytest.raises(kind, match=words):
        export_scenes(replace(run, out=tmp_path / "out", **change))  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


def test_options_that_exclude_each_other(run: ExportRequest) -> None:
    with pytest.raises(ConfigError, match="--frame and --per-actor exclude each other"):
        replace(run, frame=3, per_actor=True)


def test_an_export_is_replaced_only_when_asked(run: ExportRequest, tmp_path: Path) -> None:
    out = tmp_path / "out"
    export_scenes(replace(run, out=out, chunks=(0,)))
    before = files_of(out)
    with pytest.raises(ConfigError, match="--overwrite"):
        export_scenes(replace(run, out=out, chunks=(1,)))
    assert files_of(out) == before
    export_scenes(replace(run, out=out, chunks=(1,), overwrite=True))
    assert set(files_of(out)) != set(before)
    # A file of the user's among them, and a folder that is no export's.
    (out / "thesis.txt").write_text("years of work")
    with pytest.raises(InputError, match="no export's"):
        export_scenes(replace(run, out=out, overwrite=True))
    (out / SCENE_FILE).unlink()
    with pytest.raises(InputError, match="no export's"):
        export_scenes(replace(run, out=out, overwrite=True))
    assert (out / "thesis.txt").read_text() == "years of work"


def test_an_interrupted_export_leaves_nothing(run: ExportRequest, tmp_path: Path) -> None:
    class StoppedError(BaseException):
        pass

    def stop(done: int, total: int, note: str = "") -> None:
        if done == 1:
            raise StoppedError

    with pytest.raises(StoppedError):
        export_scenes(replace(run, out=tmp_path / "out"), stop)
    assert not list(tmp_path.iterdir())


def test_a_scene_that_rests_has_no_actors_and_no_frames(tmp_path: Path) -> None:
    write_random_scene(tmp_path / "rest.ply")
    store = str(tmp_path / "store")
    import_scene(store, tmp_path / "rest.ply")
    request = ExportRequest(store=store, scene="rest", format="ply", out=tmp_path / "out")
    for change, words in (
        ({"per_actor": True}, "no actors"),
        ({"all_frames": True}, "nothing in it moves"),
        ({"stage": "enet"}, "no stages"),
        ({"chunks": (3,)}, "no chunk 3"),
    ):
        with pytest.raises(GenreError, match=words):
            export_scenes(replace(request, **change))  # type: ignore[arg-type]


def test_formats_that_are_written_are_listed() -> None:
    files = [name for name in list_export_formats() if name in known_formats()]
    assert len(files) == 5
    for name in files:
        assert load_format(name).can_write
