"""A disk that fills up, fails or refuses in the middle of a commit: one clear error, nothing half-written."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from genre_tasks.errors import (
    ArtifactCorruptError,
    DiskFullError,
    GenreError,
    InputError,
    ResourceError,
    TransientIOError,
)
from storage.local import LocalStore
from tests.contracts.store_suite import address
from tests.ordinary_user import as_ordinary_user
from tests.storage.artifact_values import MAKERS, make

ROOT = Path(__file__).parents[2]


def failing(call: str, after: int, code: int, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Let ``os.<call>`` fail from its ``after``-th use on; the list counts the uses."""
    real, uses = getattr(os, call), [0]

    def fake(*args: object, **kwargs: object) -> object:
        uses[0] += 1
        if uses[0] > after:
            raise OSError(code, os.strerror(code))
        return real(*args, **kwargs)

    monkeypatch.setattr(os, call, fake)
    return uses


def leftovers(root: Path) -> list[Path]:
    return [p for p in root.rglob("*") if p.is_file()]


@pytest.mark.parametrize("kind", MAKERS)
@pytest.mark.parametrize("call", ["write", "fsync"])
def test_a_full_disk_at_every_moment_of_a_commit(
    kind: str, call: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    value, after = make(kind), 0
    while True:
        store = LocalStore(tmp_path / str(after))
        with monkeypatch.context() as patch:
            uses = failing(call, after, errno.ENOSPC, patch)
            try:
                store.commit(address(), kind, value)
                assert uses[0] <= after
                break
            except DiskFullError as error:
                assert "disk is full" in str(error) and "--store" in error.remedy and error.stage == "gnet"
                assert str(tmp_path) in str(error.file)
        found = store.find(address())
        if found is None:
            assert leftovers(store.root) == []
        else:  # only the last sync, of the folder above, comes after the rename
            assert call == "fsync" and after == uses[0] - 1
            store.verify(found)
        after += 1
    assert after >= len(store.find(address()).manifest.files) + 1  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("code", "kind"),
    [
        (errno.EDQUOT, DiskFullError),
        (errno.EFBIG, DiskFullError),
        (errno.EMFILE, ResourceError),
        (errno.EIO, TransientIOError),
        (errno.EAGAIN, TransientIOError),
        (errno.ESTALE, TransientIOError),
        (errno.EACCES, InputError),
        (errno.EROFS, InputError),
        (errno.ENAMETOOLONG, InputError),
    ],
)
def test_each_error_of_the_system_has_its_kind(
    code: int, kind: type[GenreError], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = LocalStore(tmp_path)
    with monkeypatch.context() as patch, pytest.raises(kind, match=errno.errorcode[code]) as caught:
        failing("write", 1, code, patch)
        store.commit(address(), "evaluation", make("evaluation"))
    assert caught.value.file is not None and caught.value.remedy
    assert store.find(address()) is None and leftovers(tmp_path) == []


def test_a_full_disk_loses_nothing_that_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = LocalStore(tmp_path)
    one = store.commit(address(), "evaluation", make("evaluation"))
    with monkeypatch.context() as patch, pytest.raises(DiskFullError):
        failing("write", 2, errno.ENOSPC, patch)
        store.commit(address("enet"), "evaluation", make("evaluation"))
    store.verify(one)
    assert [a.address for a in store.artifacts()] == [one.address]


def test_short_writes_are_continued(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = os.write
    monkeypatch.setattr(os, "write", lambda handle, data: real(handle, data[:100]))
    store = LocalStore(tmp_path)
    written = store.commit(address(), "chunk", make("chunk"))
    # Reading checks digests of whole files, so a part that was not written would be an error.
    assert store.read(written).views


def test_reading_fails_for_a_while(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = LocalStore(tmp_path)
    artifact = store.commit(address(), "evaluation", make("evaluation"))
    real = Path.open

    def fake(self: Path, *args: object, **kwargs: object) -> object:
        if self.name == "curve.parquet":
            raise OSError(errno.EIO, os.strerror(errno.EIO), str(self))
        return real(self, *args, **kwargs)  # type: ignore[call-overload]

    with monkeypatch.context() as patch, pytest.raises(TransientIOError, match=r"curve\.parquet"):
        patch.setattr(Path, "open", fake)
        store.read(artifact)
    store.read(artifact)


def test_a_file_where_the_store_should_be(tmp_path: Path) -> None:
    (tmp_path / "store").write_text("x")
    store = LocalStore(tmp_path / "store")
    assert store.find(address()) is None
    with pytest.raises(InputError, match="is a folder"):
        store.commit(address(), "evaluation", make("evaluation"))


def test_a_folder_without_permission(tmp_path: Path) -> None:
    value = make("evaluation")
    LocalStore(tmp_path / "store").commit(address(), "evaluation", value)
    with as_ordinary_user() as folder:
        folder.chmod(0o555)
        with pytest.raises(InputError, match="Not permitted"):
            LocalStore(folder / "store").commit(address(), "evaluation", value)


def test_a_real_limit_on_the_size_of_files(tmp_path: Path) -> None:
    """The kernel itself refuses, inside the writers of Parquet and EXR, and a later run without the limit succeeds."""
    kinds = ["chunk", "fixed_views"]
    code = """
import resource, sys
from pathlib import Path
from genre_tasks.errors import ResourceError
from storage.local import LocalStore
from tests.contracts.store_suite import address
from tests.storage.artifact_values import make
resource.setrlimit(resource.RLIMIT_FSIZE, (1500, 1500))
for kind in sys.argv[2:]:
    try:
        LocalStore(Path(sys.argv[1])).commit(address(kind), kind, make(kind))
    except ResourceError as error:
        print(kind, "EFBIG" in str(error))
"""
    command = [sys.executable, "-c", code, str(tmp_path), *kinds]
    done = subprocess.run(command, cwd=ROOT, timeout=120, check=True, capture_output=True, text=True)
    assert done.stdout.split() == ["chunk", "True", "fixed_views", "True"]
    store = LocalStore(tmp_path)
    assert leftovers(tmp_path) == []
    for kind in kinds:
        store.verify(store.commit(address(kind), kind, make(kind)))


def test_an_artifact_that_goes_away_while_it_is_read(tmp_path: Path) -> None:
    store = LocalStore(tmp_path)
    artifact = store.commit(address(), "evaluation", make("evaluation"))
    store.discard(artifact)
    with pytest.raises(ArtifactCorruptError, match="missing"):
        store.read(artifact)
