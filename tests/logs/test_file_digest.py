"""Digests of a log's files: remembered while a file stays as it is, and not without bound."""

from __future__ import annotations

import os
from pathlib import Path

from genre_tasks.logs import file_digest
from genre_tasks.logs.file_digest import digest_files


def test_a_file_is_read_again_once_it_changes_and_few_are_remembered(tmp_path: Path) -> None:
    file = tmp_path / "a"
    file.write_bytes(b"one")
    before = digest_files(tmp_path, [file], [])
    hits = file_digest._hash_content.cache_info().hits
    assert digest_files(tmp_path, [file], []) == before
    known = file_digest._hash_content.cache_info()
    assert known.hits == hits + 1 and known.maxsize is not None
    file.write_bytes(b"two")
    os.utime(file, ns=(1, 1))
    assert digest_files(tmp_path, [file], []) != before
