"""Imported scenes by name and key: one file is one scene, and a name that means several says how to choose."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from flows.exchange import import_scene as import_module
from flows.exchange.export_request import ExportRequest
from flows.exchange.export_scenes import export_scenes
from flows.exchange.import_scene import import_scene
from flows.exchange.stored_scenes import open_stored_scenes
from genre_tasks.errors import InputError
from genre_tasks.exchange.one_cloud import make_resting_scene
from genre_tasks.exchange.registry import load_format
from tests.exchange.splat_clouds import make_cloud
from tests.flows.small_simulation import make_run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> ExportRequest:
    """A run of two chunks, to be exported as PLY."""
    store = tmp_path_factory.mktemp("exchange")
    return ExportRequest(store=str(store), scene=make_run(store), format="ply", out=store / "unused")


@pytest.fixture
def store(tmp_path: Path) -> str:
    """A store without anything."""
    return str(tmp_path / "store")


def write_cloud(path: Path, count: int = 5) -> Path:
    load_format("ply").write(path, make_resting_scene(make_cloud(count)))
    return path


def edit_background(folder: Path) -> None:
    """Removes all but ten Gaussians of a file, as an editor of Gaussians does."""
    path = folder / "chunk-0" / "background.ply"
    scene = load_format("ply").read(path)
    cleaned = replace(scene.nodes[0], cloud=scene.nodes[0].cloud.select(slice(0, 10)))
    load_format("ply").write(path, replace(scene, nodes=(cleaned,)))


def find_keys(error: InputError) -> list[str]:
    return re.findall(r" of \d{4}-\d\d-\d\d \d\d:\d\d:\d\d has ([0-9a-f]{12})\b", error.remedy)


def count_background(store: str, name: str) -> int:
    return len(open_stored_scenes(store, name).load(0).nodes[0].cloud)


class StoppedError(BaseException):
    """What an interrupted command ends by."""


def stop_after_one(done: int, total: int, note: str = "") -> None:
    if done == 1:
        raise StoppedError


def import_one_chunk(store: str, folder: Path) -> None:
    with pytest.raises(StoppedError):
        import_scene(store, folder, "street", stop_after_one)


def test_chunks_of_two_files_are_not_one_scene(run: ExportRequest, store: str, tmp_path: Path) -> None:
    for number in (0, 1):
        export_scenes(replace(run, out=tmp_path / f"log-{number}", chunks=(number,)))
        import_scene(store, tmp_path / f"log-{number}", "street")
    with pytest.raises(InputError, match="several imported scenes are called 'street'") as caught:
        open_stored_scenes(store, "street")
    assert "another --name" in caught.value.remedy
    found = [open_stored_scenes(store, key).chunk_numbers for key in find_keys(caught.value)]
    assert sorted(map(list, found)) == [[0], [1]]


def test_a_key_means_all_chunks_of_its_import(run: ExportRequest, store: str, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    export_scenes(replace(run, out=folder))
    records = [import_scene(store, folder, "street")]
    edit_background(folder)
    records.append(import_scene(store, folder, "street"))
    with pytest.raises(InputError, match="several imported scenes") as caught:
        open_stored_scenes(store, "street")
    keys = find_keys(caught.value)
    # One for each import, and the keys of all chunks are as good.
    assert len(keys) == 2
    for key in [*keys, *(chunk["key"] for record in records for chunk in record["chunks"])]:
        assert open_stored_scenes(store, key).chunk_numbers == [0, 1]
    assert 10 in [count_background(store, key) for key in keys]
    assert [count_background(store, record["chunks"][1]["key"]) == 10 for record in records] == [False, True]


def test_an_interrupted_import_is_not_exported(run: ExportRequest, store: str, tmp_path: Path) -> None:
    export_scenes(replace(run, out=tmp_path / "out"))
    import_one_chunk(store, tmp_path / "out")
    with pytest.raises(InputError, match=r"1 of 2 chunks.*Import the file again"):
        export_scenes(ExportRequest(store=store, scene="street", format="ply", out=tmp_path / "again"))
    record = import_scene(store, tmp_path / "out", "street")
    for name in ("street", record["chunks"][0]["key"]):
        assert open_stored_scenes(store, name).chunk_numbers == [0, 1]


def test_imports_from_before_chunks_were_counted_are_opened(
    run: ExportRequest, store: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    export_scenes(replace(run, out=tmp_path / "out"))
    with monkeypatch.context() as patch:
        patch.setattr(import_module, "CHUNK_COUNT", "unknown to this version")
        import_one_chunk(store, tmp_path / "out")
    assert open_stored_scenes(store, "street").chunk_numbers == [0]
    import_scene(store, tmp_path / "out", "street")
    assert open_stored_scenes(store, "street").chunk_numbers == [0, 1]


def test_a_file_that_newer_code_reads_again_is_one_scene(
    run: ExportRequest, store: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    export_scenes(replace(run, out=tmp_path / "out"))
    key = import_scene(store, tmp_path / "out", "street")["chunks"][0]["key"]
    monkeypatch.setattr(import_module, "code_digest", lambda *modules: "newer")
    import_one_chunk(store, tmp_path / "out")
    # The newer import is not complete, and holds nothing else.
    assert open_stored_scenes(store, "street").describe_chunk(0)["key"] == key
    newer = import_scene(store, tmp_path / "out", "street")["chunks"][1]["key"]
    for name in ("street", key, newer):
        assert open_stored_scenes(store, name).chunk_numbers == [0, 1]
    assert open_stored_scenes(store, newer).describe_chunk(1)["key"] == newer


def test_a_file_under_two_names_is_found_by_its_key(store: str, tmp_path: Path) -> None:
    write_cloud(tmp_path / "a.ply")
    keys = {import_scene(store, tmp_path / "a.ply", name)["chunks"][0]["key"] for name in ("one", "two")}
    (key,) = keys
    assert count_background(store, key) == count_background(store, key[:8]) == 5
    assert open_stored_scenes(store, "two").describe()["imported"] == "two"


def test_the_unique_start_of_a_name_is_enough(store: str, tmp_path: Path) -> None:
    for count, name in enumerate(("street-a", "street-b", "garden"), start=5):
        import_scene(store, write_cloud(tmp_path / f"{name}.ply", count))
    assert open_stored_scenes(store, "gar").describe()["imported"] == "garden"
    with pytest.raises(InputError, match="several imported scenes begin with 'street'") as caught:
        open_stored_scenes(store, "street")
    assert "street-a of 2" in caught.value.remedy and len(find_keys(caught.value)) == 2
    # Also where both are of the same file: the user means one of two names.
    import_scene(store, tmp_path / "garden.ply", "garage")
    with pytest.raises(InputError, match="begin with 'gar'"):
        open_stored_scenes(store, "gar")
    import_scene(store, write_cloud(tmp_path / "street.ply", 9))
    assert count_background(store, "street") == 9


@pytest.mark.parametrize("word", ["gardn", ""])
def test_an_unknown_name_is_answered_by_the_known_ones(store: str, tmp_path: Path, word: str) -> None:
    for name in ("garden", "street"):
        import_scene(store, write_cloud(tmp_path / f"{name}.ply"))
    with pytest.raises(InputError, match="0 runs and 0 imported scenes") as caught:
        open_stored_scenes(store, word)
    assert "Imported scenes: garden, street." in caught.value.remedy
    assert ("Did you mean 'garden'" in caught.value.remedy) == bool(word)


def test_the_name_of_a_run_is_not_the_start_of_an_imported_one(run: ExportRequest, tmp_path: Path) -> None:
    store = str(tmp_path / "copy")
    shutil.copytree(run.store, store)
    import_scene(store, write_cloud(tmp_path / "scene.ply"), f"{run.scene}-cleaned")
    with pytest.raises(InputError, match="a run and an imported scene begin with"):
        open_stored_scenes(store, run.scene[:6])
    import_scene(store, write_cloud(tmp_path / "scene.ply", 6), f"{run.scene}-thinned")
    assert open_stored_scenes(store, run.scene).describe()["run"] == run.scene
    assert count_background(store, f"{run.scene}-t") == 6
