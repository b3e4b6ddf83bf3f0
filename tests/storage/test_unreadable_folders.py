"""Folders of a store that cannot be listed: what is in them counts neither as gone nor as damaged."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from genre_tasks.errors import GenreError, InputError
from storage.artifact_folders import find_hidden
from storage.files import payload_files
from storage.local import LocalStore
from storage.manifest_writer import find_damaged_file
from tests.contracts.store_suite import address
from tests.ordinary_user import as_ordinary_user
from tests.storage.artifact_values import make


@pytest.fixture
def store(tmp_path: Path) -> Iterator[LocalStore]:
    """A store with an artifact in each of two chunks, and a run, of a user whom permissions bind."""
    made = LocalStore(tmp_path / "store")
    for chunk in (0, 1):
        made.commit(address(chunk=chunk), "novel_views", make("novel_views"))
    (made.root / "runs" / "aa").mkdir(parents=True)
    (made.root / "runs" / "aa" / "run.json").write_text("{}")
    # What imports modules comes first.
    assert [error for _, error in made.verify_all()] == [None, None]
    with as_ordinary_user(made.root) as folder:
        yield LocalStore(folder)


def close(folder: Path) -> None:
    folder.chmod(0o000)


def test_a_closed_folder_is_unreadable_and_hides_nothing_after_it(store: LocalStore) -> None:
    closed = store.root / "synthetic" / "street-seed=1" / "0000"
    close(closed)
    faults: dict[str, GenreError | None] = dict(store.verify_all())
    assert [type(fault) for fault in faults.values()] == [InputError, type(None)]
    assert next(iter(faults)) == closed.relative_to(store.root).as_posix()
    with pytest.raises(InputError, match=r"Not permitted.*0000"):
        list(store.artifacts())
    # A folder that is not asked for does not matter.
    assert len(list(store.artifacts(dataset="synthetic", log="street-seed=1", chunk=1))) == 1
    assert list(store.artifacts(dataset="nothing")) == []


def test_a_closed_folder_of_an_artifact_is_no_damage(store: LocalStore) -> None:
    artifact = next(store.artifacts(chunk=0))
    close(artifact.path / "views")
    with pytest.raises(InputError, match=r"Not permitted.*views"):
        store.verify(artifact)
    # A writer must not replace it either.
    with pytest.raises(PermissionError):
        find_damaged_file(artifact.path, artifact.manifest)


def test_a_manifest_that_may_not_be_read_is_no_program_fault(store: LocalStore) -> None:
    (next(store.artifacts(chunk=0)).path / "manifest.json").chmod(0o000)
    with pytest.raises(InputError, match=r"Not permitted.*manifest\.json"):
        list(store.artifacts())


def test_records_in_a_closed_folder_are_not_removed_ones(store: LocalStore) -> None:
    assert len(store.records.find("runs", "run.json")) == 1
    assert store.records.find("pins", "pin.json") == []
    # One that cannot be read is found, and its reader says so.
    close(store.root / "runs" / "aa")
    assert len(store.records.find("runs", "run.json")) == 1
    close(store.root / "runs")
    with pytest.raises(InputError, match=r"Not permitted.*runs"):
        store.records.find("runs", "run.json")


def test_a_disk_has_a_folder_of_its_own(store: LocalStore) -> None:
    folder = store.root / "lost+found"
    folder.mkdir()
    close(folder)
    assert len(list(store.artifacts())) == 2


def test_links_to_folders_are_files_of_a_payload(tmp_path: Path) -> None:
    (tmp_path / "real" / ".hidden").mkdir(parents=True)
    (tmp_path / "real" / ".hidden" / "b").write_text("x")
    (tmp_path / "real" / "a").symlink_to(tmp_path)
    assert [name for name, _ in payload_files(tmp_path / "real")] == [".hidden/b", "a"]
    assert list(payload_files(tmp_path / "nothing")) == []


def test_payload_is_not_searched_for_what_killed_processes_left(tmp_path: Path) -> None:
    store = LocalStore(tmp_path)
    artifact = store.commit(address(), "novel_views", make("novel_views"))
    (artifact.path / "views" / ".tmp-in-payload").mkdir()
    (artifact.path / ".tmp-in-artifact").mkdir()
    beside = artifact.path.parent / ".tmp-beside"
    (beside / ".tmp-below").mkdir(parents=True)
    assert set(find_hidden(tmp_path)) == {beside, artifact.path / ".tmp-in-artifact"}
