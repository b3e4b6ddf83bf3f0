"""Digests of a log's files: remembered while they stay as they are, however many they are, and not without bound."""

from __future__ import annotations

import functools
import hashlib
import os
from pathlib import Path

import pytest

from genre_tasks.logs import file_digest
from genre_tasks.logs.file_digest import digest_files
from genre_tasks.logs.findings import Finding

WARNING = Finding("word", "warning", "message")


@pytest.fixture
def read_files(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the files whose content is read; the content of two files is remembered."""
    names: list[str] = []
    hash_content = file_digest._hash_content.__wrapped__

    def count(path: str, size: int, mtime_ns: int) -> str:
        names.append(Path(path).name)
        return str(hash_content(path, size, mtime_ns))

    monkeypatch.setattr(file_digest, "_hash_content", functools.lru_cache(maxsize=2)(count))
    monkeypatch.setattr(file_digest, "_known_digests", file_digest._KnownDigests())
    return names


def write_files(folder: Path, count: int) -> list[Path]:
    files = [folder / f"{number}.bin" for number in range(count)]
    for file in files:
        file.write_bytes(file.name.encode())
    return files


def test_a_digest_is_of_names_sizes_contents_and_warnings(tmp_path: Path) -> None:
    """Stored results are found by it: it must stay as it is."""
    files = write_files(tmp_path, 2)
    lines = [f"{file.name}\0005\0{hashlib.sha256(file.name.encode()).hexdigest()}\n" for file in files]
    expected = hashlib.sha256("".join([*lines, "word\0message\n"]).encode()).hexdigest()
    for _ in range(2):
        assert digest_files(tmp_path, reversed(files), [WARNING, Finding("a", "note", "b")]) == expected
    assert digest_files(tmp_path, files, []) != expected


def test_a_log_of_more_files_than_are_remembered_is_read_once(tmp_path: Path, read_files: list[str]) -> None:
    files = write_files(tmp_path, 5)
    before = digest_files(tmp_path, files, [])
    for _ in range(3):
        assert digest_files(tmp_path, files, []) == before
    assert read_files == [file.name for file in files]
    files[3].write_bytes(b"other")
    os.utime(files[3], ns=(1, 1))
    assert digest_files(tmp_path, files, []) != before


def test_a_file_that_changes_is_read_again_alone(tmp_path: Path, read_files: list[str]) -> None:
    files = write_files(tmp_path, 2)
    before = digest_files(tmp_path, files, [])
    files[0].write_bytes(b"other")
    os.utime(files[0], ns=(1, 1))
    assert digest_files(tmp_path, files, []) != before
    assert read_files == ["0.bin", "1.bin", "0.bin"]


def test_a_link_that_leads_elsewhere_is_another_file(tmp_path: Path, read_files: list[str]) -> None:
    first, second = write_files(tmp_path, 2)
    for file in (first, second):
        os.utime(file, ns=(1, 1))
    (tmp_path / "link").symlink_to(first)
    before = digest_files(tmp_path, [tmp_path / "link"], [])
    (tmp_path / "link").unlink()
    (tmp_path / "link").symlink_to(second)
    assert digest_files(tmp_path, [tmp_path / "link"], []) != before


def test_a_file_that_cannot_be_read_is_tried_again(
    tmp_path: Path, read_files: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    files = write_files(tmp_path, 2)

    def refuse(path: str, size: int, mtime_ns: int) -> str:
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as patch:
        patch.setattr(file_digest, "_hash_content", refuse)
        refused = digest_files(tmp_path, files, [])
    assert digest_files(tmp_path, files, []) != refused
    assert read_files == ["0.bin", "1.bin"]


def test_few_digests_are_remembered(tmp_path: Path, read_files: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(file_digest, "_MAX_KNOWN_DIGESTS", 2)
    for file in write_files(tmp_path, 4):
        digest_files(tmp_path, [file], [])
    assert len(file_digest._known_digests._digests) == 2
    assert file_digest._hash_content.cache_info().maxsize is not None
