"""The local store: the contract, and what is its own (layout, moving, temporaries, permissions, processes)."""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import time
from pathlib import Path
from typing import Any

import pytest

from genre_tasks.errors import ArtifactCorruptError, ConfigError
from genre_tasks.temporary_names import describe_owner
from storage import local
from storage.artifact_folders import last_modified
from storage.local import LocalStore, Provenance
from storage.manifest import MANIFEST, NewerSchemaError
from storage.opening import open_local_store
from tests.contracts.store_suite import KEY, OTHER, StoreSuite, address
from tests.storage.artifact_values import COLORS, MAKERS, assert_same, make


class TestLocalStore(StoreSuite):
    @pytest.fixture
    def store(self, tmp_path: Path) -> LocalStore:
        return LocalStore(tmp_path / "store")

    @pytest.fixture
    def second(self, store: LocalStore) -> LocalStore:
        return open_local_store(store.root.as_uri())


def test_layout_can_be_walked(tmp_path: Path) -> None:
    artifact = LocalStore(tmp_path).commit(address("evaluate/gnet"), "evaluation", make("evaluation"))
    assert artifact.path == tmp_path / "synthetic/street-seed=1/0000/evaluate/gnet" / KEY
    assert [p.name for p in artifact.path.parent.iterdir()] == [KEY]
    manifest = json.loads((artifact.path / MANIFEST).read_text())
    assert manifest["stage"] == "evaluate/gnet" and manifest["schema_version"] == 1
    assert {f["path"] for f in manifest["files"]} | {MANIFEST} == {
        p.relative_to(artifact.path).as_posix() for p in artifact.path.rglob("*") if p.is_file()
    }
    assert str(tmp_path) not in (artifact.path / MANIFEST).read_text()


def test_a_moved_store_works(tmp_path: Path) -> None:
    store = LocalStore(tmp_path / "here")
    for kind in MAKERS:
        store.commit(address(kind), kind, make(kind))
    shutil.move(store.root, tmp_path / "there")
    moved = LocalStore(tmp_path / "there")
    for kind in MAKERS:
        artifact = moved.find(address(kind))
        assert artifact is not None
        assert_same(make(kind), moved.read(artifact), kind, COLORS)


def test_an_artifact_moved_to_another_key_is_refused(tmp_path: Path) -> None:
    store = LocalStore(tmp_path)
    artifact = store.commit(address(), "evaluation", make("evaluation"))
    elsewhere = address(key="f" * 64)
    shutil.copytree(artifact.path, tmp_path / elsewhere.relative_path)
    with pytest.raises(ArtifactCorruptError, match="belongs to"):
        store.find(elsewhere)
    assert [a.address for a in store.artifacts()] == [artifact.address]
    assert {Path(name).name: error is None for name, error in store.verify_all()} == {KEY: True, "f" * 64: False}


def test_no_manifest_no_artifact(tmp_path: Path) -> None:
    store = LocalStore(tmp_path)
    artifact = store.commit(address(), "evaluation", make("evaluation"))
    (artifact.path / MANIFEST).unlink()
    assert store.find(address()) is None
    assert list(store.artifacts()) == []
    store.verify(store.commit(address(), "evaluation", make("evaluation")))


def test_an_unreadable_manifest_is_found_checked_and_replaced(tmp_path: Path) -> None:
    store = LocalStore(tmp_path)
    artifact = store.commit(address(), "evaluation", make("evaluation"))
    (artifact.path / MANIFEST).write_text("{")
    with pytest.raises(ArtifactCorruptError, match=r"not readable.*manifest\.json"):
        store.find(address())
    ((_, error),) = store.verify_all()
    assert error is not None
    store.verify(store.commit(address(), "evaluation", make("evaluation")))


def test_a_newer_schema_is_neither_read_nor_removed(tmp_path: Path) -> None:
    store = LocalStore(tmp_path)
    artifact = store.commit(address(), "evaluation", make("evaluation"))
    (artifact.path / MANIFEST).write_text(json.dumps({"schema_version": 2, "anything": 1}))
    for act in (
        lambda: store.find(address()),
        lambda: store.discard(address()),
        lambda: store.commit(address(), "evaluation", make("evaluation")),
    ):
        with pytest.raises(NewerSchemaError, match=r"schema version 2, this version knows up to 1.*Update"):
            act()
    assert (artifact.path / "metrics.parquet").exists()
    assert [p.name for p in artifact.path.parent.iterdir()] == [KEY]


def test_unexpected_and_missing_files_are_named(tmp_path: Path) -> None:
    store = LocalStore(tmp_path)
    artifact = store.commit(address(), "novel_views", make("novel_views"))
    extra = artifact.path / "views" / "extra.exr"
    extra.write_bytes(b"x")
    with pytest.raises(ArtifactCorruptError, match=r"not in the manifest.*extra\.exr"):
        store.verify(artifact)
    extra.unlink()
    store.verify(artifact)
    victim = next((artifact.path / "views").iterdir())
    kept = victim.read_bytes()
    victim.unlink()
    with pytest.raises(ArtifactCorruptError, match="is missing") as caught:
        store.verify(artifact)
    assert caught.value.file == str(victim) and caught.value.log == "street-seed=1" and caught.value.stage == "gnet"
    other = tmp_path / "other.exr"
    other.write_bytes(kept)
    victim.symlink_to(other)
    with pytest.raises(ArtifactCorruptError, match="is a link"):
        store.read(artifact)


def test_temporaries_of_killed_processes_are_cleaned_by_age(tmp_path: Path) -> None:
    store = LocalStore(tmp_path)
    artifact = store.commit(address(), "evaluation", make("evaluation"))
    for name in (".tmp-old", ".trash-old", ".tmp-new"):
        (artifact.path.parent / name / "sub").mkdir(parents=True)
        (artifact.path.parent / name / "sub" / "file").write_bytes(b"x")
    before = time.time() - 7200
    for name in (".tmp-old", ".trash-old"):
        for path in (artifact.path.parent / name).rglob("*"):
            os.utime(path, (before, before))
        os.utime(artifact.path.parent / name, (before, before))
    assert [a.address for a in store.artifacts()] == [artifact.address]
    assert store.clean_temporaries(older_than_s=3600) == 2
    assert sorted(p.name for p in artifact.path.parent.iterdir()) == [".tmp-new", KEY]
    store.verify(artifact)


def test_an_old_folder_of_a_living_process_stays(tmp_path: Path) -> None:
    """A process that was suspended for hours goes on with what it was writing."""
    store = LocalStore(tmp_path)
    artifact = store.commit(address(), "evaluation", make("evaluation"))
    living = artifact.path.parent / f".tmp-gnet-{describe_owner()}-1"
    living.mkdir()
    before = time.time() - 7200
    os.utime(living, (before, before))
    assert store.clean_temporaries(older_than_s=3600) == 0 and living.is_dir()


def test_folders_that_disappear_meanwhile_end_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other processes commit, collect and repair while a store is listed and cleaned."""
    store = LocalStore(tmp_path)
    artifact = store.commit(address(), "evaluation", make("evaluation"))
    other = store.commit(address(key=OTHER), "evaluation", make("evaluation"))
    real = local.load_manifest

    def removed_first(folder: Path) -> Any:
        if folder == other.path:
            shutil.rmtree(folder)
        return real(folder)

    monkeypatch.setattr(local, "load_manifest", removed_first)
    assert [found.address for found in store.artifacts()] == [artifact.address]
    assert last_modified(tmp_path / "nothing") == pytest.approx(time.time(), abs=60)
    names = os.walk

    def vanishing(top: Any, **options: Any) -> Any:
        for base, folders, files in names(top, **options):
            yield base, folders, [*files, "gone"]

    monkeypatch.setattr(os, "walk", vanishing)
    assert last_modified(artifact.path) <= time.time()


def test_a_corrupt_one_that_another_writer_repaired_meanwhile_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = LocalStore(tmp_path)
    artifact = store.commit(address(), "evaluation", make("evaluation"))
    good = {p: p.read_bytes() for p in artifact.path.rglob("*") if p.is_file()}
    (artifact.path / "curve.parquet").write_bytes(b"bad")
    judge, calls = LocalStore._is_sound, []

    def repaired_after_the_first_look(self: LocalStore, path: Path, at: object) -> bool:
        answer = judge(self, path, at)  # type: ignore[arg-type]
        if not calls:
            for p, data in good.items():
                p.write_bytes(data)
        calls.append(answer)
        return answer

    monkeypatch.setattr(LocalStore, "_is_sound", repaired_after_the_first_look)
    after = store.commit(address(), "evaluation", make("evaluation"), Provenance(warnings=("late",)))
    assert calls[:2] == [False, True] and after.manifest.warnings == ()
    store.verify(after)


def _commit(root: str, seed: int, start: object, results: object) -> None:
    start.wait()  # type: ignore[attr-defined]
    provenance = Provenance(warnings=(str(seed),))
    made = LocalStore(Path(root)).commit(address(), "evaluation", make("evaluation", seed), provenance)
    results.put(made.manifest.warnings)  # type: ignore[attr-defined]


def test_two_processes_on_one_key(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")  # a fork would take along what other tests started here
    start, results = context.Barrier(2), context.Queue()
    workers = [context.Process(target=_commit, args=(str(tmp_path), seed, start, results)) for seed in (1, 2)]
    for worker in workers:
        worker.start()
    said = {results.get(timeout=60) for _ in workers}
    for worker in workers:
        worker.join(60)
        assert worker.exitcode == 0
    assert len(said) == 1
    artifact = LocalStore(tmp_path).find(address())
    assert artifact is not None and artifact.manifest.warnings in said
    assert_same(make("evaluation", int(artifact.manifest.warnings[0])), LocalStore(tmp_path).read(artifact))
    assert [p.name for p in artifact.path.parent.iterdir()] == [KEY]


@pytest.mark.parametrize("uri", ["s3://bucket/x", "http://host/x", "file://elsewhere/x", "", "file://"])
def test_unknown_schemes_are_refused(uri: str) -> None:
    with pytest.raises(ConfigError, match="no known kind"):
        open_local_store(uri)


def test_paths_and_file_uris_open(tmp_path: Path) -> None:
    odd = tmp_path / "a b#c"
    assert open_local_store(str(odd)).root == odd == open_local_store(odd.as_uri()).root
